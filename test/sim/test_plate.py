"""Hinges of meshes: what a sheet stores that settles on a cylinder is what a plate would."""

from functools import cache

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from support.meshes import disc, file_of
from support.scenes import numbers, simulate
from xpbd_ros.sim.constraints.plate_rigidity import plate

EDGE, COUNT = 0.05, 12
KINDS = {'regular': 0.0, 'turned': 20.0, 'alternating': 0.0, 'irregular': 0.0,
         'irregular and turned': 35.0}
"""degrees that each kind of mesh is turned by"""
DIRECTIONS = np.radians(np.arange(0.0, 180.0, 15.0))


@cache
def sheet(kind):
    """Return vertices and triangles of a square mesh, and which are not at its rim or beside."""
    row, column = (k.ravel() for k in np.mgrid[:COUNT, :COUNT])
    if kind == 'alternating':
        points = EDGE * np.stack([column, row], 1)
    else:
        points = EDGE * np.stack([column + 0.5 * (row % 2), row * 0.75**0.5], 1)
        if kind.startswith('irregular'):
            points = points + 0.3 * EDGE * np.random.default_rng(len(kind)).uniform(
                -1.0, 1.0, points.shape)
    if kind.startswith('irregular'):
        triangles = Delaunay(points).simplices
        d = points[triangles] - points[triangles][:, [1, 2, 0]]
        area = 0.5 * np.abs(d[:, 0, 0] * d[:, 1, 1] - d[:, 0, 1] * d[:, 1, 0])
        triangles = triangles[area > 0.1 * np.square(d).sum(2).max(1)]    # none like a needle
    else:
        triangles = []
        for j, c in np.ndindex(COUNT - 1, COUNT - 1):
            a, b = j * COUNT + c, (j + 1) * COUNT + c
            falling = (j + c) % 2 if kind == 'alternating' else j % 2 == 0
            triangles += ([(a, a + 1, b), (a + 1, b + 1, b)] if falling
                          else [(a, a + 1, b + 1), (a, b + 1, b)])
    triangles, near = np.array(triangles), np.zeros(len(points), bool)
    sides, often = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1),
                             axis=0, return_counts=True)
    near[sides[often == 1]] = True
    near[sides[near[sides].any(1)]] = True
    turn = np.radians(KINDS[kind])
    points = points @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return np.pad(points, ((0, 0), (0, 1))), triangles, ~near


def built(kind, effect, warp, weft):
    vertices, triangles, _ = sheet(kind)
    return simulate(mesh=file_of(vertices, triangles), method='auto', substeps=None,
                    effects={effect: {'warp': warp, 'weft': weft}})


def settles(simulation, kind):
    """Return a function: the energy per area of a sheet of given heights that has settled."""
    bends, (vertices, _, inside) = simulation.effects['bend'].constraints, sheet(kind)
    particles = numbers(simulation, bends.particles)
    fold = sparse.csr_matrix((bends.weight.ravel(), (np.repeat(np.arange(len(particles)), 4),
                                                     particles.ravel())))
    stiffness = (fold.T @ sparse.diags(1.0 / bends.compliance) @ fold).tocsc()
    x, there = vertices[particles], inside[particles].any(1)
    area = sum(0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, k] - x[:, 0]), axis=1)
               for k in (2, 3)) / 3.0    # each triangle has three hinges

    def energy(z):
        z = z.copy()
        z[inside] = spsolve(stiffness[inside][:, inside],
                            -stiffness[inside][:, ~inside] @ z[~inside])
        return (0.5 * (fold @ z)**2 / bends.compliance)[there].sum() / area[there].sum()
    return energy


def stored(simulation, kind, warp, weft):
    """Return energy per area over that of a plate, rolled along each direction and settled."""
    energy, (x, y, _) = settles(simulation, kind), sheet(kind)[0].T
    return np.array([energy(0.5 * (c * x + s * y)**2)
                     / (0.5 * (np.sqrt(warp) * c * c + np.sqrt(weft) * s * s)**2)
                     for c, s in zip(np.cos(DIRECTIONS), np.sin(DIRECTIONS))])


def strips(simulation, kind):
    """Return the rigidity of strips along warp and weft that are free to curl and to twist."""
    energy, (x, y, _) = settles(simulation, kind), sheet(kind)[0].T
    bent = 0.5 * x * x, 0.5 * y * y, x * y
    plate = [[energy(one + other) - energy(one) - energy(other) for other in bent]
             for one in bent]
    return 1.0 / np.diag(np.linalg.inv(plate))[:2]


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('warp, weft', [(2e-3, 2e-3), (1e-3, 4e-3), (5e-3, 1e-3)])
def test_a_sheet_on_a_cylinder_has_the_energy_of_a_plate(warp, weft, kind):
    """(√B1 c² + √B2 s²)² / 2 per area, along every direction."""
    simulation = built(kind, 'bend', warp, weft)
    np.testing.assert_allclose(stored(simulation, kind, warp, weft), 1.0, rtol=0.02)
    assert simulation.notes == ()


@pytest.mark.parametrize('kind', KINDS)
def test_bend_and_hinge_are_the_same_plate(kind):
    bend, hinge = (built(kind, effect, 1e-3, 4e-3) for effect in ('bend', 'hinge'))
    height = np.random.default_rng(1).normal(0.0, 1e-6, len(bend.slot))
    for simulation in (bend, hinge):
        simulation.state.x[2, simulation.slot] = height
    assert hinge.effects['hinge'].constraints.energy(hinge.state.x) == pytest.approx(
        bend.effects['bend'].constraints.energy(bend.state.x), rel=1e-6)


@pytest.mark.parametrize('kind', KINDS)
def test_a_strip_that_may_curl_is_as_stiff_as_said(kind):
    simulation = built(kind, 'bend', 1e-3, 4e-3)
    found = plate(simulation.cloths[0].mesh, 1e-3, 4e-3)
    np.testing.assert_allclose(found.strip, strips(simulation, kind), rtol=0.02)


@pytest.mark.parametrize('kind', ['regular', 'irregular'])
def test_what_a_mesh_cannot_carry_is_told_with_what_it_gives(kind):
    """A hundredfold: hinges of one formula gave 3.3e-3 N m along warp for 1e-4."""
    warp, weft = 1e-4, 1e-2
    simulation = built(kind, 'bend', warp, weft)
    along = stored(simulation, kind, warp, weft)[[0, 6]] * (warp, weft)
    (note,) = simulation.notes
    assert note.startswith('cloths.c.effects.bend: the hinges of this mesh cannot bend as asked: '
                           '0.0001 N m along warp and 0.01 along weft come out as ')
    rolled, curled = (part.split(';')[0].split(',')[0].split(' and ') for part in (
        note.split('come out as ')[1], note.split('free to curl as ')[1]))
    np.testing.assert_allclose(np.array(rolled, float), along, rtol=0.05)
    np.testing.assert_allclose(np.array(curled, float), strips(simulation, kind), rtol=0.05)
    assert along[0] < 5.0 * warp
    assert along[1] == pytest.approx(weft, rel=0.1)


def test_a_curved_mesh_refuses_two_rigidities():
    vertices, triangles = disc(4)
    vertices[:, 2] = 0.3 * vertices[:, 0]**2
    for stiffness, count in (({'stiffness': 1e-3}, 0), ({'warp': 1e-3, 'weft': 2e-3}, 1)):
        simulation = simulate(mesh=file_of(vertices, triangles), effects={'bend': stiffness})
        assert len(simulation.notes) == count
        if not count:
            np.testing.assert_allclose(simulation.effects['bend'].constraints.compliance, 1e3,
                                       rtol=1e-12)


def test_a_mesh_without_an_inside_has_the_rigidity_across_each_edge():
    """For an edge at an angle φ to warp that is (√B1 sin² φ + √B2 cos² φ)²."""
    angle = np.radians(30.0)
    edge, across = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.4, 0.0])
    vertices = np.array([0.0 * edge, edge, 0.5 * edge + across, 0.5 * edge - across])
    bends = simulate(mesh=file_of(vertices, np.array([[0, 1, 2], [1, 0, 3]])), effects={
        'bend': {'warp': 1e-3, 'weft': 9e-3}}).effects['bend'].constraints
    np.testing.assert_allclose(1.0 / bends.compliance, 1e-3 * (0.25 + 3.0 * 0.75)**2, rtol=1e-6)
