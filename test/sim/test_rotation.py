"""Quaternions, against scipy's."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation, Slerp

from xpbd_ros.sim.geometry.quaternion import (
    conjugate,
    flow,
    from_z_axis,
    interpolate,
    multiply,
    rotate,
)


@pytest.fixture
def rotations():
    """Return some random rotations."""
    return Rotation.random(20, random_state=3)


def test_rotate_multiply_and_conjugate_agree_with_scipy(rotations):
    vector = np.array([0.3, -2.0, 0.7])
    for a, b in zip(rotations[:-1], rotations[1:]):
        p, q = a.as_quat().tolist(), b.as_quat().tolist()
        np.testing.assert_allclose(rotate(*p, *vector), a.apply(vector), atol=1e-14)
        assert abs(np.dot(multiply(p, q), (a * b).as_quat())) == pytest.approx(1.0, abs=1e-14)
        np.testing.assert_allclose(rotate(*conjugate(p), *a.apply(vector)), vector, atol=1e-14)


def test_interpolation_goes_the_short_way_and_stays_a_rotation(rotations):
    a = rotations[0]
    b = Rotation.from_rotvec([0.0, 0.4, 0.2]) * a
    p, q = a.as_quat(), b.as_quat()
    for sign in (1.0, -1.0):
        for s in np.linspace(0.0, 1.0, 11):
            found = interpolate(tuple(p), tuple(sign * q), s)
            assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-15)
            expected = Slerp([0.0, 1.0], Rotation.concatenate([a, b]))(s)
            assert (Rotation(found).inv() * expected).magnitude() < 2e-3    # of a turn of 0.45 rad
    assert (Rotation(interpolate(tuple(p), tuple(q), 0.5)).inv()
            * Slerp([0.0, 1.0], Rotation.concatenate([a, b]))(0.5)).magnitude() < 1e-15 ** 0.5


@pytest.mark.parametrize('normal', [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -3, 0), (1, 2, -3),
                                    (1e-9, 0, -1), (1e-200, 0, 1e-200), (0, 1e200, 1e200),
                                    (1e-160, 0, -1)])
def test_z_turns_to_any_direction(normal):
    q = from_z_axis(normal)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-14)
    unit = np.array(normal) / np.abs(normal).max()
    np.testing.assert_allclose(rotate(*q, 0.0, 0.0, 1.0), unit / np.linalg.norm(unit), atol=1e-14)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 0.1, 1.0, 3.0, 40.0])
def test_a_flow_is_the_exponential_of_its_twist(angle):
    random = np.random.default_rng(5)
    for _ in range(20):
        w, v = random.normal(size=(2, 3))
        w *= angle / np.linalg.norm(w)
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.cross(np.eye(3), w)
        twist[:3, 3] = v
        q, t = flow(tuple(w.tolist()), tuple(v.tolist()))
        expected = expm(twist)
        np.testing.assert_allclose(Rotation(q).as_matrix(), expected[:3, :3], atol=1e-12)
        np.testing.assert_allclose(t, expected[:3, 3], atol=1e-12)
