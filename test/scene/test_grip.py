"""The scene grip: soft fingers hold a towel's corner by friction alone, and let it go."""

import numpy as np
import pytest

from support.tiers import slow
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene


@pytest.mark.parametrize('method, integrator, substeps', [
    ('line', 'ndf2', 23), slow('gauss_seidel', 'backward_euler', 30),
    slow('gauss_seidel_symmetric', 'bdf2', 40), slow('jacobi', 'backward_euler', 60),
    slow('explicit', 'leapfrog', 80)])
def test_the_corner_stays_between_the_fingers_until_they_open(method, integrator, substeps):
    simulation = compile_scene(load_scene('grip', {'solver': {
        'method': method, 'integrator': integrator, 'substeps': substeps}}))
    assert not simulation.frame().pins
    for k in range(264):
        frame = simulation.step()
        stats = simulation.stats()
        press = stats['pad_force_upper_n'], stats['pad_force_lower_n']
        place = frame.x - frame.colliders['upper'].pose.position
        if k == 29:    # closed
            within = (np.abs(place[:, 0]) < 0.018) & (np.abs(place[:, 1]) < 0.013)
            held = place[within].copy()
            assert len(held) >= 4
        if 29 <= k < 215:
            assert min(press) > 5.0
            assert np.abs(place[within] - held).max() < 5e-4
        if k == 72:    # lifted; its diagonal is 0.42 m long
            assert frame.x[within, 2].min() > 0.35
            assert frame.x[:, 2].max() < 0.4
    assert press == (0.0, 0.0)
    assert np.abs(frame.x[within, 2]).max() < 0.03
    assert (frame.x[:, 0] < 0.07).all()
    assert np.linalg.norm(place[within], axis=1).min() > 0.04
