"""
Run a scene many times with other values of its keys, and gather the outcomes in a Parquet table.

The values are the rows of a CSV file (--table), whose columns are keys as in --set, or random
draws from ranges (--vary, --runs, --seed). Each run is a row: its values, and shape, forces,
energy, strain and estimated error at its end. The table does not depend on the number of workers,
but for the column wall_s. With -o of an interrupted sweep it continues, and with more --runs it
grows. Several workers need Dask (extra cluster); a worker that is killed loses no row.

Exit code: 0, or 1 if a run has no outcome; the table has the reason.
"""

from functools import partial
import hashlib
import json
from pathlib import Path
import signal
import sys
import time

from xpbd_ros import __version__
from xpbd_ros.cli.output import add_json_argument, check_outputs, write_json
from xpbd_ros.cli.overrides import add_set_argument, overrides_of
from xpbd_ros.cli.progress import add_scheduler_argument, progress
from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.folder import fresh_folder

EXAMPLE = ('xpbd_ros sweep drape --vary cloths.cover.friction=0.1:1 --vary '
           'cloths.cover.effects.bend.stiffness=1e-5:1e-2:log --runs 100 -o drape_sweep')
SHOWN = ('height_mean_m', 'strain', 'kinetic_j', 'elastic_j', 'error_estimate_m')
"""columns whose range is printed"""


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scene', help='a scene file, or the name of a shipped scene')
    parser.add_argument('--table', metavar='CSV',
                        help='values of each run: columns are keys such as solver.substeps; an '
                             'empty cell leaves the value of the scene')
    parser.add_argument('--vary', action='append', default=[], metavar='KEY=LOW:HIGH[:log]',
                        help='draw a key from a range, uniformly, or with :log its logarithm; '
                             'may be given several times')
    parser.add_argument('--runs', type=int, metavar='N', help='number of runs of --vary')
    parser.add_argument('--seed', type=int, default=0, metavar='S',
                        help='of the random values (default: 0)')
    parser.add_argument('-o', '--output', metavar='DIR',
                        help='folder for the results: a new one, or that of the same sweep to '
                             'continue; default: a new one, named by time')
    parser.add_argument('--logs', action='store_true',
                        help='also write a log of each run, as xpbd_ros run does; needs ROS')
    parser.add_argument('--duration', type=float, metavar='S',
                        help="simulated time in s, instead of the scene's duration")
    add_set_argument(parser, 'override one key of the scene in all runs')
    parser.add_argument('--workers', type=int, metavar='N',
                        help='number of local processes (default: all cores)')
    add_scheduler_argument(parser)
    add_json_argument(parser)


def run(arguments) -> int:
    """Run the scene with all values, and write the table."""
    from xpbd_ros.cli.ros import need_ros
    from xpbd_ros.sweep.store import need_pyarrow, Store
    check_outputs(arguments.json, folder=arguments.output)
    need_pyarrow()
    if arguments.logs:
        need_ros('sweep --logs')
    base, values, about = values_of(arguments)
    workers = workers_of(arguments)
    folder = Path(arguments.output) if arguments.output else fresh_folder('sweep')
    store = Store(folder, about)
    if (there := max(store.rows, default=-1) + 1) > len(values):
        raise InputError(f'--runs: must be at least {there}, the runs that {folder} holds already '
                         f'(got {len(values)}); or name another folder')
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    begin, resumed = time.perf_counter(), len(store.rows)
    try:
        compute(arguments, store, base, values, workers)
    except KeyboardInterrupt:
        print(f'xpbd_ros sweep: interrupted after {len(store.rows)} of {len(values)} runs; '
              f'continue with the same command and -o {folder}', file=sys.stderr)
        return 130
    except BaseException:
        store.discard_if_empty()
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
    table, wall = store.join(), time.perf_counter() - begin
    failed = [row for row in store.rows.values() if row['error']]
    numbers = {'runs': len(store.rows), 'failed': len(failed), 'table': table,
               'workers': None if arguments.scheduler else workers, 'wall_s': wall,
               'resumed': resumed}
    write_json(arguments.json, numbers)
    if arguments.json != '-':
        print('\n'.join(lines(numbers, store.rows.values(), failed)))
    return 1 if failed else 0


def values_of(arguments) -> tuple[dict, list[dict], dict]:
    """Return the overrides of all runs, those of each run, and values that identify the sweep."""
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER
    from xpbd_ros.sweep.parameters import check_keys, draw, Range, read_table, whole_numbers
    if bool(arguments.table) == bool(arguments.vary):
        raise InputError('needs either --table or --vary, and not both')
    if arguments.vary and (arguments.runs is None or arguments.runs < 1):
        raise InputError('--vary needs --runs, the number of runs, at least 1')
    if arguments.table and arguments.runs is not None:
        raise InputError('--runs goes with --vary; the rows of --table are the runs')
    if arguments.seed < 0:
        raise InputError(f'--seed: must be >= 0 (got {arguments.seed})')
    base = overrides_of(arguments.keys, duration=arguments.duration)
    scene = load_scene(arguments.scene, base)
    if arguments.table:
        values = read_table(arguments.table)
        check_keys(arguments.scene, values, base)
        given = values
    else:
        ranges = [Range.parse(text) for text in arguments.vary]
        if len({each.key for each in ranges}) < len(ranges):
            raise InputError('--vary: a key is given twice')
        values = draw(ranges, arguments.runs, arguments.seed)
        for key in whole_numbers(arguments.scene, ranges, base):
            values = [{**each, key: round(each[key])} for each in values]
        check_keys(arguments.scene, values, base)
        given = [arguments.seed, *map(str, ranges)]
    return base, values, {'scene': digest(scene.raw), 'values': digest(given),
                          'version': f'{__version__} {CACHE_FOLDER.name}',
                          'logs': arguments.logs}


def digest(value) -> str:
    """Return a hash of plain data."""
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def workers_of(arguments) -> int:
    """Return the number of local processes."""
    from xpbd_ros.scene.threads import free_cores
    workers = free_cores() if arguments.workers is None else arguments.workers
    if workers < 1:
        raise InputError(f'--workers: must be >= 1 (got {workers})')
    return workers


def compute(arguments, store, base: dict, values: list[dict], workers: int) -> None:
    """Run the scene with the values that have no row yet."""
    from xpbd_ros.cli.ros import new_log
    from xpbd_ros.cli.run import count_frames
    from xpbd_ros.study.parallel import run_tasks
    from xpbd_ros.sweep.outcome import ERROR, outcome
    from xpbd_ros.sweep.parameters import scene_or_reason
    from xpbd_ros.sweep.store import LOST
    tasks, numbers = [], []
    for number, keys in enumerate(values):
        if number in store.rows:
            continue
        scene = scene_or_reason(arguments.scene, {**base, **keys})
        try:
            if isinstance(scene, str):
                raise InputError(scene)
            tasks.append((scene, count_frames(scene),
                          store.log(number) if arguments.logs else None))
            numbers.append(number)
        except InputError as error:
            store.add(number, keys, {ERROR: str(error)})
    if arguments.logs:
        store.log(0).parent.mkdir(exist_ok=True)
    for k, found in run_tasks(partial(outcome, new_log=new_log), tasks, processes=workers,
                              scheduler=arguments.scheduler, dask=True, what='runs',
                              progress=progress, lost=lambda _: {
                                  ERROR: f'{LOST}; it may have run out of memory'}):
        store.add(numbers[k], values[numbers[k]], found)


def lines(numbers: dict, rows, failed: list[dict]) -> list[str]:
    """Return the printed summary."""
    text = [f"{counted(numbers['runs'], 'run')}, {numbers['failed']} without an outcome, in "
            f"{numbers['wall_s']:.1f} s"
            + (f" with {counted(numbers['workers'], 'worker')}"
               if numbers['workers'] else '')
            + (f" ({numbers['resumed']} from before)" if numbers['resumed'] else '')]
    for name in SHOWN:
        found = [row[name] for row in rows if row.get(name) is not None]
        if found:
            text.append(f'{name:<18} {min(found):.4g} to {max(found):.4g}')
    text += [f"run {row['run']:<14} {row['error']}" for row in failed[:5]]
    if len(failed) > 5:
        text.append(f'and {len(failed) - 5} more')
    return [*text, f"table              {numbers['table']}"]
