"""The angle of a plane vector, lane by lane: as exact as the library's, on every side."""

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes, load, store
from xpbd_ros.sim.constraints.atan2 import angle_of


@jit
def angles(s, c, found):
    for q in range(0, len(s), lanes(s)):
        store(found, q, angle_of(load(s, q), load(c, q)))


def measured(s, c, dtype=np.float64):
    s, c = (np.ascontiguousarray(np.broadcast_to(v, 4096), dtype) for v in (s, c))
    found = np.zeros(4096, dtype)
    angles(s, c, found)
    return found


def test_it_is_exact_to_four_ulp_all_around():
    turn = np.linspace(-np.pi, np.pi, 4096)
    for size, dtype in ((1.0, np.float64), (1e-150, np.float64), (1e150, np.float64),
                        (1.0, np.float32)):
        s, c = (size * np.sin(turn)).astype(dtype), (size * np.cos(turn)).astype(dtype)
        expected = np.arctan2(s.astype(float), c.astype(float))
        error = np.abs(measured(s, c, dtype) - expected)
        assert (error <= 4.0 * np.spacing(np.abs(expected).astype(dtype))).all()


def test_small_angles_keep_all_their_digits():
    s = np.geomspace(1e-300, 1e-3, 4096)
    np.testing.assert_allclose(measured(s, 1.0), np.arctan2(s, 1.0), rtol=4e-16)


def test_the_axes_and_nothing():
    for s, c, expected in ((0, 1, 0), (1, 0, np.pi / 2), (-1, 0, -np.pi / 2), (0, -1, np.pi),
                           (1, 1, np.pi / 4), (-1, -1, -3 * np.pi / 4), (0, 0, 0)):
        assert measured(s, c)[0] == expected
