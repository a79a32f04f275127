"""
Convert commands to the messages that the log keeps.

``inputs`` converts them back; every number comes back bit for bit.
"""

from itertools import groupby

from geometry_msgs.msg import (
    Point,
    PointStamped,
    Transform,
    Twist as TwistMessage,
    Vector3,
    Vector3Stamped,
)
from rcl_interfaces.msg import Parameter, ParameterEvent
from rclpy.parameter import Parameter as RclpyParameter
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import String, UInt64
from visualization_msgs.msg import Marker, MarkerArray

from xpbd_ros.ros.clouds import cloud_of
from xpbd_ros.ros.inputs import SECOND
from xpbd_ros.ros.messages import quaternion, set_stamp, stamped, vector
from xpbd_ros.sim.commands import (
    Click,
    Grasp,
    LoadState,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Release,
    ReleaseAll,
    RemoveAllColliders,
    RemoveCollider,
    Reset,
    SaveState,
    SetKey,
    SetState,
    SetWind,
)


def as_messages(commands, frame_id: str, time_ns: int) -> list[tuple[str, object]]:
    """
    Return applied commands as pairs (topic below the node's name, message), in order.

    Consecutive commands of one kind share a message; targets of one name have one each.
    """
    found = []
    for key, batch in groupby(commands, _batch):
        group = list(batch)
        kind = key[0]
        if kind in (Grasp, Release, ReleaseAll):
            found.append(('pins', MarkerArray(
                markers=[_marker(c, frame_id, time_ns) for c in group])))
        elif kind is PlaceCollider:
            found.append(('colliders', MarkerArray(
                markers=[_collider(c, frame_id, time_ns) for c in group])))
        elif kind in (MovePin, MoveCollider):
            topic = 'pin_targets' if kind is MovePin else 'collider_states'
            found += [(topic, _targets(part, frame_id)) for part in _of_distinct_names(group)]
        elif kind is SetWind:
            found += [('wind', stamped(Vector3Stamped(vector=vector(Vector3, c.velocity)),
                                       frame_id, time_ns)) for c in group]
        elif kind is SetKey:
            event = ParameterEvent(node='cloth')
            set_stamp(event.stamp, time_ns)
            event.changed_parameters = [_parameter(c) for c in group]
            found.append(('/parameter_events', event))
        elif kind is Reset:
            found.append(('resets', UInt64(data=len(group))))
        elif kind is Click:
            found += [('clicked_point', stamped(PointStamped(point=vector(Point, c.point)),
                                                frame_id, time_ns)) for c in group]
        elif kind in (SaveState, LoadState):
            found += [('saved_states', String(data='save' if kind is SaveState else 'load'))
                      for _ in group]
        elif kind is SetState:
            found += [(f'cloth/{c.cloth}/set_state', cloud_of(c.positions, frame_id, time_ns))
                      for c in group]
    return found


def _batch(command) -> tuple:
    kind = type(command)
    if kind in (MovePin, MoveCollider):
        return kind, command.stamp_ns, command.twist is None
    if kind in (RemoveCollider, RemoveAllColliders):
        kind = PlaceCollider
    return (Grasp if kind in (Release, ReleaseAll) else kind,)


def _marker(command, frame_id: str, time_ns: int) -> Marker:
    marker = stamped(Marker(type=Marker.SPHERE), frame_id, time_ns)
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
    marker = stamped(Marker(ns=getattr(command, 'collider', ''), action=Marker.DELETE), frame_id,
                     time_ns)
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


def _name(command) -> str:
    return getattr(command, 'pin', None) or command.collider


def _of_distinct_names(group) -> list[list]:
    """Return targets in order, a new list before each name that is in the present one."""
    found: list[list] = [[]]
    for command in group:
        if _name(command) in map(_name, found[-1]):
            found.append([])
        found[-1].append(command)
    return found


def _targets(group, frame_id: str) -> MultiDOFJointState:
    message = stamped(MultiDOFJointState(), frame_id, group[0].stamp_ns)
    for command in group:
        message.joint_names.append(_name(command))
        message.transforms.append(Transform(
            translation=vector(Vector3, command.pose.position),
            rotation=quaternion(command.pose.orientation)))
        if command.twist is not None:
            message.twist.append(TwistMessage(linear=vector(Vector3, command.twist.linear),
                                              angular=vector(Vector3, command.twist.angular)))
    return message


def _parameter(command: SetKey) -> Parameter:
    value = command.value
    if isinstance(value, tuple | list):    # of one type in ROS
        floats = any(isinstance(each, float) for each in value)
        value = [float(each) for each in value] if floats else list(value)
    return RclpyParameter(command.key, value=value).to_parameter_msg()
