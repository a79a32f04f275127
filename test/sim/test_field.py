"""Signed distance fields of closed surfaces, against the shapes that they are of."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from support.meshes import BOX_FACES, box_surface, octahedral_ball
from xpbd_ros.errors import InputError
from xpbd_ros.sim.contact.colliders import BOX, Grids, Heights, SPHERE
from xpbd_ros.sim.contact.distance_field import distance_field
from xpbd_ros.sim.contact.signed_distance import grid_distance, ground_distance, shape_distance


def look_up(field, points):
    """Return φ and the normals at some points."""
    grids = Grids(field.values.ravel(), np.array([0]), np.array([field.values.shape]),
                  field.origin[None], np.array([field.spacing]), np.array([field.clearance]))
    found = np.array([grid_distance(grids, 0, *p) for p in points.tolist()])
    return found[:, 0], found[:, 1:]


def exact(shape, size, points):
    """Return φ and the normals of a shape."""
    found = np.array([shape_distance(shape, *size, *p) for p in points.tolist()])
    return found[:, 0], found[:, 1:]


def nodes(field):
    """Return the places of all nodes."""
    return field.origin + field.spacing * np.stack(np.meshgrid(
        *map(np.arange, field.values.shape), indexing='ij'), -1).reshape(-1, 3)


@pytest.mark.parametrize('half', [(0.3, 0.5, 0.2), (0.3, 0.3, 0.3)])
def test_at_the_nodes_of_a_box_it_is_exact_inside_and_outside(half):
    """Nodes on the diagonals of the faces, where rays hit two triangles, are included."""
    field = distance_field(*box_surface(*half), gap=0.01, spacing=0.031)
    expected, _ = exact(BOX, half, nodes(field))
    np.testing.assert_allclose(field.values.ravel(), expected, atol=1e-6)
    assert field.reach == pytest.approx(np.linalg.norm(half))


def test_the_normal_is_along_the_gradient_between_the_nodes():
    """The grid holds random values, and central differences give the gradient in each cell."""
    rng, step = np.random.default_rng(5), 1e-6
    field = SimpleNamespace(values=rng.normal(size=(4, 3, 5)), origin=np.array([0.1, -0.2, 0.3]),
                            spacing=0.5, clearance=1.0)
    points = field.origin + 0.5 * (rng.integers(0, [3, 2, 4], (200, 3))
                                   + rng.uniform(0.01, 0.99, (200, 3)))
    gradient = np.stack([look_up(field, points + way)[0] - look_up(field, points - way)[0]
                         for way in step * np.eye(3)], 1)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(look_up(field, points)[1], gradient, atol=1e-6)


def test_the_error_between_nodes_falls_with_the_spacing_squared():
    points = np.random.default_rng(2).uniform(-0.33, 0.33, (2000, 3))
    points = points[np.linalg.norm(points, axis=1) > 0.15]
    expected, normals = exact(SPHERE, (0.3, 0.0, 0.0), points)
    errors = []
    for spacing in (0.06, 0.03):
        phi, found = look_up(distance_field(*octahedral_ball(), gap=0.01, spacing=spacing), points)
        errors.append(np.abs(phi - expected).max())
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-12)
        assert np.linalg.norm(found - normals, axis=1).max() < 8.0 * spacing
    assert errors[1] < 0.4 * errors[0] < 0.1 * 0.06


def test_ground_has_its_tangent_plane_and_goes_on_beyond_its_rim():
    """The height field has 4 rows along y and 6 columns along x, and is 3 m by 1 m."""
    rng, half, step = np.random.default_rng(6), np.array([1.5, 0.5]), 1e-6
    table = rng.normal(size=(4, 6))
    heights = Heights(table.ravel(), np.array([0]), np.array([[6, 4]]))
    bilinear = RegularGridInterpolator((np.linspace(-0.5, 0.5, 4), np.linspace(-1.5, 1.5, 6)),
                                       table)
    points = rng.uniform(-2.0, 2.0, (500, 3))

    def height(x, y):
        return bilinear(np.stack([np.clip(y, -0.5, 0.5), np.clip(x, -1.5, 1.5)], -1))
    x, y, z = points.T
    up = np.stack([(height(x - step, y) - height(x + step, y)) / (2.0 * step),
                   (height(x, y - step) - height(x, y + step)) / (2.0 * step), np.ones(500)], 1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    found = np.array([ground_distance(heights, 0, *half, *p) for p in points.tolist()])
    np.testing.assert_allclose(found[:, 1:], up, atol=1e-6)
    np.testing.assert_allclose(found[:, 0], (z - height(x, y)) * up[:, 2], atol=1e-6)


def test_off_the_grid_it_is_never_more_than_the_distance():
    points = np.random.default_rng(3).uniform(-3.0, 3.0, (2000, 3))
    field = distance_field(*box_surface(), gap=0.01, spacing=0.05)
    expected, _ = exact(BOX, (0.3, 0.5, 0.2), points)
    phi, normals = look_up(field, points)
    out = expected > field.clearance + 0.2
    beyond = (np.abs(points) > 0.5 * field.spacing * (np.array(field.values.shape) - 1)).any(1)
    assert (phi[beyond] >= field.clearance).all()
    assert (phi <= expected + 0.02).all()
    assert (phi[out] > 0.1 * expected[out]).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)


def test_faces_may_be_flipped_doubled_or_overlap():
    rng = np.random.default_rng(4)
    vertices, faces = box_surface()
    soup = vertices[np.array([f[::-1] if rng.random() < 0.5 else f for f in faces])]
    again = distance_field(soup.reshape(-1, 3), np.arange(36).reshape(-1, 3), gap=0.01,
                           spacing=0.05)
    np.testing.assert_array_equal(
        again.values, distance_field(vertices, faces, gap=0.01, spacing=0.05).values)
    both = np.concatenate([vertices, vertices + [0.2, 0.0, 0.0]])
    field = distance_field(both, np.concatenate([faces, faces + 8]), gap=0.01, spacing=0.05)
    inside = (np.abs(nodes(field) - [0.1, 0.0, 0.0]) < [0.4, 0.5, 0.2]).all(1)
    phi = field.values.ravel()
    assert (inside == (phi < 0.0))[np.abs(phi) > 1e-6].all()
    assert inside.sum() > 500


@pytest.mark.parametrize('turn', [None, 1, 2])
@pytest.mark.parametrize('thick', [0.004, 0.01, 0.03])
def test_what_is_thin_has_a_grid_on_which_it_is_not_lost(thick, turn):
    """Each point halfway through a plate is inside, and its distance not far off."""
    turn = Rotation.identity() if turn is None else Rotation.random(random_state=turn)
    vertices, faces = box_surface(0.1, 0.08, 0.5 * thick)
    field = distance_field(turn.apply(vertices), faces, gap=0.01)
    points = np.random.default_rng(1).uniform(-0.07, 0.07, (500, 3)) * [1.0, 1.0, 0.0]
    phi, _ = look_up(field, turn.apply(points))
    assert phi.max() < -0.05 * thick
    assert field.spacing == 0.01 if thick > 0.02 else field.spacing < 0.01


def test_the_spacing_is_the_gap_unless_that_is_too_fine():
    assert distance_field(*box_surface(), gap=0.05).spacing == 0.05
    assert distance_field(*box_surface(), gap=0.001).spacing == pytest.approx(1.0 / 96.0)


@pytest.mark.parametrize('surface, text', [
    ((box_surface()[0], BOX_FACES[1:]),
     'is not closed (3 open edges), so it has no inside; close it, or use a box'),
    ((box_surface()[0], BOX_FACES[:0]), 'has no triangles'),
    ((box_surface()[0] * np.nan, BOX_FACES), 'has vertices that are not finite'),
    ((box_surface()[0], BOX_FACES + 1), 'names vertex 8, and has 8'),
    ((box_surface()[0] * 1e4, BOX_FACES),
     'a spacing of 1 m takes 6005 × 10005 × 4005 nodes, more than 16000000; use a larger one')])
def test_what_is_no_body_is_refused(surface, text):
    with pytest.raises(InputError) as error:
        distance_field(*surface, gap=0.01, spacing=1.0)
    assert str(error.value) == text
