"""The stiffness that ``check`` predicts is the one that the simulation has once it hangs still."""

import numpy as np
import pytest
from scipy import sparse

from support.meshes import ball, file_of
from support.scenes import DOWN, EXAMPLES, GRAVITY, hang, run, run_until_still, simulate
from support.tiers import slow
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.sim.particles.history import new_history, STEPS, usual_step
from xpbd_ros.sim.stepping.methods import SOFT
from xpbd_ros.study.prediction.loads import in_axes, sheets, SLOPES
from xpbd_ros.study.prediction.static_response import JACOBI, StaticResponse
from xpbd_ros.study.prediction.stiffness import response_of, SIGNIFICANT, STEP_RATIO, stiffness


def scene(grid, size, *, effects, pins, substeps, iterations=1, method='gauss_seidel',
          integrator='backward_euler', rate=10.0):
    return scene_from_mapping({
        'solver': {'method': method, 'integrator': integrator, 'substeps': substeps,
                   'iterations': iterations},
        'cloths': {'c': {'grid': {'size': list(size), 'resolution': list(grid)}, 'density': 1.0,
                         'pose': {'orientation': DOWN}, 'effects': effects}},
        'pins': pins, 'effects': {'damping': {'rate': rate}}}, where='x', name='x')


def measured(simulation, *, edges=slice(None)):
    """Return mean, least and largest effective stiffness over asked, of edges that are pulled."""
    built = simulation.effects['stretch'].constraints
    gives = built.residual(simulation.state.x)[edges]
    force = -simulation.effects['stretch'].data.edges.force[built.index][edges]
    alpha = built.compliance[edges]
    seen = force >= SIGNIFICANT * force.max()
    gives, wants = gives[seen], (alpha * force)[seen]
    return wants.sum() / gives.sum(), (wants / gives).min(), (wants / gives).max()


CHAIN = {'top': {'cloth': 'c', 'at': 'corner_00'}}


@pytest.mark.parametrize('substeps, iterations', [(1, 1), (4, 1), (64, 1), (2, 5), (16, 3)])
@pytest.mark.parametrize('modulus', [30.0, 1e3, 3e4])
def test_a_hanging_chain_gives_as_predicted(modulus, substeps, iterations):
    """To 1e-6: on a straight chain the law is exact for any number of iterations."""
    chosen = scene((12, 1), (1.1, 1.0), effects={'stretch': {'warp': modulus, 'weft': modulus}},
                   pins=CHAIN, substeps=substeps, iterations=iterations)
    simulation = compile_scene(chosen)
    (row,) = stiffness(chosen, simulation, simulation.solver)
    run_until_still(simulation, speed=1e-9)
    np.testing.assert_allclose(np.array([row.effective, row.effective_min, row.effective_max])
                               / modulus, measured(simulation), rtol=1e-6)
    assert row.asked == modulus
    if substeps * substeps * iterations < 64:
        assert row.error > 0.1 or modulus < 1e3


@pytest.mark.parametrize('method, integrator', [
    ('gauss_seidel_symmetric', 'bdf2'), ('line', 'ndf2'), slow('gauss_seidel', 'bdf2')])
@pytest.mark.parametrize('pin', ['corner_00', 'corner_01'])
def test_other_sweeps_and_integrators_are_predicted_as_well(method, integrator, pin):
    """And a chain hung from its other end, whose edges are swept the other way round."""
    turned = pin == 'corner_01'
    chosen = scene((12, 1), (1.1, 1.0), effects={'stretch': {'warp': 2e3, 'weft': 2e3}},
                   pins={'top': {'cloth': 'c', 'at': pin}}, substeps=8, iterations=2,
                   method=method, integrator=integrator)
    if turned:
        chosen.raw['cloths']['c']['pose'] = {'orientation': [0.0, -0.5**0.5, 0.0, 0.5**0.5]}
        chosen = scene_from_mapping(chosen.raw, where='x', name='x')
    simulation = compile_scene(chosen)
    (row,) = stiffness(chosen, simulation, simulation.solver)
    run_until_still(simulation, speed=1e-9)
    np.testing.assert_allclose(np.array([row.effective, row.effective_min, row.effective_max])
                               / 2e3, measured(simulation), rtol=1e-6)
    assert (row.error < 1e-3) == (method == 'line')


@pytest.mark.parametrize('modulus', [100.0, pytest.param(3e3, marks=pytest.mark.slow), 1e5])
@pytest.mark.parametrize('substeps, iterations', [
    (2, 1), (8, 4), *(pytest.param(*both, marks=pytest.mark.slow) for both in (
        (1, 1), (4, 2), (16, 1), (64, 1)))])
def test_a_hanging_cloth_gives_about_as_predicted(modulus, substeps, iterations):
    """Its mean within 25 %: where it gives too much its tensions go another way."""
    chosen = scene((9, 7), (0.8, 0.6), effects={
        'stretch': {'warp': modulus, 'weft': modulus}, 'shear': {'stiffness': 0.05 * modulus}},
        pins={'top': {'cloth': 'c', 'at': 'edge_x0'}}, substeps=substeps, iterations=iterations)
    simulation = compile_scene(chosen)
    row = next(row for row in stiffness(chosen, simulation, simulation.solver)
               if row.direction == 'warp')
    run(simulation, 600)
    warp = sheets(simulation)[0].effects['stretch'].along == 0
    assert row.effective / modulus == pytest.approx(measured(simulation, edges=warp)[0], rel=0.25)


@pytest.mark.parametrize('integrator', STEPS)
def test_the_step_of_an_integrator_is_the_one_that_it_takes(integrator):
    assert STEP_RATIO[integrator] == pytest.approx(
        usual_step(new_history(integrator, 16, np.float64), 1.0), rel=1e-15)


def test_effective_compliance_adds_that_of_later_edges():
    """The law itself, to rounding, with the tensions that the cloth has: K = 1, and K = 3."""
    for iterations in (1, 3):
        chosen = scene((5, 4), (0.4, 0.3), effects={
            'stretch': {'warp': 3e3, 'weft': 2e3}, 'shear': {'stiffness': 100.0}},
            pins={'top': {'cloth': 'c', 'at': 'edge_x0'}}, substeps=4, iterations=iterations)
        simulation = compile_scene(chosen)
        run_until_still(simulation, speed=1e-11)
        sheet = sheets(simulation)[0]
        law = response_of(sheet, ['shear', 'stretch'], simulation.solver, simulation.frame_dt,
                     held=sheet.held, damping=10.0)
        gives, tension = [], []
        for name in ('shear', 'stretch'):
            built = simulation.effects[name].constraints
            gives.append(built.residual(simulation.state.x))
            tension.append(-simulation.effects[name].data.edges.force[built.index])
        gives, tension = np.concatenate(gives), np.concatenate(tension)
        # the law is linear about the rest shape: what is left is quadratic in the strain
        strain = np.abs(gives).max() / 0.1
        assert strain < 0.02
        np.testing.assert_allclose(law.residuals(tension), gives, rtol=0.0,
                                   atol=2.0 * strain * np.abs(gives).max())


def rectangle(columns=6, rows=4):
    """Return an OBJ file of 0.5 m x 0.3 m, its inner particles out of line, and its left side."""
    x = np.stack([*np.meshgrid(np.linspace(0.0, 0.5, columns), np.linspace(0.0, 0.3, rows)),
                  np.zeros((rows, columns))], 2)
    x[1:-1, 1:-1, :2] += np.random.default_rng(0).uniform(-0.015, 0.015, (rows - 2, columns - 2,
                                                                          2))
    n = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return file_of(x.reshape(-1, 3), triangles), n[:, 0].tolist()


@pytest.mark.parametrize('mesh', [False, True])
def test_gradients_are_those_of_the_residuals(mesh):
    """Central differences at rest, for all effects that are linearised."""
    names = [name for name in SLOPES if not (mesh and name == 'shear')]
    simulation = simulate((5, 4), mesh=mesh and rectangle()[0],
                          effects={name: EXAMPLES[name] for name in names})
    x, step = np.zeros(simulation.state.x.shape), 1e-6
    x[:, simulation.slot] = in_axes(simulation.cloths[0].mesh).T
    for name in names:
        listed = simulation.effects[name].constraints
        slopes = SLOPES[name](listed, x.T)
        for i in simulation.slot:
            for k in range(2 if name == 'bend' else 0, 3):
                ends = []
                for way in (step, -step):
                    there = x.copy()
                    there[k, i] += way
                    ends.append(listed.residual(there).reshape(len(slopes), -1))
                found = (ends[0] - ends[1])[:, 2 if name == 'bend' else 0:] / (2.0 * step)
                expected = (slopes[..., k] * (listed.particles == i)[:, None]).sum(2)
                np.testing.assert_allclose(found, expected, rtol=0.0, err_msg=name,
                                           atol=1e-5 * np.abs(slopes).max())


def test_the_gas_that_a_ball_lacks_is_what_is_filled_in():
    """The excess volume is V0 (amount^(1/κ) - 1); V0 follows from ∇V·x = 3 V."""
    simulation = simulate(mesh=file_of(*ball(2, 0.5)), effects={
        'stretch': {'warp': 300.0, 'weft': 300.0},
        'pressure': {'amount': 1.1, 'outside': 1e4, 'kappa': 1.4}})
    (sheet,) = sheets(simulation)
    volume = float((sheet.effects['pressure'].jacobian @ sheet.rest.ravel())[0]) / 3.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 0.5**3, rel=0.05)
    assert sheet.excess == pytest.approx(volume * (1.1**(1.0 / 1.4) - 1.0), rel=1e-9)


@pytest.mark.parametrize('names', [
    ('membrane',), pytest.param(('area', 'membrane', 'stretch'), marks=pytest.mark.slow)])
def test_a_mesh_gives_what_the_law_says(names):
    """Row by row, with the tensions that it has under a hundredth of g; the mean beforehand."""
    file, side = rectangle()
    modulus = {'warp': 300.0, 'weft': 200.0}
    effects = {'stretch': modulus, 'area': {'stiffness': 100.0},
               'membrane': {**modulus, 'shear': 100.0, 'poisson': 0.2}}
    chosen = scene_from_mapping({
        'gravity': [0.0, 0.0, -0.1],    # the law is linear about rest
        'solver': {'method': 'gauss_seidel_symmetric', 'integrator': 'bdf2', 'substeps': 5},
        'cloths': {'c': {'mesh': {'file': file}, 'density': 0.2, 'pose': {'orientation': DOWN},
                         'effects': {name: effects[name] for name in names}}},
        'pins': {'top': {'cloth': 'c', 'at': side}},
        'effects': {'damping': {'rate': 10.0}, 'force': {'per_mass': [0.0, 0.0, 0.0]}}},
        where='x', name='x')
    simulation = compile_scene(chosen)
    rows = stiffness(chosen, simulation, simulation.solver)
    run_until_still(simulation, speed=1e-11)
    (sheet,) = sheets(simulation)
    law = response_of(sheet, list(names), simulation.solver, simulation.frame_dt, held=sheet.held,
                 damping=10.0)
    gives, tension = {}, {}
    for name in names:
        built = simulation.effects[name]
        force = (built.data.edges if name == 'stretch' else built.data).force
        gives[name] = built.constraints.residual(simulation.state.x)
        tension[name] = -force[..., built.constraints.index].T
    given, first = law.residuals(np.concatenate([t.ravel() for t in tension.values()])), 0
    for mine in map(np.ravel, gives.values()):
        np.testing.assert_allclose(given[first:first + len(mine)], mine, rtol=0.0,
                                   atol=1e-3 * np.abs(mine).max())
        first += len(mine)
    assert [row.effect for row in rows] == [
        name for name in names for _ in range(1 if name == 'area' else 2)]
    strain, pull = gives['membrane'][:, 0], tension['membrane']
    wanted = (simulation.effects['membrane'].constraints.block @ pull[..., None])[:, 0, 0]
    sign = np.sign(pull[:, 0]) * (np.abs(pull[:, 0]) >= SIGNIFICANT * np.abs(pull[:, 0]).max())
    (row,) = [row for row in rows if (row.effect, row.direction) == ('membrane', 'warp')]
    found = (sign * wanted).sum() / (sign * strain).sum()
    assert row.effective / 300.0 == pytest.approx(found, rel=0.25)
    assert found < 0.95


@pytest.mark.parametrize('iterations', [1, 3])
def test_paths_of_a_mesh_give_what_the_law_says(iterations):
    """Edge by edge, and less than by sweeps alone."""
    file, side = rectangle(12, 8)
    found = {}
    for method in ('line', 'gauss_seidel_symmetric'):
        simulation = compile_scene(scene_from_mapping({
            'gravity': [0.0, 0.0, -0.01],    # the law is linear about rest
            'solver': {'method': method, 'integrator': 'bdf2', 'substeps': 3,
                       'iterations': iterations},
            'cloths': {'c': {'mesh': {'file': file}, 'density': 0.2,
                             'pose': {'orientation': DOWN},
                             'effects': {'stretch': {'warp': 300.0, 'weft': 200.0}}}},
            'pins': {'top': {'cloth': 'c', 'at': side}}, 'effects': {'damping': {'rate': 10.0}}},
            where='x', name='x'))
        run_until_still(simulation, speed=1e-11)
        (sheet,) = sheets(simulation)
        law = response_of(sheet, ['stretch'], simulation.solver, simulation.frame_dt,
                          held=sheet.held, damping=10.0)
        built = simulation.effects['stretch']
        gives = built.constraints.residual(simulation.state.x)
        tension = -built.data.edges.force[built.constraints.index]
        np.testing.assert_allclose(law.residuals(tension), gives, rtol=0.0,
                                   atol=2e-3 * np.abs(gives).max())
        found[method] = np.abs(gives).sum()
    assert found['line'] < (0.6 if iterations == 1 else 0.9) * found['gauss_seidel_symmetric']


@pytest.mark.slow
@pytest.mark.parametrize('substeps', [1, 2, 4, 16])
@pytest.mark.parametrize('modulus', [30.0, 300.0, 3000.0])
def test_a_hanging_mesh_gives_about_as_predicted(modulus, substeps):
    """Edges alone: the mean within 25 %."""
    file, side = rectangle()
    chosen = scene_from_mapping({
        'gravity': [0.0, 0.0, -1e-3 * modulus],
        'solver': {'method': 'line', 'integrator': 'bdf2', 'substeps': substeps},
        'cloths': {'c': {'mesh': {'file': file}, 'density': 0.2, 'pose': {'orientation': DOWN},
                         'effects': {'stretch': {'warp': modulus, 'weft': modulus}}}},
        'pins': {'top': {'cloth': 'c', 'at': side}}, 'effects': {'damping': {'rate': 10.0}}},
        where='x', name='x')
    simulation = compile_scene(chosen)
    row = next(row for row in stiffness(chosen, simulation, simulation.solver)
               if row.direction == 'warp')
    run(simulation, 400)
    warp = sheets(simulation)[0].effects['stretch'].along == 0
    assert row.effective / modulus == pytest.approx(measured(simulation, edges=warp)[0], rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize('substeps', [16, 44, 88, 200])
def test_a_balloon_has_the_overpressure_that_is_predicted(substeps):
    """Within a tenth: a skin that is a thirtieth longer is not quite as at rest."""
    chosen = load_scene('balloon', {'solver.substeps': substeps, 'gravity': [0.0, 0.0, 0.0],
                                    'effects.damping.rate': 20.0})
    simulation = compile_scene(chosen)
    (row,) = [row for row in stiffness(chosen, simulation, simulation.solver)
              if row.effect == 'pressure']
    run(simulation, 60)
    assert simulation.stats()['overpressure_balloon_pa'] == pytest.approx(row.effective, rel=0.1)
    assert (row.error > 1.0) == (substeps == 16)


def test_rigid_edges_have_the_stiffness_of_the_artefact_alone():
    """Twice as many substeps: four times as stiff."""
    found = []
    for substeps in (4, 8):
        chosen = scene((12, 1), (1.1, 1.0), effects={'stretch': {'compliance': 0.0}}, pins=CHAIN,
                       substeps=substeps, rate=0.0)
        simulation = compile_scene(chosen)
        (row,) = stiffness(chosen, simulation, simulation.solver)
        assert row.asked == np.inf
        found.append(row.effective)
    assert found[1] / found[0] == pytest.approx(4.0)


@pytest.mark.parametrize('method', ['gauss_seidel', 'gauss_seidel_symmetric', 'line'])
@pytest.mark.parametrize('grid', [(5, 4), (1, 4), (4, 1), (2, 2)])
def test_rigid_edges_of_a_cloth_are_predicted_by_any_method(grid, method):
    """Also those along the side that it hangs from, which nothing moves."""
    simulation = simulate(grid, (0.4, 0.3), effects={'stretch': {'compliance': 0.0}}, substeps=8,
                          method=method, integrator='bdf2')
    rows = stiffness(simulation._retune.scene, simulation, simulation.solver)
    assert [row.direction for row in rows] == ['warp'] * (grid[0] > 1) + ['weft'] * (grid[1] > 1)
    for row in rows:
        assert row.effective > 10.0
        assert row.effective_min > 0.0


def test_a_compliance_scale_is_part_of_what_is_asked():
    simulation = hang(5, effects={'stretch': {'warp': 100.0, 'weft': 100.0}}, scale=4.0,
                      substeps=64)
    chosen = simulation._retune.scene
    (row,) = stiffness(chosen, simulation, simulation.solver)
    assert row.asked == 25.0
    assert row.effective == pytest.approx(25.0, rel=0.02)


def test_without_artefact_every_modulus_is_what_was_asked():
    simulation = simulate((6, 5), (0.5, 0.5), effects={
        'stretch': {'warp': 50.0, 'weft': 40.0}, 'shear': {'stiffness': 5.0},
        'bend': {'stiffness': 1e-3}}, substeps=4000, gravity=(0, 0, -GRAVITY))
    for row in stiffness(simulation._retune.scene, simulation, simulation.solver):
        assert row.effective == pytest.approx(row.asked, rel=1e-3), row


@pytest.mark.parametrize('iterations', [1, 7])
def test_the_law_of_jacobi_is_what_its_sweep_does_at_rest(iterations):
    """A straight chain, swept densely: what it gives is where a substep changes nothing."""
    n, load, relaxation = 5, 3.0, 0.4
    alpha, mobility = np.full(n, 2e-3), np.array([0.0, 1e-3, 1e-3, 1e-3, 1e-3, 2e-3])
    J = np.diff(np.eye(n + 1), axis=0)
    law = StaticResponse(sparse.csr_matrix(np.kron(J, [1.0, 0.0, 0.0])), alpha, mobility,
              ((JACOBI, np.arange(n)),), iterations, relaxation)
    gives, A = np.zeros(n), J * mobility @ J.T
    push = mobility * np.eye(n + 1)[-1] * load
    for _ in range(20_000):
        stretch, force = gives + J @ push, np.zeros(n)
        start = stretch.copy()
        for _ in range(iterations):
            force -= (stretch + alpha * force) / (np.diag(A) / relaxation + alpha)
            stretch = start + A @ force
        gives = stretch
    np.testing.assert_allclose(law.residuals(np.full(n, load)), gives, rtol=1e-8)


def test_single_passes_of_lines_are_as_stiff_in_bending_as_asked():
    """As those of Gauss-Seidel, with all of W, are not."""
    def strip(method, rigidity):
        return scene((20, 12), (1.0, 0.6), effects={'bend': {'stiffness': rigidity}}, pins={},
                     substeps=2, method=method)

    rate = compile_scene(strip('line', 1.0)).effects['bend'].rate
    errors = []
    for method in ('line', 'gauss_seidel'):
        soft = strip(method, 0.9 * SOFT * 120.0**2 / rate)
        simulation = compile_scene(soft)
        (row,) = stiffness(soft, simulation, simulation.solver)
        errors.append(abs(row.error))
    assert errors[0] < 3e-3 < 3e-2 < errors[1]
