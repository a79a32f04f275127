"""
Convert messages to checked commands, and list the input topics.

Each reader is a pure function of one message: it returns commands, or raises ``InputError`` with
the reason.
"""

from collections.abc import Callable, Mapping
from math import isfinite
import re
import struct
from typing import Any, NamedTuple

from geometry_msgs.msg import PointStamped, PoseStamped, Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import parameter_value_to_python
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import String, UInt64
from visualization_msgs.msg import Marker, MarkerArray

from xpbd_ros.errors import counted, InputError
from xpbd_ros.ros.clouds import points_of
from xpbd_ros.scene.read import NAME
from xpbd_ros.sim.command_check import (
    checked,
    checked_point,
    checked_pose,
    checked_twist,
    checked_velocity,
    FAR,
)
from xpbd_ros.sim.commands import (
    Click,
    Command,
    Grasp,
    LoadState,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Pose,
    Release,
    ReleaseAll,
    RemoveAllColliders,
    RemoveCollider,
    Reset,
    SaveState,
    SetKey,
    SetState,
    SetWind,
    Twist,
)

SECOND = 10**9
"""one second [ns]"""
SAVED: dict[str, type[SaveState] | type[LoadState]] = {'save': SaveState, 'load': LoadState}
"""commands by their words in a log"""
MOST_RESETS = 4096
"""resets in one frame, at most; a log with more was not written by this program"""


def pose(position, orientation, what: str) -> Pose:
    """Return a checked pose with a normalized quaternion."""
    return checked_pose(Pose(
        (position.x, position.y, position.z),
        (orientation.x, orientation.y, orientation.z, orientation.w)), what)


def twist(message, what: str) -> Twist:
    """Return a checked twist."""
    linear, angular = message.linear, message.angular
    return checked_twist(Twist((linear.x, linear.y, linear.z),
                               (angular.x, angular.y, angular.z)), what)


def check_frame(header, frame_id: str, what: str) -> int:
    """Return the stamp of a header [ns]; refuse a TF frame other than the scene's."""
    if header.frame_id not in ('', frame_id):
        raise InputError(f"{what}: TF frame '{header.frame_id}' is not the scene's "
                         f"'{frame_id}'; transform it first")
    return nanoseconds(header.stamp, f'{what}: stamp')


def nanoseconds(time, what: str) -> int:
    """Return a time or duration [ns]; refuse negative and denormalized ones."""
    if time.sec < 0 or time.nanosec >= SECOND:
        raise InputError(f'{what}: {time.sec} s and {time.nanosec} ns are not a valid time')
    return time.sec * SECOND + time.nanosec


def check_name(name: str, what: str) -> str:
    """Return a name; refuse one that a scene cannot have."""
    if not NAME.fullmatch(name):
        raise InputError(f'{what}: bad name {name[:40]!r}; it must match {NAME.pattern}')
    return name


def read_pins(message: MarkerArray, frame_id: str) -> list[Command]:
    """Read ``~/pins``: ADD grasps or moves a pin, DELETE releases it, DELETEALL releases all."""
    return _read_markers(message, frame_id, 'pin', _grasp, Release, ReleaseAll)


def read_colliders(message: MarkerArray, frame_id: str) -> list[Command]:
    """Read ``~/colliders``: ADD adds, moves or reshapes one, DELETE and DELETEALL remove."""
    return _read_markers(message, frame_id, 'collider', _placed, RemoveCollider,
                         RemoveAllColliders)


def _read_markers(message: MarkerArray, frame_id: str, kind: str, add: Callable,
                  delete: Callable[[str], Command], delete_all: Callable[[], Command]
                  ) -> list[Command]:
    """Return a command for each marker: add(marker, name, text for errors), delete(name), …"""
    commands: list[Command] = []
    for marker in message.markers:
        what = f'marker {marker.ns}/{marker.id}'
        check_frame(marker.header, frame_id, what)
        if marker.action == Marker.DELETEALL:
            commands.append(delete_all())
            continue
        name = marker_name(marker, kind, what)
        if marker.action not in (Marker.ADD, Marker.DELETE):
            raise InputError(f'{what}: unknown action {marker.action}')
        commands.append(add(marker, name, what) if marker.action == Marker.ADD else delete(name))
    return commands


def _grasp(marker: Marker, name: str, what: str) -> Grasp:
    radius = 0.5 * marker.scale.x
    if not (isfinite(radius) and radius > 0.0):
        raise InputError(f'{what}: scale.x is twice the grasp radius and must be finite and > 0 m '
                         f'(got {marker.scale.x})')
    return Grasp(name, pose(marker.pose.position, marker.pose.orientation, what), radius,
                 nanoseconds(marker.lifetime, f'{what}: lifetime'))


def _placed(marker: Marker, name: str, what: str) -> PlaceCollider:
    shape, size = read_shape(marker, what)
    return PlaceCollider(
        name, shape, size, pose(marker.pose.position, marker.pose.orientation, what),
        nanoseconds(marker.lifetime, f'{what}: lifetime'))


def marker_name(marker: Marker, nameless: str, what: str) -> str:
    """Return the name that a marker's ns and id stand for: ns, or ns_id if id is not 0."""
    if marker.ns and not marker.id:
        return check_name(marker.ns, what)
    return check_name(f'{marker.ns or nameless}_{marker.id}', what)


def read_shape(marker: Marker, what: str) -> tuple[str, tuple[float, ...]]:
    """Return a marker's shape and size [m] as ``PlaceCollider`` takes them."""
    size = marker.scale.x, marker.scale.y, marker.scale.z
    if not all(isfinite(c) and 0.0 < 0.5 * c <= FAR for c in size):
        raise InputError(f'{what}: scale {list(size)} must be > 0 m and no more than {2 * FAR:g}')
    if marker.type == Marker.CUBE:
        return 'box', size
    if marker.type == Marker.TRIANGLE_LIST:
        corners = tuple(c * s for p in marker.points for c, s in zip((p.x, p.y, p.z), size))
        if not corners or len(corners) % 9 or not all(-FAR <= c <= FAR for c in corners):
            raise InputError(f'{what}: {len(marker.points)} points are no triangles: 3 '
                             f'each, within {FAR:g} m')
        return 'mesh', corners
    if marker.type not in (Marker.SPHERE, Marker.CYLINDER):
        raise InputError(f'{what}: type {marker.type} is no collider (known: CUBE, SPHERE, '
                         'CYLINDER, TRIANGLE_LIST)')
    if size[0] != size[1] or marker.type == Marker.SPHERE and size[0] != size[2]:
        raise InputError(f'{what}: scale {list(size)} must be the same across: a collider is '
                         'round')
    radius = 0.5 * size[0]
    return ('sphere', (radius,)) if marker.type == Marker.SPHERE else (
        'cylinder', (radius, size[2]))


def read_targets(message: MultiDOFJointState, frame_id: str, kind: type) -> list[Command]:
    """``~/pin_targets`` and ``~/collider_states``: where several named ones go, in one stamp."""
    count = len(message.joint_names)
    stamp_ns = check_frame(message.header, frame_id, 'header')
    if len(message.transforms) != count or len(message.twist) not in (0, count):
        raise InputError(f'{counted(count, "name")} but '
                         f'{counted(len(message.transforms), "transform")} and '
                         f'{counted(len(message.twist), "twist")}')
    commands: list[Command] = []
    seen: set[str] = set()
    for k, name in enumerate(message.joint_names):
        check_name(name, 'joint_names')
        if name in seen:
            raise InputError(f'joint_names: {name!r} twice; send one target of each')
        seen.add(name)
        transform = message.transforms[k]
        commands.append(kind(
            name, pose(transform.translation, transform.rotation, name),
            twist(message.twist[k], name) if message.twist else None, stamp_ns))
    return commands


def read_pose(message, frame_id: str, name: str, kind: type = MoveCollider) -> list[Command]:
    """Read ``~/collider/<name>/pose`` and ``~/pin/<name>/target``: the target of one."""
    stamp_ns = check_frame(message.header, frame_id, 'header')
    return [kind(name, pose(message.pose.position, message.pose.orientation, name), None,
                 stamp_ns)]


def read_click(message: PointStamped, frame_id: str) -> list[Command]:
    """Read ``~/clicked_point``: a particle to pin, or a pin to release."""
    check_frame(message.header, frame_id, 'header')
    point = message.point
    return [Click(checked_point((point.x, point.y, point.z), 'point'))]


def read_wind(message: Vector3Stamped, frame_id: str) -> list[Command]:
    """Read ``~/wind``: the velocity of the air."""
    check_frame(message.header, frame_id, 'header')
    vector = message.vector
    return [SetWind(checked_velocity((vector.x, vector.y, vector.z), 'vector'))]


def read_events(message: ParameterEvent) -> list[Command]:
    """Read ``/parameter_events`` of a log: changed live keys."""
    return [SetKey(p.name, parameter_value_to_python(p.value))
            for p in message.changed_parameters]


def read_resets(message: UInt64) -> list[Command]:
    """Read ``~/resets`` of a log: the number of resets before a frame."""
    if message.data > MOST_RESETS:
        raise InputError(f'{message.data} resets in one frame (at most {MOST_RESETS})')
    return [Reset()] * message.data


def read_saved_states(message: String) -> list[Command]:
    """Read ``~/saved_states`` of a log: 'save' or 'load'."""
    if message.data not in SAVED:
        raise InputError(f"{message.data[:40]!r} is neither 'save' nor 'load'")
    return [SAVED[message.data]()]


def read_set_state(message: PointCloud2, frame_id: str, cloth: str) -> list[Command]:
    """Read ``~/cloth/<name>/set_state`` of a log: the positions of all particles of a cloth."""
    check_frame(message.header, frame_id, 'header')
    return [checked(SetState(cloth, tuple(points_of(message).ravel().tolist())))]


def unpacked(raw: bytes, kind: type):
    """Return a deserialized message; refuse bytes that are not a message of type ``kind``."""
    try:
        return deserialize_message(raw, kind)
    except Exception as error:
        raise InputError(f'cannot be unpacked ({error})') from error


def count_in(raw: bytes, kind: type) -> int:
    """
    Return the number of markers or names in a serialized message, without unpacking it.

    In a MarkerArray the count comes first; in a MultiDOFJointState it follows stamp and TF frame.
    """
    order = '<' if raw[1:2] == b'\x01' else '>'
    try:
        if kind is MarkerArray:
            return struct.unpack_from(f'{order}I', raw, 4)[0]
        length = struct.unpack_from(f'{order}I', raw, 12)[0]
        return struct.unpack_from(f'{order}I', raw, 4 + (12 + length + 3) // 4 * 4)[0]
    except struct.error:
        return 0


def max_entries(effects: Mapping[str, Any]) -> int:
    """Return the most entries of an array message: one deletes all, two replace each name."""
    return 1 + 2 * max(getattr(effects.get('pin'), 'max_pins', 0),
                       getattr(effects.get('contact'), 'max_colliders', 0))


class Input(NamedTuple):
    """One input topic."""

    kind: type
    """message type"""
    read: Callable
    """reader: (message, frame_id) -> commands"""
    commands: tuple[type, ...]
    """types of the commands that ``read`` returns"""
    effect: str | None
    """effect that the scene needs for the node to subscribe; None if only logs have the topic"""


INPUTS = {
    'pins': Input(MarkerArray, read_pins, (Grasp, Release, ReleaseAll), 'pin'),
    'pin_targets': Input(MultiDOFJointState, lambda m, f: read_targets(m, f, MovePin), (MovePin,),
                         'pin'),
    'colliders': Input(MarkerArray, read_colliders,
                       (PlaceCollider, RemoveCollider, RemoveAllColliders), 'contact'),
    'collider_states': Input(MultiDOFJointState, lambda m, f: read_targets(m, f, MoveCollider),
                             (MoveCollider,), 'contact'),
    'clicked_point': Input(PointStamped, read_click, (Click,), 'pin'),
    'wind': Input(Vector3Stamped, read_wind, (SetWind,), 'wind'),
    'parameter_events': Input(ParameterEvent, lambda m, f: read_events(m), (SetKey,), None),
    'resets': Input(UInt64, lambda m, f: read_resets(m), (Reset,), None),
    'saved_states': Input(String, lambda m, f: read_saved_states(m), (SaveState, LoadState),
                          None),
}
"""by topic below the node's name; a log may have all, with ``parameter_events`` at the root"""


NAMED = {
    re.compile(r'(?:^|/)collider/(\w+)/pose$'): lambda name: Input(
        PoseStamped, lambda m, f: read_pose(m, f, name), (), None),
    re.compile(r'(?:^|/)pin/(\w+)/target$'): lambda name: Input(
        PoseStamped, lambda m, f: read_pose(m, f, name, MovePin), (), None),
    re.compile(r'(?:^|/)cloth/(\w+)/set_state$'): lambda name: Input(
        PointCloud2, lambda m, f: read_set_state(m, f, name), (SetState,), None),
}
"""inputs of one collider, pin or cloth, from its name, by the topic"""


def input_of(topic: str) -> Input | None:
    """Return the input on a topic of a log or of a node; None if it has none of that name."""
    for pattern, about in NAMED.items():
        if found := pattern.search(topic):
            return about(found[1])
    return INPUTS.get(topic.rsplit('/', 1)[-1])


def topic_of(command: Command) -> str:
    """Return the topic that carries a command, or ``parameters`` for a live key."""
    if isinstance(command, SetKey):
        return 'parameters'
    if isinstance(command, SetState):
        return 'set_state'
    return next(topic for topic, about in INPUTS.items() if isinstance(command, about.commands))
