"""The scenes that are installed with the package, as test parameters."""

from importlib.util import find_spec

import pytest

from xpbd_ros.share import shipped_scenes

NAMES = list(shipped_scenes())
WITH_MESHIO = pytest.mark.skipif(find_spec('meshio') is None,
                                 reason="meshio is missing: pip install '.[mesh]'")
"""Whole files take it as ``pytestmark``: where launch_testing is about, which imports files of
tests to look into them, one that skips itself at its import skips all."""


def each_scene(*, slow=(), without=()):
    """Return a mark that runs a test with the name of every scene, or all but a few."""
    return pytest.mark.parametrize('name', [pytest.param(name, marks=[
        *[pytest.mark.slow] * (name in slow), *[WITH_MESHIO] * (name == 'softbox')])
        for name in NAMES if name not in without])
