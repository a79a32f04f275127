"""
Messages to commands, checked, and commands back to messages as the log keeps them.

Each reader is a pure function of one message: it returns commands or raises ``InputError`` with
the reason. What goes through unharmed comes out of the log's message bit for bit.
"""

from itertools import groupby
from math import isfinite, sqrt
import struct

from geometry_msgs.msg import (
    Point,
    Transform,
    Twist as TwistMessage,
    Vector3,
    Vector3Stamped,
)
from rcl_interfaces.msg import Parameter, ParameterEvent
from rclpy.parameter import Parameter as RclpyParameter, parameter_value_to_python
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import UInt64
from visualization_msgs.msg import Marker, MarkerArray

from xpbd_ros.errors import InputError
from xpbd_ros.ros.messages import quaternion, set_stamp, vector
from xpbd_ros.scene.read import NAME
from xpbd_ros.sim.commands import (
    Command,
    Grasp,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Pose,
    Release,
    ReleaseAll,
    RemoveAllColliders,
    RemoveCollider,
    Reset,
    SetKey,
    SetWind,
    Twist,
)

FAR = 1e6
"""nothing sensible is further away, or faster [m, m/s, rad/s]"""
SECOND = 10**9
"""[ns]"""
MOST_RESETS = 4096
"""in one frame; a log that says more is not one of ours"""


def pose(position, orientation, what: str) -> Pose:
    """Return a pose, or refuse numbers that are none and quaternions that are no rotation."""
    p = (position.x, position.y, position.z)
    q = (orientation.x, orientation.y, orientation.z, orientation.w)
    if not all(map(isfinite, p + q)):
        raise InputError(f'{what}: position or orientation is not finite')
    if max(map(abs, p)) > FAR:
        raise InputError(f'{what}: position {list(p)} is further than {FAR:g} m away')
    square = sum(c * c for c in q)
    if not 0.8 < square < 1.2:
        raise InputError(f'{what}: orientation {list(q)} is not a unit quaternion')
    if abs(square - 1.0) > 1e-12:
        q = tuple(c / sqrt(square) for c in q)
    return Pose(p, q)


def twist(message, what: str) -> Twist:
    """Return a twist, or refuse numbers that are none."""
    linear = (message.linear.x, message.linear.y, message.linear.z)
    angular = (message.angular.x, message.angular.y, message.angular.z)
    if not all(map(isfinite, linear + angular)):
        raise InputError(f'{what}: twist is not finite')
    if max(map(abs, linear + angular)) > FAR:
        raise InputError(f'{what}: twist {list(linear)}, {list(angular)} is faster than {FAR:g}')
    return Twist(linear, angular)


def check_frame(header, frame_id: str, what: str) -> int:
    """Refuse another TF frame than the scene's; return the stamp [ns]."""
    if header.frame_id not in ('', frame_id):
        raise InputError(f"{what}: TF frame '{header.frame_id}' is not the scene's "
                         f"'{frame_id}'; transform it first")
    return nanoseconds(header.stamp, f'{what}: stamp')


def nanoseconds(time, what: str) -> int:
    """Return a time or a duration as one number; refuse what would not come back as it is."""
    if time.sec < 0 or time.nanosec >= SECOND:
        raise InputError(f'{what}: {time.sec} s and {time.nanosec} ns make no sense')
    return time.sec * SECOND + time.nanosec


def check_name(name: str, what: str) -> str:
    """Refuse a name that the scene could not have."""
    if not NAME.fullmatch(name):
        raise InputError(f'{what}: bad name {name[:40]!r}')
    return name


def read_pins(message: MarkerArray, frame_id: str) -> list[Command]:
    """``~/pins``: ADD grasps (or moves what is held), DELETE releases, DELETEALL releases all."""
    commands: list[Command] = []
    for marker in message.markers:
        what = f'marker {marker.ns}/{marker.id}'
        check_frame(marker.header, frame_id, what)
        if marker.action == Marker.DELETEALL:
            commands.append(ReleaseAll())
            continue
        name = marker_name(marker, 'pin', what)
        if marker.action == Marker.DELETE:
            commands.append(Release(name))
        elif marker.action == Marker.ADD:
            radius = 0.5 * marker.scale.x
            if not (isfinite(radius) and radius > 0.0):
                raise InputError(f'{what}: scale.x is twice the grasp radius and must be > 0 m '
                                 f'(got {marker.scale.x})')
            commands.append(Grasp(
                name, pose(marker.pose.position, marker.pose.orientation, what), radius,
                nanoseconds(marker.lifetime, f'{what}: lifetime')))
        else:
            raise InputError(f'{what}: unknown action {marker.action}')
    return commands


def marker_name(marker: Marker, nameless: str, what: str) -> str:
    """Return the name that a marker's ns and id are for: ns, or ns_id where there is an id."""
    if marker.ns and not marker.id:
        return check_name(marker.ns, what)
    return check_name(f'{marker.ns or nameless}_{marker.id}', what)


def read_colliders(message: MarkerArray, frame_id: str) -> list[Command]:
    """``~/colliders``: ADD adds, moves or reshapes, DELETE and DELETEALL take away."""
    commands: list[Command] = []
    for marker in message.markers:
        what = f'marker {marker.ns}/{marker.id}'
        check_frame(marker.header, frame_id, what)
        if marker.action == Marker.DELETEALL:
            commands.append(RemoveAllColliders())
            continue
        name = marker_name(marker, 'collider', what)
        if marker.action == Marker.DELETE:
            commands.append(RemoveCollider(name))
        elif marker.action == Marker.ADD:
            shape, size = read_shape(marker, what)
            commands.append(PlaceCollider(
                name, shape, size, pose(marker.pose.position, marker.pose.orientation, what),
                nanoseconds(marker.lifetime, f'{what}: lifetime')))
        else:
            raise InputError(f'{what}: unknown action {marker.action}')
    return commands


def read_shape(marker: Marker, what: str) -> tuple[str, tuple[float, ...]]:
    """Return the shape of a marker and its size [m], as ``PlaceCollider`` has them."""
    size = marker.scale.x, marker.scale.y, marker.scale.z
    if not all(isfinite(c) and 0.0 < 0.5 * c <= FAR for c in size):
        raise InputError(f'{what}: scale {list(size)} must be > 0 m and no more than {2 * FAR:g}')
    if marker.type == Marker.CUBE:
        return 'box', size
    if marker.type == Marker.TRIANGLE_LIST:
        corners = tuple(c * s for p in marker.points for c, s in zip((p.x, p.y, p.z), size))
        if not corners or len(corners) % 9 or not all(-FAR <= c <= FAR for c in corners):
            raise InputError(f'{what}: {len(marker.points)} points are no triangles within '
                             f'{FAR:g} m')
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
        raise InputError(f'{count} names but {len(message.transforms)} transforms and '
                         f'{len(message.twist)} twists')
    commands = []
    for k, name in enumerate(message.joint_names):
        check_name(name, 'joint_names')
        transform = message.transforms[k]
        commands.append(kind(
            name, pose(transform.translation, transform.rotation, name),
            twist(message.twist[k], name) if message.twist else None, stamp_ns))
    return commands


def read_pose(message, frame_id: str, collider: str) -> list[Command]:
    """``~/collider/<name>/pose``: where one collider goes."""
    stamp_ns = check_frame(message.header, frame_id, 'header')
    return [MoveCollider(collider, pose(message.pose.position, message.pose.orientation,
                                        collider), None, stamp_ns)]


def read_wind(message: Vector3Stamped, frame_id: str) -> list[Command]:
    """``~/wind``: how the air moves."""
    check_frame(message.header, frame_id, 'header')
    velocity = (message.vector.x, message.vector.y, message.vector.z)
    if not all(map(isfinite, velocity)):
        raise InputError('vector is not finite')
    if max(map(abs, velocity)) > FAR:
        raise InputError(f'vector {list(velocity)} is faster than {FAR:g} m/s')
    return [SetWind(velocity)]


def read_events(message: ParameterEvent) -> list[Command]:
    """Read the log's ``/parameter_events``: live keys that changed."""
    return [SetKey(p.name, parameter_value_to_python(p.value))
            for p in message.changed_parameters]


def read_resets(message: UInt64) -> list[Command]:
    """Read the log's ``~/resets``: how many there were before a frame."""
    if message.data > MOST_RESETS:
        raise InputError(f'{message.data} resets in one frame (at most {MOST_RESETS})')
    return [Reset()] * message.data


def unpacked(raw: bytes, kind: type):
    """Return a serialized message as one of a type, or refuse bytes that are none."""
    try:
        return deserialize_message(raw, kind)
    except Exception as error:
        raise InputError(f'cannot be unpacked ({error})') from error


def count_in(raw: bytes, kind: type) -> int:
    """
    Return how many markers or names a serialized message claims to hold, without unpacking it.

    MarkerArray starts with the count; MultiDOFJointState with a stamp, the TF frame and the count.
    """
    order = '<' if raw[1:2] == b'\x01' else '>'
    try:
        if kind is MarkerArray:
            return struct.unpack_from(f'{order}I', raw, 4)[0]
        length = struct.unpack_from(f'{order}I', raw, 12)[0]
        return struct.unpack_from(f'{order}I', raw, 4 + (12 + length + 3) // 4 * 4)[0]
    except struct.error:
        return 0


def as_messages(commands, frame_id: str, time_ns: int) -> list[tuple[str, object]]:
    """
    Return applied commands as (topic below the node, message), in order.

    Neighbours that fit into one message share it.
    """
    found = []
    for key, group in groupby(commands, _batch):
        group = list(group)
        kind = key[0]
        if kind in (Grasp, Release, ReleaseAll):
            found.append(('pins', MarkerArray(
                markers=[_marker(c, frame_id, time_ns) for c in group])))
        elif kind is PlaceCollider:
            found.append(('colliders', MarkerArray(
                markers=[_collider(c, frame_id, time_ns) for c in group])))
        elif kind in (MovePin, MoveCollider):
            topic = 'pin_targets' if kind is MovePin else 'collider_states'
            found.append((topic, _targets(group, frame_id)))
        elif kind is SetWind:
            found += [('wind', _wind(c, frame_id, time_ns)) for c in group]
        elif kind is SetKey:
            event = ParameterEvent(node='cloth')
            set_stamp(event.stamp, time_ns)
            event.changed_parameters = [_parameter(c) for c in group]
            found.append(('/parameter_events', event))
        elif kind is Reset:
            found.append(('resets', UInt64(data=len(group))))
    return found


READERS = {
    'pins': (MarkerArray, read_pins),
    'pin_targets': (MultiDOFJointState, lambda m, f: read_targets(m, f, MovePin)),
    'colliders': (MarkerArray, read_colliders),
    'collider_states': (MultiDOFJointState, lambda m, f: read_targets(m, f, MoveCollider)),
    'wind': (Vector3Stamped, read_wind),
    'parameter_events': (ParameterEvent, lambda m, f: read_events(m)),
    'resets': (UInt64, lambda m, f: read_resets(m)),
}
"""the log's input topics, by their last part: type, and reader (message, frame_id) -> commands"""


def _batch(command) -> tuple:
    kind = type(command)
    if kind in (MovePin, MoveCollider):
        return kind, command.stamp_ns, command.twist is None
    if kind in (RemoveCollider, RemoveAllColliders):
        kind = PlaceCollider
    return (Grasp if kind in (Release, ReleaseAll) else kind,)


def _marker(command, frame_id: str, time_ns: int) -> Marker:
    marker = Marker(type=Marker.SPHERE)
    marker.header.frame_id = frame_id
    set_stamp(marker.header.stamp, time_ns)
    if isinstance(command, ReleaseAll):
        marker.action = Marker.DELETEALL
        return marker
    marker.ns = command.pin
    marker.action = Marker.DELETE
    if isinstance(command, Grasp):
        marker.action = Marker.ADD
        marker.pose.position = vector(Point, command.pose.position)
        marker.pose.orientation = quaternion(command.pose.orientation)
        size = 2.0 * command.radius
        marker.scale = Vector3(x=size, y=size, z=size)
        marker.color.a = 1.0
        marker.lifetime.sec, marker.lifetime.nanosec = divmod(command.lifetime_ns, SECOND)
    return marker


def _collider(command, frame_id: str, time_ns: int) -> Marker:
    marker = Marker(ns=getattr(command, 'collider', ''), action=Marker.DELETE)
    marker.header.frame_id = frame_id
    set_stamp(marker.header.stamp, time_ns)
    if isinstance(command, RemoveAllColliders):
        marker.action = Marker.DELETEALL
    elif isinstance(command, PlaceCollider):
        marker.action, size = Marker.ADD, command.size
        marker.type = {'box': Marker.CUBE, 'sphere': Marker.SPHERE, 'cylinder': Marker.CYLINDER,
                       'mesh': Marker.TRIANGLE_LIST}[command.shape]
        if command.shape == 'mesh':
            marker.points = [Point(x=x, y=y, z=z) for x, y, z in zip(*[iter(size)] * 3)]
            size = 1.0, 1.0, 1.0
        elif command.shape != 'box':
            across = 2.0 * size[0]
            size = across, across, size[-1] if command.shape == 'cylinder' else across
        marker.scale = vector(Vector3, size)
        marker.pose.position = vector(Point, command.pose.position)
        marker.pose.orientation = quaternion(command.pose.orientation)
        marker.color.a = 1.0
        marker.lifetime.sec, marker.lifetime.nanosec = divmod(command.lifetime_ns, SECOND)
    return marker


def _targets(group, frame_id: str) -> MultiDOFJointState:
    message = MultiDOFJointState()
    message.header.frame_id = frame_id
    set_stamp(message.header.stamp, group[0].stamp_ns)
    for command in group:
        message.joint_names.append(getattr(command, 'pin', None) or command.collider)
        message.transforms.append(Transform(
            translation=vector(Vector3, command.pose.position),
            rotation=quaternion(command.pose.orientation)))
        if command.twist is not None:
            message.twist.append(TwistMessage(linear=vector(Vector3, command.twist.linear),
                                              angular=vector(Vector3, command.twist.angular)))
    return message


def _wind(command: SetWind, frame_id: str, time_ns: int) -> Vector3Stamped:
    message = Vector3Stamped(vector=vector(Vector3, command.velocity))
    message.header.frame_id = frame_id
    set_stamp(message.header.stamp, time_ns)
    return message


def _parameter(command: SetKey) -> Parameter:
    value = command.value
    if isinstance(value, tuple):
        value = list(value)
    return RclpyParameter(command.key, value=value).to_parameter_msg()
