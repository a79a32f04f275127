"""The scene shirt: fingers lift a T-shirt by friction alone, lay it down and fold it once."""

import numpy as np
import pytest

from support.meshes import file_of
from support.shirt import HEM, NECK, shirt, SHOULDER
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.study.prediction import check
from xpbd_ros.study.stress.crossings import crossings

FINGERS = [f'{side}_{finger}' for side in ('left', 'right') for finger in ('upper', 'lower')]
LIFTED, LAID, CLOSED, OPEN = 132, 234, 24, 360
"""frames: the shirt hangs, and lies on the table; the fingers have closed, and open"""
THICKNESS = 0.003


class Shirt:
    """The scene with a mesh of its own, checked in every frame."""

    def __init__(self, spacing: float):
        """Build the scene with a shirt of edges of this length [m]."""
        self.vertices, self.triangles = shirt(spacing)
        self.simulation = compile_scene(load_scene('shirt', {
            'cloths.shirt.mesh.file': file_of(self.vertices, self.triangles)}))
        assert not self.simulation.frame().pins

    def run(self, frames: range):
        """Step, and return the last frame; while the fingers are closed, they hold the shirt."""
        for k in frames:
            frame = self.simulation.step()
            x, stats = frame.x, self.simulation.stats()
            assert np.isfinite(x).all()
            assert np.isfinite(frame.v).all()
            beside = (np.abs(x[:, :2] - (0.0, 0.08)) > (0.5, 0.53)).any(1)
            assert x[~beside, 2].min() > 0.9 * THICKNESS    # pads may press cloth into the table
            assert not stats['self_without_room']
            place = {side: x - frame.colliders[f'{side}_upper'].pose.position
                     for side in ('left', 'right')}
            if k == CLOSED:
                self.held = {side: (np.abs(at) < (0.03, 0.015, 0.012)).all(1)
                             for side, at in place.items()}
                self.gripped = {side: at[self.held[side]] for side, at in place.items()}
            if CLOSED <= k < OPEN - 6:
                assert min(stats[f'pad_force_{name}_n'] for name in FINGERS) > 0.5
                slip = [np.median(np.abs(at[self.held[side]] - self.gripped[side]).max(1))
                        for side, at in place.items()]
                assert max(slip) < 0.003
        return frame

    def lift_and_lay_down(self) -> np.ndarray:
        """Return the positions on the table [m]."""
        hanging = self.run(range(1, LIFTED + 1)).x
        assert hanging[:, 2].min() > 0.05
        assert np.ptp(hanging[:, 2]) > 0.9 * (SHOULDER[1] - HEM[1])
        on_table = self.run(range(LIFTED + 1, LAID + 1)).x
        assert np.ptp(on_table[:, 1]) > 0.85 * NECK[1]
        assert np.quantile(on_table[:, 2], 0.9) < 0.05
        assert crossings(on_table, self.triangles) == 0
        return on_table


@pytest.mark.slow
def test_a_coarse_shirt_is_lifted_and_laid_down():
    Shirt(0.04).lift_and_lay_down()


def heights(points, triangles):
    """Return each point's height over each triangle, NaN where it is not over or below it."""
    def cross(p, q):
        return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    u, v, w = b - a, c - a, points[:, None] - a
    s, t = cross(w, v) / cross(u, v), cross(u, w) / cross(u, v)
    over = (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
    return np.where(over, w[..., 2] - s * u[:, 2] - t * v[:, 2], np.nan)


@pytest.mark.slow
def test_the_shirt_is_lifted_laid_down_and_folded():
    """The lower part covers the chest, less 15 % where a sleeve comes to lie in the fold."""
    spacing = 0.0125
    case = Shirt(spacing)
    vertices, on_table = case.vertices, case.lift_and_lay_down().copy()
    frame = case.run(range(LAID + 1, 451))
    x, stats = frame.x, case.simulation.stats()
    hem = vertices[:, 1] == HEM[1]
    shoulders = vertices[:, 1] >= SHOULDER[1]
    lower = vertices[:, 1] < 0.3
    chest = (np.abs(vertices[:, :2] - (0.0, 0.51)) < (0.2, 0.06)).all(1)
    assert not any(stats[f'pad_force_{name}_n'] for name in FINGERS)
    assert np.ptp(x[:, 1]) < 0.65 * np.ptp(on_table[:, 1])
    assert np.abs(x[hem] - on_table[hem]).max() < 0.05
    assert np.linalg.norm(x[shoulders, :2] - on_table[shoulders, :2], axis=1).min() > 0.4
    height = heights(x[chest], x[case.triangles[lower[case.triangles].all(1)]])
    assert np.isfinite(height).any(1).mean() > 0.85
    assert np.nanmin(height) > 0.9 * THICKNESS
    assert np.linalg.norm(frame.v, axis=1).mean() < 0.05
    assert crossings(x, case.triangles) == 0


@pytest.mark.slow
def test_check_says_that_the_shirt_is_slow():
    [frame] = check(load_scene('shirt')).warnings
    assert frame.startswith('a frame takes about ')
