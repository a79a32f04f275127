"""The grid and what is derived from it, against brute force."""

from itertools import combinations

import numpy as np
import pytest

from xpbd_ros.sim.geometry.mesh import cross, dot, grid_mesh, hinges, length

SIZES = [((0.5, 0.7), (4, 6)), ((1.0, 2.0), (7, 3)), ((0.3, 0.4), (2, 2)), ((1.0, 0.2), (9, 1)),
         ((0.2, 1.0), (1, 9)), ((0.2, 0.3), (1, 1))]


def triangle_areas(mesh):
    """Return the signed area of each triangle, positive counter-clockwise seen from +z."""
    a, b, c = (mesh.positions[mesh.triangles[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)[:, 2]


@pytest.mark.parametrize('size, resolution', SIZES)
def test_the_areas_of_the_particles_sum_to_the_sheet(size, resolution):
    mesh = grid_mesh(size, resolution)
    assert mesh.area.sum() == pytest.approx(size[0] * size[1], rel=1e-14)
    assert (mesh.area > 0.0).all()
    assert mesh.grid.shape == (resolution[1], resolution[0])
    assert sorted(mesh.grid.ravel()) == list(range(len(mesh.positions)))


def test_the_rim_has_half_the_area_and_the_corners_a_quarter():
    area = grid_mesh((0.4, 0.9), (5, 4)).area.reshape(4, 5)
    np.testing.assert_allclose(area, 0.1 * 0.3 * np.outer([.5, 1, 1, .5], [.5, 1, 1, 1, .5]),
                               rtol=1e-14)


@pytest.mark.parametrize('size, resolution', SIZES)
def test_the_triangles_tile_the_sheet_and_face_up(size, resolution):
    mesh = grid_mesh(size, resolution)
    cells = (resolution[0] - 1) * (resolution[1] - 1)
    areas = triangle_areas(mesh)
    assert len(areas) == 2 * cells
    np.testing.assert_allclose(areas, np.full(2 * cells, 0.5 * np.prod(mesh.spacing)), rtol=1e-12)


def test_the_corners_lie_where_the_size_says():
    mesh = grid_mesh((0.5, 0.7), (4, 6))
    corners = mesh.positions[mesh.grid[[0, 0, -1, -1], [0, -1, 0, -1]]]
    np.testing.assert_allclose(corners, [[0, 0, 0], [.5, 0, 0], [0, .7, 0], [.5, .7, 0]],
                               atol=1e-15)


def test_neighbouring_cells_have_crossing_diagonals():
    mesh = grid_mesh((3.0, 3.0), (4, 4))
    diagonal = {}
    for triangle in mesh.triangles:
        for i, j in combinations(triangle, 2):
            step = mesh.positions[j] - mesh.positions[i]
            if step[0] and step[1]:
                middle = 0.5 * (mesh.positions[i] + mesh.positions[j])
                diagonal[tuple(np.floor(middle[:2]).astype(int))] = np.sign(step[0] * step[1])
    assert len(diagonal) == 9
    for (column, row), sign in diagonal.items():
        for other in ((column + 1, row), (column, row + 1)):
            if other in diagonal:
                assert diagonal[other] == -sign


@pytest.mark.parametrize('size, resolution', SIZES)
def test_hinges_are_all_pairs_of_triangles_that_share_an_edge(size, resolution):
    triangles = grid_mesh(size, resolution).triangles
    expected = set()
    for s, t in combinations([set(triangle) for triangle in triangles.tolist()], 2):
        if len(s & t) == 2:
            expected.add((frozenset(s & t), frozenset(s ^ t)))
    found = hinges(triangles)
    assert found.shape == (len(expected), 4)
    assert {(frozenset(h[:2]), frozenset(h[2:])) for h in found.tolist()} == expected


def test_vector_functions_agree_with_numpy():
    a, b = np.random.default_rng(1).normal(size=(2, 7, 3))
    np.testing.assert_allclose(length(a), np.linalg.norm(a, axis=-1), rtol=1e-15)
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-15)
    np.testing.assert_allclose(dot(a, b), np.einsum('ij,ij->i', a, b), atol=1e-15)
