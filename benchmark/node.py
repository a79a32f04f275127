"""
Cost of the node beside the physics, and how regular its clouds are.

    python benchmark/node.py                       a minute of a 100×100 cloth at 60 Hz
    python benchmark/node.py --seconds 20 --json figures.json
    python benchmark/node.py --idle                without subscribers and without a log

Four processes run on a private ROS domain on loopback. The node steps a hanging cloth with contact
and records it. A listener subscribes to the clouds and the markers, and takes all that has arrived
30 times a second. A bare node has one timer of the frame's period. Shares are processor time over
wall time: of the node with all its threads, of the physics (``Simulation.step``), of the estimates
of its error, and of the overhead, the rest. DDS, markers and log are overhead.

Jitter is |interval - period|: of the publications of the clouds (DDS source time), of the ends of
the steps, and of the calls of the bare timer, which is the machine's.
"""

import argparse
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np

from xpbd_ros.cli.output import add_json_argument, refuse_existing, STDOUT, write_json
from xpbd_ros.demo.domain import private_environment
from xpbd_ros.errors import InputError
from xpbd_ros.study.machine import describe, machine

RATE = 60.0
LISTEN_RATE = 30.0
WARM_UP = 3.0
"""from the activation to the first moment that counts [s]"""
SCENE = """
cloths:
  sheet:
    grid: {size: [1.0, 1.0], resolution: [SIDE, SIDE]}
    pose: {position: [-0.5, -0.5, 1.0]}
    density: 0.2
    effects:
      stretch: {warp: 1000.0, weft: 1000.0}
      shear: {stiffness: 5.0}
      bend: {stiffness: 1.0e-5}
pins:
  left: {cloth: sheet, at: corner_00}
  right: {cloth: sheet, at: corner_01}
colliders:
  table: {plane: {normal: [0, 0, 1]}, friction: 0.5}
effects:
  contact: {thickness: 0.002}
  friction: {}
  damping: {rate: 0.5}
solver: {method: line, integrator: ndf2, substeps: SUBSTEPS, iterations: 1}
"""


def main() -> int:
    """Measure, and print the figures."""
    arguments = _parser().parse_args()
    if arguments.role:
        return {'node': run_node, 'listener': listen, 'timer': run_timer}[arguments.role](
            arguments.rest)
    try:
        refuse_existing(arguments.json)
        found = measure(arguments)
        write_json(arguments.json, found)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    out = sys.stderr if arguments.json == STDOUT else sys.stdout
    print(as_text(found), file=out)
    return 0


def measure(arguments) -> dict:
    """Run the processes, and return the figures."""
    here = machine()
    with tempfile.TemporaryDirectory(prefix='xpbd_ros_benchmark_') as name:
        folder = Path(name)
        scene = folder / 'sheet.yaml'
        scene.write_text(SCENE.replace('SIDE', str(arguments.side)).replace(
            'SUBSTEPS', str(arguments.substeps)))
        environment = private_environment()
        files = {role: folder / f'{role}.json' for role in ('node', 'listener', 'timer')}
        quiet = arguments.idle
        words = ['-p', f'scene:={scene}'] + (
            [] if quiet else ['-p', f'record.path:={folder / "log"}'])

        def start(role: str, *more: str) -> subprocess.Popen:
            return subprocess.Popen(
                [sys.executable, __file__, '--role', role, str(files[role]),
                 str(arguments.seconds), *more], env=environment)
        node = start('node', *words)
        others = [start('timer')] + ([] if quiet else [start('listener')])
        try:
            if node.wait() or any(each.wait() for each in others):
                raise InputError('a process of the measurement failed')
        finally:
            for each in (node, *others):
                each.kill()
        found = {role: json.loads(file.read_text()) for role, file in files.items()
                 if file.exists()}
    return figures(found, here, arguments)


def figures(found: dict, here: dict, arguments) -> dict:
    """Return the figures from the files of the processes."""
    node, period = found['node'], 1.0 / RATE
    wall, frames = node['wall_s'], len(node['steps_s'])
    result = {
        'cpu': describe(here), 'load': here['load'], 'side': arguments.side,
        'substeps': arguments.substeps, 'seconds': wall, 'frames': frames,
        'dropped': node['dropped'], 'node': node['cpu_s'] / wall,
        'physics': node['physics_s'] / wall,
        'estimates': node['estimates_s'] / wall,
        'overhead': (node['cpu_s'] - node['physics_s'] - node['estimates_s']) / wall,
        'threads': {name: seconds / wall for name, seconds in node['threads_s'].items()},
        'step_ms': percentiles(1e3 * np.array(node['steps_s'])),
        'step_end_jitter_ms': jitter(node['ends_s'], period),
        'timer_jitter_ms': jitter(found['timer']['calls_s'], period)}
    if 'listener' in found:
        heard = found['listener']
        result['jitter_ms'] = jitter(heard['sources_s'], period)
        stamps = np.round(np.array(heard['stamps_s']) / period).astype(int)
        inside = (stamps > stamps[0] + RATE) & (stamps < stamps[-1] - 1)
        result['clouds'] = len(stamps)
        result['clouds_missing'] = int(heard['missing'])
        result['markers'] = heard['markers']
        assert inside.any()
    return result


def jitter(moments, period: float) -> dict[str, float]:
    """Return percentiles of |interval - period| [ms]."""
    return percentiles(1e3 * np.abs(np.diff(moments) - period))


def percentiles(values: np.ndarray) -> dict[str, float]:
    """Return the median, the 99th percentile and the largest."""
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return {'p50': float(p50), 'p99': float(p99), 'max': float(values.max())}


def as_text(found: dict) -> str:
    """Return the figures as lines."""
    lines = [f"{found['cpu']}; load {found['load']}",
             f"{found['side']}² particles, {found['substeps']} substeps, {found['frames']} frames "
             f"in {found['seconds']:.0f} s, {found['dropped']} dropped",
             'share of a core: ' + ', '.join(
                 f'{name} {100 * found[name]:.1f} %'
                 for name in ('node', 'physics', 'estimates', 'overhead')),
             'by thread: ' + ', '.join(f'{name} {100 * share:.1f} %'
                                       for name, share in found['threads'].items())]
    for name in ('step_ms', 'step_end_jitter_ms', 'jitter_ms', 'timer_jitter_ms'):
        if name in found:
            p = found[name]
            lines.append(f"{name}: median {p['p50']:.2f}, p99 {p['p99']:.2f}, "
                         f"largest {p['max']:.2f}")
    if 'clouds' in found:
        lines.append(f"clouds {found['clouds']}, missing {found['clouds_missing']}, "
                     f"markers {found['markers']}")
    return '\n'.join(lines)


# the processes


def threads_s() -> dict[str, float]:
    """Return the processor time of each kind of thread of this process [s]."""
    found: dict[str, float] = {}
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    for task in Path('/proc/self/task').iterdir():
        text = (task / 'stat').read_text().rpartition(')')[2].split()
        name = names.get(int(task.name), 'DDS and others').rstrip('_0123456789')
        ticks = int(text[11]) + int(text[12])
        found[name] = found.get(name, 0.0) + ticks / os.sysconf('SC_CLK_TCK')
    return found


def run_node(rest: list[str]) -> int:
    """Run the node for some seconds, with the physics timed."""
    import rclpy

    from xpbd_ros.ros.cloth_node import ClothNode
    from xpbd_ros.ros.process import run
    from xpbd_ros.sim.simulation import Simulation
    file, seconds, *words = rest
    physics, ends, walls = [], [], []
    step = Simulation.step

    def timed(simulation, *arguments, **options):
        begin, wall = time.thread_time(), time.perf_counter()
        frame = step(simulation, *arguments, **options)
        physics.append(time.thread_time() - begin)
        walls.append(time.perf_counter() - wall)
        ends.append(time.monotonic())
        return frame
    Simulation.step = timed
    nodes = []

    class Node(ClothNode):
        def on_activate(self, state):
            nodes.append(self)
            result = super().on_activate(state)
            threading.Thread(target=watch, daemon=True, name='watch').start()
            return result

    def watch():
        time.sleep(WARM_UP)
        node = nodes[0]
        before = threads_s(), time.process_time(), time.monotonic(), len(physics), (
            node.stepper.dropped), node.error_monitor.seconds
        time.sleep(float(seconds))
        first = before[3]
        threads = threads_s()
        Path(file).write_text(json.dumps({
            'wall_s': time.monotonic() - before[2],
            'cpu_s': time.process_time() - before[1], 'physics_s': sum(physics[first:]),
            'steps_s': walls[first:], 'ends_s': ends[first:],
            'dropped': node.stepper.dropped - before[4],
            'estimates_s': node.error_monitor.seconds - before[5],
            'threads_s': {name: value - before[0].get(name, 0.0)
                          for name, value in threads.items()}}))
        time.sleep(1.0)
        rclpy.try_shutdown()
    return run(Node, ['--ros-args', *words])


def run_timer(rest: list[str]) -> int:
    """Run a node with one timer; keep the moments of its calls."""
    import rclpy
    file, seconds = rest[:2]
    rclpy.init()
    node, calls = rclpy.create_node('bare_timer'), []
    node.create_timer(1.0 / RATE, lambda: calls.append(time.monotonic()))
    end = time.monotonic() + float(seconds) + WARM_UP
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=1.0)
    Path(file).write_text(json.dumps({'calls_s': calls[int(RATE):]}))
    return 0


def listen(rest: list[str]) -> int:
    """Take all clouds and markers that have arrived, 30 times a second."""
    import rclpy
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2
    from visualization_msgs.msg import MarkerArray
    file, seconds = rest[:2]
    rclpy.init()
    node = rclpy.create_node('listener')
    clouds = node.create_subscription(PointCloud2, '/cloth/particles', lambda m: None, 5, raw=True)
    markers = node.create_subscription(MarkerArray, '/cloth/markers', lambda m: None, 5, raw=True)
    stamps, sources, marked, sequence = [], [], 0, []
    end = None
    due = time.monotonic()
    while end is None or time.monotonic() < end:
        due += 1.0 / LISTEN_RATE
        time.sleep(max(0.0, due - time.monotonic()))
        while True:
            with clouds.handle:
                found = clouds.handle.take_message(PointCloud2, True)
            if found is None:
                break
            if end is None:
                end = time.monotonic() + WARM_UP + float(seconds) - 1.0
            stamp = deserialize_message(found[0], PointCloud2).header.stamp
            stamps.append(stamp.sec % 10**6 + 1e-9 * stamp.nanosec)
            sources.append(1e-9 * (found[1]['source_timestamp'] % 10**15))
            sequence.append(found[1]['publication_sequence_number'])
        while True:
            with markers.handle:
                found = markers.handle.take_message(MarkerArray, True)
            if found is None:
                break
            marked += 1
    first = int(WARM_UP * RATE)
    gaps = np.diff(sequence[first:]) - 1
    Path(file).write_text(json.dumps({
        'stamps_s': stamps[first:], 'sources_s': sources[first:], 'markers': marked,
        'missing': int(gaps.sum())}))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=60.0, metavar='S')
    parser.add_argument('--side', type=int, default=100, metavar='N',
                        help='particles along a side; 100 unless given')
    parser.add_argument('--substeps', type=int, default=4, metavar='K', help='4 unless given')
    parser.add_argument('--idle', action='store_true', help='no subscriber, no log')
    parser.add_argument('--role', choices=('node', 'listener', 'timer'), help=argparse.SUPPRESS)
    parser.add_argument('rest', nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    add_json_argument(parser)
    return parser


if __name__ == '__main__':
    sys.exit(main())
