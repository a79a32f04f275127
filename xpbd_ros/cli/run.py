"""
Simulate a scene as fast as possible, without DDS, and write the same log as the node.

The motions in the scene file move pins and colliders. --commands also applies the inputs of an
earlier log, at the frames that they acted on, and compares the run with that log, for its duration
unless --duration is given. With the log of another program (MCAP or rosbag2), pins and colliders
follow the TF frames, robots and topics that the scene names, from --start-offset on.

Exit code: 0. With --commands it is 1 if the run is not bit-identical to the log: another scene,
other keys (--set included), a log that begins in the middle of a run, or refused inputs.
"""

from pathlib import Path
import sys
import time
from typing import Any

from xpbd_ros.cli.output import add_json_argument, check_outputs, write_json
from xpbd_ros.cli.overrides import add_set_argument, overrides_of
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import need_ros, new_log, recording_of
from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.folder import fresh_folder
from xpbd_ros.scene.frames import notes_without_tf

EXAMPLE = 'xpbd_ros run drape --duration 2 --set solver.substeps=24 -o drape_run'

LONGEST = 1e6
"""duration of a run, at most [s]"""


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scene', help='a scene file, or the name of a shipped scene')
    parser.add_argument('-o', '--output', metavar='RUN',
                        help='new folder for the log; default: one named by time')
    parser.add_argument('--duration', type=float, metavar='S',
                        help="simulated time in s, instead of the scene's duration")
    parser.add_argument('--commands', metavar='LOG',
                        help='apply the inputs of this log (a folder or an .mcap file), and '
                             'compare the states with its states; or take motion from the log of '
                             'another program')
    parser.add_argument('--start-offset', type=float, default=0.0, metavar='S',
                        help="time at which the run begins in another program's log, in s")
    parser.add_argument('--settings', metavar='FILE',
                        help="a file with a 'solver:' block, which overrides the scene's keys")
    add_set_argument(parser)
    parser.add_argument('--picture', metavar='FILE',
                        help='draw three instants of the run to this new PNG file; needs the '
                             'extra view')
    add_json_argument(parser)


def run(arguments) -> int:
    """Simulate, record and, with ``--commands``, compare the scene."""
    need_ros('run')
    from xpbd_ros.ros.diagnostics import percentile
    from xpbd_ros.ros.error_monitor import ErrorMonitor
    from xpbd_ros.ros.repeat import Repeat
    from xpbd_ros.ros.signals import collected_signals
    from xpbd_ros.scene.compare import first_texts
    from xpbd_ros.scene.compile import compile_scene

    check_all_outputs(arguments)
    recording, foreign = commands_in(arguments)
    if recording is not None and recording.not_repeatable:
        print(f'xpbd_ros run: {recording.not_repeatable}', file=sys.stderr)
        return 1
    scene = scene_of(arguments, recording, foreign)
    frames = count_frames(scene)
    simulation = compile_scene(scene)
    motion = motion_in(foreign, scene, simulation, frames, arguments.start_offset)
    quiet = arguments.json == '-'
    repeat = None
    if recording is not None:
        repeat = Repeat(recording, scene, simulation, frames)
        repeat.look(simulation.frame())
    folder = Path(arguments.output) if arguments.output else fresh_folder('run')
    recorder = new_log(folder, scene, simulation, program='run')
    step_ms, shots = [], shots_of(arguments, simulation, frames)
    refused: list[str] = []
    notes = [*([] if motion else notes_without_tf(scene)), *simulation.notes]
    monitor = ErrorMonitor(simulation, target=scene.top.solver.error_target,
                           most=scene.top.solver.max_substeps)
    try:
        simulation.compile()
        begin = time.perf_counter()
        with collected_signals() as signals:
            for index in progress(range(1, frames + 1), 'frames'):
                start = time.perf_counter()
                inputs = (repeat or motion).commands(index) if repeat or motion else ()
                frame = simulation.step([*inputs, *monitor.commands()], keep=monitor.due())
                step_ms.append(1e3 * (time.perf_counter() - start))
                monitor.look(1e-3 * step_ms[-1])
                refused += refusals(frame)
                if repeat:
                    repeat.look(frame)
                if shots:
                    shots.look(frame)
                notes += [f'frame {index}: {text}' for text in frame.news]
                recorder.frame(frame)
                recorder.values(monitor.values(), frame)
                if signals:
                    raise KeyboardInterrupt(f'after frame {index}; its log is {folder}')
    finally:
        monitor.close()
        recorder.close()
    wall = time.perf_counter() - begin
    numbers: dict[str, Any] = {
        'frames': frames,
        'real_time_factor': frames * simulation.frame_dt / wall,
        'step_ms': {'p50': percentile(step_ms, 0.5), 'p95': percentile(step_ms, 0.95),
                    'max': max(step_ms, default=0.0)},
        'solver': vars(simulation.solver),
        'refused': len(refused),
        'error': monitor.summary(),
        **recorder.guards.numbers(simulation.stats()),
        'notes': notes,
        'state_hash': f'{simulation.hash():016x}',
        'run': folder.absolute(),
    }
    if repeat:
        notes += repeat.notes
        numbers['commands'] = repeat.numbers()
    if motion:
        notes += [*motion.texts(), *first_texts(refused, 'refused')]
    if shots:
        numbers['pictures'] = [shots.draw(Path(arguments.picture))]
    write_json(arguments.json, numbers)
    if not quiet:
        print(table(scene.name, numbers, monitor))
    return verdict(repeat, quiet) if repeat else 0


def check_all_outputs(arguments) -> None:
    """Raise InputError if outputs exist or clash, or the picture cannot be rendered."""
    check_outputs(arguments.json, picture=arguments.picture, folder=arguments.output)
    if arguments.picture:
        from xpbd_ros.study.picture import need_view
        need_view('--picture')


def shots_of(arguments, simulation, frames: int):
    """Return what keeps the instants that ``--picture`` draws; None without it."""
    if not arguments.picture:
        return None
    from xpbd_ros.study.snapshots import Shots
    return Shots(simulation, frames)


def commands_in(arguments) -> tuple[Any, Any]:
    """Return the log of ``--commands``: (a recorded run, None) or (None, another program's)."""
    log = None
    if arguments.commands:
        from xpbd_ros.log.foreign import ForeignLog
        log = ForeignLog(arguments.commands)
        if log.scene is not None:
            log = None
    if log is None:
        if arguments.start_offset:
            raise InputError("--start-offset: needs --commands with another program's log")
        return recording_of('run', arguments.commands) if arguments.commands else None, None
    for text in log.damage:
        print(f'xpbd_ros run: damaged log: {text}; messages may be lost', file=sys.stderr)
    length = 1e-9 * (log.end_ns - log.start_ns)
    if not length:
        raise InputError(f'{log.path}: all its messages have one time, so nothing moves; record '
                         f'for longer')
    if not 0.0 <= arguments.start_offset < length:
        raise InputError(f'--start-offset: must be within the log, from 0 to before {length:.3f} '
                         f's (got {arguments.start_offset:g} s)')
    return None, log


def motion_in(log, scene, simulation, frames: int, offset: float):
    """Return the motion in another program's log; None without one."""
    if log is None:
        return None
    from xpbd_ros.ros.foreign_motion import ForeignMotion
    try:
        return ForeignMotion(log, scene, simulation, frames=frames, offset=offset)
    except InputError as error:
        raise InputError(f'{scene.where}: {error}') from None


def scene_of(arguments, recording, foreign):
    """Return the scene with the overrides; with a log, as long as it."""
    from xpbd_ros.scene.load import load_scene
    overrides = overrides_of(arguments.keys, settings=arguments.settings,
                             duration=arguments.duration)
    scene = load_scene(arguments.scene, overrides)
    if recording is None and foreign is None or arguments.duration is not None:
        return scene
    length = (recording.last / scene.top.frame_rate if foreign is None else
              1e-9 * (foreign.end_ns - foreign.start_ns) - arguments.start_offset)
    return load_scene(arguments.scene, {**overrides, 'duration': length})


def refusals(frame) -> list[str]:
    """Return the refused commands of a frame, each with its reason."""
    return [f'frame {frame.index}: {type(command).__name__} is refused: {reason}'
            for command, reason in frame.refused]


def verdict(repeat, quiet: bool) -> int:
    """Print whether the run was as recorded, and return the exit code."""
    if repeat.identical and not quiet:
        print(f'commands as in {repeat.path}: {counted(repeat.compared, "frame")}, bit for '
              'bit')
    for text in repeat.problems:
        print(f'xpbd_ros run: {repeat.path}: {text}', file=sys.stderr)
    return 0 if repeat.identical else 1


def table(name: str, numbers: dict, monitor) -> str:
    """Return what the run came to, as text."""
    from xpbd_ros.ros.guards import texts, TOTALS

    solver = numbers['solver']
    return '\n'.join([
        f"{name}: {counted(numbers['frames'], 'frame')}, "
        f"{numbers['real_time_factor']:.2f} × real time",
        f"step     {numbers['step_ms']['p50']:.2f} ms p50, {numbers['step_ms']['p95']:.2f} ms p95",
        f"solver   {solver['method']}, {solver['integrator']}, "
        f"{solver['substeps']} × {solver['iterations']} ({solver['reason']})",
        f'error    {monitor}',
        f"state    {numbers['state_hash']}",
        f"log      {numbers['run']}",
        *(f'picture  {file}' for file in numbers.get('pictures', ())),
        *(f'note     {text}' for text in numbers['notes']),
        *(f'note     {counted(numbers[guard], "frame")} {text}' for guard, text in TOTALS.items()
          if numbers.get(guard)),
        *(f'note     {text}' for text in texts(numbers['guards'])),
        *([f"refused  {counted(numbers['refused'], 'command')}"] if numbers['refused'] else [])])


def count_frames(scene) -> int:
    """Return the number of frames in the scene's duration; refuse a duration out of range."""
    duration, rate = scene.top.duration, scene.top.frame_rate
    if duration * rate < 0.5 or duration > LONGEST:
        raise InputError(f'{scene.where}: duration: must be from a frame ({1.0 / rate:.3g} s) to '
                         f'{LONGEST:g} s (got {duration:g} s)')
    return max(1, round(duration * rate))
