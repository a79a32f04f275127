"""
Measure the cost of each effect of a scene on this machine: time, memory, code.

The scene runs for its duration five times, with a clock read between the kernels of the effects.
A second simulation without those readings runs alternately and gives the total time. Effects that
the scene does not name are listed as absent: they have no arrays and no machine code.

Next to the time per constraint the table has a lower bound, its memory traffic at this machine's
cache bandwidth, and the floating-point operations that this machine could do in the measured time.
All on one thread.

With --calibrate it measures random and shipped scenes with line and explicit instead, which takes
some minutes, and writes the cost table of this machine for solver.cost_table, by which auto keeps
budget_ms.
"""

from pathlib import Path

from xpbd_ros.cli.output import add_json_argument, check_outputs, write_json, write_text
from xpbd_ros.cli.overrides import add_set_argument, overrides_of
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import commands_of
from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.folder import fresh_folder

EXAMPLE = 'xpbd_ros cost towel --duration 2'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scene', nargs='?', help='a scene file, or the name of a shipped scene')
    parser.add_argument('--calibrate', nargs='?', const='', metavar='FILE',
                        help='write the cost table of this machine to this new file, by default '
                        'cost_table.yaml in a new folder')
    parser.add_argument('--duration', type=float, metavar='S',
                        help="simulated time in s, instead of the scene's duration")
    parser.add_argument('--commands', metavar='LOG',
                        help='apply the inputs of this log, a folder or an .mcap file')
    add_set_argument(parser)
    parser.add_argument('--picture', metavar='FILE',
                        help='draw the table to this new PNG file')
    add_json_argument(parser)


def run(arguments) -> int:
    """Measure the scene and print the table, or write the cost table of this machine."""
    if arguments.calibrate is not None:
        return calibrate(arguments)
    if arguments.scene is None:
        raise InputError('needs a scene, or --calibrate')
    from xpbd_ros.cli.run import count_frames
    from xpbd_ros.scene.load import load_scene
    overrides = overrides_of(arguments.keys, duration=arguments.duration)
    check_outputs(arguments.json, picture=arguments.picture)
    scene = load_scene(arguments.scene, overrides)
    frames = count_frames(scene)
    commands = {}
    if arguments.commands:
        commands = commands_of('cost', arguments.commands, scene, frames)
    from xpbd_ros.study.cost import cost
    from xpbd_ros.study.cost.limits import limits
    from xpbd_ros.study.machine import describe, machine
    found = cost(scene, frames, commands=commands, progress=progress)
    here, most = machine(), limits()
    numbers = {
        'machine': here, 'limits': most, 'scene': str(Path(scene.where).absolute()),
        'effects': [numbers_of(row, most) for row in found.effects],
        'others': [numbers_of(row, most) for row in found.others],
        'frame_ms': found.frame_ms, 'frame_ms_spread': found.frame_ms_spread,
        'frames': found.frames, 'substeps': found.substeps, 'particles': found.particles,
        'state_bytes': found.state_bytes,
    }
    if arguments.picture:
        from xpbd_ros.study.cost.picture import draw
        numbers['pictures'] = [draw(found, f'{scene.name}: {found.particles} particles, '
                                    f'{found.frame_ms:.2f} ms per frame',
                                    Path(arguments.picture))]
    write_json(arguments.json, numbers)
    if arguments.json != '-':
        print('\n'.join(lines(scene.name, found, describe(here), most)))
    return 0


def calibrate(arguments) -> int:
    """Measure the cost table of this machine and write it."""
    for name in ('scene', 'duration', 'commands', 'picture'):
        if getattr(arguments, name) is not None:
            raise InputError(f'--calibrate: does not go with {name}; it runs scenes of its '
                             'own')
    if arguments.keys:
        raise InputError('--calibrate: does not go with --set; it runs scenes of its own')
    file = Path(arguments.calibrate) if arguments.calibrate else None
    check_outputs(arguments.json, file)
    if file is None:
        folder = fresh_folder('cost')
        folder.mkdir()
        file = folder / 'cost_table.yaml'
    from xpbd_ros.scene.cost_table import table_text
    from xpbd_ros.study.cost.calibrate import calibrate as measured
    from xpbd_ros.study.machine import describe, machine
    here = machine()
    table = measured(progress)
    write_text(file, table_text(table, describe(here)))
    write_json(arguments.json, {'machine': here, 'table': str(file.absolute()),
                                'methods': table.methods, 'effects': table.effects})
    if arguments.json != '-':
        print(f'{file.absolute()}: take it with solver.cost_table')
    return 0


def numbers_of(row, most: dict) -> dict:
    """Return the JSON keys of a row."""
    return {**vars(row), 'ns_per_constraint': row.ns_per_constraint,
            'least_ns': row.least_ns(most['cache_gb_s']),
            'flops_in_time': row.flops_in_time(most['fma_gflop_s'])}


def lines(name: str, found, machine: str, most: dict) -> list[str]:
    """Return the printed table."""
    text = [f'{name}: {counted(found.particles, "particle")}, '
            f'{counted(found.substeps, "substep")}, {counted(found.frames, "frame")}, '
            f'{found.frame_ms:.2f} ± {found.frame_ms_spread:.2f} ms per frame',
            machine, '',
            f'  {"effect":<14} {"µs/substep":>15} {"share":>7} {"constraints":>11} '
            f'{"ns each":>8} {"least":>6} {"flops":>6} {"KiB":>8} {"kernels":>7}']
    for row in found.effects + found.others:
        if not row.present:
            text.append(f'  {row.name:<14} {"absent":>15} {"0 %":>7} {0:>11} {"":>22} {0:>8} '
                        f'{0:>7}')
            continue
        each = f'{"":>22}' if not row.constraints else (
            f'{row.ns_per_constraint:>8.2f} {row.least_ns(most["cache_gb_s"]):>6.2f} '
            f'{row.flops_in_time(most["fma_gflop_s"]):>6.0f}')
        if row in found.others:
            amounts = ''
        else:
            amounts = (f' {row.constraints:>11} {each} {row.bytes / 1024:>8.0f} '
                       f'{row.kernels:>7}')
        text.append(f'  {row.name:<14} {row.us_per_substep:>8.2f} ± {row.us_spread:<4.2f} '
                    f'{100 * row.share:>5.1f} %{amounts}')
    text += ['', '  least: ns for its memory traffic from cache; flops: operations possible in '
             '"ns each"',
             '  integration: prediction and velocities; python: of a frame, what is outside the '
             'native call; rest: neither',
             f'  state of the particles: {found.state_bytes / 1024:.0f} KiB',
             f'  one core of this machine: {most["memory_gb_s"]:.0f} GB/s from memory, '
             f'{most["cache_gb_s"]:.0f} GB/s from cache, {most["fma_gflop_s"]:.0f} Gflop/s']
    return text
