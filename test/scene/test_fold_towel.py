"""The scene fold_towel: two grippers fold a towel twice, the second time by two layers of it."""

import numpy as np
import pytest

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.study.stress.crossings import crossings

FINGERS = [f'pad_force_{side}_{finger}_n' for side in ('left', 'right')
           for finger in ('upper', 'lower')]


@pytest.mark.slow
@pytest.mark.parametrize('resolution', [[31, 43], [41, 57]])
def test_the_towel_lies_folded_in_four_and_at_rest(resolution):
    simulation = compile_scene(load_scene('fold_towel', {
        'cloths.towel.grid.resolution': resolution}))
    [cloth] = simulation.cloths
    for k in range(540):
        frame = simulation.step()
        stats = simulation.stats()
        press = [stats[name] for name in FINGERS]
        if 36 <= k < 156 or 312 <= k < 426:    # one layer, two layers
            assert min(press) > 0.5
        if k == 280:    # folded once, of 0.4 m x 0.56 m
            assert 0.19 < np.ptp(frame.x[:, 0]) < 0.27
            assert np.ptp(frame.x[:, 1]) > 0.53
        assert stats['self_squeezed'] == stats['contacts_squeezed'] == 0
    assert press == [0.0] * 4
    across, along, high = np.ptp(frame.x, axis=0)
    assert 0.19 < across < 0.27
    assert 0.27 < along < 0.36
    assert 0.009 < high < 0.05    # four layers of 3 mm
    assert frame.x[:, 2].min() > 0.002
    assert np.abs(frame.v).max() < 0.2
    assert crossings(frame.x, cloth.mesh.triangles) == 0
