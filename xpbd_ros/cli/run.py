"""
Run a scene as fast as it can, without DDS, and write the same log as the node.

The scene's own motions move pins and colliders; --commands applies the inputs of an earlier log,
at the frames that they acted on, for as long as the log goes. Then the exit code is 0 where scene
and states are those of the log, bit for bit, and else 1: another scene, other keys (--set too), a
log that began in the midst of a run, an input that is refused.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import signal
import sys
import time

from xpbd_ros import __version__
from xpbd_ros.cli.output import add_json_argument, check_output, write_json
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import need_ros, recording_of
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import fresh_folder

EXAMPLE = 'xpbd_ros run drape --duration 2 --set solver.substeps=24 -o drape_run'


GUARDS = {'frames_taken_back': 'were not finite and were taken back',
          'explicit_redone': 'were too rough for explicit and were done again with line'}
"""what guards count, where there is something to count"""
LONGEST = 1e6
"""[s]; stamps and disks end not far behind"""


def add_arguments(parser):
    """Declare what the verb takes."""
    parser.add_argument('scene', help='a scene file, or the name of a shipped scene')
    parser.add_argument('-o', '--output', metavar='RUN', help='folder of the log; must not exist')
    parser.add_argument('--duration', type=float, metavar='S',
                        help="simulated seconds, instead of the scene's")
    parser.add_argument('--commands', metavar='LOG',
                        help='apply the inputs of this log, and compare with its states')
    parser.add_argument('--settings', metavar='FILE',
                        help="a file with a 'solver:' block, to override the scene's keys")
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE', dest='keys',
                        help='override one key of the scene, such as solver.substeps=32')
    parser.add_argument('--picture', metavar='FILE',
                        help='draw three instants of the run as a PNG, with PyVista; must not '
                             'exist')
    add_json_argument(parser)


def run(arguments) -> int:
    """Step through the scene and record it."""
    need_ros('run')
    from xpbd_ros.ros.diagnostics import percentile
    from xpbd_ros.ros.outputs import Outputs
    from xpbd_ros.ros.recorder import Recorder
    from xpbd_ros.ros.watch import ErrorMonitor
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.load import load_scene, settings_overrides
    from xpbd_ros.scene.save import scene_text

    overrides = settings_overrides(arguments.settings) if arguments.settings else {}
    overrides.update(parse_keys(arguments.keys))
    if arguments.duration is not None:
        overrides['duration'] = arguments.duration
    for output in (arguments.json, arguments.picture):
        check_output(output)
    if arguments.picture:
        from xpbd_ros.study.picture import need_view
        need_view('--picture')
    scene = load_scene(arguments.scene, overrides)
    recording = recording_of('run', arguments.commands) if arguments.commands else None
    if recording is not None:
        if recording.late:
            print(f'xpbd_ros run: {recording.late}', file=sys.stderr)
            return 1
        if arguments.duration is None:
            overrides['duration'] = recording.last / scene.top.frame_rate
            scene = load_scene(arguments.scene, overrides)
    frames = count_frames(scene)
    simulation = compile_scene(scene)
    quiet = arguments.json == '-'
    outputs = Outputs(simulation, scene.top.frame_id, scene_text(scene, simulation.solver))
    repeat = None
    if recording is not None:
        from xpbd_ros.ros.repeat import Repeat
        repeat = Repeat(recording, scene, simulation, frames)
        repeat.look(simulation.frame())
    folder = Path(arguments.output) if arguments.output else fresh_folder('run')
    recorder = Recorder(folder, outputs, epoch_ns=time.time_ns(),
                        settings={'program': 'run', 'version': __version__})
    step_ms, refused, notes = [], 0, [*simulation.notes]
    shots = None
    if arguments.picture:
        from xpbd_ros.study.snapshots import Shots
        shots = Shots(simulation, frames)
    watch = ErrorMonitor(simulation, target=scene.top.solver.error_target,
                  most=scene.top.solver.max_substeps)
    try:
        simulation.compile()
        begin = time.perf_counter()
        with signals_wait() as signals:
            for index in progress(range(1, frames + 1), 'frames'):
                start = time.perf_counter()
                inputs = repeat.commands(index) if repeat else ()
                frame = simulation.step([*inputs, *watch.commands()], keep=watch.due())
                step_ms.append(1e3 * (time.perf_counter() - start))
                watch.look(1e-3 * step_ms[-1])
                refused += len(frame.refused)
                if repeat:
                    repeat.look(frame)
                if shots:
                    shots.look(frame)
                notes += [f'frame {index}: {text}' for text in frame.news]
                recorder.frame(frame, outputs.frame(frame, recorder.epoch_ns + frame.time_ns))
                if signals:
                    raise KeyboardInterrupt
    finally:
        watch.close()
        recorder.close()
    wall = time.perf_counter() - begin
    numbers = {
        'frames': frames,
        'real_time_factor': frames * simulation.frame_dt / wall,
        'step_ms': {'p50': percentile(step_ms, 0.5), 'p95': percentile(step_ms, 0.95),
                    'max': max(step_ms, default=0.0)},
        'solver': vars(simulation.solver),
        'refused': refused,
        'error': watch.summary(),
        **{name: count for name, count in simulation.stats().items() if name in GUARDS},
        'notes': notes,
        'state_hash': f'{simulation.hash():016x}',
        'run': folder.absolute(),
    }
    if repeat:
        notes += repeat.notes
        numbers['commands'] = repeat.numbers()
    if shots:
        numbers['pictures'] = [shots.draw(Path(arguments.picture))]
    write_json(arguments.json, numbers)
    if not quiet:
        print(f"{scene.name}: {frames} frames, {numbers['real_time_factor']:.2f} × real time\n"
              f"step     {numbers['step_ms']['p50']:.2f} ms p50, "
              f"{numbers['step_ms']['p95']:.2f} ms p95\n"
              f'solver   {simulation.solver.method}, {simulation.solver.integrator}, '
              f'{simulation.solver.substeps} × {simulation.solver.iterations} '
              f'({simulation.solver.reason})\n'
              f'error    {watch}\n'
              f"state    {numbers['state_hash']}\n"
              f'log      {folder.absolute()}')
        for file in numbers.get('pictures', ()):
            print(f'picture  {file}')
        for text in notes:
            print(f'note     {text}')
        if refused:
            print(f'refused  {refused} commands')
        if repeat and repeat.identical:
            print(f'commands as in {recording.path}: {repeat.compared} frames, bit for bit')
        for name, text in GUARDS.items():
            if numbers.get(name):
                print(f'note     {numbers[name]} frames {text}')
    if repeat is None:
        return 0
    for text in repeat.problems:
        print(f'xpbd_ros run: {recording.path}: {text}', file=sys.stderr)
    return 0 if repeat.identical else 1


@contextmanager
def signals_wait() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM, to be seen to between frames: else they cut the log short."""
    signals: list[int] = []
    before = {number: signal.signal(number, lambda number, _: signals.append(number))
              for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def count_frames(scene) -> int:
    """Return how many frames the scene's duration is, or refuse it."""
    duration, rate = scene.top.duration, scene.top.frame_rate
    if duration * rate < 0.5 or duration > LONGEST:
        raise InputError(f'{scene.where}: duration: must be from a frame ({1.0 / rate:.3g} s) to '
                         f'{LONGEST:g} s (got {duration:g} s)')
    return max(1, round(duration * rate))


def parse_keys(pairs: list[str]) -> dict:
    """Return ``key=value`` overrides, the values read as YAML."""
    from xpbd_ros.scene.load import parse_yaml
    found = {}
    for pair in pairs:
        key, equals, value = pair.partition('=')
        if not equals or not key:
            raise InputError(f'--set {pair}: must be KEY=VALUE, such as solver.substeps=32')
        found[key] = parse_yaml(value, f'--set {key}')
    return found
