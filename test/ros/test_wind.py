"""The wind over DDS: it acts from the next frame on, is recorded, and blows again from the log."""

import json
import subprocess
import sys

from geometry_msgs.msg import Vector3, Vector3Stamped
import pytest

from support.logs import recorded_inputs, state_hashes
from support.node import child_environment, Cloth

SCENE = """
gravity: [0.0, 0.0, 0.0]
cloths:
  kite:
    grid: {size: [0.4, 0.4], resolution: [5, 5]}
    density: 0.1
    effects:
      stretch: {warp: 500.0, weft: 500.0}
effects:
  wind: {velocity: [0.0, 0.0, 0.0]}
  pin: {}
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 4}
"""


def wind(x=0.0, y=0.0, z=0.0, frame_id='') -> Vector3Stamped:
    """Return a message for ~/wind."""
    message = Vector3Stamped(vector=Vector3(x=x, y=y, z=z))
    message.header.frame_id = frame_id
    return message


def test_wind_acts_from_the_next_frame_on_and_repeats(start, peer, tmp_path):
    (tmp_path / 'kite.yaml').write_text(SCENE)
    run = tmp_path / 'run'
    cloth = Cloth(peer, start(scene=tmp_path / 'kite.yaml', mode='lockstep',
                              publish_clock='true'))
    cloth.meet(wind=wind())
    cloth.restart(record__path=str(run))
    cloth.meet()
    still = cloth.step()
    assert not cloth.cloud(still)[..., 2].any()
    cloth.peer.say('/cloth/wind', wind(z=4.0))
    cloth.step()
    cloth.peer.say('/cloth/wind', wind(z=float('nan')))
    cloth.node.wait_for('/cloth/wind: refused: vector is not finite')
    cloth.step()
    cloth.peer.say('/cloth/wind', wind(z=2.0))
    frame = cloth.step(5)
    rise = cloth.cloud(frame)[..., 2]
    assert rise.min() > 0.0
    assert cloth.cloud(frame)[..., 0] == pytest.approx(cloth.cloud(still)[..., 0], abs=0.02)
    assert cloth.record(False) == (True, str(run))
    assert {topic for _, topic in recorded_inputs(run)} == {'wind'}
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'run', tmp_path / 'kite.yaml', '--commands', run,
         '--duration', repr(frame / 60.0), '-o', tmp_path / 'again', '--json', '-'],
        env=child_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['refused'] == 0
    assert state_hashes(tmp_path / 'again') == state_hashes(run)
    assert len(set(state_hashes(run).values())) > 4
