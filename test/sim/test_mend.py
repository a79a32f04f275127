"""Meshes as people have them: what is right stays, what can be is mended, the rest is refused."""

import numpy as np
import pytest

from support.meshes import box, disc
from xpbd_ros.errors import InputError
from xpbd_ros.sim.geometry.mesh import cross, hinges
from xpbd_ros.sim.geometry.mesh_repair import solid_mesh, surface_mesh

SCALES = pytest.mark.parametrize('scale', [1e-150, 1e-6, 1.0, 1e6, 1e150])
SQUARE = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
HALVES = [[0, 1, 2], [0, 2, 3]]


def normals(mesh):
    a, b, c = (mesh.positions[mesh.triangles[:, k]] for k in range(3))
    return cross(b - a, c - a)


def test_a_good_surface_stays_as_it_is():
    vertices, triangles = disc()
    mesh = surface_mesh(vertices, triangles)
    assert mesh.notes == ()
    assert mesh.grid is None and mesh.spacing is None and mesh.tetrahedra.shape == (0, 4)
    np.testing.assert_array_equal(mesh.positions, vertices)
    np.testing.assert_array_equal(mesh.triangles, triangles)


def test_each_triangle_gives_a_third_of_its_area_to_each_corner():
    mesh = surface_mesh(*disc())
    share = np.zeros(len(mesh.positions))
    for triangle in mesh.triangles:
        a, b, c = mesh.positions[triangle]
        share[triangle] += np.linalg.norm(np.cross(b - a, c - a)) / 6.0
    np.testing.assert_allclose(mesh.area, share, rtol=1e-13)
    assert mesh.area.sum() == pytest.approx(0.5 * 24 * 0.25 * np.sin(2 * np.pi / 24), rel=1e-3)


def test_edges_and_hinges_are_those_of_brute_force():
    mesh = surface_mesh(*disc(3))
    sides = {}
    for number, triangle in enumerate(mesh.triangles.tolist()):
        for k in range(3):
            sides.setdefault(frozenset((triangle[k], triangle[k - 1])), []).append(number)
    assert {frozenset(edge) for edge in mesh.edges.tolist()} == set(sides)
    assert len(mesh.edges) == len(sides)
    assert (mesh.edges[:, 0] < mesh.edges[:, 1]).all()
    inner = {edge for edge, faces in sides.items() if len(faces) == 2}
    assert {frozenset(hinge[:2]) for hinge in mesh.hinges.tolist()} == inner
    assert len(mesh.hinges) == len(inner)


def test_a_body_has_the_edges_and_skin_of_its_tetrahedra():
    mesh = solid_mesh(*box((2, 2, 3), 0.1))
    assert mesh.notes == ()
    assert mesh.area.sum() == pytest.approx(0.2 * 0.2 * 0.3, rel=1e-13)
    assert len(mesh.triangles) == 2 * 2 * (2 * 2 + 2 * 3 + 2 * 3)
    middle = mesh.positions[mesh.triangles].mean(1)
    assert ((middle - mesh.positions.mean(0)) * normals(mesh)).sum(1).min() > 0.0
    assert len(hinges(mesh.triangles)) == 3 * len(mesh.triangles) // 2    # closed
    pairs = {tuple(sorted((a, b))) for cell in mesh.tetrahedra.tolist()
             for a in cell for b in cell if a != b}
    assert set(map(tuple, mesh.edges.tolist())) == pairs


@SCALES
@pytest.mark.parametrize('vertices, triangles, particles, left, note', [
    ([*SQUARE, [1, 1, 0], [-0.0, 0, 0]], [[0, 1, 2], [5, 4, 3]], 4, 2,
     '2 vertices at the place of another; merged'),
    ([*SQUARE, [9, 9, 9], [np.nan, 0, 0]], HALVES, 4, 2,
     '2 vertices that no triangle uses; left out'),
    (SQUARE, [*HALVES, [2, 0, 1]], 4, 2, '1 triangle there twice; left out'),
    (SQUARE, [*HALVES, [1, 1, 2], [3, 3, 3]], 4, 2,
     '2 triangles with an edge of length zero; left out'),
    ([*SQUARE, [2, 0, 0]], [*HALVES, [1, 2, 4]], 5, 3, '1 triangle turned over; mended'),
    ([*SQUARE, [.5, -.01, 0]], [*HALVES, [0, 4, 1]], 5, 3,
     '1 triangle like needles (worst 0.01 high on 1 long); accuracy suffers there, remesh'),
    ([*SQUARE, [2, 0, 0], [3, 0, 0], [2, 1, 0]], [*HALVES, [4, 5, 6]], 7, 3,
     '2 separate pieces; nothing joins them')])
def test_what_can_be_mended_is_and_is_said(vertices, triangles, particles, left, note, scale):
    mesh = surface_mesh(np.array(vertices) * scale, triangles)
    assert mesh.notes[0] == note
    assert (len(mesh.positions), len(mesh.triangles)) == (particles, left)
    assert np.isfinite(mesh.positions).all()
    if scale == 1.0:
        assert normals(mesh)[:, 2].min() > 0.0
        assert mesh.area.sum() == pytest.approx(0.5 * normals(mesh)[:, 2].sum(), rel=1e-14)


def test_triangles_with_a_particle_in_common_are_one_piece():
    bow = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]]
    assert surface_mesh(np.array(bow, float), [[0, 1, 2], [0, 3, 4]]).notes == ()


def test_removed_vertices_leave_the_order_of_the_file():
    vertices = [[7.0, 7, 7], *SQUARE[:2], SQUARE[0], *SQUARE[2:]]
    mesh = surface_mesh(vertices, [[3, 2, 4], [1, 4, 5]])
    np.testing.assert_array_equal(mesh.positions, SQUARE)
    np.testing.assert_array_equal(mesh.triangles, HALVES)
    assert mesh.notes[-1] == 'particles are numbered without what is left out'


@SCALES
@pytest.mark.parametrize('vertices, triangles, reason', [
    (SQUARE, np.zeros((0, 3)), 'has no triangles'),
    (SQUARE, [[0, 1, 2], [0, 2, 4]], 'triangle 1 names a vertex that does not exist (got '
     '[0, 2, 4], there are 4 vertices)'),
    (SQUARE, [[0, 1, -1]], 'triangle 0 names a vertex that does not exist (got [0, 1, -1], there '
     'are 4 vertices)'),
    ([*SQUARE[:3], [np.inf, 0, 0]], HALVES, 'vertex 3 must be finite (got [inf, '),
    (SQUARE, [[0, 0, 1]], 'has no triangle with corners in different places'),
    ([*SQUARE, [.5, .5, 0]], [*HALVES, [0, 4, 2]], 'triangle 2 is degenerate: its corners lie in '
     'line (1 triangle so); remove or remesh'),
    ([*SQUARE, [.5, .5, 1e-5]], [HALVES[0], [0, 2, 2], [2, 4, 0], HALVES[1]],
     'triangle 2 is degenerate: its corners lie in line'),
    ([*SQUARE, [1, 0, 1]], [*HALVES, [0, 2, 4]], '1 edge with more than two triangles, the first '
     'between particles 0, 2; split')])
def test_what_cannot_be_mended_is_refused(vertices, triangles, reason, scale):
    with pytest.raises(InputError) as error, np.errstate(invalid='ignore'):
        surface_mesh(np.array(vertices) * scale, np.array(triangles, int))
    assert str(error.value).startswith(reason)


def test_a_direction_of_any_length_is_a_unit_vector():
    for warp in ((3e-300, 0, -4e-300), (3e300, 0, -4e300), (3, 0, -4)):
        assert surface_mesh(SQUARE, HALVES, warp).warp == pytest.approx((0.6, 0, -0.8), rel=1e-15)
    with pytest.raises(InputError, match='warp: must not be zero'):
        surface_mesh(SQUARE, HALVES, (0, 0, 0))


def test_orientation_follows_the_majority_of_each_piece():
    vertices, triangles = disc()
    rng = np.random.default_rng(1)
    apart = np.concatenate([vertices, vertices + [2.0, 0.0, 0.0]])
    both = np.concatenate([triangles, triangles[:, ::-1] + len(vertices)])
    wrong = np.union1d([0], rng.permutation(len(both))[:len(both) // 4])
    both[wrong] = both[wrong][:, ::-1]
    mesh = surface_mesh(apart, both)
    assert mesh.notes[0] == f'{len(wrong)} triangles turned over; mended'
    up = normals(mesh)[:, 2] > 0.0
    assert up[:len(triangles)].all() and not up[len(triangles):].any()


def test_a_closed_surface_faces_outward():
    body = solid_mesh(*box((1, 1, 1)))
    mesh = surface_mesh(body.positions + 50.0, body.triangles[:, ::-1])
    assert mesh.notes == ('1 closed surface inside out; turned',)
    np.testing.assert_array_equal(mesh.triangles, body.triangles)
    assert surface_mesh(body.positions + 50.0, body.triangles).notes == ()


def test_a_moebius_strip_is_told():
    count = 12
    angle = 2 * np.pi * np.arange(count) / count
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    tilt = 0.2 * (np.cos(angle / 2)[:, None] * out
                  + np.sin(angle / 2)[:, None] * np.array([0, 0, 1.0]))
    vertices = np.concatenate([out + tilt, out - tilt])
    triangles = []
    for k in range(count):
        a, b, c, d = k, k + count, (k + 1) % count, (k + 1) % count + count
        if k == count - 1:
            c, d = d, c
        triangles += [(a, b, c), (c, b, d)]
    assert surface_mesh(vertices, triangles).notes == (
        'the surface has one side only, like a Möbius strip',)


def test_bodies_are_mended_and_refused_alike():
    vertices, tetrahedra = box((1, 1, 1))
    wrong = tetrahedra.copy()
    wrong[[1, 4]] = wrong[[1, 4]][:, [0, 2, 1, 3]]
    mesh = solid_mesh(vertices, np.concatenate([wrong, wrong[:1, ::-1], [[0, 1, 1, 3]]]))
    assert mesh.notes == ('1 tetrahedron with an edge of length zero; left out',
                          '1 tetrahedron there twice; left out',
                          '2 tetrahedra inside out; turned')
    assert mesh.area.sum() == pytest.approx(1e-3, rel=1e-13)
    assert len(mesh.triangles) == 12
    flat = [*vertices, [0.1, 0.1, 0.0]]
    with pytest.raises(InputError, match='tetrahedron 6 is degenerate: its corners are flat'):
        solid_mesh(flat, [*tetrahedra, [0, 2, 4, 6]])
    with pytest.raises(InputError, match='1 face with more than two tetrahedra'):
        solid_mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, 0.1, 2]],
                   [[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])


def test_neighbours_lie_near_one_another_in_memory():
    vertices, triangles = disc(12)
    shuffled = np.random.default_rng(2).permutation(len(vertices))
    mesh = surface_mesh(vertices[np.argsort(shuffled)], shuffled[triangles])
    rank = mesh.rank
    assert sorted(rank) == list(range(len(vertices)))
    apart = np.abs(rank[mesh.edges[:, 0]] - rank[mesh.edges[:, 1]])
    assert apart.max() < 3 * 2 * 12 and len(vertices) == 469
    both = surface_mesh(np.concatenate([vertices, vertices + 3.0]),
                        np.concatenate([triangles, triangles + len(vertices)]))
    assert sorted(both.rank) == list(range(2 * len(vertices)))    # pieces too
