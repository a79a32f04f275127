"""What every effect must do, whatever it is; walks EFFECTS, so a new one is held to it too."""

from dataclasses import fields, MISSING
import re

import numpy as np
import pytest
from sim.small import EXAMPLES, run, run_until_still, simulate, with_every_effect

from xpbd_ros.effects import EFFECTS, load, SECTIONS
from xpbd_ros.errors import InputError
from xpbd_ros.sim import stages
from xpbd_ros.sim.state import Substep

OF_CLOTHS = [name for name, scope in EFFECTS.items() if scope == 'cloth']
WITH_ENERGY = [name for name in OF_CLOTHS if load(name).energy is not None]
WITH_RESIDUAL = [name for name in OF_CLOTHS if load(name).residual is not None]
H = 0.01
SUBSTEP = Substep(H, 0.0, 1.0)
TILT = {'position': [0.1, -0.2, 0.3], 'orientation': [0.1, 0.7, -0.1, 0.7]}


def cloth(name, grid=(4, 3), **options):
    """Return a cloth with oblong cells that has one effect, and room for pins."""
    return simulate(grid, (0.6, 0.5), effects={name: EXAMPLES[name]}, scene_effects={'pin': {}},
                    pose=TILT, **options)


def apply(stage, data, state):
    """Run one stage of one effect."""
    kernel = stages._KERNELS.get((stage, type(data)))
    if kernel is not None:
        kernel(data, state, SUBSTEP)


def single(value, c, count):
    """Return an effect's data with only the constraint c."""
    if hasattr(value, '_fields'):
        return type(value)(*(
            field if name in ('held', 'colours') else single(field, c, count)
            for name, field in zip(value._fields, value)))
    return value[c:c + 1].copy() if len(value) == count else value


def crumple(simulation, seed=0):
    """Displace every particle by a tenth of an edge, and return its state."""
    simulation.state.x[:] += np.random.default_rng(seed).normal(0.0, 0.02,
                                                                simulation.state.x.shape)
    return simulation.state


def gradient(function, x, step=1e-6):
    """Return the derivative of a function of positions: its shape, then that of x."""
    columns = []
    for index in np.ndindex(x.shape):
        there, back = x.copy(), x.copy()
        there[index] += step
        back[index] -= step
        columns.append((np.asarray(function(there)) - np.asarray(function(back))) / (2.0 * step))
    return np.stack(columns, -1).reshape(*np.shape(columns[0]), *x.shape)


def constraints(name, seed=0):
    """Yield the state of a crumpled cloth and each constraint of its effect alone."""
    simulation = cloth(name)
    state = crumple(simulation, seed)
    built = simulation.effects[name]
    count = len(built.particles)
    assert count > 4
    for c in range(count):
        yield state, single(built.data, c, count), built.particles[c]


@pytest.mark.parametrize('name', EFFECTS)
def test_an_effect_says_what_it_is(name):
    effect = load(name)
    module = re.sub(r'\s+', ' ', __import__(effect.build.__module__, fromlist=['x']).__doc__)
    assert effect.name == name
    assert 'Limits:' in module
    for field in fields(effect.parameters):
        metadata = field.metadata
        assert metadata['doc'], field.name
        assert field.default is not MISSING or field.default_factory is not MISSING or metadata[
            'above'] is not None or metadata['minimum'] is not None, field.name
    assert set(effect.needs) <= {*EFFECTS, 'self_collision'}
    assert (effect.entry is not None) == (name in SECTIONS.values())
    assert name in EXAMPLES, 'give sim/small.py an example of the new effect'


@pytest.mark.parametrize('name', OF_CLOTHS)
def test_the_rest_shape_stays_put_without_gravity(name):
    simulation = cloth(name, gravity=(0, 0, 0))
    start = simulation.state.x.copy()
    for _ in range(20):
        apply(stages.force, simulation.effects[name].data, simulation.state)
        apply(stages.prepare, simulation.effects[name].data, simulation.state)
        apply(stages.project, simulation.effects[name].data, simulation.state)
        apply(stages.finish, simulation.effects[name].data, simulation.state)
    np.testing.assert_allclose(simulation.state.x, start, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(simulation.state.v, 0.0)


@pytest.mark.parametrize('name', WITH_RESIDUAL)
def test_the_kernel_moves_along_the_gradient_of_the_residual(name):
    """Δx = -M⁻¹ h² Jᵀ (h² J M⁻¹ Jᵀ + α)⁻¹ C, with J by finite differences of the definition."""
    effect = load(name)
    for state, data, particles in constraints(name):
        before = state.x.copy()
        residual = np.atleast_1d(effect.residual(data, before)).ravel()
        jacobian = gradient(lambda x, data=data: np.ravel(effect.residual(data, x)), before)
        alpha = 0.5 * residual @ residual / effect.energy(data, before)
        weighted = H**2 * jacobian * state.inv_mass[:, None]
        system = np.einsum('apk,bpk->ab', weighted, jacobian) + alpha * np.eye(len(residual))
        expected = -np.einsum('apk,a->pk', weighted, np.linalg.solve(system, residual))
        apply(stages.prepare, data, state)
        apply(stages.project, data, state)
        np.testing.assert_allclose(state.x - before, expected, rtol=0.0,
                                   atol=1e-8 * np.abs(expected).max())
        others = np.setdiff1d(np.arange(len(before)), particles)
        np.testing.assert_array_equal(state.x[others], before[others])
        state.x[:] = before


@pytest.mark.parametrize('name', WITH_ENERGY)
def test_a_projection_exerts_no_force_and_no_torque(name):
    for state, data, _ in constraints(name):
        before = state.x.copy()
        apply(stages.prepare, data, state)
        apply(stages.project, data, state)
        pushed = state.mass[:, None] * (state.x - before)
        rounding = 1e-15 * state.mass.max()
        assert np.abs(pushed).max() > 1e9 * rounding
        np.testing.assert_allclose(pushed.sum(0), 0.0, atol=rounding)
        np.testing.assert_allclose(np.cross(before, pushed).sum(0), 0.0, atol=rounding)
        state.x[:] = before


@pytest.mark.parametrize('name', WITH_ENERGY)
def test_what_is_applied_already_counts_so_more_iterations_do_not_stiffen(name):
    """C + α f = 0 from the first projection on; without the memory C would go to 0."""
    for state, data, _ in constraints(name):
        before = state.x.copy()
        apply(stages.prepare, data, state)
        apply(stages.project, data, state)
        once = state.x.copy()
        for _ in range(10):
            apply(stages.project, data, state)
        np.testing.assert_allclose(state.x, once, rtol=0.0,
                                   atol=1e-3 * np.abs(once - before).max())
        state.x[:] = before


@pytest.mark.parametrize('name', WITH_ENERGY)
def test_the_force_on_a_pinned_particle_is_minus_the_gradient_of_the_energy(name):
    effect = load(name)
    for state, data, particles in constraints(name):
        before = state.x.copy()
        state.inv_mass[particles[0]] = 0.0
        state.reaction[:] = 0.0
        held = next(value for value in _arrays(data, 'held'))
        held[:2] = (1, 0)
        apply(stages.prepare, data, state)
        apply(stages.project, data, state)
        apply(stages.react, data, state)
        expected = -gradient(lambda x, data=data: effect.energy(data, x), state.x)[particles[0]]
        np.testing.assert_array_equal(state.x[particles[0]], before[particles[0]])
        np.testing.assert_allclose(state.reaction[particles[0]], expected, rtol=0.0,
                                   atol=1e-6 * np.linalg.norm(expected))
        state.x[:] = before
        state.inv_mass[:] = 1.0 / state.mass


def _arrays(data, name):
    """Yield the arrays of that name in an effect's data."""
    for key, value in zip(data._fields, data):
        if hasattr(value, '_fields'):
            yield from _arrays(value, name)
        elif key == name:
            yield value


@pytest.mark.parametrize('name', WITH_ENERGY)
def test_no_two_constraints_of_a_colour_share_a_particle(name):
    built = cloth(name, (7, 6)).effects[name]
    starts, = _arrays(built.data, 'colours')
    assert starts[-1] == len(built.particles)
    for begin, end in zip(starts[:-1], starts[1:]):
        members = built.particles[begin:end].ravel()
        assert len(np.unique(members)) == len(members)


@pytest.mark.parametrize('name', WITH_ENERGY)
def test_a_pinned_particle_is_not_moved_and_all_pinned_is_fine(name):
    simulation = cloth(name)
    state, data = crumple(simulation), simulation.effects[name].data
    before = state.x.copy()
    state.inv_mass[:5] = 0.0
    apply(stages.prepare, data, state)
    apply(stages.project, data, state)
    np.testing.assert_array_equal(state.x[:5], before[:5])
    assert (state.x[5:] != before[5:]).any()
    state.inv_mass[:] = 0.0
    state.x[:] = before
    apply(stages.prepare, data, state)
    apply(stages.project, data, state)
    np.testing.assert_array_equal(state.x, before)


def test_a_hanging_cloth_balances_its_weight():
    """
    The forces are those of the energies' definitions: Σ ∇E = m g at every free particle.

    Up to what one substep turns the gradients by, which falls with its square.
    """
    errors = []
    for substeps in (4, 8, 16, 32):
        simulation = simulate(
            (4, 4), effects={name: EXAMPLES[name] for name in OF_CLOTHS}, substeps=substeps,
            iterations=30, scene_effects={'damping': {'rate': 15.0}}, density=0.2,
            pins={'a': {'cloth': 'c', 'at': 'corner_10'}, 'b': {'cloth': 'c', 'at': 'edge_0x'}})
        run_until_still(simulation, speed=1e-10)
        state = simulation.state
        pull = -gradient(lambda x, effects=simulation.effects: sum(
            load(name).energy(effects[name].data, x) for name in WITH_ENERGY), state.x)
        weight = state.mass[:, None] * state.gravity
        errors.append(np.abs((pull + weight)[state.inv_mass > 0.0]).max() / np.abs(weight).max())
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), 2.0, atol=0.2)
    assert errors[-1] < 5e-5


@pytest.mark.parametrize('name', WITH_ENERGY)
def test_compliance_scale_divides_the_energy(name):
    energies = []
    for scale in (1.0, 4.0):
        simulation = cloth(name, scale=scale)
        energies.append(load(name).energy(simulation.effects[name].data,
                                          crumple(simulation).x))
    assert energies[0] == pytest.approx(4.0 * energies[1], rel=1e-12)


@pytest.mark.parametrize('name', EFFECTS)
def test_every_parameter_has_a_range_that_is_kept(name):
    """What is below the range is refused with key and unit."""
    for field in fields(load(name).parameters):
        bound = field.metadata['above'] if field.metadata['above'] is not None else field.metadata[
            'minimum']
        if bound is None or field.name == 'pairs':
            continue
        parameters = {**EXAMPLES[name], field.name: bound - 1.0}
        path = f'cloths.c.effects.{name}' if name in OF_CLOTHS else f'effects.{name}'
        with pytest.raises(InputError) as error:
            simulate(effects={name: parameters} if name in OF_CLOTHS else None,
                     scene_effects=None if name in OF_CLOTHS else {name: parameters})
        assert str(error.value).startswith(f'small.yaml: {path}.{field.name}: must be ')


def test_all_effects_together_run_the_same_twice_and_end_at_rest():
    """A cloth on a table, held at a corner."""
    hashes = []
    for _ in range(2):
        simulation = with_every_effect((9, 8), substeps=8, pins={
            'a': {'cloth': 'c', 'at': 'corner_00', 'target': [0.2, 0.2, 0.3]}})
        frame = run(simulation, 1000)
        assert np.linalg.norm(frame.v, axis=1).max() < 1e-6
        hashes.append(simulation.hash())
    assert hashes[0] == hashes[1]
