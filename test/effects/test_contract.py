"""What every effect must do, whatever it is; walks EFFECTS, so a new one is held to it too."""

from dataclasses import fields, MISSING
import re

import numpy as np
import pytest

from support.meshes import file_of
from support.scenes import (
    EXAMPLES,
    run,
    run_stage,
    run_until_still,
    SETTINGS,
    SHAPES,
    simulate,
    with_effects,
)
from support.tiers import quick_only
from xpbd_ros.effects import EFFECTS, load, SECTIONS
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.scene.stability import stability_limit
from xpbd_ros.sim.backend.simd import lane_count
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.grid_batches import Runs
from xpbd_ros.sim.constraints.pinned import hold_batch
from xpbd_ros.sim.measure import elastic_energy
from xpbd_ros.sim.particles.accumulators import Explicit, Jacobi
from xpbd_ros.sim.particles.state import places, Substep
from xpbd_ros.sim.stepping import stages

OF_CLOTHS = [name for name, scope in EFFECTS.items() if scope == 'cloth']
ELASTIC = [name for name in OF_CLOTHS if name not in ('strain_limit', 'tether', 'rayleigh')]
"""those that have an energy: neither bounds nor damping"""
BOUNDS = {'strain_limit': {'max': 0.1}, 'seam': {'compliance': 0.002}}
"""within a cloth, and without an energy"""
ELSEWHERE = {
    'pin': 'outside: test_pin has its places, springs and wrench',
    'wind': 'moves nothing itself',
    'drag': 'outside: test_drag has the formula and the terminal speed',
    'force': 'outside: test_force has it as gravity',
    'damping': 'outside: test_damping has the closed form',
    'rayleigh': 'of the other constraints: test_rayleigh has the oscillator and its momentum',
    'tether': 'outside, from pins: test_limits has how far and what pulls',
    'self_collision': 'unilateral: test_self_collision has pairs, momentum and planes',
    'contact': 'outside, unilateral: test_contact has each shape',
    'friction': 'outside: test_friction has the incline, the stop and the capstan',
}
"""why the checks of energies leave an effect out"""
H = 0.01
SUBSTEP = Substep(H, 0.0, 1.0)
TILT = {'position': [0.1, -0.2, 0.3], 'orientation': [0.1, 0.7, -0.1, 0.7]}


ON_MESHES = [(name, mesh) for name in ELASTIC for mesh in (False, True)
             if mesh or name not in SHAPES if not (mesh and name in ('shear',))]
SHEETS = [name for name in ELASTIC if name not in SHAPES]
KINDS = pytest.mark.parametrize('name, mesh', ON_MESHES)
"""each effect of cloths on a grid, and on another mesh where it can be"""


SLOW = ('jacobi', 'explicit')
"""methods that take long to come to rest; they have tests of their own"""


def cloth(name, grid=(4, 3), **options):
    """Return a cloth with oblong cells, or a body, that has one effect, and room for pins."""
    if name in SHAPES:
        options['mesh'] = file_of(*SHAPES[name]())
    return simulate(grid, (0.6, 0.5), effects={name: EXAMPLES[name]}, scene_effects={'pin': {}},
                    pose=TILT, **options)


def apply(stage, data, state):
    """Run one stage of one effect."""
    state.mobility[:] = state.inv_mass * H**2
    run_stage(stage, data, state, SUBSTEP)


def apply_all(stage, built, state):
    """Run one stage of one effect, on all its parts in their order, or back."""
    for data in built.parts[::-1] if stage is stages.project_back else built.parts:
        apply(stage, data, state)


def batch_of(data):
    """Return the part of an effect's data that has its constraints."""
    return data if hasattr(data, 'runs') or hasattr(data, 'particles') else data.edges


def single(data, these, c):
    """Return an effect's data with only the constraint c."""
    batch, index = batch_of(data), these.index[c]
    if hasattr(batch, 'particles'):    # in packs: the other lanes are left to the padding
        own = {field: array.copy() for field, array in batch._asdict().items()
               if isinstance(array, np.ndarray) and field != 'records'}
        own['particles'][:] = batch.records.shape[0] - 1
        own['particles'][:, index] = these.particles[c]
        alone = batch._replace(**own)
        return alone if batch is data else data._replace(edges=alone)
    runs = batch.runs
    r = next(r for r in range(len(runs.start)) if index - (runs.start[r] + runs.base[r]) in (
        j * runs.stride[r] + k for j in range(runs.rows[r]) for k in range(runs.count[r])))
    anchor = index - runs.base[r]
    place = runs.place[r] + (anchor - runs.start[r]) % runs.stride[r]
    if getattr(batch, 'stops', None) is not None:
        batch = batch._replace(stops=batch.stops._replace(first=np.zeros(2, np.int64)))
    alone = batch._replace(runs=Runs(
        *(np.array([value]) for value in (anchor, 1, 1, 0)), runs.offset[r:r + 1],
        *(np.array([value]) for value in (runs.base[r], runs.shape[r], place)),
        np.array([0, 1, 1]), np.array([0, 1, 2]), runs.present))
    return alone if batch_of(data) is data else data._replace(edges=alone)


def one_by_one(built):
    """Yield each constraint of an effect, with the effect's data for it alone."""
    for data, these in zip(built.parts, built.by_part, strict=True):
        batch = batch_of(data)
        if len(these.particles) == 1:    # the gas of a surface
            yield data, these
            continue
        for c in range(len(these.particles)):
            alone = single(data, these, c)
            constraint = type(these).of(batch_of(alone))
            if hasattr(batch, 'runs'):
                np.testing.assert_array_equal(constraint.particles, these.particles[c:c + 1])
                np.testing.assert_array_equal(constraint.index, these.index[c:c + 1])
            yield alone, constraint


def crumple(simulation, seed=0):
    """Displace every particle by a tenth of an edge, and return its state."""
    state, slot = simulation.state, simulation.slot
    state.x[:, slot] += np.random.default_rng(seed).normal(0.0, 0.02, (3, len(slot)))
    return state


def gradient(function, x, particles, step=1e-6):
    """Return the derivative of a function of positions: its shape, then 3, then the particles."""
    columns = []
    for k in range(3):
        for i in particles:
            there, back = x.copy(), x.copy()
            there[k, i] += step
            back[k, i] -= step
            columns.append((np.asarray(function(there)) - np.asarray(function(back)))
                           / (2.0 * step))
    return np.stack(columns, -1).reshape(*np.shape(columns[0]), 3, len(particles))


def constraints(name, mesh):
    """Yield the state of a crumpled cloth and each constraint of its effect alone."""
    simulation = cloth(name, mesh=mesh)
    state = crumple(simulation)
    found = list(one_by_one(simulation.effects[name]))
    assert len(found) == len(simulation.effects[name].constraints.particles)
    assert len(found) > 4 or name == 'pressure'    # which is one for a whole surface
    for data, constraint in found:
        yield state, data, constraint


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
    assert set(effect.needs) <= set(EFFECTS)
    assert (effect.entry is not None) == (name in SECTIONS.values())
    assert name in EXAMPLES, 'give test/support/scenes.py an example of the new effect'


def test_each_effect_passes_every_check_or_has_an_exception():
    assert sorted([*ELASTIC, *BOUNDS, *ELSEWHERE]) == sorted(EFFECTS)


@pytest.mark.parametrize('name', BOUNDS)
def test_a_bound_moves_its_two_particles_along_the_gradient(name):
    """By no force and no torque in sum, though their masses differ."""
    simulation = compile_scene(scene_from_mapping({
        'solver': {'method': 'gauss_seidel'},
        'cloths': {'c': {'grid': {'size': [0.6, 0.5], 'resolution': [2, 1]}, 'density': 1.0,
                         'pose': TILT, 'effects': {} if name == 'seam' else {
                             name: BOUNDS[name]}}},
        **({'seams': {'s': {'between': [{'cloth': 'c', 'at': at} for at in (
            'corner_00', 'corner_01')], **BOUNDS[name]}}} if name == 'seam' else {}),
    }, where='small.yaml', name='small'))
    state, ends = crumple(simulation), simulation.slot
    state.mass[ends] = 1.0, 3.0
    state.inv_mass[ends] = 1.0 / state.mass[ends]
    state.x[:, ends[1]] = state.x[:, ends[0]] + [0.9, -0.4, 0.5]    # too far
    before = state.x.copy()
    apply_all(stages.prepare, simulation.effects[name], state)
    apply_all(stages.project_inequalities, simulation.effects[name], state)
    d, mobility = before[:, ends[0]] - before[:, ends[1]], H**2 * state.inv_mass[ends]
    length = np.linalg.norm(d)
    rest, alpha = (0.0, 0.002) if name == 'seam' else (1.1 * 0.6, 0.0)
    force = -(length - rest) / (mobility.sum() + alpha) * d / length
    np.testing.assert_allclose((state.x - before)[:, ends], np.outer(force, mobility * [1, -1]),
                               rtol=1e-9)


@KINDS
def test_the_rest_shape_stays_put_without_gravity(name, mesh):
    simulation = cloth(name, gravity=(0, 0, 0), mesh=mesh)
    start = simulation.state.x.copy()
    for _ in range(20):
        apply_all(stages.force, simulation.effects[name], simulation.state)
        apply_all(stages.prepare, simulation.effects[name], simulation.state)
        apply_all(stages.project, simulation.effects[name], simulation.state)
        apply_all(stages.finish, simulation.effects[name], simulation.state)
    np.testing.assert_allclose(simulation.state.x, start, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(simulation.state.v, 0.0)


@KINDS
def test_the_kernel_moves_along_the_gradient_of_the_residual(name, mesh):
    """Δx = -M Jᵀ (J M Jᵀ + α)⁻¹ C with M = w h², J by finite differences of the definition."""
    for state, data, constraint in constraints(name, mesh):
        project_and_compare(state, data, constraint)


def test_so_it_does_for_a_body_that_is_stretched_far():
    """To twice its size, where C_D is not taken from the strain."""
    simulation = cloth('volume', mesh=True)
    simulation.state.x[:] *= 2.0
    data, constraint = next(one_by_one(simulation.effects['volume']))
    project_and_compare(crumple(simulation), data, constraint)


def project_and_compare(state, data, constraint):
    """Hold one projection of one constraint against its definition."""
    before, particles = state.x.copy(), constraint.particles[0]
    residual = constraint.residual(before).ravel()
    jacobian = gradient(lambda x: constraint.residual(x).ravel(), before, particles)
    alpha = (constraint.block[0] if hasattr(constraint, 'block') else
             constraint.compliance[0] * np.eye(len(residual)))
    assert constraint.energy(before) == pytest.approx(
        0.5 * residual @ np.linalg.solve(alpha, residual), rel=1e-12)
    weighted = H**2 * jacobian * state.inv_mass[particles]
    system = np.einsum('akp,bkp->ab', weighted, jacobian) + alpha
    expected = -np.einsum('akp,a->kp', weighted, np.linalg.solve(system, residual))
    apply(stages.prepare, data, state)
    apply(stages.project, data, state)
    np.testing.assert_allclose((state.x - before)[:, particles], expected, rtol=0.0,
                               atol=1e-8 * np.abs(expected).max())
    others = np.setdiff1d(np.arange(before.shape[1]), particles)
    np.testing.assert_array_equal(state.x[:, others], before[:, others])
    state.x[:] = before


@pytest.mark.parametrize('name, mesh', quick_only(
    ON_MESHES, ('stretch', True)))
def test_jacobi_relaxes_and_explicit_takes_the_force_at_x(name, mesh):
    """The projection of others with the mobilities over ω, times ω; and Δx = -w h² ∇E."""
    for state, data, constraint in list(constraints(name, mesh))[::7]:
        if not hasattr(batch_of(data), 'particles'):
            continue    # runs have tests of their own
        before, particles = state.x.copy(), constraint.particles[0]
        mobile = state._replace(inv_mass=5.0 * state.inv_mass)
        apply(stages.prepare, data, mobile)
        apply(stages.project, data, mobile)
        whole = state.x - before
        force = -gradient(constraint.energy, before, particles)
        state.x[:] = before
        room = np.zeros_like(before), np.zeros((before.shape[1], 4))
        for apart, expected in ((Jacobi(*room, np.full(1, 5.0)), 0.2 * whole[:, particles]),
                                (Explicit(*room), H**2 * force * state.inv_mass[particles])):
            apart.move[:] = 0.0
            aside = state._replace(apart=apart)
            apply(stages.prepare, data, aside)
            apply(stages.project, data, aside)
            np.testing.assert_array_equal(state.x, before)
            np.testing.assert_allclose(apart.move[:, particles], expected, rtol=0.0,
                                       atol=1e-6 * np.abs(expected).max())


@KINDS
def test_a_projection_exerts_no_force_and_no_torque(name, mesh):
    for state, data, _ in constraints(name, mesh):
        before = state.x.copy()
        apply(stages.prepare, data, state)
        apply(stages.project, data, state)
        pushed = state.mass[:, None] * places(state.x - before)
        rounding = 1e-15 * state.mass.max()
        assert np.abs(pushed).max() > 1e7 * rounding
        np.testing.assert_allclose(pushed.sum(0), 0.0, atol=rounding)
        np.testing.assert_allclose(np.cross(places(before), pushed).sum(0), 0.0, atol=rounding)
        state.x[:] = before


@KINDS
def test_multipliers_keep_stiffness_independent_of_iterations(name, mesh):
    """C + α f = 0 from the first projection on; without the memory C would go to 0."""
    for state, data, _ in constraints(name, mesh):
        before = state.x.copy()
        apply(stages.prepare, data, state)
        apply(stages.project, data, state)
        once = state.x.copy()
        for _ in range(10):
            apply(stages.project, data, state)
        np.testing.assert_allclose(state.x, once, rtol=0.0,
                                   atol=1e-3 * np.abs(once - before).max())
        state.x[:] = before


@pytest.mark.parametrize('name, mesh', quick_only(
    ON_MESHES, ('stretch', False), ('bend', False), ('hinge', False), ('volume', True)))
def test_the_force_on_a_pinned_particle_balances_the_others(name, mesh):
    """To rounding, also where the gradient turns from one projection to the next."""
    for state, data, constraint in constraints(name, mesh):
        before, pinned = state.x.copy(), constraint.particles[0, 0]
        inv_mass = state.inv_mass.copy()
        state.inv_mass[pinned] = 0.0
        state.reaction[:] = 0.0
        hold_batch(data, constraint, state.inv_mass)
        apply(stages.prepare, data, state)
        for pass_ in range(3):
            apply(stages.project_back if pass_ == 1 else stages.project, data, state)
        apply(stages.accumulate_reactions, data, state)
        given = (state.mass * (state.x - before)).sum(1) / H**2
        rounding = 1e-15 * state.mass.max() / H**2
        assert np.linalg.norm(given) > 1e4 * rounding
        np.testing.assert_array_equal(state.x[:, pinned], before[:, pinned])
        np.testing.assert_allclose(state.reaction[:, pinned], -given, rtol=1e-9,
                                   atol=10.0 * rounding)
        state.x[:] = before
        state.inv_mass[:] = inv_mass


KINDS_AND_GRIDS = pytest.mark.parametrize('name, grid', [
    (name, grid) for name, mesh in ON_MESHES
    for grid in ([None] if mesh else [(7, 6), (5, 19), (18, 3)])])
"""each effect of cloths on grids of several sizes, and (None) on a mesh where it can be"""


def of_kind(name, grid):
    """Return a cloth with one effect."""
    return cloth(name, grid or (2, 2), mesh=grid is None)


@KINDS_AND_GRIDS
def test_no_two_constraints_of_a_vector_share_a_particle(name, grid):
    built = of_kind(name, grid).effects[name]
    if name == 'pressure':    # one constraint, its triangles in packs
        for members in vectors(built.data):
            assert len(np.unique(members)) == members.size
        return
    for data, these in zip(built.parts, built.by_part, strict=True):
        listed, seen = set(map(tuple, these.particles.tolist())), 0
        for members in vectors(batch_of(data)):
            assert len(np.unique(members)) == members.size
            seen += sum(tuple(each) in listed for each in members.tolist())
        assert seen == len(these.particles) == len(listed)
        assert len(np.unique(these.index)) == seen    # each has a multiplier of its own
        corners = np.hstack([np.sort(part, 1) for part in (these.particles[:, :2],
                                                           these.particles[:, 2:])])
        assert len(np.unique(corners, axis=0)) == seen


def vectors(batch):
    """Yield the particles of constraints that are projected side by side, in the widest vector."""
    if hasattr(batch, 'particles'):
        for k in range(0, batch.particles.shape[1], PACK):
            members = batch.particles[:, k:k + PACK].T
            yield members[members[:, 0] != members[:, 1]]
        return
    runs, lanes = batch.runs, lane_count('float64')
    for r in range(len(runs.start)):
        for row in range(runs.rows[r]):
            for q in range(0, runs.count[r], lanes):
                anchors = (runs.start[r] + row * runs.stride[r]
                           + np.arange(q, min(q + lanes, runs.count[r])))
                yield anchors[:, None] + runs.offset[r]


@KINDS_AND_GRIDS
def test_a_backward_sweep_reverses_the_forward_sweep(name, grid):
    simulation = of_kind(name, grid)
    state, built = crumple(simulation), simulation.effects[name]
    before = state.x.copy()
    apply_all(stages.prepare, built, state)
    swept = []
    for stage in (stages.project, stages.project_back, stages.project_back, stages.project):
        apply_all(stage, built, state)
        swept.append(state.x.copy())
    state.x[:] = before
    apply_all(stages.prepare, built, state)
    alone = [data for data, _ in one_by_one(built)]
    for expected, order in zip(swept, (alone, alone[::-1], alone[::-1], alone)):
        for data in order:
            apply(stages.project, data, state)
        np.testing.assert_array_equal(state.x, expected)


@pytest.mark.parametrize('name, grid, order', [
    *[(*each, 'sequential') for each in KINDS_AND_GRIDS.args[1]],
    ('bend', None, 'coloured'), ('bend', (7, 6), 'coloured'), ('bend', (5, 19), 'coloured')])
def test_the_first_sweep_of_a_substep_zeroes_the_multipliers(name, grid, order):
    """Of each constraint before its projection; the sweeps of later iterations go on with them."""
    simulation = cloth(name, grid or (2, 2), mesh=grid is None, order=order)
    state, built, random = crumple(simulation), simulation.effects[name], np.random.default_rng(1)
    state.mobility[:] = state.inv_mass * H**2
    for data, these in zip(built.parts, built.by_part, strict=True):
        kernel = stages.KERNELS[stages.project, type(data)]
        if kernel not in stages.SWEEPS:
            continue
        before, force, found = state.x.copy(), batch_of(data).force, []
        for stale in (np.zeros_like(force), random.normal(0.0, 100.0, force.shape)):
            state.x[:] = before
            force[:] = stale
            kernel(data, state, SUBSTEP, False, bool(stale.any()))
            found += [state.x.copy(), force[..., these.index]]
            kernel(data, state, SUBSTEP._replace(iteration=1), False, bool(stale.any()))
            found += [state.x.copy(), force[..., these.index]]
        for expected, now in zip(found[:4], found[4:], strict=True):
            assert np.isfinite(now).all()
            np.testing.assert_array_equal(now, expected)
        state.x[:] = before


@pytest.mark.parametrize('stage', [stages.project, stages.project_back, stages.solve_lines])
@KINDS
def test_a_pinned_particle_is_not_moved_and_all_pinned_is_fine(name, mesh, stage):
    simulation = cloth(name, mesh=mesh, method='line')
    state, built = crumple(simulation), simulation.effects[name]
    if not any((stage, type(data)) in stages.KERNELS for data in built.parts):
        assert stage is stages.solve_lines
        return
    before, slot = state.x.copy(), simulation.slot
    padding = np.setdiff1d(np.arange(before.shape[1]), slot)
    state.inv_mass[slot[:5]] = 0.0
    apply_all(stages.prepare, built, state)
    apply_all(stage, built, state)
    np.testing.assert_array_equal(state.x[:, slot[:5]], before[:, slot[:5]])
    np.testing.assert_array_equal(state.x[:, padding], 0.0)
    assert (state.x[:, slot[5:]] != before[:, slot[5:]]).any()
    assert np.isfinite(state.x).all()
    state.inv_mass[:] = 0.0
    state.x[:] = before
    apply_all(stages.prepare, built, state)
    apply_all(stage, built, state)
    np.testing.assert_array_equal(state.x, before)


@pytest.mark.parametrize('names', [
    ('bend', 'shear', 'stretch'),
    pytest.param(('hinge', 'membrane'), marks=pytest.mark.slow),
    pytest.param(tuple(SHEETS), id='all', marks=pytest.mark.slow)])
@pytest.mark.parametrize('method, integrator', [
    s if s == ('gauss_seidel', 'backward_euler')
    else pytest.param(*s, marks=pytest.mark.slow) for s in SETTINGS if s[0] not in SLOW])
def test_a_hanging_cloth_balances_its_weight(method, integrator, names):
    """
    The forces are those of the energies' definitions: Σ ∇E = m g at every free particle.

    Up to what one substep turns the gradients by, which falls with its square. ``line`` sweeps
    soft effects once, forward and back in turn, which leaves a motion that falls with its cube.
    """
    if integrator == 'ndf2':    # which is refused beside limits
        names = [name for name in names if name not in ('strain_limit', 'tether')]
    errors = []
    for substeps in (4, 8, 16):
        simulation = simulate(
            (4, 4), (1.0, 0.9), effects={name: EXAMPLES[name] for name in names},
            substeps=substeps, iterations=30, density=0.2,
            scene_effects={'damping': {'rate': 15.0}},
            pins={'a': {'cloth': 'c', 'at': 'corner_10'}, 'b': {'cloth': 'c', 'at': 'edge_0x'}},
            method=method, integrator=integrator)
        if method == 'line':
            frame = run(simulation, 1500)
            assert np.abs(frame.v).max() < 1e-4 * (4 / substeps)**3
        else:
            run_until_still(simulation, speed=1e-10)
        state = simulation.state
        pull = -gradient(lambda x, effects=simulation.effects: sum(
            effects[name].constraints.energy(x) for name in names), state.x,
            simulation.slot).T
        weight = state.mass[simulation.slot, None] * state.gravity
        free = state.inv_mass[simulation.slot] > 0.0
        errors.append(np.abs((pull + weight)[free]).max() / np.abs(weight).max())
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), 2.0, atol=0.2)
    assert errors[-1] < 2e-4


@KINDS
def test_compliance_scale_divides_the_energy(name, mesh):
    energies = []
    for scale in (1.0, 4.0):
        simulation = cloth(name, scale=scale, mesh=mesh)
        crumple(simulation)
        energies.append(elastic_energy(simulation))
    assert energies[0] == pytest.approx(4.0 * energies[1], rel=1e-12)


@KINDS
def test_explicit_substeps_resolve_the_highest_frequency_of_the_rest_shape(name, mesh):
    """By the second derivatives of the energy."""
    simulation = cloth(name, mesh=mesh)
    state, slot, built = simulation.state, simulation.slot, simulation.effects[name]
    stiffness, size = 0.0, 3 * len(slot)
    for these in built.by_part:
        if name == 'volume':    # C_D is a norm, without derivatives at rest
            stiffness = gradient(lambda x, these=these: gradient(
                these.energy, x, slot, 1e-4), state.x, slot, 1e-4).reshape(size, size)
            continue
        count = len(these.particles)
        jacobian = gradient(lambda x, these=these, count=count: these.residual(x).reshape(
            count, -1), state.x, slot).reshape(count, -1, size)
        alpha = (these.block if hasattr(these, 'block') else
                 these.compliance[:, None, None] * np.eye(jacobian.shape[1]))
        stiffness = stiffness + np.einsum('cai,caj->ij', jacobian, np.linalg.solve(
            alpha, jacobian))
    mass = np.sqrt(np.tile(state.mass[slot], 3))
    highest = 0.5 * np.sqrt(np.linalg.eigvalsh(stiffness / np.outer(mass, mass))[-1])
    bound = stability_limit({name: built}, state)
    assert highest <= bound * (1.0 + 1e-6)
    assert bound < 1.6 * highest


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


@pytest.mark.slow
def test_all_effects_together_are_repeatable_and_end_at_rest():
    """A cloth on a table, held at a corner."""
    hashes = []
    for _ in range(2):
        simulation = with_effects((9, 8), names=EFFECTS, substeps=8, pins={
            'a': {'cloth': 'c', 'at': 'corner_00', 'target': [0.2, 0.2, 0.3]}})
        frame = run(simulation, 1000)
        assert np.linalg.norm(frame.v, axis=1).max() < 1e-6
        hashes.append(simulation.hash())
    assert hashes[0] == hashes[1]
