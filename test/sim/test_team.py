"""Threads: the same bits for any number of them, and no deadlock."""

import time

from numba import njit
import numpy as np
import pytest

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.backend.threads import (
    alone,
    LATE,
    LATE_SHARE,
    REST,
    share,
    ThreadPool,
    ThreadTeam,
    wait,
    wait_uneven,
    WORTH_PARTS,
)
from xpbd_ros.sim.contact.pads import press_pads

STRETCH = {'warp': 2e3, 'weft': 1e3}
ALL = {'stretch': STRETCH, 'shear': {'stiffness': 300.0}, 'bend': {'stiffness': 1e-4}}


def hashes(threads: int, *, effects=None, cloths=None, frames=4, method='line',
           precision='float64', **solver) -> list[int]:
    """Return the hash after each of some frames of two sheets, one above the other."""
    scene = {
        'solver': {'method': method, 'substeps': 6, 'threads': threads, 'precision': precision,
                   **solver},
        'cloths': {'wide': {'grid': {'size': [0.5, 0.7], 'resolution': [19, 43]}, 'density': 0.2,
                            'pose': {'position': [0, 0, 0.1]}, 'effects': effects or ALL},
                   'small': {'grid': {'size': [0.1, 0.1], 'resolution': [3, 5]}, 'density': 0.3,
                             'effects': {'stretch': STRETCH}}},
        'pins': {'a': {'cloth': 'wide', 'at': 'corner_00'}},
        'colliders': {'ball': {'sphere': {'radius': 0.1}, 'position': [0.2, 0.3, 0.0]}},
        'effects': {'contact': {'thickness': 0.002}, 'friction': {}}}
    if method in ('line', 'explicit'):
        del scene['colliders'], scene['effects']
    simulation = compile_scene(scene_from_mapping(scene, where='x', name='x'))
    found = []
    for _ in range(frames):
        simulation.step()
        found.append(simulation.hash())
    assert np.isfinite(simulation.frame().x).all()
    return found


@pytest.mark.parametrize('method, options', [
    ('line', {'effects': {'stretch': STRETCH}}), pytest.param('line', {}, marks=pytest.mark.slow),
    pytest.param('gauss_seidel_symmetric', {'precision': 'float32'}, marks=pytest.mark.slow),
    pytest.param('jacobi', {'iterations': 3}, marks=pytest.mark.slow),
    pytest.param('explicit', {'substeps': 100}, marks=pytest.mark.slow)])
def test_the_same_bits_with_any_number_of_threads(method, options):
    one = hashes(1, method=method, **options)
    for threads in (2, 3):
        assert hashes(threads, method=method, **options) == one
    assert len(set(one)) == len(one)


def hung(threads: int, **solver) -> list:
    """Return what each of some frames has of two taut sheets that hang by two corners each."""
    sheet = {'grid': {'size': [0.5, 0.7], 'resolution': [19, 43]}, 'density': 0.5,
             'effects': {'stretch': {'warp': 20.0, 'weft': 20.0},
                         'strain_limit': {'max': 0.05}, 'tether': {}}}
    simulation = compile_scene(scene_from_mapping({
        'solver': {'substeps': 8, 'integrator': 'bdf2', 'threads': threads, **solver},
        'cloths': {'c': sheet, 'd': {**sheet, 'pose': {'position': [0.0, 0.0, 0.5]}}},
        'pins': {f'{cloth}{at}': {'cloth': cloth, 'at': at} for cloth in 'cd'
                 for at in ('corner_00', 'corner_01')}}, where='x', name='x'))
    found = []
    for _ in range(8):
        pins = simulation.step().pins
        simulation._crew._rest = 0    # as in ``lying``
        found.append((simulation.hash(), *(tuple(pin.force) for pin in pins.values())))
    stats = simulation.stats()
    assert min(stats['tethers_taut'], stats['strain_over_limit'] + 0.05) > 0.0
    return found


@pytest.mark.slow
@pytest.mark.parametrize('precision', ['float32', 'float64'])
@pytest.mark.parametrize('method', ['line', 'gauss_seidel'])
def test_limits_have_the_same_bits_with_any_number_of_threads(method, precision):
    one = hung(1, method=method, precision=precision)
    for threads in (2, 3, 5):
        assert hung(threads, method=method, precision=precision) == one


GROUND = {'floor': {'plane': {}},
          'ball': {'sphere': {'radius': 0.1}, 'position': [0.2, 0.3, -0.07]}}
MANY = {**GROUND, 'bar': {'box': {'size': [0.1, 0.5, 0.05]}, 'position': [0.4, 0.3, 0.0],
                          'restitution': 0.6, 'static_friction': 0.9},
        'lid': {'box': {'size': [0.2, 0.2, 0.05]}, 'position': [0.1, 0.6, 0.035]},
        'hills': {'heights': {'size': [0.5, 0.7], 'values': [[0.0, 0.01], [0.02, 0.01]]},
                  'position': [0.25, 0.35, -0.005]}}
PADS = {name: {**each, 'pad': {'stiffness': 1e6}, 'restitution': 0.0}
        for name, each in MANY.items()}
FULL = {f'floor_{k}': {'plane': {}} for k in range(20)}


def lying(threads: int, colliders, *, effects=None, contact=None, frames=5, **solver) -> list:
    """Return what each of some frames has of a crumpled sheet that lies on colliders."""
    simulation = compile_scene(scene_from_mapping({
        'solver': {'substeps': 4, 'threads': threads, **solver},
        'cloths': {'c': {'grid': {'size': [0.5, 0.7], 'resolution': [19, 43]}, 'density': 0.2,
                         'pose': {'position': [0, 0, 0.003]}, 'effects': {'stretch': STRETCH}}},
        'colliders': colliders, 'effects': {'contact': {'thickness': 0.004, **(contact or {})},
                                            'friction': {}, **(effects or {})}},
        where='x', name='x'))
    noise = np.random.default_rng(1).normal(0.0, 0.003, (3, len(simulation.slot)))
    simulation.state.x[:, simulation.slot] += noise
    found = []
    for _ in range(frames):
        frame = simulation.step()
        simulation._crew._rest = 0    # else only the first frames with fewer cores than threads
        stats = {name: value for name, value in simulation.stats().items()
                 if name != 'frames_on_one_thread'}
        found.append((simulation.hash(), stats, *(
            (*state.force, *state.torque) for state in frame.colliders.values())))
    assert sum(stats['contacts'] for _, stats, *_ in found) > 100
    return found


@pytest.mark.parametrize('colliders, options', [
    (GROUND, {'method': 'gauss_seidel', 'integrator': 'backward_euler', 'effects': {
        'pin': {}, 'self_collision': {'thickness': 0.004}}}), *(    # steps of test_self_collision
        pytest.param(*each, marks=pytest.mark.slow) for each in [
            (GROUND, {'method': 'gauss_seidel', 'integrator': 'backward_euler'}),
            (GROUND, {'method': 'line', 'integrator': 'ndf2'}),
            (MANY, {'method': 'gauss_seidel', 'integrator': 'backward_euler'}),
            (MANY, {'method': 'line', 'integrator': 'ndf2', 'precision': 'float32'}),
            (PADS, {'method': 'line', 'integrator': 'bdf2'}),
            (PADS, {'method': 'line', 'integrator': 'bdf2', 'effects': {
                'self_collision': {'thickness': 0.004}}}),
            (MANY, {'method': 'jacobi', 'iterations': 2, 'contact': {'when': 'after'}}),
            (GROUND, {'method': 'explicit', 'integrator': 'leapfrog', 'substeps': 80}),
            (FULL, {'method': 'gauss_seidel', 'integrator': 'backward_euler'})])])
def test_contact_has_the_same_bits_with_any_number_of_threads(colliders, options):
    one = lying(1, colliders, **options)
    for threads in (2, 3):
        assert lying(threads, colliders, **options) == one
    assert bool(one[0][1]['contacts_without_room']) == (colliders is FULL)


@pytest.mark.slow
def test_threads_share_the_particles_that_pads_clamp():
    """Their last candidates, with which they are solved, are all of the second collider."""
    pad = {'box': {'size': [0.2, 0.2, 0.1]}, 'pad': {'stiffness': 1e6}}
    simulation = compile_scene(scene_from_mapping({
        'solver': {'method': 'gauss_seidel', 'substeps': 4},
        'cloths': {'c': {'grid': {'size': [0.5, 0.7], 'resolution': [19, 43]}, 'density': 0.2,
                         'effects': {'stretch': STRETCH}}},
        'colliders': {'low': {**pad, 'position': [0.25, 0.35, -0.05]},
                      'high': {**pad, 'position': [0.25, 0.35, 0.05]}},
        'effects': {'contact': {'thickness': 0.004}, 'friction': {}}}, where='x', name='x'))
    simulation.step()
    contacts, done = simulation.effects['contact'].contacts, []
    for worker in range(2):
        contacts.pads.given[:] = 0.0
        press_pads(contacts.pads, contacts, simulation.state._replace(
            team=ThreadTeam(worker, 2, np.zeros(24, np.int64))))
        done.append(int((contacts.pads.given[:contacts.count[0]] > 0.0).sum()))
    assert min(done) > 0.4 * sum(done) > 40


@njit(nogil=True)
def _in_step(team, seen, rounds):
    """Count rounds; note where somebody is not exactly here."""
    wrong = 0
    for k in range(rounds):
        seen[team.worker * 8] = k
        wait(team)
        for other in range(team.workers):
            wrong += seen[other * 8] != k
        wait(team)
    return wrong


def test_the_barrier_holds_until_all_threads_are_there():
    crew, seen, wrong = ThreadPool(3), np.zeros(24, np.int64), []

    def step(effects, state):
        wrong.append(_in_step(state.team, seen, 300))

    crew.run(step, (), _Stub())
    crew.run(step, (), _Stub())
    assert len(wrong) in (4, 6) and not any(wrong)    # one of them alone where cores are busy


class _Stub:
    """A state that knows of nothing but its team."""

    team = None

    def _replace(self, team):
        stub = _Stub()
        stub.team = team
        return stub


@pytest.mark.parametrize('worker', [0, 1])
def test_an_exception_in_a_thread_causes_no_deadlock(worker):
    crew, seen = ThreadPool(3), np.zeros(24, np.int64)

    def broken(effects, state):
        if state.team.worker == worker:
            raise KeyboardInterrupt
        _in_step(state.team, seen, 1)

    with pytest.raises(KeyboardInterrupt):
        crew.run(broken, (), _Stub())
    found = []
    crew.run(lambda effects, state: found.append(_in_step(state.team, seen, 3)), (), _Stub())
    assert found == [0, 0, 0]


@njit
def _share(team, count):
    return share(team, count), alone(team)


@pytest.mark.parametrize('count', [0, 1, 2, 5, 12, 100])
@pytest.mark.parametrize('workers', [1, 2, 3, 7])
def test_shares_are_whole_and_one_is_alone(count, workers):
    gate = np.zeros(8, np.int64)
    found = [_share(ThreadTeam(k, workers, gate), count) for k in range(workers)]
    assert [k for (begin, end), _ in found for k in range(begin, end)] == list(range(count))
    assert [yes for _, yes in found] == [True] + [False] * (workers - 1)
    assert _share(None, count) == ((0, count), True)


@njit(nogil=True)
def _meet_once(team):
    wait(team)


@njit(nogil=True)
def _meet_uneven(team):
    wait_uneven(team)


def meets(sleeper: int, seen: list[int]):
    """Return a step of LATE barriers before each of which one thread sleeps."""
    def step(effects, state):
        seen.append(state.team.workers)
        for _ in range(LATE):
            if state.team.worker == sleeper:
                time.sleep(0.05)
            _meet_once(state.team)
    return step


def test_where_another_thread_is_late_the_main_one_goes_on_alone_for_a_while():
    crew, seen = ThreadPool(2), []
    crew.run(meets(0, seen), (), _Stub())    # compiles
    first, most = REST
    for steps in (first, 2 * first):
        crew.run(meets(1, seen), (), _Stub())
        seen.clear()
        before = crew.alone
        for _ in range(steps):
            crew.run(meets(9, seen), (), _Stub())
        assert (seen, crew.alone - before) == ([1] * steps, steps)
    crew.run(meets(0, seen), (), _Stub())
    assert seen[-2:] == [2, 2]


@pytest.mark.parametrize('late, barriers, goes_alone', [
    (LATE - 1, 10, False), (LATE, 10, True),
    (LATE, (LATE + 1) * LATE_SHARE, False), (LATE + 1, (LATE + 1) * LATE_SHARE, True)])
def test_few_late_barriers_of_many_are_none(late, barriers, goes_alone):
    crew = ThreadPool(2)

    def step(effects, state):
        if state.team.worker == 0:
            state.team.gate[:2] = barriers, late

    crew.run(step, (), _Stub())
    crew.run(lambda effects, state: None, (), _Stub())
    assert crew.alone == goes_alone


def test_shares_that_are_not_equally_long_are_not_late():
    crew = ThreadPool(2)

    def step(effects, state):
        for _ in range(2 * LATE):
            if state.team.worker == 1:
                time.sleep(0.01)
            _meet_uneven(state.team)

    for _ in range(2):
        crew.run(step, (), _Stub())
    assert crew.alone == 0


def test_others_wait_for_the_main_thread_without_an_end():
    crew, seen = ThreadPool(2), []
    for _ in range(3):
        crew.run(meets(0, seen), (), _Stub())
    assert (seen, crew.alone) == ([2] * 6, 0)


@pytest.mark.parametrize('workers', [1, 2, 3])
@pytest.mark.parametrize('count', [0, 5, WORTH_PARTS, WORTH_PARTS + 7])
def test_parts_are_whole(count, workers):
    done, pool = np.zeros(count, int), ThreadPool(workers)
    parts = []

    def work(begin, end):
        done[begin:end] += 1
        parts.append((begin, end))
    pool.by_parts(work, count)
    assert (done == 1).all()
    assert len(parts) == (workers if count >= WORTH_PARTS else 1)
