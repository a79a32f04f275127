"""The textbook solver is what a paper prints: right where things are easy."""

import numpy as np
import pytest

from xpbd_ros.study.stress.textbook import advance, Model, PLANE

pytestmark = pytest.mark.slow    # its one kernel is among those that compile longest
G = 9.80665


def model(n: int = 2, *, edges=((0, 1),), rest=0.1, alpha=1e-3, **changes) -> Model:
    """Return some particles of 0.1 kg, joined by edges."""
    count = len(edges)
    found = Model(
        np.full(n, 0.1), np.array(edges).reshape(-1, 2), np.full(count, rest),
        np.full(count, alpha), np.zeros((0, 4), np.int64), np.zeros(0), np.zeros(0),
        np.zeros((0, 4), np.int64), np.zeros(0), np.zeros((0, 3), np.int64),
        np.zeros(0, np.int64), np.zeros((0, 3)), 0.0, 0.0, 0.0, np.array([0.0, 0.0, -G]))
    return found._replace(**changes)


def hang(model, x, frames, *, w=None, pinned=(), substeps=20, damped=True):
    """Advance, the first particle pinned, and return positions and velocities."""
    v, w = np.zeros_like(x), np.array([0.0, *[10.0] * (len(x) - 1)]) if w is None else w
    centre, air = np.zeros((len(model.kind), 3)), np.zeros(4)
    for _ in range(frames):
        advance(model, x, v, w, np.zeros(0, np.int64), np.zeros((0, 3)), centre, air, 1 / 60,
                substeps, 1)
        v *= 0.9 if damped else 1.0
    return x, v


def test_a_mass_stretches_an_edge_by_weight_times_compliance():
    x, v = hang(model(), np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.1]]), 400)
    assert x[1, 2] == pytest.approx(-0.1 - 0.1 * G * 1e-3, rel=1e-9)
    assert np.abs(v).max() < 1e-6


def test_what_is_shorter_than_its_guard_is_left_alone():
    """So coincident particles stay so: one of the things that the hard cases find."""
    x, _ = hang(model()._replace(gravity=np.zeros(3)), np.zeros((2, 3)), 10)
    assert (x == 0.0).all()


def test_a_plane_holds_what_falls_on_it():
    table = model(1, edges=np.zeros((0, 2), np.int64), kind=np.array([PLANE]),
                  size=np.array([[0.0, 0.0, 1.0]]), thickness=0.01)
    x, _ = hang(table, np.array([[0.0, 0.0, 0.5]]), 120, w=np.array([10.0]), damped=False)
    assert x[0, 2] == pytest.approx(0.01, abs=1e-9)
