"""The stiffness that ``check`` predicts is the one that the simulation has once it hangs still."""

import numpy as np
import pytest
from scipy import sparse
from sim.small import DOWN, GRAVITY, hang, run, run_until_still, simulate

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.study.check.law import APART, Law
from xpbd_ros.study.check.loads import sheets
from xpbd_ros.study.check.stiffness import law_of, SEEN, stiffness


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
    seen = force >= SEEN * force.max()
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
    ('gauss_seidel_symmetric', 'bdf2'), ('line', 'ndf2'), ('gauss_seidel', 'bdf2')])
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


def test_each_edge_of_a_cloth_gives_what_later_ones_take_from_it():
    """The law itself, to rounding, with the tensions that the cloth has: K = 1, and K = 3."""
    for iterations in (1, 3):
        chosen = scene((5, 4), (0.4, 0.3), effects={
            'stretch': {'warp': 3e3, 'weft': 2e3}, 'shear': {'stiffness': 100.0}},
            pins={'top': {'cloth': 'c', 'at': 'edge_x0'}}, substeps=4, iterations=iterations)
        simulation = compile_scene(chosen)
        run_until_still(simulation, speed=1e-11)
        sheet = sheets(simulation)[0]
        law = law_of(sheet, ['shear', 'stretch'], simulation.solver, simulation.frame_dt,
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
        np.testing.assert_allclose(law.stretches(tension), gives, rtol=0.0,
                                   atol=2.0 * strain * np.abs(gives).max())


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
    law = Law(sparse.csr_matrix(np.kron(J, [1.0, 0.0, 0.0])), alpha, mobility,
              ((APART, np.arange(n)),), iterations, relaxation)
    gives, A = np.zeros(n), J * mobility @ J.T
    push = mobility * np.eye(n + 1)[-1] * load
    for _ in range(20_000):
        stretch, force = gives + J @ push, np.zeros(n)
        start = stretch.copy()
        for _ in range(iterations):
            force -= relaxation * (stretch + alpha * force) / (np.diag(A) + alpha)
            stretch = start + A @ force
        gives = stretch
    np.testing.assert_allclose(law.stretches(np.full(n, load)), gives, rtol=1e-8)
