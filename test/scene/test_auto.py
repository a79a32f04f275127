"""``solver.method: auto``: the same for the same scene, and within its budget."""

from math import ceil, sqrt

import numpy as np
import pytest

from support.scenes import run, simulate
from xpbd_ros.effects.drag import RESOLVED
from xpbd_ros.errors import InputError
from xpbd_ros.scene.auto import COMPENSATED, MIN_SUBSTEPS
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import SHIPPED
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.scene.stability import largest_rate, stability_limit
from xpbd_ros.sim.commands import SetKey
from xpbd_ros.sim.stepping.methods import is_swept_once
from xpbd_ros.study.prediction.stiffness import stiffness


def resolved(stretch=None, n=20, solver=None, **keys):
    """Return what auto makes of a square cloth."""
    return compile_scene(scene_from_mapping({
        'solver': solver or {}, **keys, 'cloths': {'c': {
            'grid': {'size': [1, 1], 'resolution': [n, n]}, 'density': 0.2,
            'effects': {'stretch': stretch or {'warp': 100.0, 'weft': 100.0}}}}},
        where='x', name='x')).solver


def lines(solver):
    """Return the setting of ``line``: of rough frames in a mix."""
    return solver.rough if solver.method == 'explicit' else solver


def cost(simulation, substeps=None):
    """Return the cost of a frame by the table [ns], of its own or other substeps."""
    solver = simulation.solver
    substeps = substeps or solver.substeps
    table = SHIPPED.methods[solver.method]
    projected = besides = 0.0
    for name, built in simulation.effects.items():
        besides += built.ns_per_particle * built.particles_worth(
            simulation.effects, simulation.state, substeps)
        if built.constraints is not None:
            count, size = built.constraints.particles.shape
            if solver.method == 'line' and is_swept_once(
                    built.rate, 1.0 / (60.0 * substeps)):
                count *= (substeps // 2 + substeps % 2) / substeps    # the last both ways
            projected += count * table.get(name, table['edge' if size == 2 else 'hinge'])
    moved = table['substep'] + table['slot'] * simulation.state.x.shape[1]
    return substeps * (moved + besides + solver.iterations * projected)


@pytest.mark.slow
@pytest.mark.parametrize('rigidity', [10.0, 1.0])
def test_stiff_bending_is_resolved_to_a_millimetre(rigidity):
    """Though a sheet's stretch alone asks for 4 substeps: 29 mm with 10 N m."""
    def swung(substeps):
        simulation = simulate((11, 11), density=0.2, method='line', integrator=None,
                              substeps=substeps, scene_effects={'pin': {}}, effects={
                                  'stretch': {'warp': 1000.0, 'weft': 1000.0},
                                  'bend': {'stiffness': rigidity}},
                              pins={name: {'cloth': 'c', 'at': name}
                                    for name in ('corner_00', 'corner_01')})
        return run(simulation, 20).x
    assert np.sqrt(((swung(None) - swung(320))**2).sum(1).mean()) < 1.5e-3


def test_it_is_a_function_of_the_scene_alone():
    for name in ('swing', 'drape', 'towel'):
        assert compile_scene(load_scene(name)).solver == compile_scene(load_scene(name)).solver


@pytest.mark.parametrize('name', ['swing', 'drape', 'towel', 'flag', 'demo'])
def test_a_shipped_scene_keeps_within_its_budget(name):
    simulation = compile_scene(load_scene(name))
    assert cost(simulation) <= 8.0e6
    assert simulation.solver.substeps >= MIN_SUBSTEPS


def test_auto_takes_a_fifth_of_the_substeps_of_explicit():
    """0.2 frame_dt √(Σ k / m), for the worst edge; and never fewer than four."""
    mixed = resolved({'compliance': 1e-3})
    solver = lines(mixed)
    weight = 0.2 / 19**2    # of an inner particle; of a corner a quarter, at the rim half
    rate = (4.0 + 2.0) / weight / 2.0 / 1e-3
    assert solver.substeps == ceil(0.2 * sqrt(rate) / 60.0)
    assert (solver.method, solver.integrator) == ('line', 'ndf2')
    assert f'; rough frames: line, ndf2, {solver.substeps} substeps resolve the' in mixed.reason
    assert mixed.substeps >= 4.5 * solver.substeps
    assert resolved({'compliance': 10.0}).substeps == MIN_SUBSTEPS == 4
    half = lines(resolved({'compliance': 1e-3}, frame_rate=120.0))
    assert half.substeps == ceil(0.2 * sqrt(rate) / 120.0)


def test_what_colliders_or_wind_may_stretch_gets_a_third_of_the_substeps():
    """Still air stretches nothing."""
    def substeps(**keys):
        return resolved({'compliance': 1e-3}, solver={'method': 'line'}, **keys).substeps
    needed = sqrt(6.0 * 19**2 / 0.2 / 2.0 / 1e-3) / 60.0
    for effects, share in (({'drag': {}}, 0.2), ({'wind': {'velocity': [0, 0, 1e-3]}}, 1.0 / 3.0),
                           ({'contact': {'thickness': 0.01}}, 1.0 / 3.0)):
        assert substeps(effects=effects) == ceil(share * needed)


def test_wind_has_the_substeps_that_resolve_its_drag():
    """h ρ C u / (2 × 0.2 kg/m²) ≤ RESOLVED, gusts included; in a mix too."""
    wind = {'wind': {'velocity': [0, 0, 70.0], 'gust': [0, 30.0, 1.0]},
            'drag': {'density': 1.2, 'normal': 1.3, 'tangential': 0.02}}
    grip = 1.2 * (0.5 * 1.3 + 2.0 * 0.02) * (70.0 + np.hypot(30.0, 1.0)) / 0.2
    for method in ('line', 'auto'):
        solver = resolved({'compliance': 10.0}, solver={'method': method}, effects=wind)
        assert solver.method == ('line' if method == 'line' else 'explicit')
        assert solver.substeps == ceil(grip / 60.0 / RESOLVED)


@pytest.mark.parametrize('effects', [{'membrane': {'young': 2000.0, 'poisson': 0.3}},
                                     {'area': {'stiffness': 2000.0}}])
def test_stretch_that_no_line_solves_gets_all_of_the_substeps(effects):
    simulation = simulate((12, 9), effects=effects, substeps=None, method='line', integrator=None)
    limit = stability_limit(simulation.effects, simulation.state)
    assert simulation.solver.substeps == ceil(limit * simulation.frame_dt) > 8


@pytest.mark.parametrize('precision, gravity, method', [
    ('float64', 1e-3, 'explicit'), ('float32', 1e-3, 'line'), ('float32', 9.8, 'explicit'),
    ('float32', 0.0, 'explicit')])
def test_a_fall_that_float32_rounds_away_leaves_auto_with_line(precision, gravity, method):
    """At 1 m from the origin, in the substeps of ``explicit``."""
    assert resolved({'compliance': 1e-3}, solver={'precision': precision},
                    gravity=[0.0, 0.0, -gravity]).method == method


def test_float32_gets_more_for_the_same_budget():
    rigid = {'compliance': 0.0}
    substeps = {precision: resolved(rigid, n=160, solver={'precision': precision}).substeps
                for precision in ('float64', 'float32')}
    assert substeps['float32'] == pytest.approx(substeps['float64'] / SHIPPED.single, rel=0.1)


def test_short_substeps_of_float32_cost_a_third_more():
    rigid = {'compliance': 0.0}
    plain, compensated = (resolved(rigid, n=n, solver={'precision': 'float32'}).substeps
                          for n in (160, 80))
    double = resolved(rigid, n=80).substeps
    assert plain <= 37 < compensated
    assert compensated == pytest.approx(double / SHIPPED.single / COMPENSATED, rel=0.1)


def test_a_run_with_long_substeps_does_not_pay_for_compensation_of_later_short_ones():
    """It has no storage for it, and says so."""
    def sheet(compliance, precision):
        return compile_scene(scene_from_mapping({
            'solver': {'method': 'line', 'precision': precision}, 'cloths': {'c': {
                'grid': {'size': [1, 1], 'resolution': [80, 80]}, 'density': 0.2,
                'effects': {'stretch': {'compliance': compliance}}}}}, where='x', name='x'))
    simulation, text = sheet(1.0, 'float32'), 'rounding errors are not compensated'
    assert simulation.solver.substeps <= 37 and simulation.state.rounding is None
    assert not simulation.apply([SetKey('cloths.c.effects.stretch.compliance', 1e-9)])
    assert simulation.solver.substeps == pytest.approx(
        sheet(1e-9, 'float64').solver.substeps / SHIPPED.single, rel=0.1)
    assert text in simulation.solver.reason
    assert text not in sheet(1e-9, 'float32').solver.reason


def test_stiff_gas_raises_the_substeps():
    """And has nearly the overpressure that it should, by the law that ``check`` goes by."""
    for outside, more in ((1e3, False), (1e6, True)):
        scene = load_scene('balloon', {'cloths.balloon.effects.pressure.outside': outside,
                                       'cloths.balloon.effects.pressure.amount': 1.01})
        scene.raw['solver'] = {'method': 'line'}
        simulation = compile_scene(scene_from_mapping(scene.raw, where=scene.where, name='x'))
        pressure = next(row for row in stiffness(scene, simulation, simulation.solver)
                        if row.effect == 'pressure')
        assert abs(pressure.error) < 0.1
        skin = ceil(simulation.frame_dt * sqrt(largest_rate(
            simulation.effects['stretch'].constraints, simulation.state.mass)))
        assert (simulation.solver.substeps > 1.5 * skin) == more


def test_substeps_never_fall_with_stiffness():
    substeps = [lines(resolved({'compliance': alpha})).substeps for alpha in
                (1e300, 1.0, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-12, 1e-300, 0.0)]
    assert substeps == sorted(substeps)
    assert substeps[0] == MIN_SUBSTEPS
    assert substeps[-2] == substeps[-1]    # the budget


def test_a_finer_cloth_costs_more_and_wants_more():
    stiff = {'warp': 1e6, 'weft': 1e6}
    coarse, fine = (resolved(stiff, n, {'budget_ms': 1e6}) for n in (10, 40))
    assert fine.substeps == pytest.approx(39 / 9 * coarse.substeps, rel=0.01)


def test_max_substeps_below_the_initial_ones_are_refused():
    held = {'error_target': 1e-3, 'max_substeps': 40}
    assert resolved({'compliance': 1e-3}, solver={**held, 'substeps': 40}).substeps == 40
    with pytest.raises(InputError, match='solver.max_substeps: must be at least 41, the substeps '
                                         r'that the run starts with \(got 40\)'):
        resolved({'compliance': 1e-3}, solver={**held, 'substeps': 41})
    assert resolved({'compliance': 1e-3}, solver={'max_substeps': 40, 'substeps': 41})


@pytest.mark.parametrize('compliance, why', [
    (1e-7, 'would resolve it'), (0.0, 'no number resolves rigid edges')])
def test_a_budget_too_small_is_filled_and_said_so(compliance, why):
    small, large = (resolved({'compliance': compliance}, solver={'budget_ms': budget})
                    for budget in (1.0, 4.0))
    assert large.substeps == pytest.approx(4 * small.substeps, abs=4)
    assert small.reason.startswith(
        f'auto: line, bdf2, {small.substeps} substeps fill the budget of 1 ms; ')
    assert why in small.reason
    least = resolved({'compliance': compliance}, solver={'budget_ms': 1e-6})
    assert least.reason.startswith('auto: line, bdf2, 1 substep fills the budget of 1e-06 ms; ')


@pytest.mark.parametrize('iterations', [1, 3])
@pytest.mark.parametrize('method', ['auto', 'gauss_seidel', 'gauss_seidel_symmetric'])
@pytest.mark.parametrize('compliance', [0.0, 1e-7])
def test_a_filled_budget_has_no_room_for_one_more_substep(compliance, method, iterations):
    simulation = compile_scene(load_scene('swing', {
        'solver.method': method, 'solver.iterations': iterations, 'solver.budget_ms': 3.0,
        'cloths.sheet.effects.stretch': {'compliance': compliance}}))
    substeps, used = simulation.solver.substeps, cost(simulation)
    assert used <= 3.0e6 < used / substeps * (substeps + 1)


@pytest.mark.parametrize('budget_ms', np.linspace(0.4, 2.0, 9))
def test_a_budget_buys_the_most_substeps_though_short_ones_take_less_time(budget_ms):
    """Bending is soft in 5 substeps or more, shear in 19: one more may take less time."""
    simulation = compile_scene(load_scene('swing', {
        'solver.method': 'line', 'solver.budget_ms': float(budget_ms),
        'cloths.sheet.effects': {'stretch': {'compliance': 1e-7}, 'shear': {'stiffness': 40.0},
                                 'bend': {'stiffness': 1e-4}}}))
    fitting = [n for n in range(1, 100) if cost(simulation, n) <= 1e6 * budget_ms]
    assert simulation.solver.substeps == max(fitting)


def test_cloth_that_touches_itself_gets_four_substeps_whatever_the_budget():
    """Fewer move it further in each, and the searches cost what the substeps save."""
    chosen = resolved({'compliance': 1e-4}, solver={'budget_ms': 1e-6},
                      effects={'self_collision': {'thickness': 0.01}})
    assert chosen.substeps == 4
    assert ('4 substeps exceed the budget of 1e-06 ms, but fewer take no less time with '
            'self_collision, about ') in chosen.reason


@pytest.mark.parametrize('method', ['line', 'gauss_seidel'])
def test_a_large_budget_gives_no_more_substeps_than_a_scene_may_have(method):
    solver = resolved({'compliance': 0.0}, 5, solver={'method': method, 'budget_ms': 1e6})
    assert solver.substeps == 10_000
    assert 'are the largest number allowed; no number resolves rigid edges' in solver.reason


def test_a_budget_for_nothing_buys_one_substep():
    assert resolved(n=60, solver={'budget_ms': 1e-6}).substeps == 1


@pytest.mark.parametrize('method, integrator', [
    ('auto', 'leapfrog'), ('line', 'ndf2'), ('gauss_seidel_symmetric', 'bdf2'),
    ('gauss_seidel', 'backward_euler')])
def test_the_integrator_goes_with_the_method_unless_given(method, integrator):
    assert resolved(solver={'method': method}).integrator == integrator
    for given in ('backward_euler', 'bdf2', 'ndf2'):
        assert resolved(solver={'method': method, 'integrator': given}).integrator == given


def test_what_ndf2_goes_wild_with_has_bdf2():
    curtain = {'solver.substeps': 16}
    assert compile_scene(load_scene('curtain', curtain)).solver.integrator == 'bdf2'
    with pytest.raises(InputError, match="solver.integrator: 'ndf2' is unstable with "
                                         '(strain_limit|tether), which the scene has; take bdf2'):
        compile_scene(load_scene('curtain', {**curtain, 'solver.integrator': 'ndf2'}))


def test_too_few_substeps_for_ndf2_are_of_bdf2():
    few, enough = (resolved({'compliance': 1e-3}, solver={'substeps': n}) for n in (3, 4))
    assert (few.integrator, enough.integrator) == ('bdf2', 'ndf2')


def test_what_is_given_is_taken():
    solver = resolved(solver={'substeps': 3, 'iterations': 2})
    assert (solver.method, solver.substeps, solver.iterations) == ('line', 3, 2)
    assert solver.reason == 'line, ndf2, 3 substeps as given'
    solver = resolved({'compliance': 0.0}, solver={'substeps': 5000, 'method': 'gauss_seidel',
                                                   'budget_ms': 1e-3})
    assert (solver.method, solver.substeps) == ('gauss_seidel', 5000)
    assert solver.reason == 'gauss_seidel, backward_euler, 5000 substeps as given'
