"""``resim`` of every shipped scene: the same bits with other threads and vector widths."""

import json
import subprocess
import sys

import pytest

from support.node import child_environment
from support.shipped_scenes import NAMES, WITH_MESHIO
from support.tiers import slow

DURATION = '0.2'
"""of each run [s]"""
QUICK = 'sheet'
"""the scene of the quick tier, whose kernels compile fast"""


def verb(*words: str, bits: str | None = None) -> dict:
    """Return the JSON of a verb in a process of its own; ``bits``: width of vectors."""
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', *words, '--json', '-'], capture_output=True, text=True,
        env={**child_environment(), **({} if bits is None else {'XPBD_ROS_VECTOR_BITS': bits})})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope='module')
def log_of(tmp_path_factory):
    """Return a function that returns the log of a scene, recorded once."""
    logs = {}

    def log_of(name: str) -> str:
        if name not in logs:
            logs[name] = str(tmp_path_factory.mktemp('runs') / name)
            verb('run', name, '--duration', DURATION, '-o', logs[name])
        return logs[name]
    return log_of


def cases() -> list:
    """Return (scene, threads, vector width) as parameters; one is in the quick tier."""
    found = []
    for name in NAMES:
        for threads, bits in (('2', None), ('1', '256'), ('2', '128')):
            if (name, bits) == (QUICK, None):
                found.append(pytest.param(name, threads, bits))
                continue
            case = slow(name, threads, bits)
            found.append(pytest.param(*case.values, marks=[
                *case.marks, *[WITH_MESHIO] * (name == 'softbox')]))
    return found


@pytest.mark.parametrize(('name', 'threads', 'bits'), cases())
def test_each_scene_is_solved_again_bit_for_bit(log_of, name, threads, bits):
    found = verb('resim', log_of(name), '--threads', threads, bits=bits)
    assert found['identical'], found
    assert found['frames'] == 13
