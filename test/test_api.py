"""The Python API: saved states, rollouts, and what is public."""

import inspect
from pathlib import Path
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest

from support.scenes import run, with_effects
import xpbd_ros
from xpbd_ros import (
    Grasp,
    InputError,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Pose,
    Release,
    SetKey,
    SetWind,
    Twist,
)

PAGE = (Path(__file__).parents[1] / 'doc/python.md').read_text()
STRIP = {'cloths': {'c': {'grid': {'size': [0.2, 0.2], 'resolution': [4, 4]}, 'density': 0.2,
                          'effects': {'stretch': {'warp': 100.0, 'weft': 100.0}}}},
         'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}},
         'solver': {'method': 'gauss_seidel', 'integrator': 'bdf2', 'substeps': 4}}
COMMANDS = [Grasp('b', Pose((1.0, 0.0, 0.0)), 0.1), MovePin('a', Pose((0.0, 0.0, 0.2))),
            MoveCollider('table', Pose((0.0, 0.0, 0.05))), SetKey('gravity', [0.0, 1.0, -9.0])]


def test_a_restored_state_continues_to_the_same_bits():
    """With all effects of a sheet, in the midst of motion; commands act on all that is saved."""
    simulation = with_effects()
    run(simulation, 3, COMMANDS)
    saved = simulation.save()
    assert saved.index == simulation.index == 3
    first = [(simulation.step([Release('b')]).x.tobytes(), simulation.hash()) for _ in range(5)]
    for other in (simulation, saved.simulation(), saved.simulation()):
        other.restore(saved)
        assert other.index == 3
        assert set(other.frame().pins) == {'a', 'b'}
        again = [(other.step([Release('b')]).x.tobytes(), other.hash()) for _ in range(5)]
        assert again == first
    assert saved.index == 3


@pytest.mark.parametrize('simulation', [
    lambda: xpbd_ros.load(STRIP), lambda: xpbd_ros.load({**STRIP, 'pins': {}}), with_effects],
    ids=['pins', 'neither', 'both'])
def test_a_frame_is_data_that_pickles(simulation):
    """Such as the answer of a process of a pool, or an entry of a data set."""
    frame = simulation().frame()
    other = pickle.loads(pickle.dumps(frame))
    assert other.index == frame.index
    np.testing.assert_array_equal(other.x, frame.x)
    assert {name: pin.pose for name, pin in other.pins.items()} == {
        name: pin.pose for name, pin in frame.pins.items()}
    assert set(other.colliders) == set(frame.colliders)


def test_a_state_of_another_scene_is_refused():
    simulation = xpbd_ros.load(STRIP)
    before = simulation.hash()
    other = xpbd_ros.load(STRIP, **{'cloths.c.grid.resolution': [4, 5]})
    with pytest.raises(InputError, match='another scene: it has 20 particles and the effects'):
        simulation.restore(other.save())
    other = xpbd_ros.load(STRIP, **{'effects': {'damping': {'rate': 1.0}}})
    with pytest.raises(InputError, match='pin, damping, stretch; this one has 16 and pin, str'):
        simulation.restore(other.save())
    assert simulation.hash() == before


def test_rollouts_are_in_order_and_leave_their_start_alone():
    simulation = xpbd_ros.load(STRIP)
    simulation.step()
    before = simulation.hash()
    sequences = [[[MovePin('a', Pose((0.0, 0.0, 0.01 * k)))]] + 5 * [[]] for k in range(6)]

    def last(frames):
        return list(frames)[-1].x

    expected = []
    for sequence in sequences:
        alone = simulation.save().simulation()
        expected.append([alone.step(commands) for commands in sequence][-1].x)
    for workers in (1, 3, None):
        found = xpbd_ros.rollouts(simulation, sequences, last, workers=workers)
        assert (np.array(found) == expected).all()
    assert len({x.tobytes() for x in found}) == 6
    assert simulation.hash() == before
    assert xpbd_ros.rollouts(simulation.save(), sequences[:1], lambda frames: next(frames).index,
                             ) == [2]


def test_rollouts_start_from_the_state_of_a_live_node(tmp_path):
    """Its ``~/record`` writes the whole state, pins included; what follows has the same bits."""
    pytest.importorskip('rclpy', reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    from support.logs import COMMANDS, recorded, SHEET, state_hashes
    (tmp_path / 'sheet.yaml').write_text(SHEET)
    log = recorded(tmp_path / 'sheet.yaml', tmp_path / 'log', COMMANDS, begin=6)
    simulation = xpbd_ros.load(log)
    assert simulation.index == 6
    assert set(simulation.frame().pins) == {'left', 'hand'}
    hashes = state_hashes(log)
    assert simulation.hash() == hashes[6]
    sequence = [COMMANDS.get(index, []) for index in range(7, 13)]
    last = xpbd_ros.rollouts(simulation, [sequence, 6 * [[]]], lambda frames: [*frames][-1].x)
    other = simulation.save().simulation()
    for commands in sequence:
        frame = other.step(commands)
    assert other.hash() == hashes[12]
    assert np.array_equal(last[0], frame.x)
    assert not np.array_equal(last[1], frame.x)
    with pytest.raises(InputError, match='the state of a log goes with the keys of its scene'):
        xpbd_ros.load(log, gravity=[0.0, 0.0, 0.0])


def test_bad_input_is_refused_with_the_way_out():
    with pytest.raises(InputError, match="did you mean 'towel'"):
        xpbd_ros.load('towl')
    with pytest.raises(InputError, match='solver.substeps: must be'):
        xpbd_ros.load(STRIP, **{'solver.substeps': -1})
    with pytest.raises(InputError, match='^x+: File name too long'):
        xpbd_ros.load(1000 * 'x')
    with pytest.raises(AttributeError, match="no attribute 'lod'"):
        _ = xpbd_ros.lod


def test_the_page_names_all_that_is_public_and_its_example_runs():
    for name in xpbd_ros.__all__:
        public = getattr(xpbd_ros, name)
        assert public.__doc__, name
        assert re.search(rf'`(simulation\.)?{name}\b', PAGE), name
    for method in ('step', 'frame', 'save', 'restore', 'hash', 'check', 'compile'):
        assert inspect.getdoc(getattr(xpbd_ros.Simulation, method))
        assert f'`simulation.{method}(' in PAGE or f'`.{method}(' in PAGE
    assert set(dir(xpbd_ros)) == {*xpbd_ros.__all__, '__version__'}
    example = re.search(r'```python\n(.*?)```', PAGE, re.S)[1]
    assert len(example.splitlines()) <= 15
    values = {}
    exec(example.replace('print(', 'found = ('), values)
    slow, fast = values['found']
    assert 0.0 < slow < fast


def test_without_a_simulation_nothing_is_compiled_or_imported():
    code = 'import sys, xpbd_ros; xpbd_ros.__version__; print("numba" in sys.modules)'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout == 'False\n'
    code = ('import sys, xpbd_ros; xpbd_ros.load; '
            'print(sorted(name for name in sys.modules if "rclpy" in name))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout == '[]\n'


NAN, INF = float('nan'), float('inf')
HOME = Pose((0.0, 0.0, 0.0))


@pytest.mark.parametrize(('command', 'reason'), [
    (MovePin('a', Pose((NAN, 0.0, 0.0))), 'MovePin a: position or orientation is not finite'),
    (MovePin('a', Pose((2e6, 0.0, 0.0))), r'MovePin a: position .* further than 1e\+06 m away'),
    (MovePin('a', Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))), 'is not a unit quaternion'),
    (MovePin('a', Pose((0.0, 0.0))), r'position must be 3 numbers \(got \(0.0, 0.0\)\)'),
    (MovePin('a', Pose(('x', 0.0, 0.0))), 'MovePin a: a value is not a number'),
    (MovePin('a', Pose(['x', 0.0, 0.0])), 'MovePin a: a value is not a number'),
    (MovePin('a', HOME, Twist((INF, 0.0, 0.0))), 'MovePin a: twist is not finite'),
    (MovePin('a', HOME, Twist((0.0, 0.0, 2e6))), r'twist .* is faster than 1e\+06'),
    (MovePin('a', HOME, HOME), r'is not a Twist'),
    (MovePin('a', HOME, 0), 'MovePin a: 0 is not a Twist'),
    (MovePin('a', Pose((10**400, 0.0, 0.0))), 'MovePin a: a value is not a number .int too large'),
    (MovePin('a', HOME, stamp_ns=10**400), r'stamp_ns must be below 2\*\*31 s'),
    (Grasp('g', HOME, 10**400), 'Grasp g: a value is not a number'),
    (SetKey(3, 1), "SetKey: 3 is not a key such as 'solver.substeps'"),
    (MovePin('a', None), 'MovePin a: None is not a Pose'),
    (MovePin(3, HOME), 'MovePin: 3 is not a name'),
    (Release(3), 'Release: 3 is not a name'),
    (MovePin('a', HOME, None, -1), r'stamp_ns must be an integer >= 0 ns \(got -1\)'),
    (Grasp('g', HOME, NAN), r'Grasp g: radius must be > 0 m \(got nan\)'),
    (Grasp('g', HOME, -0.1), r'Grasp g: radius must be > 0 m \(got -0.1\)'),
    (Grasp('g', HOME, 'wide'), 'Grasp g: a value is not a number'),
    (PlaceCollider('q', 'torus', (1.0,), HOME), "unknown shape 'torus' .known: box, sphere, cyl"),
    (PlaceCollider('q', 'box', (1.0,), HOME), 'size of a box must be 3 numbers'),
    (PlaceCollider('q', 'sphere', (0.0,), HOME), r'size \[0.0\] must be > 0 m'),
    (PlaceCollider('q', 'mesh', 8 * (0.0,), HOME), 'corners of the triangles must be 9 numbers'),
    (PlaceCollider('q', 'mesh', (), HOME), 'corners of the triangles must be 9 numbers'),
    (PlaceCollider('q', 'mesh', 9 * (NAN,), HOME), 'a corner is further than'),
    (SetWind((NAN, 0.0, 0.0)), 'SetWind: velocity is not finite'),
    (SetWind((1.0, 2.0)), 'SetWind: velocity: vector must be 3 numbers'),
    (None, 'None is not a command such as MovePin')])
def test_a_bad_command_is_refused_with_the_reason(command, reason):
    """At the door: the frame of the other commands is computed, to the same bits as without."""
    simulation, other = xpbd_ros.load(STRIP), xpbd_ros.load(STRIP)
    good = MovePin('a', Pose((0.0, 0.0, 0.1)))
    frame = simulation.step([good, command, ()])
    assert frame.applied == (good,)
    (refused, why), = frame.refused
    assert refused is command
    assert re.search(reason, why)
    other.step([good])
    assert simulation.hash() == other.hash()


def test_a_command_takes_arrays_and_quaternions_near_unit_length():
    simulation = xpbd_ros.load(STRIP)
    frame = simulation.step([MovePin('a', Pose(np.array([0.0, 0.0, 0.1]), [0.0, 0.0, 0.0, 1.001]),
                                     Twist([0.0, 0.0, 6.0], [0.0, 0.0, 0.0]))])
    assert frame.applied == (MovePin('a', Pose((0.0, 0.0, 0.1)), Twist((0.0, 0.0, 6.0))),)


def test_no_name_is_not_that_of_the_log_in_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / 'run.mcap').touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match='scene: has no name; give that of a scene file or log'):
        xpbd_ros.load('')


def test_numbers_of_numpy_are_numbers():
    simulation = xpbd_ros.load(STRIP, **{'solver.substeps': np.float32(12),
                                         'gravity': np.array([0, 0, -1])})
    assert simulation.solver.substeps == 12
    assert simulation.state.gravity.tolist() == [0.0, 0.0, -1.0]
    frame = simulation.step([
        SetKey('solver.substeps', np.int64(7)), SetKey('gravity', np.array([0.0, 0.0, -2.0])),
        MovePin('a', HOME, stamp_ns=np.int64(5))])
    assert frame.refused == ()
    assert frame.applied[:2] == (SetKey('solver.substeps', 7), SetKey('gravity', [0.0, 0.0, -2.0]))
    assert type(frame.applied[0].value) is int and type(frame.applied[2].stamp_ns) is int
    simulation.check({'solver.substeps': np.int64(9)})


def test_other_arguments_of_the_wrong_type_are_refused():
    simulation = xpbd_ros.load(STRIP)
    with pytest.raises(TypeError, match=r'None is not a state from Simulation.save'):
        simulation.restore(None)
    with pytest.raises(TypeError, match='None is not a simulation or a state'):
        xpbd_ros.rollouts(None, [], list)
    with pytest.raises(TypeError, match='None is not a path of a scene file, a name or a mapping'):
        xpbd_ros.load(None)
    with pytest.raises(InputError, match=r'workers: must be >= 1 \(got 0\)'):
        xpbd_ros.rollouts(simulation, [], list, workers=0)
