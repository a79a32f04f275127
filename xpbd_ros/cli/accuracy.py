"""
Measure error against time for a scene, and recommend a solver setting.

The scene runs with many combinations of method, integrator, substeps, iterations and precision.
Each run is compared with an independent reference solver, or with this solver's own limit for
dt → 0, and then timed on its own. The recommendation is the most accurate setting within --budget,
or the cheapest one within --max-error. The output folder gets a settings file for 'run --settings'
and the node, a CSV, a picture and a report. With -o of an interrupted study it continues; with -o
of a finished one another --budget or --max-error is answered without new runs.

Exit code: 0, or 1 if no setting meets the budget or the error.
"""

import math
from pathlib import Path
import signal
import sys

import yaml

from xpbd_ros.cli.output import add_json_argument, check_outputs, STDOUT, write_json
from xpbd_ros.cli.overrides import add_set_argument, overrides_of
from xpbd_ros.cli.progress import add_scheduler_argument, progress
from xpbd_ros.cli.ros import commands_of
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import fresh_folder

EXAMPLE = 'xpbd_ros accuracy swing --budget 4 -o swing_accuracy'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scene', help='a scene file, or the name of a shipped scene')
    parser.add_argument('--budget', type=float, metavar='MS',
                        help='longest CPU time per frame (95th percentile), in ms; default: the '
                             "scene's solver.budget_ms, else half of the frame period")
    parser.add_argument('--max-error', type=float, metavar='M',
                        help='recommend the cheapest setting whose error is at most this, in m')
    parser.add_argument('--commands', metavar='LOG',
                        help='apply the inputs of this log, a folder or an .mcap file')
    parser.add_argument('-o', '--output', metavar='DIR',
                        help='folder for the results: a new one, or that of the same study to '
                             'continue; default: a new one, named by time')
    parser.add_argument('--duration', type=float, metavar='S',
                        help="simulated time in s, instead of the scene's duration")
    parser.add_argument('--times', metavar='S,S,…',
                        help='times in s at which positions are compared; default: 1/4, 1/2 and '
                             'the whole of the time for which trajectories are predictable')
    parser.add_argument('--methods', metavar='NAME,…',
                        help='try only these methods, such as line,gauss_seidel')
    parser.add_argument('--by', choices=('position', 'shape'),
                        help='error measure: positions of particles, or time means of the shape, '
                             'for chaotic scenes; default: chosen by the scene')
    parser.add_argument('--baselines', action='store_true',
                        help='also run and draw PBD, textbook XPBD, XPBD with decayed multipliers '
                             'and an explicit mass-spring solver')
    parser.add_argument('--jobs', type=int, metavar='N',
                        help='parallel processes for the errors (default: all cores); timings '
                             'always use one')
    add_scheduler_argument(parser)
    add_set_argument(parser, 'override one key of the scene, such as gravity=[0,0,-1.62]')
    add_json_argument(parser)


def run(arguments) -> int:
    """Measure the settings, recommend one, and write the results."""
    from xpbd_ros.cli.run import count_frames
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.scene.threads import free_cores
    for name, value in (('--budget', arguments.budget), ('--max-error', arguments.max_error)):
        if value is not None and not (value > 0.0 and math.isfinite(value)):
            unit = 'ms' if name == '--budget' else 'm'
            raise InputError(f'{name}: must be > 0 {unit} (got {value:g})')
    overrides = overrides_of(arguments.keys, duration=arguments.duration)
    check_outputs(arguments.json, folder=arguments.output)
    scene = load_scene(arguments.scene, overrides)
    frames = count_frames(scene)
    times = frames_of(arguments.times, scene, frames)
    methods = methods_of(arguments.methods)
    jobs = free_cores() if arguments.jobs is None else arguments.jobs
    if jobs < 1:
        raise InputError(f'--jobs: must be >= 1 (got {jobs})')
    commands = {}
    if arguments.commands:
        commands = commands_of('accuracy', arguments.commands, scene, frames)
    folder = Path(arguments.output) if arguments.output else fresh_folder('accuracy')
    from xpbd_ros.study.accuracy import study
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        found = study(scene, frames, folder, times=times, commands=commands, methods=methods,
                      baselines=arguments.baselines, by=arguments.by, processes=jobs,
                      scheduler=arguments.scheduler, progress=progress)
        return finish(arguments, found, folder, commands)
    except KeyboardInterrupt:
        print(f'xpbd_ros accuracy: interrupted; continue with the same command and -o {folder}',
              file=sys.stderr)
        return 130
    finally:
        signal.signal(signal.SIGTERM, before)


def frames_of(times: str | None, scene, frames: int) -> list[int]:
    """Return the frames at the times of ``--times``, ascending; empty without any."""
    found = []
    for text in (times or '').split(',') if times is not None else ():
        try:
            time = float(text)
        except ValueError:
            time = math.nan
        frame = round(time * scene.top.frame_rate) if math.isfinite(time) else 0
        if not 1 <= frame <= frames:
            raise InputError(f'--times: must be from a frame ({1.0 / scene.top.frame_rate:.3g} s) '
                             f'to the duration, {scene.top.duration:g} s (got {text.strip()!r})')
        found.append(frame)
    return sorted(set(found))


def methods_of(names: str | None) -> tuple[str, ...]:
    """Return the methods of ``--methods``; all without any."""
    from xpbd_ros.scene.read import unknown
    from xpbd_ros.sim.stepping.methods import METHODS
    if names is None:
        return tuple(METHODS)
    found = tuple(dict.fromkeys(name.strip() for name in names.split(',')))
    for name in found:
        if name not in METHODS:
            raise InputError(f'--methods {name}: {unknown(name, METHODS, "method")}')
    return found


def finish(arguments, found, folder: Path, commands: dict) -> int:
    """Recommend a setting, run it again, write all files and print a summary."""
    from xpbd_ros.scene.load import settings_overrides
    from xpbd_ros.study.accuracy.choose import recommend, Row
    from xpbd_ros.study.accuracy.measure import again
    from xpbd_ros.study.accuracy.motion import NUMBERS, SCENE
    from xpbd_ros.study.accuracy.picture import draw
    from xpbd_ros.study.accuracy.report import (
        facts,
        numbers_of,
        numbers_of_default,
        settings_text,
        write_csv,
        write_page,
    )
    asked, drawn = budgets(arguments, found)
    chosen = recommend(found.rows, found.by, budget=asked, max_error=arguments.max_error,
                       floor=found.floor)
    settings, rerun, recommended = '', None, None
    file = folder / 'settings.yaml'
    file.unlink(missing_ok=True)
    if chosen is not None:
        settings = settings_text(found, chosen)
        file.write_text(settings, encoding='utf-8')
        keys = {key.removeprefix('solver.'): value
                for key, value in settings_overrides(str(file)).items()}
        rerun = again(found.scene, found.truth, found.frames, commands, keys)
        row = Row(chosen.setting, *rerun)
        recommended = {**numbers_of(chosen, found.by), 'file': file,
                       'rerun': {'error_m': row.error(found.by), 'ms_p50': row.timed.ms_p50,
                                 'ms_p95': row.timed.ms_p95}}
    picture = draw(found, folder / 'accuracy.png', chosen=chosen, budget=drawn)
    said = facts(found, chosen, asked, arguments.max_error, rerun)
    table = write_csv(found, folder / 'accuracy.csv')
    page = write_page(found, folder / 'accuracy.html', picture, said, chosen, settings)
    truth = found.truth
    numbers = {
        'scene': str(Path(found.scene.where).absolute()), 'machine': found.machine,
        'particles': found.particles,
        'frames': found.frames, 'frame_ms': 1e3 * found.frame_dt,
        'settings': [numbers_of(one, found.by) for one in found.rows],
        'defaults': [numbers_of_default(one, found.by) for one in found.defaults],
        'refused': [vars(one) for one in found.refused],
        'reference': {'kind': truth.kind, 'text': truth.text,
                      'times_s': [float(f) * found.frame_dt for f in truth.frames],
                      'uncertainty_m': truth.uncertainty, 'own_limit_apart_m': truth.apart,
                      'horizon_s': truth.horizon * found.frame_dt, 'floor_m': found.floor},
        'by': found.by, 'error': found.what, 'notes': found.notes,
        'commands': str(Path(arguments.commands).absolute()) if arguments.commands else None,
        'budget_ms': asked, 'max_error_m': arguments.max_error, 'recommended': recommended,
        'pictures': [picture], 'report': page, 'csv': table,
    }
    (folder / SCENE).write_text(yaml.safe_dump(found.scene.raw, sort_keys=False),
                                encoding='utf-8')
    (folder / NUMBERS).unlink(missing_ok=True)
    for destination in (str(folder / NUMBERS), arguments.json):
        write_json(destination, numbers)
    if arguments.json != STDOUT:
        print('\n'.join([*(f'{name:<10} {text}' for name, text in said), '',
                         *lines(found, chosen, drawn), '', f'report     {page.absolute()}',
                         f'in motion  xpbd_ros view {folder}',
                         *([f'settings   {file.absolute()}'] if chosen is not None else [])]))
    return 0 if chosen is not None else 1


def budgets(arguments, found) -> tuple[float | None, float]:
    """Return the budget to recommend by (None with --max-error alone) and that to draw [ms]."""
    usual = (found.scene.raw.get('solver') or {}).get('budget_ms', 500.0 * found.frame_dt)
    if arguments.budget is None and arguments.max_error is not None:
        return None, usual
    return arguments.budget or usual, arguments.budget or usual


def lines(found, chosen, budget: float) -> list[str]:
    """Return the printed table: Pareto front, the scene's own setting, best of each curve."""
    from xpbd_ros.study.accuracy.picture import within
    from xpbd_ros.study.accuracy.report import cells, heads, name_of
    best = list(within(found.rows, found.by, budget).values())
    shown = [row for row in found.rows if row.timing is not None and (
        row.pareto or row.scene or row is chosen or row in best)]
    shown.sort(key=lambda row: row.timed.ms_p50)
    widths = (44, 7, 7, 12, 7, 9, 8, 8, 10, 12, 12, 0)

    def line(mark: str, row) -> str:
        first, *others = (cell.rjust(width) if k else cell.ljust(width)
                          for k, (cell, width) in enumerate(zip(row, widths)))
        return f'{mark} {first}{" ".join(["", *others])}'.rstrip()

    text = [line('  ', heads(found.by))]
    for row in shown:
        mark = '->' if row is chosen else ' *' if row.pareto else '  '
        text.append(line(mark, cells(row, found.by)))
    text.append(f'  * on the Pareto front; all {len(found.rows)} settings are in the report')
    for row in found.rows:
        if not row.errors.finite:
            text.append(f'  left out: {name_of(row.setting)}: {row.errors.note}')
    return text + [f'  left out: {one.method}: {one.reason}' for one in found.refused]
