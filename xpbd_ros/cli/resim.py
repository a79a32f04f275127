"""
Solve a recorded run again, from its log alone, and compare the states with the recorded ones.

The scene, its meshes and the inputs with the frames that they acted on come from the log, and if
it begins in the middle of a run, a checkpoint of that moment. --set changes keys of the scene from
the start of the run, or with --from (and in a log from the middle of a run) from that time on; the
deviation from the recorded run is reported then.

Exit code: 0 if the run is bit-identical, or with --set; 1 if a state deviates, or an input is
refused.
"""

import argparse
import os
from pathlib import Path
import sys
import time
from typing import Any

from xpbd_ros import __version__
from xpbd_ros.cli.output import add_json_argument, check_outputs, refuse_existing, write_json
from xpbd_ros.cli.overrides import add_set_argument, parse_keys
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import need_ros, new_log, recording_of
from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import CHECKPOINT, VECTOR_BITS

WIDTHS = ('128', '256', '512')
SIMD = 'xpbd_ros.sim.backend.simd'
EXAMPLE = 'xpbd_ros resim drape_run --set solver.substeps=64 --picture fork.png'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('run', metavar='RUN', help='folder of the log, or the .mcap file in it')
    parser.add_argument('-o', '--output', metavar='RUN2',
                        help='new folder for a log of the new run, with its deviation from RUN')
    add_set_argument(parser, 'change one key of the scene, such as solver.substeps=32')
    parser.add_argument('--from', type=float, default=0.0, metavar='S', dest='start',
                        help='time in the log from which --set acts, in s; needs live keys')
    parser.add_argument('--threads', type=int, metavar='N',
                        help="number of threads, instead of the scene's; no state depends on it")
    parser.add_argument('--picture', metavar='FILE',
                        help='draw the deviation against time to this new PNG file')
    add_json_argument(parser)


def run(arguments) -> int:
    """Repeat the recorded run, compare and report."""
    need_ros('resim')
    check_outputs(arguments.json, picture=arguments.picture, folder=arguments.output)
    refuse_existing(arguments.output)
    log = LogReader(arguments.run)
    take_recorded_vectors(log)
    from xpbd_ros.ros.repeat import Repeat
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.sim.commands import SetKey

    recording = recording_of('resim', log)
    keys = parse_keys(arguments.keys)
    fork = fork_frame(recording, arguments)
    late = keys if fork > 0 else {}
    scene = recording.scene_with(overrides(recording, {} if late else keys, arguments.threads))
    check_rate(scene, recording.scene)
    simulation = compile_scene(scene)
    check_live(simulation, late)
    recording.begin(simulation)
    repeat = Repeat(recording, recording.scene, simulation, recording.last)
    simulation.compile()
    recorder = recorder_of(arguments, scene, simulation)
    begin, first = time.perf_counter(), simulation.index
    try:
        repeat.look(simulation.frame())
        for index in progress(range(first + 1, recording.last + 1), 'frames'):
            changes = [SetKey(*item) for item in late.items()] if index == fork + 1 else []
            frame = simulation.step([*changes, *repeat.commands(index)])
            repeat.look(frame)
            if recorder is not None:
                write(recorder, frame, repeat)
    finally:
        if recorder is not None:
            recorder.close()
    wall = time.perf_counter() - begin
    numbers: dict[str, Any] = {
        **repeat.numbers(), 'run': Path(arguments.run), 'first_frame': first,
        'forked': {'frame': fork, 'keys': keys} if keys else None,
        'real_time_factor': (recording.last - first) * simulation.frame_dt / wall,
        'rms_deviation_m': max((each.rms for each in repeat.track), default=None),
        'environment': environment_differences(recording),
        'resimulated': arguments.output and Path(arguments.output).absolute(),
    }
    if arguments.picture:
        from xpbd_ros.study.deviation_picture import draw
        numbers['pictures'] = [draw(Path(arguments.picture), repeat.track, simulation.frame_dt,
                                    title(arguments, keys, fork * simulation.frame_dt))]
    write_json(arguments.json, numbers)
    if arguments.json != '-':
        print(report(repeat, numbers))
    if keys:
        return 1 if repeat.refused else 0
    for text in repeat.problems:
        print(f'xpbd_ros resim: {repeat.path}: {text}', file=sys.stderr)
    return 0 if repeat.identical else 1


def take_recorded_vectors(log: LogReader) -> None:
    """
    Compute with vectors of the width that the checkpoint in a log has, also on other processors.

    The width is fixed when the simulation is imported, so this comes before.
    """
    bits = log.settings.get(VECTOR_BITS)
    if CHECKPOINT in log.attachments and bits in WIDTHS and SIMD not in sys.modules:
        os.environ.setdefault('XPBD_ROS_VECTOR_BITS', bits)


def fork_frame(recording, arguments) -> int:
    """Return the frame after which ``--set`` acts; 0 for the start of the run."""
    rate = recording.scene.top.frame_rate
    first, last = recording.first / rate, recording.last / rate
    if arguments.start == 0.0:
        return recording.first
    if not arguments.keys:
        raise InputError('--from: has no effect without --set')
    if not first <= arguments.start < last:
        raise InputError(f'--from: must be within the log, from {first:.3f} s to before '
                         f'{last:.3f} s (got {arguments.start:g} s)')
    return round(arguments.start * rate)


def check_rate(scene, recorded) -> None:
    """Raise InputError if frames of two scenes have one number and two times."""
    rate = recorded.top.frame_rate
    if scene.top.frame_rate != rate:
        raise InputError(f'--set frame_rate: inputs and states of a log belong to frames, of '
                         f'which it has {rate:g} Hz (got {scene.top.frame_rate:g} Hz); change '
                         'solver.substeps instead, or run the scene by xpbd_ros run')


def check_live(simulation, keys: dict) -> None:
    """Raise InputError if keys cannot change in the middle of a run."""
    try:
        simulation.check(keys)
    except InputError as error:
        raise InputError(f'--set: {error}; others can only fork a run from its start') from None


def overrides(recording, keys: dict, threads: int | None) -> dict:
    """Return the overrides of the recorded scene."""
    if threads is None:
        return keys
    from xpbd_ros.scene.model import MOST_THREADS
    if not 1 <= threads <= MOST_THREADS:
        raise InputError(f'--threads: must be from 1 to {MOST_THREADS} (got {threads})')
    if recording.first and threads != recording.scene.top.solver.threads:
        raise InputError('--threads: a log that begins in the middle of a run continues with its '
                         f'own threads ({recording.scene.top.solver.threads})')
    return {**keys, 'solver.threads': threads}


def recorder_of(arguments: argparse.Namespace, scene, simulation):
    """Return the recorder of the new log; None without ``-o``."""
    if not arguments.output:
        return None
    return new_log(Path(arguments.output), scene, simulation, program='resim',
                   resimulates=str(Path(arguments.run).absolute()))


def write(recorder, frame, repeat) -> None:
    """Write a frame and its deviation to the new log."""
    recorder.frame(frame)
    if repeat.track and repeat.track[-1].frame == frame.index:
        recorder.values({'deviation/largest': repeat.track[-1].largest,
                         'deviation/rms': repeat.track[-1].rms}, frame)


def environment_differences(recording) -> list[dict[str, str]]:
    """Return the versions, and the processor, that differ from those of the recorded run."""
    from xpbd_ros.ros.recorder import environment
    here = {'version': __version__, **environment()}
    return [{'name': name, 'here': value, 'log': recording.settings[name]}
            for name, value in here.items() if recording.settings.get(name, value) != value]


def report(repeat, numbers: dict) -> str:
    """Return the result as text."""
    found = [f"{repeat.path}: {counted(numbers['frames'], 'frame')} compared, "
             f"{numbers['real_time_factor']:.2f} × real time"]
    if repeat.first is None and repeat.compared:
        found.append('states    bit-identical')
    else:
        worst = max(repeat.track, key=lambda each: each.largest, default=None)
        found.append(f'states    differ from frame {repeat.first} on' + (
            f', by up to {worst.largest:.3g} m (frame {worst.frame}), '
            f'{worst.rms:.3g} m RMS there' if worst else ''))
    for key, value in (numbers['forked'] or {'keys': {}})['keys'].items():
        found.append(f"fork      {key} = {value} after frame {numbers['forked']['frame']}")
    found += [f"note      {each['name']}: {each['here']} here, {each['log']} in the log"
              for each in numbers['environment']]
    found += [f'note      {text}' for text in numbers['notes']]
    if numbers['resimulated']:
        found.append(f"log       {numbers['resimulated']}")
    return '\n'.join([*found, *(f'picture   {file}' for file in numbers.get('pictures', ()))])


def title(arguments, keys: dict, start: float) -> str:
    """Return the title of the picture."""
    name = Path(arguments.run).name
    if not keys:
        return f'{name}, solved again'
    changed = ', '.join(f'{key} = {value}' for key, value in keys.items())
    return f'{name}, solved again with {changed}' + (f' from {start:g} s on' if start else '')
