"""
Find the values of keys with which a scene explains a recorded point cloud.

The scene starts and moves as the recording did: give its pins and colliders a motion, or let a log
of xpbd_ros bring its inputs. A cloud with as many points as the cloth has particles is compared
particle by particle (NaN marks missing points), any other with the surface. Each value comes with
an interval of 95 %, or as not determined if the motion does not depend on it. Values are positive,
and searched over a factor of 100 to both sides of the scene's, or from LOW to HIGH.

Exit code: 0, or 1 if a value is not determined.
"""

import math

from xpbd_ros.cli.output import add_json_argument, check_outputs, new_folder, STDOUT, write_json
from xpbd_ros.cli.overrides import add_set_argument, parse_keys
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import commands_of, need_ros
from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.folder import fresh_folder

EXAMPLE = ('xpbd_ros fit towel --log camera_run --vary cloths.towel.effects.bend.stiffness --vary '
           'cloths.towel.friction=0.1:2')
RANGE = 100.0
"""factor between the scene's value and the ends of the range"""
ROUNDS = 3
"""fits, at most, until auto chooses the solver that the values were found with"""


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scene', help='a scene file, or the name of a shipped scene')
    parser.add_argument('--log', required=True, metavar='RUN',
                        help='the recording: a folder or an .mcap file')
    parser.add_argument('--vary', action='append', required=True, metavar='KEY[=LOW:HIGH]',
                        help='a key to fit, such as cloths.towel.effects.bend.stiffness; may be '
                             'given several times')
    parser.add_argument('--cloud', metavar='TOPIC',
                        help='topic of the clouds; default: those named particles, or the only '
                             'one')
    parser.add_argument('--start', type=float, default=0.0, metavar='S',
                        help='time in the recording at which the scene starts (default: 0)')
    parser.add_argument('--duration', type=float, metavar='S',
                        help='compare only the first S seconds')
    add_set_argument(parser, 'override one key of the scene')
    parser.add_argument('-o', '--output', metavar='DIR',
                        help='new folder for the picture; default: one named by time')
    add_json_argument(parser)


def run(arguments) -> int:
    """Fit the keys, print their values and draw the residuals."""
    need_ros('fit')
    from xpbd_ros.fit.clouds import read_clouds
    from xpbd_ros.fit.model import Model
    from xpbd_ros.fit.picture import draw
    from xpbd_ros.log.reader import LogReader
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.study.accuracy.measure import without_solver
    check_outputs(arguments.json, folder=arguments.output)
    scene = load_scene(arguments.scene, parse_keys(arguments.keys))
    check_times(arguments, 1.0 / scene.top.frame_rate)
    keys = [key_of(text, scene) for text in arguments.vary]
    if len({key.name for key in keys}) < len(keys):
        raise InputError('--vary: a key is given twice')
    simulation = compile_scene(scene)
    clouds = read_clouds(arguments.log, scene, simulation.cloths, topic=arguments.cloud,
                         start=arguments.start, duration=arguments.duration)
    commands = {}
    if any(topic.endswith('/state_hash') for topic in LogReader(arguments.log).topics):
        commands = without_solver(commands_of('fit', arguments.log, scene,
                                              max(cloud.frame for cloud in clouds)))
    model = Model(scene, clouds, commands)
    for key in keys:
        for side, value in (('LOW', key.low), ('HIGH', key.high)):
            try:
                model.scene_with({key.name: value})
            except InputError as error:
                raise InputError(f'{error}; {side} of the range of {key.name}; give --vary '
                                 f'{key.name}=LOW:HIGH') from None
    with new_folder(arguments.output or fresh_folder('fit')) as folder:
        assert folder is not None
        found, setting = fitted(model, keys)
        units = {key: unit_of(scene, key) for key in found.values}
        picture = draw(found, folder / 'residuals.png', units)
    numbers = {
        'values': {key: {'value': value.value, 'low': value.low, 'high': value.high,
                         'unit': units[key], 'determined': value.determined,
                         'why_not': value.why_not}
                   for key, value in found.values.items()},
        'residual_m': found.residual_m, 'clouds': len(clouds), 'points': model.points,
        'organised': all(cloud.particles is not None for cloud in clouds),
        'solver': setting.block(), 'runs': found.runs, 'pictures': [picture]}
    write_json(arguments.json, numbers)
    if arguments.json != STDOUT:
        print('\n'.join(lines(numbers)))
    return 0 if all(value.determined for value in found.values.values()) else 1


def check_times(arguments, frame_dt: float) -> None:
    """Raise InputError for a start before the recording, or less than a frame to compare."""
    start, duration = arguments.start, arguments.duration
    if not 0.0 <= start < math.inf:
        raise InputError(f'--start: must be >= 0 s, the start of the recording (got {start:g} s)')
    if duration is not None and not 0.5 * frame_dt <= duration < math.inf:
        raise InputError(f'--duration: must be at least a frame ({frame_dt:.3g} s; got '
                         f'{duration:g} s); leave it out to compare the whole recording')


def key_of(text: str, scene):
    """Return the key of ``--vary``, with its range."""
    from xpbd_ros.fit.solve import Key
    name, equals, limits = text.partition('=')
    start = value_of(scene, name)
    low, high = (start / RANGE, start * RANGE) if start else (0.0, 0.0)
    if equals:
        try:
            low, high = (float(part) for part in limits.split(':'))
        except ValueError:
            raise InputError(f'--vary {text}: must be KEY or KEY=LOW:HIGH') from None
        if not 0.0 < low < high < math.inf:
            raise InputError(f'--vary {text}: LOW must be > 0 and less than HIGH')
        start = min(max(start or 0.0, low), high)
    if not start:
        raise InputError(f'--vary {name}: the scene gives no value > 0 to begin with; give '
                         f'--vary {name}=LOW:HIGH')
    return Key(name, start, low, high)


def value_of(scene, name: str) -> float | None:
    """Return the number that a scene has at a key; None without one; raise for unknown keys."""
    from xpbd_ros.scene.load import scene_from_mapping
    from xpbd_ros.scene.model import live_keys
    known = live_keys(scene)
    value = known[name][1] if name in known else scene.raw
    for part in name.split('.') if name not in known else ():
        value = value.get(part) if isinstance(value, dict) else None
    if value is None:    # a key that needs no value, or none at all
        scene_from_mapping(scene.raw, where=scene.where, name=scene.name, overrides={name: 1.0})
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f'--vary {name}: is not a number in the scene') from None
    if number < 0.0:
        raise InputError(f'--vary {name}: must be > 0 (got {number:g})')
    return number


def unit_of(scene, name: str) -> str:
    """Return the unit of a key; empty if it has none."""
    from xpbd_ros.scene.model import all_keys
    known = all_keys(scene)
    return (known[name][0].metadata.get('unit') or '') if name in known else ''


def fitted(model, keys):
    """
    Return the fit, and the solver setting of its runs.

    All runs of a fit have one setting, since residuals would jump where ``auto`` chooses another.
    """
    from xpbd_ros.fit.model import Model
    from xpbd_ros.fit.solve import fit
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.threads import free_cores
    from xpbd_ros.study.accuracy.solver_setting import setting_of, with_solver
    setting, start, found = setting_of(compile_scene(model.scene)), None, None
    for _ in range(ROUNDS):
        fixed = Model(with_solver(model.scene, setting.block()), model.clouds, model.commands)
        compile_scene(fixed.scene).compile()
        found = fit(fixed, keys, start, threads=free_cores(), progress=progress)
        start = {key: value.value for key, value in found.values.items()}
        chosen = setting_of(compile_scene(model.scene_with(start)))
        if chosen == setting:
            break
        used, setting = setting, chosen
    else:
        setting = used
    return found, setting


def lines(numbers: dict) -> list[str]:
    """Return the printed result."""
    width = max(map(len, numbers['values']))
    text = []
    for key, found in numbers['values'].items():
        if found['determined']:
            unit = f" {found['unit']}" if found['unit'] else ''
            said = (f"{found['value']:.4g}{unit}, 95 %: {found['low']:.4g} to "
                    f"{found['high']:.4g}{unit}")
        else:
            said = f"not determined: {found['why_not']}"
        text.append(f'{key:<{width}}  {said}')
    solver = numbers['solver']
    return [*text,
            f"residual  {1e3 * numbers['residual_m']:.3g} mm RMS",
            f"points    {numbers['points']} of {counted(numbers['clouds'], 'cloud')}, compared "
            'with ' + ('their particles' if numbers['organised'] else 'the surface'),
            f"solver    {solver['method']}, {solver['integrator']}, "
            f"{solver['substeps']} × {solver['iterations']}; {numbers['runs']} runs",
            f"picture   {numbers['pictures'][0]}"]
