"""``resim`` of every shipped scene: the same bits with other threads and vector widths."""

import json
import subprocess
import sys

import pytest

from support.node import child_environment
from support.shipped_scenes import NAMES, WITH_MESHIO

DURATION = '0.2'
"""of each run [s]"""


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


@pytest.mark.slow    # test_resim has other threads in the quick tier, test_solver other widths
@pytest.mark.parametrize(('threads', 'bits'), [('2', None), ('1', '256'), ('2', '128')])
@pytest.mark.parametrize('name', [
    pytest.param(name, marks=[WITH_MESHIO] * (name == 'softbox')) for name in NAMES])
def test_each_scene_is_solved_again_bit_for_bit(log_of, name, threads, bits):
    found = verb('resim', log_of(name), '--threads', threads, bits=bits)
    assert found['identical'], found
    assert found['frames'] == 13
