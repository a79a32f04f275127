"""Seams: what they join, how far they open, and what is refused."""

from math import ceil

import numpy as np
import pytest

from support.meshes import disc, file_of
from support.scenes import DOWN, GRAVITY, run, run_until_still, SETTINGS
from support.tiers import slow
from xpbd_ros.effects.seam import runs_of
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.scene.stability import stability_limit
from xpbd_ros.sim.commands import MovePin, Pose, SetKey, SetState
from xpbd_ros.sim.measure import angular_momentum, elastic_energy, kinetic_energy, momentum

COMPLIANCE = 0.004
SOME = ('gauss_seidel', 'backward_euler'),
LEAPFROG = {'method': 'explicit', 'integrator': 'leapfrog'}
METHODS = pytest.mark.parametrize('method, integrator', [pytest.param(
    *setting, marks=[pytest.mark.slow] * (setting not in SOME)) for setting in SETTINGS])


def scene(cloths, seams, *, pins=None, gravity=GRAVITY, substeps=4, damping=20.0, scale=1.0,
          method='gauss_seidel', integrator='backward_euler', precision='float64', effects=None):
    """Return cloths: name: (resolution, size, position) or a mesh; they hang warp down."""
    return compile_scene(scene_from_mapping({
        'gravity': [0.0, 0.0, -gravity], 'solver': {
            'method': method, 'integrator': integrator, 'substeps': substeps,
            'precision': precision,
            'compliance_scale': scale},
        'cloths': {name: {**({'grid': {'size': list(shape[1]), 'resolution': list(shape[0])},
                              'pose': {'orientation': DOWN, 'position': list(shape[2])}}
                             if isinstance(shape, tuple) else shape), 'density': 0.5,
                          'effects': {'stretch': {'warp': 200.0, 'weft': 200.0}}}
                   for name, shape in cloths.items()},
        'seams': seams, 'pins': pins or {},
        'effects': {'damping': {'rate': damping}, 'pin': {}, **(effects or {})},
    }, where='small.yaml', name='small'))


def seam(one='edge_x1', other='edge_x0', **more):
    """Return a seam from cloth a to cloth b."""
    return {'hem': {'between': [{'cloth': 'a', 'at': one}, {'cloth': 'b', 'at': other}], **more}}


A, B = ((3, 4), (0.2, 0.3), (0.0, 0.0, 0.0)), ((3, 4), (0.2, 0.3), (0.0, 0.0, -0.2))
TOP = {'top': {'cloth': 'a', 'at': 'edge_x0'}}


def sides(simulation):
    """Return both sides of a seam of A and B, shape (4, 3) each."""
    x = simulation.frame().x.reshape(2, 4, 3, 3)
    return x[0, :, -1], x[1, :, 0]


@METHODS
def test_a_rigid_seam_holds_what_hangs_on_it(method, integrator):
    """It is closed at any setting, and its weight is on the pins; without it that falls."""
    simulation = scene({'a': A, 'b': B}, seam(), pins=TOP, method=method, integrator=integrator,
                       substeps=20 if method == 'explicit' else 4)
    frame = run(simulation, 600)
    assert np.abs(frame.v).max() < 1e-5
    one, other = sides(simulation)
    np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(frame.pins['top'].force, [0.0, 0.0, -0.06 * GRAVITY], atol=1e-5)
    torn = scene({'a': A, 'b': B}, {}, pins=TOP, method=method, integrator=integrator)
    assert run(torn, 60).x[12:, 2].max() < -0.5


@pytest.mark.parametrize('at', ['edge_x1', 'corner_01'])
def test_a_seam_opens_by_its_compliance_for_each_newton(at):
    """As a whole, however many pairs it has: m g α."""
    simulation = scene({'a': A, 'b': B}, seam(at, at.replace('x1', 'x0').replace('01', '00'),
                                              compliance=COMPLIANCE),
                       pins={'all': {'cloth': 'a', 'at': list(range(12))}})
    frame = run_until_still(simulation, speed=1e-11)
    one, other = sides(simulation)
    gaps = (one - other)[:1 if at.startswith('c') else None]
    weight = 0.5 * 0.06 * GRAVITY
    np.testing.assert_allclose(gaps.mean(0), [0.0, 0.0, weight * COMPLIANCE], atol=1e-7 * weight)
    assert frame.pins['all'].force[2] == pytest.approx(-2.0 * weight, rel=1e-7)


def test_the_second_side_of_a_seam_pulls_at_its_pins_too():
    simulation = scene({'a': A, 'b': B}, {'hem': {'between': [
        {'cloth': 'b', 'at': 'edge_x0'}, {'cloth': 'a', 'at': 'edge_x1'}],
        'compliance': COMPLIANCE}}, pins={'all': {'cloth': 'a', 'at': list(range(12))}})
    frame = run_until_still(simulation, speed=1e-11)
    assert frame.pins['all'].force[2] == pytest.approx(-0.06 * GRAVITY, rel=1e-7)


def test_a_seam_between_pinned_particles_pulls_at_both_pins():
    """By its gap over its compliance, whether or not the cloths beside it can move."""
    apart, gap = ((3, 4), (0.2, 0.3), (0.0, 0.0, -0.25)), 0.05
    simulation = scene({'a': A, 'b': apart}, seam(compliance=COMPLIANCE), gravity=0.0, pins={
        'upper': {'cloth': 'a', 'at': 'edge_x1'}, 'lower': {'cloth': 'b', 'at': 'edge_x0'}})
    frame = run(simulation, 2)
    for name, side in (('upper', -1.0), ('lower', 1.0)):
        np.testing.assert_allclose(frame.pins[name].force, [0.0, 0.0, side * gap / COMPLIANCE],
                                   atol=1e-9)


def test_numbers_are_matched_in_the_order_that_they_are_given():
    simulation = scene({'a': A, 'b': B}, seam([2, 5, 8, 11], [9, 6, 3, 0]))
    one, other = (cloth.slots for cloth in simulation.cloths)
    np.testing.assert_array_equal(simulation.effects['seam'].data.first, one[[2, 5, 8, 11]])
    np.testing.assert_array_equal(simulation.effects['seam'].data.second, other[[9, 6, 3, 0]])


def test_a_seam_takes_a_live_compliance_and_the_scale():
    simulation = scene({'a': A, 'b': B}, seam(compliance=COMPLIANCE), scale=3.0,
                       pins={'all': {'cloth': 'a', 'at': list(range(12))}})
    for key, value, opens in (('seams.hem.compliance', COMPLIANCE, 3.0),
                              ('solver.compliance_scale', 1.0, 1.0),
                              ('seams.hem.compliance', 2.0 * COMPLIANCE, 2.0)):
        assert simulation.step([SetKey(key, value)]).refused == ()
        run_until_still(simulation, speed=1e-11)
        one, other = sides(simulation)
        assert (one - other)[:, 2].mean() == pytest.approx(
            opens * 0.03 * GRAVITY * COMPLIANCE, rel=1e-6)


@pytest.mark.parametrize('compliance', [0.0, COMPLIANCE])
def test_a_seam_keeps_momentum(compliance):
    light = ((3, 4), (0.05, 0.3), (0.0, 0.0, -0.2))
    simulation = scene({'a': A, 'b': light}, seam(compliance=compliance), gravity=0.0,
                       damping=0.0)
    state, slots = simulation.state, simulation.cloths[1].slots
    state.v[:, slots] = np.array([[0.3], [0.2], [-0.5]])
    before = momentum(state), angular_momentum(state)
    run(simulation, 30)
    np.testing.assert_allclose(momentum(state), before[0], atol=1e-14)
    assert np.linalg.norm(state.v[:, simulation.cloths[0].slots].mean(1)) > 0.03
    if compliance == 0.0:
        one, other = sides(simulation)
        np.testing.assert_allclose(one, other, atol=1e-15)


def test_the_energy_of_an_open_seam_is_not_taken_for_instability():
    """Two cloths at rest are drawn together, and swing on undamped."""
    simulation = scene({'a': A, 'b': A}, seam(list(range(12)), list(range(12)),
                                              compliance=COMPLIANCE),
                       gravity=0.0, damping=0.0, **LEAPFROG, substeps=100)
    for cloth in simulation.cloths:
        simulation.state.mass[cloth.slots] = 0.0025
        simulation.state.inv_mass[cloth.slots] = 400.0
    simulation.state.x[1, simulation.cloths[1].slots] += 0.02
    start = simulation.effects['seam'].stored_energy(simulation.state)
    assert start == pytest.approx(0.5 * 0.02**2 / COMPLIANCE)
    y = run(simulation, 12).x[:, 1]
    assert simulation.stats()['explicit_redone'] == 0
    omega = (2.0 * 400.0 / (12.0 * COMPLIANCE))**0.5
    assert (y[12:] - y[:12]).mean() == pytest.approx(0.02 * np.cos(0.2 * omega), abs=2e-5)


RING = {f'{one}{other}': {'between': [{'cloth': one, 'at': 'edge_x1'},
                                      {'cloth': other, 'at': 'edge_x1'}], 'compliance': COMPLIANCE}
        for one, other in ('ab', 'bc', 'ca')}
"""each particle of these edges in two seams"""
PAIR = {'ab': RING['ab']}


def leapfrog(substeps, seams, *, pins=None, damping=0.0, gravity=GRAVITY):
    """Return three cloths beside one another, which move apart."""
    simulation = scene({name: (*A[:2], (0.01 * k, 0.02 * k, 0.0)) for k, name in enumerate('abc')},
                       seams, pins=pins, damping=damping, gravity=gravity, substeps=substeps,
                       **LEAPFROG)
    random = np.random.default_rng(1)
    simulation.state.v[:, simulation.slot] = 0.1 * random.standard_normal((3, 36))
    return simulation


def with_compliance(seams, compliance):
    """Return seams of another compliance."""
    return {name: {**each, 'compliance': compliance} for name, each in seams.items()}


@pytest.mark.parametrize('compliance, damping, pins', [
    (0.04, 0.0, TOP), (0.04, 5.0, {'top': {'cloth': 'a', 'at': 'edge_x1'}}), slow(0.4, 0.0, None),
    slow(0.4, 5.0, {'top': {**TOP['top'], 'compliance': 0.01}})])
def test_explicit_frames_are_of_second_order(compliance, damping, pins):
    """With particles in several seams too, pinned or on springs; velocities as well."""
    frames = [run(leapfrog(substeps, with_compliance(RING, compliance), damping=damping,
                           pins=pins), 30) for substeps in (32, 64, 128, 256)]
    for values in ([frame.x for frame in frames], [frame.v for frame in frames]):
        gaps = [np.abs(one - other).max() for one, other in zip(values, values[1:])]
        assert gaps[0] > 1e-6
        for coarse, fine in zip(gaps, gaps[1:]):
            assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.25)


@pytest.mark.parametrize('damping', [0.0, slow(1.0)])
@pytest.mark.parametrize('seams, compliance', [
    *((PAIR, 10.0**-k) for k in range(-1, 10)), *((RING, 10.0**-k) for k in range(-1, 6))])
def test_explicit_seams_are_stable_with_the_substeps_of_free_cloth(seams, compliance, damping):
    """However stiff, and where they are between second order and backward Euler."""
    seams = with_compliance(seams, compliance)
    one = leapfrog(1, seams)
    least = ceil(one.frame_dt * stability_limit(one.effects, one.state))
    simulation = leapfrog(least, seams, damping=damping, gravity=0.0)
    run(simulation, 600)
    assert simulation.stats()['explicit_redone'] == 0


@pytest.mark.parametrize('setting, compliance', [
    (LEAPFROG, 0.4), slow(LEAPFROG, 0.04),
    slow({'method': 'line', 'integrator': 'bdf2'}, 0.4)])
def test_float32_keeps_what_seams_move_by_less_than_the_last_bit(setting, compliance):
    """Without compensation of rounding errors they are 0.14 m to 0.6 m off."""
    x = [run(scene({name: (*A[:2], (0.01 * k, 0.02 * k, 0.0)) for k, name in enumerate('abc')},
                   with_compliance(RING, compliance), damping=0.0, substeps=1024, pins=TOP,
                   precision=precision, **setting), 30).x for precision in ('float64', 'float32')]
    assert np.abs(x[1] - x[0]).max() < 2e-3


def test_explicit_seams_keep_energy_and_angular_momentum():
    """The latter up to d x v h² / (4 α), which does not accumulate."""
    simulation = leapfrog(16, with_compliance(RING, 0.04), gravity=0.0)

    def measured():
        state = simulation.state
        return (kinetic_energy(state) + elastic_energy(simulation)
                + simulation.effects['seam'].stored_energy(state), angular_momentum(state))
    energy, spin = measured()
    for _ in range(600):
        simulation.step()
        now = measured()
        assert now[0] == pytest.approx(energy, rel=0.01)
        np.testing.assert_allclose(now[1], spin, atol=3e-3 * np.abs(spin).max())
    assert simulation.stats()['explicit_redone'] == 0


@pytest.mark.parametrize('compliance', [0.0, 1e-6, COMPLIANCE, 0.4])
def test_pins_feel_what_hangs_on_them_by_a_seam(compliance):
    """Σ F = M g - d/dt Σ m v - rate Σ m Δx / Δt in each frame, of all cloths together."""
    rate = 3.0
    simulation = leapfrog(16, with_compliance(RING, compliance), damping=rate, pins={
        'one': {'cloth': 'a', 'at': 'edge_x1'}, 'other': {'cloth': 'b', 'at': [9]}})
    mass, frame = simulation.state.mass[simulation.slot], simulation.frame()
    for k in range(30):
        before, start = mass @ frame.v, mass @ frame.x
        frame = simulation.step([MovePin('one', Pose((0.0, 0.02 * k, 0.01 * k)))])
        change = mass @ frame.v - before + rate * (mass @ frame.x - start)
        expected = mass.sum() * np.array([0.0, 0.0, -GRAVITY]) - change / simulation.frame_dt
        np.testing.assert_allclose(sum(pin.force for pin in frame.pins.values()), expected,
                                   atol=1e-9)


def test_a_live_key_leaves_the_force_of_rigid_seams_as_it_is():
    """The velocities of an explicit frame contain half a substep of it."""
    one, other = (leapfrog(16, with_compliance(RING, 0.0), pins=TOP) for _ in range(2))
    run(one, 10)
    run(other, 10)
    assert other.step([SetKey('effects.damping.rate', 0.0)]).refused == ()
    one.step()
    assert one.hash() == other.hash()


@pytest.mark.parametrize('way', ['set', 'taken back'])
def test_seams_exert_nothing_on_what_is_put_somewhere_at_rest(way):
    """The next frame equals that of a new simulation: ``explicit`` begins with half a kick."""
    one, fresh = (leapfrog(16, with_compliance(RING, 0.0)) for _ in range(2))
    run(one, 10)
    x = one.frame().x
    if way == 'set':
        commands = [SetState(name, x[12 * k:12 * (k + 1)]) for k, name in enumerate('abc')]
    else:
        commands = []
        one.state.v[0, one.slot[0]] = np.nan
        one.step()
        assert one.stats()['frames_taken_back'] == 1
    fresh.apply([SetState(name, x[12 * k:12 * (k + 1)]) for k, name in enumerate('abc')])
    assert one.step(commands).refused == ()
    fresh.step()
    assert one.hash() == fresh.hash()


def test_a_seam_that_starts_open_closes_slowly():
    """A tube of one cloth: its edges are 0.3 m apart at first."""
    simulation = scene({'a': ((4, 9), (0.2, 0.3), (0.0, 0.0, 0.0))},
                       {'tube': {'between': [{'cloth': 'a', 'at': 'edge_0x'},
                                             {'cloth': 'a', 'at': 'edge_1x'}]}},
                       gravity=0.0, damping=5.0)
    gaps = [0.3]
    for _ in range(60):
        x = simulation.step().x.reshape(9, 4, 3)
        gaps.append(np.linalg.norm(x[0] - x[-1], axis=1).max())
    assert gaps[1] == pytest.approx(0.3 - 1.0 / 60.0)    # then it is the cloth that pulls
    assert max(a - b for a, b in zip(gaps, gaps[1:])) < 5.0 / 60.0
    assert gaps[-1] < 1e-15


@pytest.mark.slow
def test_particles_are_matched_in_the_order_given_on_meshes_too():
    """The rim of a disc, sewn on backwards."""
    points, triangles = disc(1)
    simulation = scene({'a': A, 'b': {'mesh': {'file': file_of(points, triangles)}}},
                       seam([2, 0, 7], [5, 1, 3]), gravity=0.0)
    run(simulation, 120)
    x = simulation.frame().x
    np.testing.assert_allclose(x[[2, 0, 7]], x[12 + np.array([5, 1, 3])], atol=1e-15)


@pytest.mark.slow
def test_cloth_that_keeps_off_itself_lets_its_seams_be():
    """A seam and self-collision do not work against one another."""
    simulation = scene({'a': A, 'b': B}, seam(), pins=TOP, effects={
        'self_collision': {'thickness': 0.02}})
    run_until_still(simulation, speed=1e-6)
    one, other = sides(simulation)
    np.testing.assert_allclose(one, other, atol=1e-15)
    assert simulation.stats()['self_contacts'] == 0


@pytest.mark.parametrize('seams, message', [
    (seam('edge_x1', 'edge_0x'), 'seams.hem: its sides must have as many particles each '
     '(got 4 and 3)'),
    (seam('edge_11'), "seams.hem.between[0]: at: unknown place 'edge_11' (known: corner_00, "),
    (seam([0, 12], [0, 1]), 'seams.hem.between[0].at: indices must be from 0 to 11 '),
    (seam([1, 1], [0, 1]), 'seams.hem.between[0].at: names a particle twice'),
    (seam(compliance=-1.0), 'seams.hem.compliance: must be at least 0 m/N (got -1.0)'),
    ({'hem': {'between': [{'cloth': 'a', 'at': 'edge_x1'}]}},
     'seams.hem.between: must be 2 entries (got 1)'),
    ({'hem': {'between': [{'cloth': 'a', 'at': 'edge_x1'}, {'cloth': 'c', 'at': 'edge_x1'}]}},
     "seams.hem.between[1].cloth: unknown cloth 'c' (known: a, b)"),
    ({'hem': {'between': 2 * [{'cloth': 'a', 'at': 'edge_x1'}]}},
     'seams.hem: sews a particle to itself'),
    ({'hem': {'from': 'a'}}, 'seams.hem.from: unknown key (known: between, compliance)'),
    ({'hem': {}}, 'seams.hem.between: missing'),
])
def test_what_cannot_be_sewn_is_refused(seams, message):
    with pytest.raises(InputError) as error:
        scene({'a': A, 'b': B}, seams)
    assert str(error.value).startswith(f'small.yaml: {message}')


def test_runs_are_as_long_as_no_particle_comes_twice():
    random = np.random.default_rng(2)
    first, second = random.permutation(80).reshape(2, -1)
    assert runs_of(first, second).tolist() == [0, 40]
    first, second = random.integers(0, 30, (2, 200))
    second[first == second] = 31
    ends = runs_of(first, second)
    assert ends[0] == 0 and ends[-1] == 200 and len(ends) > 20
    for begin, end in zip(ends, ends[1:]):
        there = {*first[begin:end], *second[begin:end]}
        assert len(there) == 2 * (end - begin)
        assert end == 200 or {first[end], second[end]} & there
