"""Damping of constraints: the Kelvin-Voigt oscillator, rigid motion, and what it is not for."""

import numpy as np
import pytest

from support.meshes import disc, obj_text
from support.scenes import DOWN, GRAVITY, run, run_stage, run_until_still, simulate
from support.tiers import quick_only
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping import stages

TAU, K, H = 0.02, 30.0, 1.0 / 60.0


def pair(time, **options):
    """Return two free particles of 0.5 kg each, joined by an edge of 30 N/m; 1 m apart."""
    effects = {'stretch': {'compliance': 1.0 / K}}
    if time is not None:
        effects['rayleigh'] = {'time': time}
    return simulate((2, 1), effects=effects, gravity=(0, 0, 0), **options)


def test_the_kelvin_voigt_oscillator_decays_as_backward_euler():
    """V3: |z|² = 1 / (1 + c h / m + ω² h²) a step, with the reduced mass of two."""
    simulation = pair(TAU)
    mass = 0.5 * simulation.state.mass[simulation.slot[0]]
    simulation.state.x[0, simulation.slot] *= 1.2
    simulation.state.x_prev[:] = simulation.state.x
    c, omega2 = K * TAU, K / mass
    matrix = np.linalg.inv([[1.0, -H], [H * omega2, 1.0 + H * c / mass]])
    expected = np.array([0.2, 0.0])
    for _ in range(40):
        frame = simulation.step()
        expected = matrix @ expected
        apart = np.array([frame.x[1, 0] - frame.x[0, 0] - 1.0, frame.v[1, 0] - frame.v[0, 0]])
        np.testing.assert_allclose(apart, expected, rtol=0.0, atol=1e-12)
    assert abs(np.linalg.det(matrix)) == pytest.approx(1.0 / (
        1.0 + c * H / mass + omega2 * H * H), rel=1e-10)


@pytest.mark.parametrize('method', quick_only(
    ['gauss_seidel', 'jacobi', 'gauss_seidel_symmetric'], 'gauss_seidel'))
def test_oscillator_decay_converges_at_the_integrators_order(method):
    errors = []
    order = 2.0 if method == 'gauss_seidel_symmetric' else 1.0
    for substeps in (16, 32, 64):
        simulation = pair(TAU, method=method, substeps=substeps,
                          integrator='bdf2' if order == 2.0 else 'backward_euler')
        mass = 0.5 * simulation.state.mass[simulation.slot[0]]
        simulation.state.x[0, simulation.slot] *= 1.2
        simulation.state.x_prev[:] = simulation.state.x
        frame = run(simulation, 12)
        a, t = 0.5 * K * TAU / mass, 0.2
        w = np.sqrt(K / mass - a * a)
        exact = 0.2 * np.exp(-a * t) * (np.cos(w * t) + a / w * np.sin(w * t))
        errors.append(abs(frame.x[1, 0] - frame.x[0, 0] - 1.0 - exact))
    assert errors[0] < 0.02
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), order, atol=0.35)


def test_dampers_see_the_velocity_of_the_integrator():
    """For two particles in free flight that is (x - x̄) / H, with H = 2 h / 3 for BDF2."""
    simulation = pair(TAU, integrator='bdf2')
    simulation.state.v[:, simulation.slot] = [[0.3], [-0.2], [0.1]]
    run(simulation, 4)
    past = simulation.effects['rayleigh'].past
    assert past.per_step[0] == pytest.approx(1.5 / H)
    np.testing.assert_allclose(
        ((simulation.state.x - past.x) * past.per_step)[:, simulation.slot],
        [[0.3, 0.3], [-0.2, -0.2], [0.1, 0.1]], atol=1e-12)


def sheet(effects, **options):
    """Return a free sheet of square cells that stretches and shears."""
    return simulate((5, 4), (0.5, 0.4), gravity=(0, 0, 0), substeps=8, effects={
        'stretch': {'warp': 50.0, 'weft': 50.0}, 'shear': {'stiffness': 20.0}, **effects},
        **options)


def energy(simulation):
    """Return kinetic energy less that of the motion as a whole."""
    m, v = simulation.state.mass[simulation.slot], simulation.frame().v
    v = v - m @ v / m.sum()
    return 0.5 * float(m @ (v**2).sum(1))


def test_motion_as_a_whole_goes_on_and_wrinkles_do_not():
    found = []
    for effects in ({}, {'rayleigh': {'time': 0.01}}):
        simulation = sheet(effects)
        state, slot = simulation.state, simulation.slot
        state.v[:, slot] = np.random.default_rng(0).normal(0.0, 0.2, (3, len(slot)))
        state.v[2, slot] = 0.0
        state.v[0, slot] += 1.0
        momentum = state.mass[slot] @ simulation.frame().v
        frame = run(simulation, 20)
        np.testing.assert_allclose(state.mass[slot] @ frame.v, momentum, atol=1e-13)
        found.append(energy(simulation))
    assert found[1] < 0.9 * found[0]


@pytest.mark.parametrize('kind', ['mesh', 'grid'])
def test_a_sweep_is_equation_26_edge_after_edge(kind, tmp_path):
    if kind == 'mesh':
        (tmp_path / 'disc.obj').write_text(obj_text(*disc(1)))
        simulation = compile_scene(scene_from_mapping({
            'gravity': [0, 0, 0], 'cloths': {'c': {
                'mesh': {'file': str(tmp_path / 'disc.obj')}, 'density': 1.0,
                'effects': {'stretch': {'warp': 50.0, 'weft': 40.0}, 'rayleigh': {'time': TAU}}}},
            'solver': {'method': 'gauss_seidel', 'integrator': 'backward_euler', 'substeps': 1},
        }, where='mesh.yaml', name='mesh'))
    else:
        simulation = simulate((4, 3), gravity=(0, 0, 0), effects={
            'stretch': {'warp': 50.0, 'weft': 40.0}, 'rayleigh': {'time': TAU}})
    state, slot = simulation.state, simulation.slot
    state.v[:, slot] = np.random.default_rng(0).normal(0.0, 1.0, (3, len(slot)))
    before, edges = state.x.copy(), simulation.effects['stretch'].constraints
    x, gamma = before + H * state.v, TAU / H
    for (i, j), rest, alpha in zip(edges.particles, edges.rest_length, edges.compliance):
        d, m = x[:, i] - x[:, j], state.inv_mass[[i, j]] * H * H
        n = d / np.linalg.norm(d)
        rate = n @ (d - before[:, i] + before[:, j])
        f = -(np.linalg.norm(d) - rest + gamma * rate) / ((1.0 + gamma) * m.sum() + alpha)
        x[:, i] += m[0] * f * n
        x[:, j] -= m[1] * f * n
    simulation.step()
    np.testing.assert_allclose(state.x, x, rtol=0.0, atol=1e-14)


def test_a_pin_has_the_velocity_that_it_goes_with():
    """(x - x̄) / H is what it went in the substep over h, also for BDF2, whose H is 2 h / 3."""
    simulation = simulate(effects={'stretch': {'compliance': 1e-3}, 'rayleigh': {'time': 0.01}},
                          pins={'a': {'cloth': 'c', 'at': 'corner_00'}}, integrator='bdf2',
                          method='gauss_seidel_symmetric')
    state, data, h = simulation.state, simulation.effects['rayleigh'].data, 0.01
    pinned = simulation.slot[0]
    state.x_prev[:] = state.x
    state.x[0, pinned] += 0.03
    run_stage(stages.prepare, data, state, Substep(h, 0.0, 1.0))
    assert (state.x - data.past.x)[0, pinned] * data.past.per_step[0] == pytest.approx(3.0)


@pytest.mark.parametrize('method', quick_only(
    ['gauss_seidel', 'gauss_seidel_symmetric'], 'gauss_seidel'))
def test_it_exerts_nothing_at_rest_beside_a_pin_that_gives_way(method):
    alpha = 1e-4
    strand = simulate((2, 1), (1.0, 1.0), pose={'orientation': DOWN}, method=method, substeps=20,
                      effects={'stretch': {'compliance': alpha}, 'rayleigh': {'time': 0.01}},
                      pins={'top': {'cloth': 'c', 'at': 'corner_00', 'compliance': 1e-3}},
                      scene_effects={'damping': {'rate': 20.0}})
    x = run_until_still(strand, speed=1e-12).x
    weight = strand.state.mass[strand.slot][1] * GRAVITY
    assert np.linalg.norm(x[1] - x[0]) - 1.0 == pytest.approx(weight * alpha, rel=1e-6)


def test_each_cloth_has_the_time_that_it_asks_for():
    """Each cloth moves as in a scene of its own; one without a relaxation time is not damped."""
    times = {'a': TAU, 'b': None, 'c': 3.0 * TAU}
    simulation = compile_scene(scene_from_mapping({
        'gravity': [0, 0, 0], 'solver': {
            'method': 'gauss_seidel', 'integrator': 'backward_euler', 'substeps': 1},
        'cloths': {name: {
            'grid': {'size': [1.0, 1.0], 'resolution': [2, 1]}, 'density': 1.0,
            'pose': {'position': [0.0, 1.0 * k, 0.0]}, 'effects': {
                'stretch': {'compliance': 1.0 / K},
                **({} if time is None else {'rayleigh': {'time': time}})}}
            for k, (name, time) in enumerate(times.items())}}, where='3.yaml', name='3'))
    found = []
    for each in (simulation, *(pair(time or 0.0) for time in times.values())):
        each.state.x[0, each.slot] *= 1.2
        each.state.x_prev[:] = each.state.x
        found.append(run(each, 20).x[:, 0].reshape(-1, 2))
    np.testing.assert_allclose(found[0], np.vstack(found[1:]), atol=1e-14)


def test_no_time_is_no_damping():
    hashes = []
    for effects in ({}, {'rayleigh': {'time': 0.0}}):
        simulation = sheet(effects)
        simulation.state.v[2, simulation.slot[::3]] = 1.0
        run(simulation, 5)
        hashes.append(simulation.frame().x)
    np.testing.assert_allclose(hashes[0], hashes[1], atol=1e-13)


def test_a_scene_without_it_has_no_damping_in_its_data():
    assert sheet({}).effects['stretch'].data.edges.damping is None
    assert pair(None).effects['stretch'].data.edges.damping is None
    rigid = simulate((3, 1), effects={'stretch': {'compliance': 0.0}, 'rayleigh': {'time': 1.0}})
    assert not rigid.effects['stretch'].data.edges.damping.time.any()


def test_methods_without_rayleigh_are_refused():
    for method, integrator in (('line', 'bdf2'), ('explicit', 'leapfrog')):
        with pytest.raises(InputError, match=f"'{method}' cannot be combined with rayleigh"):
            pair(TAU, method=method, integrator=integrator)
    simulation = pair(TAU, method='auto', integrator='bdf2')
    assert simulation.solver.method == 'gauss_seidel_symmetric'
