"""The node's own parameters, and descriptors of the live keys of its scene."""

from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from xpbd_ros.scene.model import live_keys, Scene

LARGEST = 1e300


@dataclass(frozen=True)
class Row:
    """One parameter of the node."""

    name: str
    default: Any
    description: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False
    """True if it can be set at any time; otherwise only while the node is unconfigured"""


TABLE = (
    Row('scene', 'towel', 'scene file, or the name of a shipped scene'),
    Row('settings', '', "a file with a 'solver:' block, to override the scene's keys"),
    Row('frame_id', '', "TF frame of all messages; '' takes the scene's"),
    Row('autostart', True, 'configure and activate at start; false: wait for lifecycle '
        'transitions'),
    Row('mode', 'realtime', "'realtime': step by the node's clock; 'lockstep': only on ~/step; "
        "'fast': as fast as possible", choices=('realtime', 'lockstep', 'fast'), live=True),
    Row('publish_rate', 0.0, 'rate of ~/particles, ~/pin_states and ~/collider_wrenches in Hz of '
        'simulation time; must divide the frame rate; 0: every frame', minimum=0.0,
        maximum=10000.0, live=True),
    Row('marker_rate', 15.0, 'rate of ~/markers in Hz of wall time, while it has subscribers; 0: '
        'never', minimum=0.0, maximum=1000.0, live=True),
    Row('marker_color', 'none', "colour of the surfaces in ~/markers: 'strain', 'force' (tension) "
        "or 'none'", choices=('none', 'strain', 'force')),
    Row('interactive_markers', False, "handles for the scene's pins in RViz: drag them, or grasp "
        'and release from their menu'),
    Row('particle_fields', '', "further fields of ~/particles, separated by spaces: 'velocity "
        "normal strain pinned id'; '': none"),
    Row('set_state_radius', 0.05, 'largest distance of a particle from its point of a cloud on '
        '~/set_state, in m', minimum=1e-6, maximum=1e6, live=True),
    Row('record.path', '', "folder to record to from activation on; '': record only on ~/record, "
        'to a new folder', live=True),
    Row('record.flush_period', 1.0, 'a crash loses at most this much of a log, in s',
        minimum=0.01, maximum=3600.0, live=True),
    Row('record.checkpoint_period', 10.0, 'period at which the complete state is logged, in s of '
        'simulation time', minimum=0.01, maximum=1e6, live=True),
    Row('record.split_size', 4000.0, 'size at which a log goes on in a new file, in MB; 0: one '
        'file', minimum=0.0, maximum=1e6, live=True),
    Row('record.split_duration', 0.0, 'simulated time after which a log goes on in a new file, in '
        's; 0: one file', minimum=0.0, maximum=1e6, live=True),
    Row('publish_clock', False, 'publish simulation time on /clock'),
    Row('max_message_bytes', 4 * 2**20, 'larger array messages are refused before they are '
        'unpacked', minimum=1024, maximum=2**30),
)


def descriptor(row: Row) -> ParameterDescriptor:
    """Return the descriptor of a parameter of the node, as ``ros2 param describe`` shows it."""
    found = ParameterDescriptor(description=row.description, read_only=False)
    found.additional_constraints = '; '.join(filter(None, (
        f'one of {", ".join(row.choices)}' if row.choices else '',
        '' if row.live else 'read when the node is configured')))
    _set_range(found, isinstance(row.default, int), row.minimum, row.maximum)
    return found


def scene_parameters(scene: Scene, substeps: int) -> dict[str, tuple[Any, ParameterDescriptor]]:
    """Return (present value, descriptor) of each live key of a scene, by name."""
    found = {}
    for key, (field, value) in {
            'solver.substeps': (scene.top.solver.__dataclass_fields__['substeps'], substeps),
            **live_keys(scene)}.items():
        metadata = field.metadata
        unit = f' [{metadata["unit"]}]' if metadata['unit'] else ''
        about = ParameterDescriptor(
            description=f'{metadata["doc"] or field.name}{unit}'.strip())
        if metadata['above'] is not None:
            about.additional_constraints = f'must be > {metadata["above"]:g}'
        if isinstance(value, tuple):
            value = [float(c) for c in value]
        else:
            least = metadata['minimum'] if metadata['above'] is None else metadata['above']
            _set_range(about, isinstance(value, int), least, metadata['maximum'])
        found[key] = (value, about)
    return found


def _set_range(about: ParameterDescriptor, whole: bool, least, most) -> None:
    if least is None and most is None:
        return
    if whole:
        about.integer_range = [IntegerRange(
            from_value=int(least or 0), to_value=int(most if most is not None else 2**62), step=0)]
    else:
        about.floating_point_range = [FloatingPointRange(
            from_value=float(least if least is not None else -LARGEST),
            to_value=float(most if most is not None else LARGEST), step=0.0)]
