"""``solver.method: auto``: the same for the same scene, and within its budget."""

import pytest

from xpbd_ros.scene.auto import NS, SOFTNESS
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping


def resolved(stretch=None, n=20, solver=None):
    """Return what auto makes of a square cloth."""
    return compile_scene(scene_from_mapping({
        'solver': solver or {}, 'cloths': {'c': {
            'grid': {'size': [1, 1], 'resolution': [n, n]}, 'density': 0.2,
            'effects': {'stretch': stretch or {'warp': 100.0, 'weft': 100.0}}}}},
        where='x', name='x')).solver


def test_it_is_a_function_of_the_scene_alone():
    for name in ('swing', 'drape', 'towel'):
        assert compile_scene(load_scene(name)).solver == compile_scene(load_scene(name)).solver


@pytest.mark.parametrize('name', ['swing', 'drape', 'towel', 'flag', 'demo'])
def test_a_shipped_scene_keeps_within_its_budget(name):
    simulation = compile_scene(load_scene(name))
    cost = NS['particle'] * len(simulation.state.x) + sum(
        len(built.particles) * NS['edge' if built.particles.shape[1] == 2 else 'hinge']
        for built in simulation.effects.values() if built.particles is not None)
    assert simulation.solver.substeps * cost <= 8.0e6
    assert simulation.solver.substeps >= 4


def test_it_takes_as_many_substeps_as_keep_the_added_softness_small():
    """(w1 + w2) h² / 2 against α, for the worst edge; and never fewer than four."""
    soft, stiff = (resolved({'compliance': alpha}) for alpha in (10.0, 1e-3))
    assert soft.substeps == 4
    weight = 0.2 / 19**2    # of an inner particle; of a corner a quarter, at the rim half
    extra = 0.5 * (4.0 + 2.0) / weight / (60.0 * stiff.substeps)**2
    assert extra <= SOFTNESS * 1e-3
    assert 0.5 * 6.0 / weight / (60.0 * (stiff.substeps - 1))**2 > SOFTNESS * 1e-3
    assert 'keep the added softness within 10%' in stiff.reason


def test_a_budget_too_small_is_filled_and_said_so():
    for compliance, why in ((1e-7, 'would keep the added softness within 10%'),
                            (0.0, 'no number of them makes an edge rigid')):
        small, large = (resolved({'compliance': compliance}, solver={'budget_ms': budget})
                        for budget in (1.0, 4.0))
        assert large.substeps == pytest.approx(4 * small.substeps, abs=4)
        assert small.reason.startswith(
            f'auto: {small.substeps} substeps fill the budget of 1 ms; ')
        assert small.reason.endswith(why)
    assert resolved(n=60, solver={'budget_ms': 1e-6}).substeps == 1


def test_what_is_given_is_taken():
    solver = resolved(solver={'substeps': 3, 'iterations': 2})
    assert (solver.method, solver.substeps, solver.iterations) == ('gauss_seidel', 3, 2)
    assert solver.reason == 'substeps: given'
