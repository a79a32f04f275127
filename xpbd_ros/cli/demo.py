"""
Start the node, drive it over DDS as a robot would, and report the result.

Three processes run on a private ROS domain, on loopback only: the node with a towel on a table; a
robot that grasps two corners of it, lifts and holds it, sweeps a ball through it, carries it over
a stool and releases it; an observer that subscribes to the point clouds. The run is recorded,
checked and drawn.

Exit code: 0, or 1 if a check fails.
"""

from pathlib import Path
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from xpbd_ros.cli.output import add_json_argument, check_outputs, new_folder, write_json
from xpbd_ros.cli.ros import need_ros
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import fresh_folder

EXAMPLE = 'xpbd_ros demo --output my_demo'
SCENE = 'demo'
COMPILE_SECONDS = 150.0
END_SECONDS = 30.0
SLOWEST = 20.0
"""wall time over simulated time that is allowed"""


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('-o', '--output', metavar='DIR',
                        help='new folder for log, picture and node output; default: one named by '
                             'time')
    parser.add_argument('--duration', type=float, default=12.0, metavar='S',
                        help='simulated time of the demo in s, 5 to 600 (default: 12)')
    add_json_argument(parser)


def run(arguments) -> int:
    """Run the demo, check and draw it."""
    need_ros('demo')
    if not 5.0 <= arguments.duration <= 600.0:
        raise InputError(f'--duration: must be from 5 to 600 s (got {arguments.duration:g})')
    check_outputs(arguments.json, folder=arguments.output)

    def say(text: str) -> None:
        print(text, file=sys.stderr if arguments.json == '-' else sys.stdout, flush=True)

    with new_folder(arguments.output or fresh_folder('demo')) as folder:
        assert folder is not None
        play(folder, arguments.duration, say)
    say('drawing …')
    from xpbd_ros.demo import report
    numbers = report.make(folder, SCENE)
    say(report.table(numbers))
    write_json(arguments.json, numbers)
    return 0 if all(check['pass'] for check in numbers['checks']) else 1


def play(folder: Path, duration: float, say) -> None:
    """Run the three processes to the end of the demo."""
    from xpbd_ros.demo.domain import private_environment
    environment = private_environment()
    node_log = (folder / 'node.log').open('w')

    def start(*command: str, **streams) -> Any:
        processes.append(subprocess.Popen([sys.executable, '-m', *command], env=environment,
                                          **streams))
        return processes[-1]

    say(f"ROS domain {environment['ROS_DOMAIN_ID']}, loopback only; starting the node "
        '(compiling takes about a minute the first time) …')
    processes: list[Any] = []
    try:
        node = start('xpbd_ros', 'node', '--ros-args', '-p', f'scene:={SCENE}',
                     '-p', f'record.path:={folder / "run"}',
                     '-p', 'publish_clock:=true',    # stamps do not depend on the machine's speed
                     stdout=node_log, stderr=subprocess.STDOUT)
        observer = start('xpbd_ros.demo.observer', str(folder / 'observed.npz'),
                         stdout=subprocess.PIPE, text=True)
        follow(observer.stdout.readline, observer, node, folder, COMPILE_SECONDS)
        robot = start('xpbd_ros.demo.robot', str(duration), str(folder / 'robot.json'),
                      stdout=subprocess.PIPE, text=True)
        follow(lambda: [say(f'  robot: {line.strip()}') for line in robot.stdout], robot, node,
               folder, END_SECONDS + SLOWEST * duration)
        if ended(robot) != 0:
            raise InputError(f'the robot process failed with exit code {robot.returncode}')
        for process in (observer, node):
            process.send_signal(signal.SIGINT)
            if ended(process) != 0:
                raise InputError(f'{process.args[2]} failed with exit code {process.returncode}; '
                                 f'see {folder / "node.log"}')
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            ended(process)
        node_log.close()


def ended(process: subprocess.Popen) -> int:
    """Wait for a process that was told to end; kill it after END_SECONDS; return its exit code."""
    try:
        return process.wait(END_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def follow(read, process, node, folder: Path, seconds: float) -> None:
    """Call ``read`` in a thread until it returns; raise if the node ends or time runs out [s]."""
    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    end = time.monotonic() + seconds
    while reader.is_alive():
        if node.poll() is not None:
            log = (folder / 'node.log').read_text().strip().splitlines()
            raise InputError(f'the node ended early: {log[-1] if log else "without output"}')
        if time.monotonic() > end:
            raise InputError(f'{process.args[2]}: not done after {seconds:.0f} s; see '
                             f'{folder / "node.log"}')
        reader.join(0.1)
