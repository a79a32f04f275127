"""Repeat a run from its log, without DDS, in another process."""

import json
import subprocess
import sys

from support.logs import recorded_inputs, state_hashes
from support.node import child_environment
from xpbd_ros.log.reader import LogReader


def repeated(run, folder) -> dict[int, int]:
    """Return the hashes of a log's inputs applied to a log's scene by ``xpbd_ros run``."""
    (folder / 'scene.yaml').write_text(LogReader(run).scene)
    last = max(state_hashes(run))
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'run', folder / 'scene.yaml', '--commands', run,
         '-o', folder / 'again', '--json', '-'],
        env=child_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['refused'] == 0
    assert json.loads(done.stdout)['commands']['identical']
    assert json.loads(done.stdout)['frames'] == last
    assert recorded_inputs(folder / 'again') == recorded_inputs(run)
    return state_hashes(folder / 'again')
