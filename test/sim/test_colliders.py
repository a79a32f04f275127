"""Signed distances and normals of the shapes, against brute force."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from xpbd_ros.sim.contact.colliders import (
    BOX,
    CAPSULE,
    Colliders,
    CYLINDER,
    PLANE,
    reach,
    SPHERE,
    to_local,
    to_world,
    write_pose,
)
from xpbd_ros.sim.contact.signed_distance import shape_distance, signed_distance
from xpbd_ros.sim.contact.wrenches import work_of_colliders

RADIUS, HALF = 0.3, 0.5
SIZES = {SPHERE: (RADIUS, 0.0, 0.0), CAPSULE: (RADIUS, HALF, 0.0), CYLINDER: (RADIUS, HALF, 0.0),
         BOX: (0.3, 0.5, 0.2)}
SHAPES = pytest.mark.parametrize('shape', SIZES)
SPACING = 0.01


def one_collider(shape, size, start, goal):
    """Return colliders with room for one, and one."""
    return Colliders(np.array([1]), np.array([shape]), np.array([size]), np.array([-1.0]),
                     np.array([np.inf]),
                     np.array([start]), np.array([goal]), np.array([start != goal]),
                     np.zeros((1, 6)), np.zeros(1, np.bool_), None, None, None, None)


def distance(shape, size, points):
    """Return φ and the normals at many points."""
    found = np.array([shape_distance(shape, *map(float, size), *p) for p in points.tolist()])
    return found[:, 0], found[:, 1:]


def surface(shape):
    """Return points on a shape's surface, no further than SPACING from any other place on it."""
    turn = np.arange(0.0, 2.0 * np.pi, SPACING / RADIUS)
    along = np.linspace(-HALF, HALF, round(2.0 * HALF / SPACING) + 1)
    if shape in (SPHERE, CAPSULE):
        latitude = np.linspace(-np.pi / 2, np.pi / 2, round(np.pi * RADIUS / SPACING) + 1)
        b, a = np.meshgrid(latitude, turn)
        ball = RADIUS * np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)],
                                 -1).reshape(-1, 3)
        if shape == SPHERE:
            return ball
        z, a = np.meshgrid(along, turn)
        side = np.stack([RADIUS * np.cos(a), RADIUS * np.sin(a), z], -1).reshape(-1, 3)
        return np.concatenate([side, *(ball[sign * ball[:, 2] >= 0.0] + [0.0, 0.0, sign * HALF]
                                       for sign in (1.0, -1.0))])
    if shape == CYLINDER:
        z, a = np.meshgrid(along, turn)
        side = np.stack([RADIUS * np.cos(a), RADIUS * np.sin(a), z], -1).reshape(-1, 3)
        r, a = np.meshgrid(np.linspace(0.0, RADIUS, round(RADIUS / SPACING) + 1), turn)
        disc = np.stack([r * np.cos(a), r * np.sin(a), np.full(r.shape, HALF)], -1).reshape(-1, 3)
        return np.concatenate([side, disc, disc * [1.0, 1.0, -1.0]])
    faces = []
    half = np.array(SIZES[BOX])
    for axis, sign in product(range(3), (1.0, -1.0)):
        u, v = (np.linspace(-h, h, round(2.0 * h / SPACING) + 1) for h in np.delete(half, axis))
        u, v = (c.ravel() for c in np.meshgrid(u, v))
        faces.append(np.insert(np.stack([u, v]), axis, sign * half[axis], axis=0).T)
    return np.concatenate(faces)


def inside(shape, p):
    """Tell which points lie inside, from the definition of each shape."""
    r, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
    if shape == SPHERE:
        return np.linalg.norm(p, axis=1) < RADIUS
    if shape == CYLINDER:
        return (r < RADIUS) & (np.abs(z) < HALF)
    if shape == BOX:
        return (np.abs(p) < SIZES[BOX]).all(1)
    ends = [np.linalg.norm(p - [0.0, 0.0, sign * HALF], axis=1) < RADIUS for sign in (1.0, -1.0)]
    return ((r < RADIUS) & (np.abs(z) < HALF)) | ends[0] | ends[1]


@SHAPES
def test_the_distance_is_to_the_nearest_point_of_the_surface(shape):
    points = np.random.default_rng(shape).uniform(-1.2, 1.2, (2000, 3))
    phi, _ = distance(shape, SIZES[shape], points)
    nearest, _ = cKDTree(surface(shape)).query(points)
    assert (nearest >= np.abs(phi) - 1e-12).all()
    assert (nearest <= np.abs(phi) + SPACING).all()
    np.testing.assert_allclose(distance(shape, SIZES[shape], surface(shape))[0], 0.0, atol=1e-15)
    np.testing.assert_array_equal(phi < 0.0, inside(shape, points))


@SHAPES
def test_the_normal_is_the_gradient_of_the_distance(shape):
    points = np.random.default_rng(shape).uniform(-1.2, 1.2, (500, 3))
    phi, normal = distance(shape, SIZES[shape], points)
    step = 1e-6
    gradient = np.stack([(distance(shape, SIZES[shape], points + step * axis)[0]
                          - distance(shape, SIZES[shape], points - step * axis)[0]) / (2.0 * step)
                         for axis in np.eye(3)], -1)
    smooth = np.linalg.norm(gradient, axis=1) > 1.0 - 1e-6    # else on a medial plane
    assert smooth.mean() > 0.99
    np.testing.assert_allclose(normal[smooth], gradient[smooth], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-14)


def test_a_plane_is_what_lies_below_z():
    assert shape_distance(PLANE, 0.0, 0.0, 0.0, 3.0, -2.0, -0.7) == (-0.7, 0.0, 0.0, 1.0)


@pytest.mark.parametrize('shape, size, point, phi', [
    (SPHERE, (0.3, 0, 0), (0, 0, 0), -0.3),
    (SPHERE, (0.3, 0, 0), (1e-200, 0, 0), -0.3),
    (SPHERE, (0, 0, 0), (0, 0, 0), 0.0),
    (CAPSULE, (0.3, 0.5, 0), (0, 0, 0.2), -0.3),
    (CAPSULE, (0.3, 0.0, 0), (0, 0, 0), -0.3),
    (CAPSULE, (0.3, 0.0, 0), (0, 0.4, 0), 0.1),
    (CYLINDER, (0.3, 0.5, 0), (0, 0, 0), -0.3),
    (CYLINDER, (0.3, 0.5, 0), (0.3, 0, 0.5), 0.0),
    (CYLINDER, (0.5, 0.5, 0), (0, 0, 0), -0.5),
    (BOX, (0.3, 0.5, 0.2), (0.3, 0.5, 0.2), 0.0),
    (BOX, (0.3, 0.5, 0.2), (-0.3, 0.5, 0.0), 0.0),
    (BOX, (0.3, 0.5, 0.2), (0, 0, 0), -0.2),
    (BOX, (0.2, 0.2, 0.2), (0, 0, 0), -0.2),
    (BOX, (0.3, 0.5, 0.2), (0.6, 0.9, 0.2), 0.5)])
def test_the_normal_has_length_1_without_a_gradient_too(shape, size, point, phi):
    found, *normal = shape_distance(shape, *map(float, (*size, *point)))
    assert found == pytest.approx(phi, abs=1e-15)
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-15)


@SHAPES
def test_the_reach_is_the_radius_of_the_bounding_ball(shape):
    farthest = np.linalg.norm(surface(shape), axis=1).max()
    assert reach(shape, np.array(SIZES[shape])) == pytest.approx(farthest, rel=1e-12)
    assert reach(PLANE, np.zeros(3)) < 0.0


def test_poses_go_from_start_to_goal_and_axes_there_and_back():
    start, goal = Rotation.random(2, random_state=5)
    goal = Rotation.from_rotvec([0.0, 0.3, 0.1]) * start
    colliders = one_collider(SPHERE, (0.3, 0.0, 0.0), (0.0, 1.0, 2.0, *start.as_quat()),
                             (1.0, 1.0, 0.0, *goal.as_quat()))
    poses = np.zeros((1, 7))
    for s, position, turn in ((0.0, (0, 1, 2), start), (1.0, (1, 1, 0), goal),
                              (0.5, (0.5, 1, 1), Rotation.from_rotvec([0.0, 0.15, 0.05]) * start)):
        write_pose(colliders, 0, s, poses)
        np.testing.assert_allclose(poses[0, :3], position, atol=1e-15)
        point = (0.3, -0.4, 0.6)
        np.testing.assert_allclose(to_world(poses, 0, *point), turn.apply(point) + position,
                                   atol=1e-14)
        np.testing.assert_allclose(to_local(poses, 0, *to_world(poses, 0, *point)), point,
                                   atol=1e-14)


def test_a_pose_that_stays_is_written_bit_by_bit():
    pose = (0.1, 0.2, 0.3, *Rotation.from_rotvec([0.3, 0.2, 0.1]).as_quat())
    poses = np.zeros((1, 7))
    write_pose(one_collider(SPHERE, (0.3, 0.0, 0.0), pose, pose), 0, 0.3, poses)
    np.testing.assert_array_equal(poses[0], pose)


@SHAPES
def test_a_colliders_distance_is_that_of_its_shape(shape):
    pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    colliders = one_collider(shape, SIZES[shape], pose, pose)
    for p in np.random.default_rng(shape).uniform(-1.2, 1.2, (20, 3)).tolist():
        assert signed_distance(colliders, 0, *p) == shape_distance(shape, *SIZES[shape], *p)


def test_the_work_of_a_belt_is_bounded_also_where_its_body_moves_against_it():
    """Friction works with the speed of the surface, pushes with that of the pose."""
    dt, speed, impulse = 0.1, 2.0, np.array([[3.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    belt = one_collider(PLANE, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
                        (-speed * dt, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    belt.has_twist[0], belt.twist[0, 0] = True, speed
    assert work_of_colliders(impulse, belt, dt) >= 3.0 * speed
