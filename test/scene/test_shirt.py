"""The scene shirt: fingers lift a T-shirt by friction alone, lay it down and fold it once."""

import numpy as np
import pytest

from support.crossings import crossings
from support.meshes import file_of
from support.shirt import HEM, NECK, shirt, SHOULDER
from support.tiers import slow
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.study.prediction import check

FINGERS = [f'{side}_{finger}' for side in ('left', 'right') for finger in ('upper', 'lower')]
LIFTED, LAID, CLOSED, OPEN = 132, 234, 24, 360
"""frames: the shirt hangs, and lies on the table; the fingers have closed, and open"""
THICKNESS = 0.003


@pytest.mark.parametrize('spacing', [0.04, slow(0.0125)])
def test_the_shirt_is_lifted_laid_down_and_folded(spacing):
    vertices, triangles = shirt(spacing)
    simulation = compile_scene(load_scene('shirt', {
        'cloths.shirt.mesh.file': file_of(vertices, triangles)}))
    assert not simulation.frame().pins
    hem = vertices[:, 1] == HEM[1]
    shoulders = vertices[:, 1] >= SHOULDER[1]
    lower = vertices[:, 1] < 0.3
    chest = (np.abs(vertices[:, :2] - (0.0, 0.51)) < (0.2, 0.06)).all(1)
    high = on_table = None
    for k in range(1, 451):
        frame = simulation.step()
        x, stats = frame.x, simulation.stats()
        assert np.isfinite(x).all()
        assert np.isfinite(frame.v).all()
        beside = (np.abs(x[:, :2] - (0.0, 0.08)) > (0.5, 0.53)).any(1)
        assert x[~beside, 2].min() > 0.9 * THICKNESS    # pads may press cloth into the table
        assert not stats['self_without_room']
        place = {side: x - frame.colliders[f'{side}_upper'].pose.position
                 for side in ('left', 'right')}
        if k == CLOSED:
            held = {side: (np.abs(at) < (0.03, 0.015, 0.012)).all(1)
                    for side, at in place.items()}
            gripped = {side: at[held[side]] for side, at in place.items()}
        if CLOSED <= k < OPEN - 6:
            assert min(stats[f'pad_force_{name}_n'] for name in FINGERS) > 0.5
            slip = [np.median(np.abs(at[held[side]] - gripped[side]).max(1))
                    for side, at in place.items()]
            assert max(slip) < 0.003
        if k == LIFTED:
            assert x[:, 2].min() > 0.05
            high = np.ptp(x[:, 2])
        if k == LAID:
            on_table = x.copy()
    assert high > 0.9 * (SHOULDER[1] - HEM[1])
    length = np.ptp(on_table[:, 1])
    assert length > 0.85 * NECK[1]
    assert np.quantile(on_table[:, 2], 0.9) < 0.05
    assert not any(stats[f'pad_force_{name}_n'] for name in FINGERS)
    assert np.ptp(x[:, 1]) < 0.65 * length
    assert np.abs(x[hem] - on_table[hem]).max() < 0.05
    assert np.linalg.norm(x[shoulders, :2] - on_table[shoulders, :2], axis=1).min() > 0.4
    away = np.linalg.norm(x[chest, None, :2] - x[None, lower, :2], axis=2)
    assert away.min(1).max() < spacing
    assert (x[chest, 2] - x[lower, 2][away.argmin(1)]).min() > 0.9 * THICKNESS
    assert np.linalg.norm(frame.v, axis=1).mean() < 0.05
    assert crossings(x, triangles) == crossings(on_table, triangles) == 0


@pytest.mark.slow
def test_check_says_that_the_shirt_is_soft_and_slow():
    """A mesh has no lines, and twice as many substeps would cost twice the time."""
    warp, weft, frame = check(load_scene('shirt')).warnings
    assert warp.startswith('shirt at 16 substeps behaves like 42.')
    assert weft.startswith('shirt at 16 substeps behaves like 42.')
    assert frame.startswith('a frame takes about ')
