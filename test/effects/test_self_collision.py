"""Cloth against cloth: the pairs found, what keeps them apart, and that nothing gets through."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.distances import of_edges, to_triangle
from support.scenes import EXAMPLES, GRAVITY, run, simulate
from support.tiers import slow
from xpbd_ros.effects.self_collision import load_pairs
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.backend.simd import lane_count
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.commands import MovePin, Pose, SetKey
from xpbd_ros.sim.contact.contacts import DEPENETRATION
from xpbd_ros.sim.measure import momentum
from xpbd_ros.sim.particles.state import places
from xpbd_ros.sim.self_collision.creep import note_creep
from xpbd_ros.sim.self_collision.narrow_phase import choose_coefficient
from xpbd_ros.sim.self_collision.near_pairs import choose_near, SPARE
from xpbd_ros.sim.self_collision.neighbour_list import (
    CANDIDATES,
    common_step,
    EDGES,
    empty_groups,
    POINTS,
    TRAVEL,
    TRIANGLES,
)
from xpbd_ros.sim.self_collision.pair_contacts import NEVER, PairFriction
from xpbd_ros.study.stress.crossings import crossings

THICKNESS = 0.01
STRETCH = {'stretch': {'warp': 40.0, 'weft': 40.0}}


def scene(cloths, *, mode='surface', pins=None, gravity=GRAVITY, substeps=10, room=24,
          thickness=THICKNESS, colliders=None, friction=0.4, rate=60.0, solver=None,
          static=None, slope=0.0):
    """
    Return some cloths: name: (resolution, size, pose); one set of effects for all tests.

    The slope is the angle from -z to the direction of gravity, towards x [°].
    """
    return compile_scene(scene_from_mapping({
        'gravity': [gravity * np.sin(np.radians(slope)), 0.0,
                    -gravity * np.cos(np.radians(slope))], 'frame_rate': rate,
        'solver': solver or {'method': 'gauss_seidel', 'integrator': 'backward_euler',
                             'substeps': substeps},
        'cloths': {name: {'grid': {'size': list(size), 'resolution': list(resolution)},
                          'density': 0.2, 'pose': pose, 'friction': friction,
                          **({'static_friction': static} if static else {}), 'effects': STRETCH}
                   for name, (resolution, size, pose) in cloths.items()},
        'pins': pins or {},
        'colliders': colliders or {},
        'effects': {'friction': {}, 'contact': {'thickness': thickness}, 'self_collision': {
            'thickness': thickness, 'mode': mode,
            **({'room': room} if room else {})}},
    }, where='small.yaml', name='small'))


def triangles(simulation):
    """Return the triangles of all cloths, particles in natural order."""
    return np.concatenate([c.mesh.triangles + c.first for c in simulation.cloths])


def square(z, n=6, size=0.25, x=0.0, y=0.0):
    """Return a flat cloth at a height."""
    return (n, n), (size, size), {'position': [x, y, z]}


def flat(n=6, size=0.25):
    """Return the edge of a cell of that square."""
    return size / (n - 1)


def stay(simulation):
    """Run a frame of nothing, so that the list is that of the positions now."""
    simulation.state.v[:] = 0.0
    simulation.step()
    return simulation.effects['self_collision'].data.near


def listed(near, kind):
    """Return the particles of the listed pairs of a kind, sorted."""
    pairs = near.corners[:, near.kind_begin[kind]:near.kind_end[kind]].T
    if kind == EDGES:
        one, other = pairs[:, :2].tolist(), pairs[:, 2:].tolist()
        return sorted((*min(a, b), *max(a, b)) for a, b in zip(one, other))
    return sorted(map(tuple, pairs.tolist()))


def all_listed(near):
    """Return the particles of the listed pairs by kind, sorted."""
    return {kind: listed(near, kind) for kind in (
        [POINTS] if near.surface is None else [TRIANGLES, EDGES])}


def brute_force(near, x, moves, thickness=THICKNESS):
    """Return the same of the pairs closer than ``thickness`` + ``moves``, which may touch."""
    count = len(x)
    if near.surface is None:
        return {POINTS: [(i, j, count, count) for i, j in zip(*np.triu_indices(count, 1))
                         if np.linalg.norm(x[i] - x[j]) < thickness + moves[i] + moves[j]]}
    faces, edges = near.surface.triangles.corners.T, np.array(
        sorted(near.surface.edges.corners.T.tolist()))
    most = thickness + 2.0 * moves.max()
    return {
        TRIANGLES: sorted((v, *faces[f]) for v, f in zip(*boxes_within(
            x[:, None], x[faces], most)) if v not in faces[f] and to_triangle(
                x[v], *x[faces[f]]) < thickness + moves[v] + moves[faces[f]].max()),
        EDGES: [(*edges[e], *edges[f]) for e, f in zip(*boxes_within(x[edges], x[edges], most))
                if e < f and not set(edges[e]) & set(edges[f])
                and of_edges(*x[edges[e]], *x[edges[f]])
                < thickness + moves[edges[e]].max() + moves[edges[f]].max()]}


def boxes_within(one, other, reach):
    """Return the indices of items whose bounding boxes are within a distance of each other."""
    return np.nonzero(((one.min(1)[:, None] - reach <= other.max(1))
                       & (one.max(1)[:, None] + reach >= other.min(1))).all(2))


def all_near(near, pairs):
    """Return the same of the near pairs; no two of a round of a group have a common particle."""
    found = {kind: [] for kind in all_listed(near)}
    for begin in range(0, pairs.end[0], PACK):
        kind, group = pairs.kind[begin // PACK], pairs.particles[:, begin:begin + PACK].T
        turn = pairs.turn[begin:begin + PACK][group[:, 0] < len(near.slot)]
        group = group[group[:, 0] < len(near.slot)]
        assert set(turn) == set(range(pairs.rounds[begin // PACK]))
        for k in set(turn):
            own = group[turn == k]
            own = own[own < len(near.slot)]
            assert len(np.unique(own)) == len(own)
        if kind == EDGES:
            group = [(*min(one, other), *max(one, other))
                     for one, other in zip(group[:, :2].tolist(), group[:, 2:].tolist())]
        found[kind] += map(tuple, group)
    return found


def cross_or_pass(near, x, travel, pairs):
    """Return those of edges whose closest points are no ends, or that are within ``travel``."""
    def inside(a, b, c, d):
        share = np.linalg.lstsq(np.stack([b - a, c - d], 1), c - a, rcond=None)[0]
        return (share > 0.0).all() and (share < 1.0).all()
    return [pair for pair in pairs if inside(*x[list(pair)]) or of_edges(*x[list(pair)])
            < travel[list(pair[:2])].max() + travel[list(pair[2:])].max()]


def near_by_brute_force(near, spare=0.0):
    """Return the near pairs of the present positions and travels, and those ``spare`` further."""
    x, travel = near.x[:-1, :3], near.x[:-1, TRAVEL] + 0.5 * spare
    found = brute_force(near, x, travel)
    if EDGES in found:
        found[EDGES] = cross_or_pass(near, x, travel, found[EDGES])
    return found


def crumpled(mode):
    """Return two cloths that lie through one another anyhow, and where they are."""
    simulation = scene({'a': square(0.0), 'b': square(0.01, x=0.02)}, mode=mode, gravity=0.0,
                       thickness=0.02 if mode == 'particles' else THICKNESS, room=100,
                       substeps=1, rate=1e4)
    state, slot = simulation.state, simulation.slot
    state.x[:, slot] += np.random.default_rng(1).normal(0.0, 0.01, (3, len(slot)))
    return simulation, places(state.x, slot)


@pytest.mark.slow
def test_brute_force_finds_the_same_particles():
    simulation, x = crumpled('particles')
    near = stay(simulation)
    found = listed(near, POINTS)
    expected = []
    for i, j in zip(*np.triu_indices(len(x), 1)):
        keep = 0.02
        if near.cloth[i] == near.cloth[j]:
            keep = min(keep, 0.5 * np.linalg.norm(near.rest[i, :3] - near.rest[j, :3]))
        if np.linalg.norm(x[i] - x[j]) < keep + near.margin[i] + near.margin[j]:
            expected.append((i, j, len(x), len(x)))
    assert found == expected
    assert len(found) > 30


def test_brute_force_finds_the_same_triangles_and_edges():
    simulation, x = crumpled('surface')
    near = stay(simulation)
    assert all_listed(near) == brute_force(near, x, near.margin)
    edges = near.surface.edges.corners.T
    assert len(edges) == len(np.unique(edges, axis=0)) == 2 * 85


@pytest.mark.parametrize('mode', ['surface', slow('particles')])
def test_pairs_sought_again_and_near_pairs_are_those_of_brute_force(mode):
    """Four particles oscillate, and each search is for pairs of these alone."""
    other = square(0.013, x=0.02) if mode == 'surface' else square(0.0115)
    simulation = scene({'a': square(0.0), 'b': other}, mode=mode, gravity=0.0,
                       room=100, substeps=1, rate=1e4)
    state, slot = simulation.state, simulation.slot
    random = np.random.default_rng(3)
    state.x[:, slot] += random.normal(0.0, 5e-4, (3, len(slot)))
    near, pairs = stay(simulation), simulation.effects['self_collision'].data.pairs
    before, searches, touching, shared = all_listed(near), np.zeros(2, int), 0, 0
    stayed = 0
    speed = np.array([[15.0], [-10.0], [15.0]]) + random.normal(0.0, 5.0, (3, 4))
    for frame in range(12):
        state.v[:] = 0.0
        state.v[:, slot[[43, 44, 50, 64]]] = speed if frame < 9 else -speed
        grouped = near.grouped.copy()
        simulation.step()
        stayed += (near.grouped == grouped).all()
        searches += near.count[[0, 4]]
        chosen = all_near(near, pairs)
        shared += pairs.rounds[:pairs.end[0] // PACK].max(initial=1) > 1
        for kinds in (chosen, all_listed(near)):
            for found in kinds.values():
                assert len(set(found)) == len(found)
        if frame % 3 == 2:
            assert all_listed(near) == brute_force(near, near.seen, near.margin)
            for kind, found in near_by_brute_force(near).items():
                assert set(found) <= set(chosen[kind])
                touching += len(found)
            empty_groups(None, near)
            choose_near(None, near, pairs, THICKNESS, False)
            chosen = all_near(near, pairs)
            for kind, found in near_by_brute_force(near, SPARE * THICKNESS).items():
                assert sorted(chosen[kind]) == sorted(found)
    assert touching > 30 and stayed > 0
    assert shared > 0 or mode == 'particles'
    assert searches[0] >= 2 and searches[1] == 0
    assert all_listed(near) != before


def test_near_pairs_are_complete_where_particles_leave_inner_margins_while_others_are_sought():
    simulation, _ = crumpled('surface')
    near, state, slot = stay(simulation), simulation.state, simulation.slot
    stay(simulation)
    pairs = simulation.effects['self_collision'].data.pairs
    assert (near.kind_front < near.kind_end).any()
    searches = near.count[[0, 4]]
    state.x_prev[:] = state.x
    state.x[2, slot] += np.where(np.arange(len(slot)) % 2, 5e-3, -5e-3)
    state.x[2, slot[0]] += 0.02    # the only one to leave its margin
    common_step(near, state)
    _, found = load_pairs(near, state, THICKNESS)
    choose_near(None, near, pairs, THICKNESS, found)
    assert (near.count[[0, 4]] - searches == [1, 0]).all()
    chosen = all_near(near, pairs)
    for kind, found in near_by_brute_force(near).items():
        assert len(found) > 30
        assert set(found) <= set(chosen[kind])


def test_pairs_join_the_groups_while_the_list_stays():
    """Two cloths approach slowly: the groups are without pairs at first, and the list complete."""
    simulation = scene({'a': square(0.0), 'b': square(1.46 * THICKNESS, x=0.01, y=0.02)},
                       gravity=0.0, substeps=1, rate=1e4)
    state, slots = simulation.state, [cloth.slots for cloth in simulation.cloths]
    near, pairs, joined = stay(simulation), simulation.effects['self_collision'].data.pairs, 0
    for _ in range(8):
        before = near.pruned.copy(), pairs.end[0]
        for some, speed in zip(slots, (200.0, -200.0)):
            state.v[:, some] = np.array([[0.0], [0.0], [speed * THICKNESS]])
        simulation.step()
        chosen = all_near(near, pairs)
        for kind, found in near_by_brute_force(near).items():
            assert set(found) <= set(chosen[kind])
        stays = near.count[0] == 0 and (near.pruned == before[0]).all()
        joined += stays and before[1] == 0 < pairs.end[0]
    assert joined == 1


@pytest.mark.parametrize('mode', ['surface', slow('particles')])
def test_cloths_that_meet_keep_their_momentum(mode):
    simulation = scene({'a': square(0.0), 'b': square(0.03, x=0.01, y=0.02)}, mode=mode,
                       gravity=0.0, thickness=THICKNESS if mode == 'surface' else flat())
    state, slots = simulation.state, simulation.cloths[1].slots
    state.v[:, slots] = np.array([[0.2], [0.1], [-0.5]])
    before = momentum(state)
    touched = 0
    for _ in range(20):
        simulation.step()
        touched += simulation.stats()['self_contacts']
    assert touched > (20 if mode == 'surface' else 10)
    assert simulation.stats()['self_stopped'] == 0
    np.testing.assert_allclose(momentum(state), before, rtol=0.0, atol=1e-12)
    one, other = (state.v[:, cloth.slots].mean(1) for cloth in simulation.cloths)
    assert abs(one[2] - other[2]) < 0.15    # nothing bounces
    assert np.linalg.norm(other[:2]) < 0.2 and np.linalg.norm(one[:2]) > 0.03    # it rubs


@pytest.mark.slow
def test_a_twist_of_three_turns_gets_nothing_through():
    """H27: it ends as a rope."""
    simulation = scene({'c': ((7, 19), (0.12, 0.36), {})}, substeps=12, thickness=0.005,
                       gravity=0.0, pins={'low': {'cloth': 'c', 'at': 'edge_0x'},
                                          'high': {'cloth': 'c', 'at': 'edge_1x'}})
    (x, y, z), faces = simulation.step().pins['high'].pose.position, triangles(simulation)
    touched = 0
    for frame in range(240):
        turns = 3.0 * min(frame / 180, 1.0)
        pose = Pose((x, y - 0.05 * turns / 3.0, z),
                    tuple(Rotation.from_euler('y', 2.0 * np.pi * turns).as_quat()))
        shown = simulation.step([MovePin('high', pose)])
        touched = max(touched, simulation.stats()['self_contacts'])
        if frame % 10 == 9:
            assert crossings(shown.x, faces) == 0, frame
    assert touched > 30
    assert simulation.stats()['self_without_room'] == 0
    assert np.isfinite(shown.x).all()


def test_a_fold_and_a_pile_get_nothing_through():
    """H27: three cloths fall on a table and one another, the first from an edge on."""
    upright = {'orientation': [0.5**0.5, 0.0, 0.0, 0.5**0.5], 'position': [0.1, 0.13, 0.02]}
    simulation = scene({'a': ((9, 9), (0.25, 0.25), upright), 'b': square(0.35, 9),
                        'c': square(0.4, 9, x=0.05, y=0.02)},
                       colliders={'table': {'plane': {}}}, thickness=0.006)
    faces = triangles(simulation)
    for frame in range(120):
        shown = simulation.step()
        if frame % 10 == 9:
            assert crossings(shown.x, faces) == 0, frame
    assert simulation.stats()['self_contacts'] > 50
    assert shown.x[:, 2].min() > 0.0
    assert shown.x[:, 2].max() < 0.15
    assert np.abs(shown.v).max() < 1.0


def test_layers_at_rest_keep_their_groups_and_read_part_of_the_list():
    simulation = scene({'a': square(THICKNESS), 'b': square(2.0 * THICKNESS, x=0.02, y=0.01)},
                       colliders={'table': {'box': {'size': [1.0, 1.0, 0.1]},
                                            'position': [0.1, 0.1, -0.05]}})
    data, stayed = simulation.effects['self_collision'].data, 0
    near, pairs = data.near, data.pairs
    run(simulation, 30)
    for _ in range(20):
        grouped, front = near.grouped.copy(), near.kind_front.copy()
        simulation.step()
        stayed += (near.grouped == grouped).all()
        assert (near.kind_front == front).all()
    assert stayed >= 15
    assert (pairs.push > 0.0).sum() > 20
    assert (near.kind_front - near.kind_begin).sum() < 0.8 * (
        near.kind_end - near.kind_begin).sum()


@pytest.mark.slow
def test_cloth_at_rest_on_a_table_needs_no_search():
    """The neighbour list follows what cloth does, not the fall that the table prevents."""
    simulation = scene({'a': square(THICKNESS)}, colliders={
        'table': {'box': {'size': [1.0, 1.0, 0.1]}, 'position': [0.1, 0.1, -0.05]}})
    near, searches, fall = simulation.effects['self_collision'].data.near, 0, GRAVITY / 600.0**2
    run(simulation, 30)
    for _ in range(60):
        simulation.step()
        searches += near.count[0]
    assert 600 * fall > 0.9 * near.margin.max()
    assert searches == 0


def test_without_it_they_pass_through_one_another():
    """The count of crossings can count."""
    simulation = simulate((9, 9), (0.25, 0.25), effects=STRETCH)
    x = np.concatenate([simulation.frame().x, Rotation.from_euler('y', 0.5).apply(
        simulation.frame().x) + (0.03, 0.004, 0.05)])
    faces = simulation.cloths[0].mesh.triangles
    assert crossings(x, np.concatenate([faces, faces + 81])) > 5


@pytest.mark.parametrize('speed', [5.0, 50.0])
def test_however_fast_it_does_not_get_through(speed):
    """A bound on speeds alone would need other substeps."""
    simulation = scene({'a': square(0.0), 'b': square(0.15, x=0.01, y=0.015)}, gravity=0.0,
                       substeps=4, pins={'edge': {'cloth': 'a', 'at': list(range(36))}})
    simulation.state.v[2, simulation.cloths[1].slots] = -speed
    for _ in range(20):
        shown = simulation.step()
    assert shown.x[36:, 2].min() > 0.0


@pytest.mark.parametrize('aside', [0.0, 0.013])
@pytest.mark.parametrize('mode', ['surface', slow('particles')])
def test_an_overlap_comes_apart_without_a_kick(mode, aside):
    """What lies aside is pushed aside too, and what that strains swings back."""
    thickness = 0.02 if mode == 'surface' else flat()
    simulation = scene({'a': square(0.0), 'b': square(0.2 * thickness, x=aside, y=aside)},
                       mode=mode, thickness=thickness, gravity=0.0)
    for _ in range(60):
        shown = simulation.step()
        assert np.abs(shown.v).max() < DEPENETRATION
    apart = shown.x[36:, 2].mean() - shown.x[:36, 2].mean()
    assert apart > 0.6 * thickness
    if aside == 0.0:
        assert apart < 1.1 * thickness
        assert np.abs(shown.v).max() < 0.01


@pytest.mark.parametrize('friction, solver', [
    (0.4, None), slow(0.0, {'method': 'auto'}), slow(0.0, {'method': 'auto', 'substeps': 16}),
    slow(0.4, {'method': 'auto'})])
def test_a_cloth_slides_on_cloth_as_it_would_on_a_slope(friction, solver):
    """In every 0.2 s its acceleration is g (sin θ - μ cos θ), within 2 %."""
    turn = Rotation.from_euler('y', 35.0, degrees=True)
    q, down = turn.as_quat().tolist(), turn.apply([1.0, 0.0, 0.0])
    place = turn.apply([0.03, 0.1, 1.02 * THICKNESS]).tolist()
    simulation = scene({'a': ((31, 11), (0.75, 0.25), {'orientation': q}),
                        'b': ((6, 6), (0.1, 0.1), {'orientation': q, 'position': place})},
                       pins={'all': {'cloth': 'a', 'at': list(range(341))}}, friction=friction,
                       solver=solver)
    expected = GRAVITY * (np.sin(np.radians(35.0)) - friction * np.cos(np.radians(35.0)))
    speed = 0.0
    for _ in range(2):
        before, speed = speed, run(simulation, 12).v[341:].mean(0) @ down
        assert (speed - before) / 0.2 == pytest.approx(expected, rel=0.02)


def on_loose_cloth(slope, substeps=10, layers=1):
    """Return a stack of small cloths on a large loose cloth, which lies on a rough plane."""
    cloths = {'a': ((13, 9), (0.6, 0.4), {'position': [0.0, 0.0, THICKNESS]})}
    for k in range(1, layers + 1):
        cloths[f'b{k}'] = ((5, 5), (0.1, 0.1), {
            'position': [0.107 + 0.003 * k, 0.128 + 0.002 * k, (1 + k) * THICKNESS]})
    return scene(cloths, colliders={'table': {'plane': {}, 'friction': 20.0}}, slope=slope,
                 substeps=substeps)


@pytest.mark.parametrize('substeps, layers', [(10, 1), slow(4, 1), slow(40, 1), slow(10, 3)])
def test_cloth_slides_on_cloth_that_lies_on_a_collider_as_on_a_slope(substeps, layers):
    """The lower cloth is loose: pair contacts push it into the plane, which pushes it back."""
    simulation, time = on_loose_cloth(30.0, substeps, layers), 24.0 / 60.0
    expected = GRAVITY * (np.sin(np.radians(30.0)) - 0.4 * np.cos(np.radians(30.0)))
    begin = run(simulation, 12).v[117:, 0].mean()
    shown = run(simulation, 24)
    assert (shown.v[117:, 0].mean() - begin) / time == pytest.approx(expected, rel=0.03)
    assert np.abs(shown.v[:117]).max() < 0.03


@pytest.mark.parametrize('slope, substeps, layers', [
    (15.0, 10, 1), slow(15.0, 10, 3), slow(19.0, 4, 1), slow(19.0, 40, 1), slow(19.0, 10, 3)])
def test_cloth_rests_on_cloth_below_the_angle_of_friction(slope, substeps, layers):
    """It does not creep, though the lower cloth is loose; without friction it reaches 1 m/s."""
    simulation = on_loose_cloth(slope, substeps, layers)
    before = run(simulation, 24).x
    np.testing.assert_allclose(run(simulation, 24).x, before, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize('slope, substeps, layers', [
    (30.0, 10, 1), slow(27.0, 4, 1), slow(30.0, 40, 1), slow(27.0, 10, 3), slow(30.0, 10, 3),
    slow(36.0, 10, 3), slow(27.0, 10, 4), slow(30.0, 20, 3)])
def test_sliding_cloth_stops_without_a_rebound(slope, substeps, layers):
    """
    It slides down loose cloth, which then becomes level: the way is v² / 2 μ g - v h / 2.

    It does not move back faster than friction changes its velocity in a substep; one layer does
    so by a fifth of that at most.
    """
    simulation = on_loose_cloth(slope, substeps, layers)
    shown = run(simulation, 12)
    begin, speed = shown.x[117:, 0].mean(), shown.v[117:, 0].mean()
    frames = [simulation.step([SetKey('gravity', (0.0, 0.0, -GRAVITY))])]
    frames += [simulation.step() for _ in range(20)]
    h = 1.0 / 60.0 / substeps
    assert frames[-1].x[117:, 0].mean() - begin == pytest.approx(
        speed**2 / (2.0 * 0.4 * GRAVITY) - speed * h / 2.0, rel=0.02)
    assert min(frame.v[117:, 0].mean() for frame in frames) > -0.4 * GRAVITY * h * (
        0.2 if layers == 1 else 1.0)
    assert np.abs(frames[-1].v).max() < 0.005


def test_layers_on_a_table_stay_where_they_are():
    """The upper cloth overhangs the lower one, which tilts the contact normals at its edges."""
    simulation = scene({'a': square(THICKNESS), 'b': square(2.0 * THICKNESS, x=0.02, y=0.01)},
                       colliders={'table': {'box': {'size': [1.0, 1.0, 0.1]},
                                            'position': [0.1, 0.1, -0.05]}})
    before = run(simulation, 10).x
    np.testing.assert_allclose(run(simulation, 60).x, before, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize('degrees, static, sticks', [
    (15.0, None, True), (30.0, None, False), slow(30.0, 0.7, True), slow(40.0, 0.7, False)])
def test_cloth_sticks_to_cloth_below_the_angle_of_friction(degrees, static, sticks):
    """
    μ_k = 0.4: 21.8°, and 35° where μ_s is 0.7.

    The pins of the slope feel the weight less what the momentum gains.
    """
    turn = Rotation.from_euler('y', -degrees, degrees=True)
    q = turn.as_quat().tolist()
    down = turn.apply([0.0, 0.0, 1.0])
    place = (turn.apply([0.11, 0.1, 0.0]) + 0.0101 * down).tolist()
    simulation = scene({'a': ((8, 8), (0.4, 0.4), {'orientation': q}),
                        'b': ((5, 5), (0.1, 0.1), {'orientation': q, 'position': place})},
                       pins={'all': {'cloth': 'a', 'at': list(range(64))}}, static=static)
    start = simulation.frame().x[64:].mean(0)
    frames = [simulation.step() for _ in range(30)]
    moved = np.linalg.norm(frames[-1].x[64:].mean(0) - start)
    mass, time = simulation.state.mass[simulation.slot], 30.0 * simulation.frame_dt
    impulse = simulation.frame_dt * sum(frame.pins['all'].force for frame in frames)
    given = -impulse - mass @ frames[-1].v
    np.testing.assert_allclose(given, [0.0, 0.0, mass.sum() * GRAVITY * time], rtol=0.0,
                               atol=1e-6 * mass.sum() * GRAVITY * time)
    if sticks:
        assert moved < 0.004
    else:
        angle = np.radians(degrees)
        slide = 0.5 * GRAVITY * (np.sin(angle) - 0.4 * np.cos(angle)) * 0.25
        assert moved == pytest.approx(slide, rel=0.15)


class Pairs(NamedTuple):
    """Fields of pairs that ``choose_coefficient`` reads."""

    particles: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    deficit: np.ndarray


class Near(NamedTuple):
    """Fields of ``NeighbourList`` that ``choose_coefficient`` reads."""

    start: np.ndarray
    slot: np.ndarray
    cloth: np.ndarray


def test_a_pair_has_the_static_coefficient_of_its_cloths_while_it_slides_slowly():
    """The speed along the normal does not count; pairs out of reach keep the kinetic one."""
    random, count, lanes, seen = np.random.default_rng(1), 8, lane_count(np.float64), 0
    near = Near(np.zeros(2 * lanes), random.permutation(count), np.arange(count) % 2)
    v, static = random.normal(size=(3, count)), np.array([[0.5, 0.6], [0.6, 0.9]])
    pairs = Pairs(random.integers(0, count, (4, 2 * lanes)), random.normal(size=(4, 2 * lanes)),
                  random.normal(size=(3, 2 * lanes)), np.zeros(2 * lanes))
    pairs.particles[2:, ::2], pairs.weight[2:, ::2] = count, 0.0    # of two particles each
    pairs.deficit[::5] = NEVER
    pairs.normal[:] /= np.linalg.norm(pairs.normal, axis=0)
    friction = PairFriction(static, static, np.linspace(0.1, 0.3, 2 * lanes), np.zeros(2 * lanes),
                            np.zeros(0), np.zeros(0), np.zeros(0))
    for q in (0, lanes):
        choose_coefficient(static, friction, pairs, near, q, v, 1.5)
    for k, (i, j, _, last) in enumerate(pairs.particles.T):
        own = v[:, near.slot[pairs.particles[:, k] % count]]
        u, n = own @ pairs.weight[:, k], pairs.normal[:, k]
        sticks = np.linalg.norm(u - (n @ u) * n) < 1.5 and pairs.deficit[k] > NEVER
        seen += sticks
        assert friction.coefficient[k] == (static[near.cloth[i], near.cloth[
            j if last == count else last]] if sticks else friction.slides[k])
    assert 3 < seen < 2 * lanes - 3


def test_pairs_remember_the_slip_that_friction_did_not_prevent():
    """Below the limit of friction they add it up; at the limit those that slide forget it."""
    simulation = scene({'a': square(0.0), 'b': square(0.005, x=0.01, y=0.01)})
    run(simulation, 4)
    effect, state = simulation.effects['self_collision'].data, simulation.state
    near, pairs, friction = effect.near, effect.pairs, effect.pairs.friction
    end, random = pairs.end[0], np.random.default_rng(1)
    assert end > 30
    pairs.push[:end] = random.choice([0.0, 1e-4], end)
    friction.unloaded[:end] = 0.0
    friction.slip[:, :end] = random.choice([0.0, 1.0], end) * pairs.normal[:, :end] * 1e-3
    friction.creep[:, :end] = before = random.normal(0.0, 1e-6, (3, end)).astype(np.float32)
    state.x[:, near.slot] = state.x_prev[:, near.slot] + random.normal(
        0.0, random.choice([1e-7, 1e-6, 3e-5], len(near.slot)), (3, len(near.slot)))
    note_creep(friction, pairs, near, state)
    moved = np.append((state.x - state.x_prev)[:, near.slot], np.zeros((3, 1)), axis=1)
    u = (pairs.weight[:, :end] * moved[:, pairs.particles[:, :end]]).sum(1)
    n = pairs.normal[:, :end]
    u -= (n * u).sum(0) * n
    touches = pairs.push[:end] > 0.0
    below = np.linalg.norm(friction.slip[:, :end], axis=0) < friction.slides[:end] * 1e-4
    slides = np.linalg.norm(u, axis=0) > np.linalg.norm(before, axis=0)
    opposes = (u * before).sum(0) < 0.0
    stays = touches & ~below & ~slides
    for group in (~touches, touches & below, touches & ~below & slides, stays & opposes,
                  stays & ~opposes):
        assert group.sum() > 3
    np.testing.assert_allclose(friction.creep[:, :end], np.where(
        touches & (below | ~slides), np.where(below | opposes, before + u, before), 0.0),
        rtol=0.0, atol=1e-10)


@pytest.mark.parametrize('compliance', [0.0, slow(1e-6)])
def test_what_lies_on_pinned_cloth_weighs_on_its_pins(compliance):
    """On the springs of a compliant pin too: pushes load them as they would a rigid pin."""
    simulation = scene({'a': square(0.0), 'b': square(0.01, 5, 0.1, x=0.06, y=0.07)},
                       pins={'all': {'cloth': 'a', 'at': list(range(36)),
                                     'compliance': compliance}})
    force = run(simulation, 60).pins['all'].force
    own, weight = (simulation.state.mass[cloth.slots].sum() * GRAVITY
                   for cloth in simulation.cloths)
    np.testing.assert_allclose(force, [0.0, 0.0, -own - weight], atol=0.02 * weight)


def test_an_overlap_with_pinned_cloth_presses_on_nothing():
    """The push that separates it leaves no momentum, and pins no force."""
    simulation = scene({'a': square(0.0), 'b': square(0.2 * THICKNESS, x=0.01, y=0.01)},
                       pins={'all': {'cloth': 'a', 'at': list(range(36))}}, gravity=0.0)
    mass = simulation.state.mass[simulation.cloths[1].slots].sum()
    for _ in range(20):
        force = simulation.step().pins['all'].force
        assert np.linalg.norm(force) * simulation.frame_dt < 0.02 * mass * DEPENETRATION


@pytest.mark.parametrize(('room', 'finds'), [(24, False), (None, True)])
def test_thick_cloth_has_room_for_all_pairs(room, finds):
    """Three times as thick as its particles are apart."""
    simulation = scene({'a': square(0.0, 16), 'b': square(0.055, 16, x=0.003)}, room=room,
                       thickness=0.05)
    run(simulation, 3)
    assert (simulation.stats()['self_without_room'] == 0) == finds


def test_what_finds_no_room_is_counted_and_all_stays_finite():
    simulation = scene({'a': square(0.0), 'b': square(0.005, x=0.01), 'c': square(0.01)}, room=1)
    shown = run(simulation, 10)
    assert simulation.stats()['self_without_room'] > 0
    assert np.isfinite(shown.x).all()
    assert np.abs(shown.v).max() < 5.0


def test_everything_in_one_place_stays_finite():
    simulation = scene({'a': square(0.0), 'b': square(0.0)}, gravity=0.0, substeps=2)
    simulation.state.x[:, simulation.slot] = 0.1
    shown = run(simulation, 3)
    assert np.isfinite(shown.x).all()


def test_a_run_repeats_to_the_bit():
    hashes = []
    for _ in range(2):
        simulation = scene({'a': square(0.0), 'b': square(0.011, x=0.013)},
                           colliders={'table': {'plane': {}}})
        run(simulation, 20)
        hashes.append(simulation.hash())
    assert hashes[0] == hashes[1]


def test_a_surface_needs_triangles():
    with pytest.raises(InputError, match='surface needs triangles'):
        simulate((5, 1), scene_effects={'self_collision': EXAMPLES['self_collision']})


def thrown(threads, mode, speed, buffer=None):
    """Throw a sheet onto another; return hashes of frames, particles held back, and the list."""
    simulation = scene({'a': square(0.0, 9), 'b': square(0.06, 9, x=0.02, y=0.01)}, mode=mode,
                       pins={'c': {'cloth': 'a', 'at': 'corner_00'},
                             'd': {'cloth': 'a', 'at': 'corner_11'}},
                       solver={'method': 'gauss_seidel', 'integrator': 'backward_euler',
                               'substeps': 4, 'threads': threads})
    effect, found, stopped = simulation.effects['self_collision'], [], 0
    if buffer is not None:    # room for the pairs that a thread finds
        effect.data = effect.data._replace(near=effect.data.near._replace(
            buffers=np.zeros((threads, 4, buffer + CANDIDATES), np.int32)))
        simulation._collect()
    slots = simulation.cloths[1].slots
    simulation.state.v[2, slots] = -speed * np.linspace(1.0, 0.2, len(slots))
    for _ in range(24):
        simulation.step()
        simulation._crew._rest = 0    # else only the first frames with fewer cores than threads
        stopped += simulation.stats()['self_stopped']
        found.append(simulation.hash())
    return found, stopped, effect.data.near


@pytest.mark.parametrize('mode, speed, buffer', [
    ('surface', 0.5, None), slow('surface', 0.5, 100), slow('surface', 40.0, None),
    slow('particles', 0.5, None)])
def test_the_bits_are_the_same_with_any_number_of_threads(mode, speed, buffer):
    """Also where a thread has no room for what it finds, and where particles are held back."""
    one, stopped, near = thrown(1, mode, speed)
    assert near.count[0] > 0 and len(set(one)) == len(one)
    assert (stopped > 0) == (speed > 1.0)
    for threads in (2, 3):
        found, _, shared = thrown(threads, mode, speed, buffer)
        assert found == one
        assert all_listed(shared) == all_listed(near)
        most = max(shared.pieces[1, k::threads].sum() for k in range(threads))
        assert most > 0 if buffer is None else most > buffer
