"""The shipped robot over DDS: joint states close its fingers on a cloth, lift it, lay it down."""

import json
import subprocess
import sys

import numpy as np
import pytest

from support.logs import recorded_inputs
from support.node import child_environment, Cloth, points
from xpbd_ros.share import share_folder

pytest.importorskip('yourdfpy', reason="yourdfpy is missing: pip install '.[robot]'")
ROBOTS = share_folder() / 'robots'
CENTRE = 4, 4


def test_a_gripper_picks_up_a_cloth_and_lays_it_down(start, peer, tmp_path):
    run = tmp_path / 'run'
    cloth = Cloth(peer, start(scene=ROBOTS / 'robot.yaml', record__path=str(run)))
    cloth.node.wait_for("robot 'arm': follows joint_states")
    cloth.node.wait_for('running')
    with subprocess.Popen([sys.executable, str(ROBOTS / 'two_finger_motion.py')],
                          env=child_environment()) as motion:
        try:
            def held() -> bool:
                return bool(cloth.pins) and cloth.pins[-1].joint_names == ['arm_gripper']

            def centre() -> np.ndarray:
                return points(cloth.clouds[-1])[CENTRE]
            peer.until(held, 'the grasp')
            assert centre() == pytest.approx([0.0, 0.0, 0.004], abs=5e-3)
            assert cloth.status()['colliders'] == '4'
            peer.until(lambda: centre()[2] > 0.2, 'the lift')
            corners = points(cloth.clouds[-1])[[0, 0, -1, -1], [0, -1, 0, -1]]
            assert corners[:, 2].max() < centre()[2] - 0.05, 'it hangs'
            peer.until(lambda: not held(), 'the release')
            peer.until(lambda: np.ptp(points(cloth.clouds[-1])[..., 2]) < 0.1, 'rest')
        finally:
            motion.kill()
    final = points(cloth.clouds[-1])
    assert final[CENTRE][0] == pytest.approx(0.2, abs=0.03)
    assert final[..., 2].min() > 0.0
    assert not cloth.node.said('refused'), cloth.node.lines
    cloth.node.wait_for('silent for more than 1 s', 'collider arm_palm held')
    assert cloth.node.end() == 0
    assert {topic for _, topic in recorded_inputs(run)} == {
        'pins', 'pin_targets', 'colliders', 'collider_states'}
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'run', ROBOTS / 'robot.yaml', '--commands', run,
         '-o', tmp_path / 'again', '--json', '-'],
        env=child_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    numbers = json.loads(done.stdout)
    assert numbers['commands']['identical']
    assert any('arm_palm (palm)' in note for note in numbers['notes'])
