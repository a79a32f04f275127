"""The hard cases of the node: clocks that jump, too much work, inputs that are no numbers."""

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

from xpbd_ros.node_stress.node import Company
from xpbd_ros.study.stress.case import Outcome
from xpbd_ros.study.stress.refusals import Refusal

NAN, INF = float('nan'), float('inf')
STILL = 1e-3
"""how far a towel on a table may move while nothing happens to it [m]"""
PATIENCE = 20
"""how much longer than asked a clock goes on until a busy machine shows a frame"""


def verdict(name: str, company: Company, home: np.ndarray, told: str, *,
            frames: int = 1, since: int = 0) -> Outcome:
    """Return what came of a towel that should lie where it was; stamps rise ``since`` a cloud."""
    way = float(np.abs(company.points() - home).max())
    finite, why = company.finite, []
    if not finite:
        why.append('not finite')
    if not way <= STILL:
        why.append(f'moved by {way:.2g} m')
    if not company.rising(since):
        why.append('stamps do not rise')
    if len(company.clouds) < frames:
        why.append(f'{len(company.clouds)} frames')
    if not told:
        why.append('not told')
    return Outcome(name, not why, finite, recovered=way <= STILL, reported=told,
                   why='; '.join(why))


def clocks(folder: Path) -> Iterator[Outcome]:
    """Step on a /clock that runs faster, slower, stands, jumps ahead and back."""
    for rate in (0.0, -60.0, NAN, 1e9):
        scene = {'frame_rate': rate, 'cloths': {'c': {
            'grid': {'size': [1.0, 1.0], 'resolution': [2, 2]}, 'density': 1.0}}}
        yield Refusal(f'frame_rate: {rate}', scene, ('frame_rate: must be',)).outcome()
    company = Company(folder, use_sim_time='true')
    now = 10_000 * 10**9

    def tell():
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
        company.say('/clock', message)
        company.spin(0.01)

    company.until(lambda: company.process.poll() is None and company.said('waiting for /clock'),
                  'the node')
    told = company.said('waiting for /clock')
    while not company.clouds:
        tell()
        now += 5_000_000
    home = company.points()
    for name, step, count, jump in (('usual pace', 5_000_000, 100, 0),
                                    ('ten times as fast', 50_000_000, 40, 0),
                                    ('a tenth', 500_000, 100, 0), ('paused', 0, 50, 0),
                                    ('ahead by an hour', 5_000_000, 60, 3600 * 10**9),
                                    ('back by two hours', 5_000_000, 60, -7200 * 10**9),
                                    ('before time 0', 0, 3, -20_000 * 10**9),
                                    ('and in order again', 5_000_000, 60, 20_001 * 10**9)):
        before, stands = len(company.clouds), name in ('paused', 'before time 0')
        now += jump
        for tick in range(PATIENCE * count):
            if tick >= count and (stands or len(company.clouds) > before):
                break
            now += step
            tell()
        told = (company.said('/clock: refused') or company.said('the clock jumped by -')
                or company.said('the clock jumped') or told)
        outcome = verdict(f'node: /clock {name}', company, home, told, since=before)
        fresh = len(company.clouds) - before
        if stands and fresh > 2:
            outcome = Outcome(outcome.setting, False, True, why=f'{fresh} frames while it stood')
        elif not stands and not fresh:
            outcome = Outcome(outcome.setting, False, True, why='no frames')
        yield outcome
    if not company.end():
        yield Outcome('node: its end', False, True, why='not in good order')


def overload(folder: Path) -> Iterator[Outcome]:
    """Ask for far more substeps than there is time for."""
    company = Company(folder, substeps=10_000)
    company.until(lambda: company.clouds, 'the node')
    home = company.points()
    company.until(lambda: int(company.status.get('dropped_frames', 0)) > 10, 'dropped frames')
    answer = company.ask(Trigger, '/cloth/pause', Trigger.Request())
    told = next((text for text in company.warned if 'dropped' in text), '')
    outcome = verdict('node: 10000 substeps', company, home, told)
    if not answer.success:
        outcome = Outcome(outcome.setting, False, True, why=f'pause: {answer.message}')
    yield outcome
    if not company.end():
        yield Outcome('node: its end', False, True, why='not in good order')


def no_numbers(folder: Path) -> Iterator[Outcome]:
    """Send what is no number over every input."""
    company = Company(folder)
    company.until(lambda: company.clouds and company.status, 'the node')
    company.spin(0.5)
    home = company.points()

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
            before = int(company.status['rejected_inputs'])
            company.say(f'/cloth/{topic}', make(value))
            if value == 1e308:
                company.spin(0.5)
                continue
            company.until(lambda before=before: int(company.status['rejected_inputs']) > before,
                          f'a refusal of {value} on {topic}')
        yield verdict(f'node: ~/{topic}', company, home, company.said(f'/cloth/{topic}'))
    for name, value in (('gravity', [0.0, 0.0, NAN]), ('solver.compliance_scale', INF),
                        ('cloths.towel.effects.stretch.warp', -1.0)):
        answer = company.ask(
            SetParametersAtomically, '/cloth/set_parameters_atomically',
            SetParametersAtomically.Request(parameters=[
                Parameter(name, value=value).to_parameter_msg()]))
        told = '' if answer.result.successful else answer.result.reason
        yield verdict(f'node: parameter {name}', company, home, told)
    if not company.end():
        yield Outcome('node: its end', False, True, why='not in good order')


CASES = {'H20': clocks, 'H21': overload, 'H23': no_numbers}
