"""The hard cases of the node: clocks that jump, overload, non-finite inputs."""

from collections.abc import Iterator
from pathlib import Path

from geometry_msgs.msg import PoseStamped
import numpy as np
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MultiDOFJointState
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from xpbd_ros.node_stress.node import NodeUnderTest
from xpbd_ros.study.stress.case import Outcome
from xpbd_ros.study.stress.refusals import Refusal

NAN, INF = float('nan'), float('inf')
STILL = 1e-3
"""distance that a towel at rest on a table may move [m]"""
MOST_TICKS = 20
"""ticks of /clock until a busy machine must publish a frame, over those of the case"""


def verdict(name: str, tested: NodeUnderTest, home: np.ndarray, told: str, *,
            frames: int = 1, since: int = 0) -> Outcome:
    """
    Return the outcome for a towel that should have stayed at rest.

    Parameters
    ----------
    name : setting, as listed
    tested : the node and what it has published
    home : positions at rest [m], shape (particles, 3)
    told : message of the node to the user; required
    frames : clouds that must have arrived
    since : number of the first cloud from which on stamps must rise

    """
    way = float(np.abs(tested.points() - home).max())
    finite, why = tested.finite, []
    if not finite:
        why.append('not finite')
    if not way <= STILL:
        why.append(f'moved by {way:.2g} m')
    if not tested.rising(since):
        why.append('stamps do not rise')
    if len(tested.clouds) < frames:
        why.append(f'{len(tested.clouds)} frames')
    if not told:
        why.append('not reported')
    return Outcome(name, not why, finite, recovered=way <= STILL, reported=told,
                   why='; '.join(why))


def clocks(folder: Path) -> Iterator[Outcome]:
    """Run on a /clock that is fast, slow, paused, or jumps forward or back."""
    for rate in (0.0, -60.0, NAN, 1e9):
        scene = {'frame_rate': rate, 'cloths': {'c': {
            'grid': {'size': [1.0, 1.0], 'resolution': [2, 2]}, 'density': 1.0}}}
        yield Refusal(f'frame_rate: {rate}', scene, ('frame_rate: must be',)).outcome()
    tested = NodeUnderTest(folder, use_sim_time='true')
    now = 10_000 * 10**9

    def tell():
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
        tested.publish('/clock', message)
        tested.spin(0.01)

    tested.wait_for(lambda: (tested.process.poll() is None
                             and tested.message_with('waiting for /clock')),
                    'the node')
    told = tested.message_with('waiting for /clock')
    while not tested.clouds:
        tell()
        now += 5_000_000
    home = tested.points()
    for name, step, count, jump in (('usual pace', 5_000_000, 100, 0),
                                    ('ten times as fast', 50_000_000, 40, 0),
                                    ('a tenth', 500_000, 100, 0), ('paused', 0, 50, 0),
                                    ('ahead by an hour', 5_000_000, 60, 3600 * 10**9),
                                    ('back by two hours', 5_000_000, 60, -7200 * 10**9),
                                    ('before time 0', 0, 3, -20_000 * 10**9),
                                    ('and in order again', 5_000_000, 60, 20_001 * 10**9)):
        before, stands = len(tested.clouds), name in ('paused', 'before time 0')
        now += jump
        for tick in range(MOST_TICKS * count):
            if tick >= count and (stands or len(tested.clouds) > before):
                break
            now += step
            tell()
        told = (tested.message_with('/clock: refused')
                or tested.message_with('the clock jumped by -')
                or tested.message_with('the clock jumped') or told)
        outcome = verdict(f'node: /clock {name}', tested, home, told, since=before)
        fresh = len(tested.clouds) - before
        if stands and fresh > 2:
            outcome = Outcome(outcome.setting, False, True,
                              why=f'{fresh} frames while /clock was paused')
        elif not stands and not fresh:
            outcome = Outcome(outcome.setting, False, True, why='no frames')
        yield outcome
    if not tested.end():
        yield Outcome('node: its end', False, True, why='exit code not 0, or a traceback')


def overload(folder: Path) -> Iterator[Outcome]:
    """Run with far more substeps than real time allows."""
    tested = NodeUnderTest(folder, substeps=10_000)
    tested.wait_for(lambda: tested.clouds, 'the node')
    home = tested.points()
    tested.wait_for(lambda: int(tested.status.get('dropped_frames', 0)) > 10, 'dropped frames')
    answer = tested.call(Trigger, '/cloth/pause', Trigger.Request())
    told = next((text for text in tested.warned if 'dropped' in text), '')
    outcome = verdict('node: 10000 substeps', tested, home, told)
    if not answer.success:
        outcome = Outcome(outcome.setting, False, True, why=f'pause: {answer.message}')
    yield outcome
    if not tested.end():
        yield Outcome('node: its end', False, True, why='exit code not 0, or a traceback')


def no_numbers(folder: Path) -> Iterator[Outcome]:
    """Send NaN, infinite and huge numbers over every input."""
    tested = NodeUnderTest(folder)
    tested.wait_for(lambda: tested.clouds and tested.status, 'the node')
    tested.spin(0.5)
    home = tested.points()

    def marker(value) -> MarkerArray:
        one = Marker(ns='a', type=Marker.SPHERE)
        one.pose.position.x, one.scale.x, one.scale.y, one.scale.z = value, 0.1, 0.1, 0.1
        one.pose.orientation.w = 1.0
        return MarkerArray(markers=[one])

    def targets(name, value) -> MultiDOFJointState:
        from geometry_msgs.msg import Transform
        place = Transform()
        place.translation.z = value
        return MultiDOFJointState(joint_names=[name], transforms=[place])

    def pose(value) -> PoseStamped:
        found = PoseStamped()
        found.pose.position.z, found.pose.orientation.w = value, 1.0
        return found

    for topic, make in (('pins', marker), ('colliders', marker),
                        ('pin_targets', lambda value: targets('a', value)),
                        ('collider_states', lambda value: targets('ball', value)),
                        ('collider/ball/pose', pose)):
        for value in (NAN, INF, -INF, 1e308):
            before = int(tested.status['rejected_inputs'])
            tested.publish(f'/cloth/{topic}', make(value))
            if value == 1e308:
                tested.spin(0.5)
                continue
            tested.wait_for(lambda before=before: int(tested.status['rejected_inputs']) > before,
                            f'a refusal of {value} on {topic}')
        yield verdict(f'node: ~/{topic}', tested, home, tested.message_with(f'/cloth/{topic}'))
    for name, value in (('gravity', [0.0, 0.0, NAN]), ('solver.compliance_scale', INF),
                        ('cloths.towel.effects.stretch.warp', -1.0)):
        answer = tested.call(
            SetParametersAtomically, '/cloth/set_parameters_atomically',
            SetParametersAtomically.Request(parameters=[
                Parameter(name, value=value).to_parameter_msg()]))
        told = '' if answer.result.successful else answer.result.reason
        yield verdict(f'node: parameter {name}', tested, home, told)
    if not tested.end():
        yield Outcome('node: its end', False, True, why='exit code not 0, or a traceback')


CASES = {'H20': clocks, 'H21': overload, 'H23': no_numbers}
