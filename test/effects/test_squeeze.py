"""Layers of cloth between pads: they press and rub on one another as the pads squeeze them."""

import numpy as np
import pytest

from support.scenes import run, SETTINGS
from support.tiers import slow
import xpbd_ros
from xpbd_ros.sim.commands import Release, SetKey
from xpbd_ros.sim.self_collision.springs import conjugate_gradients, new_springs

R, MU, OVERLAP, SIZE, DENSITY = 0.002, 0.5, 0.001, 0.06, 0.2
"""thickness, friction, indentation of each pad [m], side of a sheet [m], [kg/m²]"""
USUAL = 'line', 'ndf2'


def stack(count, setting=USUAL, *, stiffness=1e5, substeps=8, pad=10.0, mu=MU, spread=0.001,
          rub=MU, middle=DENSITY, overlap=OVERLAP, wall=False, table=False, seed=None, threads=1):
    """
    Return sheets on one another, which pads close about in 0.1 s, and F by K A δ [N].

    The sheets are apart sideways, by up to ``spread`` from the middle [m]. ``mu`` is the friction
    of the pads, ``rub`` that of the sheets. ``wall`` is a rigid collider beside them; with
    ``table`` there is one below them instead of a pad.
    """
    apart = np.random.default_rng(count if seed is None else seed).uniform(
        -0.5 * SIZE - spread, -0.5 * SIZE + spread, (count, 2))
    high = 0.5 * (count + 1) * R - overlap + 0.01
    bodies = {name: {
        'box': {'size': [pad, pad, 0.02]}, 'friction': mu, 'pad': {'stiffness': stiffness},
        'motion': [[0.0, 0.0, 0.0, side * (high + R)], [0.1, 0.0, 0.0, side * high]]}
        for name, side in (('above', 1), ('below', -1))}
    if wall:
        bodies['wall'] = {'box': {'size': [0.02, 1.0, 0.02]},
                          'position': [0.5 * SIZE + spread + R + 0.01, 0.0, 0.0]}
    if table:
        bodies['below'] = {'box': {'size': [1.0, 1.0, 0.02]}, 'friction': mu,
                           'position': [0.0, 0.0, -0.5 * (count + 1) * R - 0.01]}
    area = min(SIZE, pad)**2
    return xpbd_ros.load({
        'frame_rate': 60, 'gravity': [0.0, 0.0, 0.0],
        'solver': {'method': setting[0], 'integrator': setting[1], 'substeps': substeps,
                   'threads': threads},
        'cloths': {f'c{k}': {
            'grid': {'size': [SIZE, SIZE], 'resolution': [7, 7]},
            'density': middle if k == count // 2 else DENSITY,
            'pose': {'position': [*(float(x) for x in apart[k]), (k - 0.5 * (count - 1)) * R]},
            'effects': {'stretch': {'warp': 500.0, 'weft': 500.0}, 'bend': {'stiffness': 1e-5}},
            'friction': rub} for k in range(count)},
        'colliders': bodies,
        'effects': {'contact': {'thickness': R}, 'self_collision': {'thickness': R},
                    'friction': {}},
    }), stiffness * area * overlap


def forces(simulation) -> np.ndarray:
    """Return the normal forces of both pads [N]."""
    return np.array([simulation.stats()[f'pad_force_{name}_n'] for name in ('above', 'below')])


def layers(values, count) -> np.ndarray:
    """Return the mean of each layer's particles."""
    return values.reshape(count, -1, 3).mean(1)


@pytest.mark.parametrize('count, setting, substeps, stiffness', [
    (2, USUAL, 8, 1e7), (3, USUAL, 8, 1e7),
    *(slow(*case) for case in (
        (2, USUAL, 8, 1e8), (3, USUAL, 8, 1e5), (4, USUAL, 24, 1e6), (4, USUAL, 8, 1e8),
        (6, USUAL, 16, 1e7), *((count, setting, substeps, 1e7) for count in (2, 4)
                               for setting in SETTINGS for substeps in (4, 32))))])
def test_a_stack_is_squeezed_by_the_indentation(count, setting, substeps, stiffness):
    """All layers transmit what the pads press with, stay a thickness apart, and at rest."""
    simulation, force = stack(count, setting, stiffness=stiffness, substeps=substeps)
    frame = run(simulation, 60)
    np.testing.assert_allclose(forces(simulation), force, rtol=0.025)
    apart = np.diff(np.median(frame.x.reshape(count, -1, 3), 1)[:, 2])
    np.testing.assert_allclose(apart, R, rtol=0.01)
    assert np.abs(frame.v).max() < 0.02


@pytest.mark.parametrize('count, stiffness, fastest', [
    (2, 1e7, 0.1), (3, 1e7, 0.1), *(slow(*case) for case in (
        (2, 5e7, 0.1), (3, 5e7, 0.1), (4, 5e7, 0.25), (6, 1e7, 0.25)))])
def test_a_stack_in_fingers_narrower_than_itself_rests(count, stiffness, fastest):
    """They press on 9 particles of 1 cm² in each layer; the cloth about them is free."""
    simulation, _ = stack(count, stiffness=stiffness, substeps=15, pad=0.035)
    run(simulation, 20)
    frames = [run(simulation, 1) for _ in range(20)]
    np.testing.assert_allclose(forces(simulation), stiffness * 9e-4 * OVERLAP, rtol=0.03)
    assert max(np.abs(frame.v).max() for frame in frames) < fastest


@pytest.mark.parametrize('count', [2, slow(4)])
def test_a_stack_without_friction_rests(count):
    """Nothing but the pads' normal forces acts on it, and these balance."""
    simulation, force = stack(count, stiffness=1e7, mu=0.0, rub=0.0)
    run(simulation, 20)
    frames = [run(simulation, 1) for _ in range(20)]
    np.testing.assert_allclose(forces(simulation), force, rtol=0.02)
    assert max(np.abs(frame.v).max() for frame in frames) < 0.02


def test_crushed_layers_meet_the_pads_as_rigid():
    """Pads close by 6 mm each, where a quarter of their thickness is 5 mm: forces stay bounded."""
    simulation, force = stack(4, stiffness=1e7, substeps=15, pad=0.035, overlap=0.006)
    most = []
    for _ in range(20):
        frame = run(simulation, 1)
        most.append(forces(simulation).max())
    assert np.isfinite(frame.x).all() and np.isfinite(frame.v).all()
    assert np.abs(frame.x).max() < 0.2
    assert 0.0 < max(most) < 3.0 * force


def test_a_wall_beside_a_stack_has_no_part_in_the_squeeze():
    """The pads press as without it, and it stops the layers that are pulled against it."""
    simulation, force = stack(3, stiffness=1e5, mu=0.0, rub=0.0, spread=0.0, wall=True)
    run(simulation, 12)
    mass, impulse, weight = 3 * DENSITY * SIZE**2, 0.0, 0.0
    frame = simulation.step([SetKey('gravity', (5.0, 0.0, 0.0))])
    for _ in range(10):
        before = mass * frame.v[:, 0].mean()
        frame = run(simulation, 1)
        impulse += frame.colliders['wall'].force[0] / 60.0
        weight += 5.0 * mass / 60.0 + before - mass * frame.v[:, 0].mean()
    np.testing.assert_allclose(forces(simulation), force, rtol=0.02)
    assert frame.x[:, 0].max() < 0.5 * SIZE + 1e-4
    assert impulse == pytest.approx(weight, rel=0.01)


@pytest.mark.parametrize('count, setting, substeps, stiffness', [
    (3, USUAL, 8, 1e7), *(slow(*case) for case in (
        (2, USUAL, 8, 1e8), (6, USUAL, 16, 1e6),
        *((count, setting, substeps, 1e7) for count in (2, 4)
          for setting in SETTINGS for substeps in (4, 32))))])
def test_layers_on_a_table_transmit_what_a_pad_presses_with(count, setting, substeps, stiffness):
    """The table bears it too; all layers stay a thickness apart, and at rest."""
    simulation, force = stack(count, setting, stiffness=stiffness, substeps=substeps, spread=0.0,
                              table=True)
    frame = run(simulation, 60)
    found = simulation.stats()['pad_force_above_n'], -frame.colliders['below'].force[2]
    np.testing.assert_allclose(found, force, rtol=0.01 * count)
    apart = np.diff(np.median(frame.x.reshape(count, -1, 3), 1)[:, 2])
    np.testing.assert_allclose(apart, R, rtol=0.01)
    assert np.abs(frame.v).max() < 0.02


@pytest.mark.parametrize('count, seed', [(2, 1), *(slow(*case) for case in (
    (2, 2), (2, 3), (3, 2), (3, 3)))])
def test_layers_on_a_table_rest_under_a_finger_narrower_than_they_are(count, seed):
    """The cloth about the finger is free."""
    simulation, _ = stack(count, stiffness=1e7, substeps=15, pad=0.035, spread=0.005, table=True,
                          seed=seed)
    run(simulation, 60)
    frames = [run(simulation, 1) for _ in range(20)]
    assert max(np.abs(frame.v).max() for frame in frames) < 0.1


def slide(simulation, count, pull, frames=6):
    """Return the speed along x of each layer after some frames of a pull along x [m/s²]."""
    simulation.step([SetKey('gravity', (pull, 0.0, 0.0))])
    return layers(run(simulation, frames - 1).v, count)[:, 0], frames / 60.0


@pytest.mark.parametrize('count, setting, substeps', [
    (2, USUAL, 8), (3, USUAL, 8), *(slow(*case) for case in (
        (4, USUAL, 16), (5, USUAL, 8), *((3, setting, 32) for setting in SETTINGS)))])
def test_a_stack_slips_at_twice_mu_times_the_force(count, setting, substeps):
    """The pads hold all layers by the friction on the outer ones, and these move as one body."""
    for load in (0.85, 1.3):
        simulation, _ = stack(count, setting, stiffness=1e4, substeps=substeps)
        run(simulation, 12)
        limit = 2.0 * MU * forces(simulation).mean() / (count * DENSITY * SIZE**2)
        speed, time = slide(simulation, count, load * limit)
        if load < 1.0:
            assert np.abs(speed).max() < 1e-3 * limit * time
        else:
            np.testing.assert_allclose(speed, (load - 1.0) * limit * time, rtol=0.01)


@pytest.mark.parametrize('load, holds', [(0.9, True), (1.3, False)])
def test_a_layer_is_drawn_out_of_a_stack_against_the_friction_of_both_its_faces(load, holds):
    """The pads are rougher than the cloths, and the layer is heavier, so the other two stay."""
    simulation, _ = stack(3, stiffness=1e4, mu=4.0, middle=10.0 * DENSITY)
    run(simulation, 12)
    limit = 2.0 * MU * forces(simulation).mean() / (10.0 * DENSITY * SIZE**2)
    speed, time = slide(simulation, 3, load * limit)
    assert np.abs(speed[[0, 2]]).max() < 5e-3 * limit * time
    expected = 0.0 if holds else (load - 1.0) * limit * time
    assert speed[1] == pytest.approx(expected, abs=0.02 * limit * time)


def test_pads_bear_the_weight_of_all_layers():
    """The wrenches on both close Newton's law, while the stack rests between them."""
    simulation, _ = stack(4, stiffness=1e5)
    run(simulation, 12)
    simulation.step([SetKey('gravity', (3.0, 0.0, -2.0))])
    frame = run(simulation, 20)
    found = sum(np.array(frame.colliders[name].force) for name in ('above', 'below'))
    weight = 4 * DENSITY * SIZE**2
    np.testing.assert_allclose(found, [3.0 * weight, 0.0, -2.0 * weight], atol=0.01 * weight)


def test_the_pairs_of_a_stack_are_those_of_all_layers_about_the_pads():
    """Every interface takes part, and no particle far from the pads."""
    simulation, _ = stack(4, stiffness=1e6, pad=0.025)
    frame = run(simulation, 20)
    squeeze = simulation.effects['self_collision'].data.squeeze
    pairs, listing = simulation.effects['self_collision'].data.pairs, squeeze.stack
    listed = listing.particles[:listing.count[1]]
    interfaces = {tuple(sorted({int(i) // 49 for i in pairs.particles[:, k] if i < len(frame.x)}))
                  for k in listing.pairs[:listing.count[0]]}
    assert interfaces == {(0, 1), (1, 2), (2, 3)}
    assert np.abs(frame.x[listed, :2]).max() < 0.0125 + 3.0 * 0.01
    for layer in range(4):
        inside = np.flatnonzero((np.abs(frame.x[:, :2]) < 0.0125).all(1)) // 49 == layer
        assert np.isin(np.flatnonzero((np.abs(frame.x[:, :2]) < 0.0125).all(1))[inside],
                       listed).all()


def test_a_saved_state_goes_on_with_the_same_bits():
    """Its working memory is not copied."""
    simulation, _ = stack(3, stiffness=1e6)
    run(simulation, 10)
    other = simulation.save().simulation()
    assert not np.shares_memory(*(each.effects['self_collision'].data.squeeze.y
                                  for each in (simulation, other)))
    run(simulation, 3)
    run(other, 3)
    assert simulation.hash() == other.hash()


@pytest.mark.parametrize('count', [1, 2, 3])
def test_layers_are_a_stack_once_pads_squeeze_them(count):
    """A single layer is none: it has no pairs."""
    simulation, _ = stack(count, stiffness=1e6)
    listed = simulation.effects['self_collision'].data.squeeze.stack.count
    run(simulation, 1)
    assert listed[0] == 0
    run(simulation, 19)
    assert (listed[0] > 0) == (count > 1)


@pytest.mark.slow
def test_a_stack_has_the_same_bits_with_any_number_of_threads():
    """One thread solves each island, while others wait."""
    hashes = set()
    for threads in (1, 2, 3):
        simulation, _ = stack(4, stiffness=1e7, threads=threads, pad=0.035)
        run(simulation, 20)
        hashes.add(simulation.hash())
    assert len(hashes) == 1


@pytest.mark.parametrize('components', [1, 3])
def test_steps_of_springs_solve_the_linear_system(components):
    """One component, or those across each particle's axis; a fixed particle does not move."""
    rng, count, springs = np.random.default_rng(3), 9, 24
    found = new_springs(springs, count)
    found = found._replace(count=found.count[0])
    found.ends[:] = np.array([rng.permutation(count)[:4] for _ in range(springs)])
    found.weight[:] = rng.normal(size=(springs, 4))
    found.stiffness[:] = rng.uniform(0.0, 30.0, springs)
    active = np.flatnonzero(np.arange(springs) % 4)
    found.count[1] = len(active)
    found.active[:len(active)] = active
    found.mass[:] = rng.uniform(0.5, 2.0, count)
    found.mass[4] = 0.0
    axis = rng.normal(size=(count, 3))
    found.axis[:] = axis / np.linalg.norm(axis, axis=1)[:, None]
    matrix = np.diag(found.mass)
    for t in active:
        w = np.zeros(count)
        w[found.ends[t]] = found.weight[t]
        matrix += found.stiffness[t] * np.outer(w, w)
    found.diagonal[:] = np.diag(matrix)
    free = np.delete(np.arange(count), 4)
    r = rng.normal(size=(count, components))
    if components == 1:
        expected = np.linalg.solve(matrix[np.ix_(free, free)], r[free])
    else:
        across = np.array([np.linalg.svd(a[None])[2][1:] for a in found.axis])
        r -= (r * found.axis).sum(1)[:, None] * found.axis
        basis = np.zeros((3 * count, 2 * count))
        for i in range(count):
            basis[3 * i:3 * i + 3, 2 * i:2 * i + 2] = across[i].T
        basis = basis[:, np.repeat(2 * free, 2) + np.tile([0, 1], len(free))]
        whole = basis.T @ np.kron(matrix, np.eye(3)) @ basis
        expected = (basis @ np.linalg.solve(whole, basis.T @ r.ravel())).reshape(-1, 3)[free]
    r[4] = 0.0
    found.residual[:components * count] = r.T.ravel()
    conjugate_gradients(found, count, components, 1e-24)
    x = found.x[:components * count].reshape(components, count).T
    np.testing.assert_allclose(x[free], expected, rtol=1e-6, atol=1e-9)
    assert (x[4] == 0.0).all()


def hanging(count, stiffness, substeps, path=()):
    """
    Return sheets that hang from fingers narrower than they are, after their pins are released.

    ``path`` are places of the fingers at later times, rows (t, x, y, z) from t = 0.5 s on.
    """
    high = 0.5 * (count + 1) * R - OVERLAP + 0.005
    simulation = xpbd_ros.load({
        'frame_rate': 60, 'solver': {'method': 'line', 'integrator': 'ndf2', 'substeps': substeps},
        'cloths': {f'c{k}': {
            'grid': {'size': [0.12, 0.16], 'resolution': [13, 17]}, 'density': 0.25,
            'friction': MU, 'pose': {'position': [-0.06 + R * k, (k - 0.5 * (count - 1)) * R, 0.0],
                                     'orientation': [0.5**0.5, 0.0, 0.0, 0.5**0.5]},
            'effects': {'stretch': {'warp': 1000.0, 'weft': 1000.0}, 'shear': {'stiffness': 50.0},
                        'bend': {'stiffness': 1e-5}}} for k in range(count)},
        'colliders': {name: {
            'box': {'size': [0.04, 0.01, 0.02]}, 'friction': 0.8, 'pad': {'stiffness': stiffness},
            'motion': [[0.0, 0.0, side * (high + 0.004), 0.15], [0.15, 0.0, side * high, 0.15],
                       *([t, x, y + side * high, z + 0.15] for t, x, y, z in path)]}
            for name, side in (('front', 1), ('back', -1))},
        'pins': {f'p{k}': {'cloth': f'c{k}', 'at': 'edge_x1'} for k in range(count)},
        'effects': {'contact': {'thickness': R}, 'self_collision': {'thickness': R},
                    'friction': {}}})
    run(simulation, 20)
    simulation.step([Release(f'p{k}') for k in range(count)])
    return simulation


@pytest.mark.slow
@pytest.mark.parametrize('count, stiffness', [(2, 2e7), (3, 2e7), (4, 2e7), (2, 2e8)])
def test_fingers_hold_sheets_that_hang_from_their_edges(count, stiffness):
    """Friction bears many times their weight; without it they fall by 4.9 m."""
    simulation = hanging(count, stiffness, 15)
    before = layers(run(simulation, 20).x, count)[:, 2]
    np.testing.assert_allclose(layers(run(simulation, 60).x, count)[:, 2], before, atol=0.002)


def shake(seed, reversals=24):
    """Return a lift by 0.1 m, then strokes of 6 cm in 0.09 s, parallel to the fingers' faces."""
    ways = np.random.default_rng(seed).normal(size=(reversals, 3)) * [1.0, 0.0, 1.0]
    ways *= 0.03 / np.linalg.norm(ways, axis=1)[:, None]
    ways[1::2] = -ways[::2]
    return [[0.5, 0.0, 0.0, 0.0], [0.8, 0.0, 0.0, 0.1],
            *([0.8 + 0.09 * (n + 1), x, y, z + 0.1] for n, (x, y, z) in enumerate(ways))]


@pytest.mark.parametrize('count, stiffness, substeps, seed', [
    (2, 2e7, 8, 4), *(slow(*case) for case in (
        *((2, 2e7, 8, seed) for seed in (1, 2, 3)), (2, 2e8, 15, 4),
        *((count, 2e7, 15, seed) for count in (3, 4) for seed in (1, 2))))])
def test_fingers_hold_sheets_through_a_lift_and_a_shake(count, stiffness, substeps, seed):
    """The fingers reverse 24 times, at 0.67 m/s, while the sheets swing below them."""
    simulation = hanging(count, stiffness, substeps, shake(seed))
    frame = run(simulation, 180)
    high = layers(frame.x, count)[:, 2]
    assert (high > 0.1).all(), high
