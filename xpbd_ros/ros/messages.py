"""
Encode frames as messages: one buffer per topic, allocated once and filled each frame.

The same bytes are published and logged. The layout of a serialized message (CDR) does not change
while the counts in it stay the same, so it is serialized once, with marker values that are then
found in the bytes and overwritten each frame.
"""

from collections.abc import Mapping
import re
import struct
from types import MappingProxyType
from typing import Any, TypeVar

from geometry_msgs.msg import (
    Point,
    Quaternion,
    Transform,
    Twist,
    Vector3,
    Wrench,
    WrenchStamped,
)
import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from xpbd_ros.sim.contact.collider_states import ColliderStates
from xpbd_ros.sim.effect import Cloth
from xpbd_ros.sim.pins.states import PinState, PinStates

COLOURS = ((0.85, 0.35, 0.28), (0.25, 0.5, 0.75), (0.45, 0.65, 0.35), (0.8, 0.65, 0.3))
RAMP = (0.15, 0.3, 0.75), (0.95, 0.95, 0.95), (0.8, 0.1, 0.1)
"""blue, white, red"""
MARK = b'\xa5\x5a\xc3\x3c'
STAMP_MARK = 0x5ac33ca5, 0x3ca55ac3
"""seconds and nanoseconds"""
HEADER = b'\0\1\0\0'
"""of a serialized message: little-endian CDR"""

Message = TypeVar('Message', bound=Any)


def set_stamp(stamp, time_ns: int) -> None:
    """Set a builtin_interfaces/Time to a time [ns]."""
    stamp.sec, stamp.nanosec = divmod(time_ns, 10**9)


def stamped(message: Message, frame_id: str, time_ns: int) -> Message:
    """Return a message with its header filled in."""
    message.header.frame_id = frame_id
    set_stamp(message.header.stamp, time_ns)
    return message


def vector(kind, values):
    """Return a Point or Vector3 (``kind``) with these coordinates."""
    x, y, z = (float(c) for c in values)
    return kind(x=x, y=y, z=z)


def quaternion(values) -> Quaternion:
    """Return a Quaternion from x, y, z, w."""
    x, y, z, w = (float(c) for c in values)
    return Quaternion(x=x, y=y, z=z, w=w)


class Cloud:
    """
    A point cloud of one cloth, such as ``~/particles``.

    A grid's cloud is organized, with rows along weft and columns along warp; a mesh's has one row.

    Parameters
    ----------
    cloth : whose particles
    frame_id : TF frame
    names : fields, separated by spaces
    dtype : of all fields
    kinds : datatypes of fields that are bits in numbers of this dtype, by name

    """

    def __init__(self, cloth: Cloth, frame_id: str, names: str = 'x y z', dtype=np.float32,
                 kinds: Mapping[str, int] = MappingProxyType({})):
        columns = names.split()
        message = PointCloud2()
        message.header.frame_id = frame_id
        grid = cloth.mesh.grid
        message.height, message.width = (1, len(cloth.slots)) if grid is None else grid.shape
        size = np.dtype(dtype).itemsize
        kind = PointField.FLOAT32 if size == 4 else PointField.FLOAT64
        message.fields = [PointField(name=name, offset=size * k,
                                     datatype=kinds.get(name, kind), count=1)
                          for k, name in enumerate(columns)]
        message.point_step = size * len(columns)
        message.row_step = message.point_step * message.width
        message.is_dense = True
        length = message.row_step * message.height
        message.data.frombytes(MARK * (length // len(MARK)))
        self.cloth = cloth
        self._buffer = bytearray(serialize_message(message))
        at = self._buffer.find(MARK * (length // len(MARK)))
        self._points = np.frombuffer(self._buffer, dtype, length // size, at).reshape(
            -1, len(columns))

    def bytes(self, values: np.ndarray, time_ns: int) -> bytes:
        """Return the serialized message; ``values`` has shape (particles of the cloth, fields)."""
        struct.pack_into('<iI', self._buffer, 4, *divmod(time_ns, 10**9))
        self._points[:] = values
        return bytes(self._buffer)


class Surface:
    """
    The surface of one cloth as a TRIANGLE_LIST marker, for ``~/markers``.

    Parameters
    ----------
    cloth : whose triangles
    index : its number among the cloths
    frame_id : TF frame
    coloured : True if each particle has a colour

    """

    def __init__(self, cloth: Cloth, index: int, frame_id: str, *, coloured: bool = False):
        triangles = cloth.mesh.triangles + cloth.first
        marker = Marker(ns=cloth.name, id=index, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
        marker.header.frame_id = frame_id
        marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
        r, g, b = COLOURS[index % len(COLOURS)]
        marker.color = ColorRGBA(r=r, g=g, b=b, a=1.0)
        mark, hue = Point(x=1.25e300, y=-1.25e300, z=1.5e300), ColorRGBA(r=1.25e30, g=-1.5e30)
        marker.points = [mark] * (3 * len(triangles))
        marker.colors = [hue] * (3 * len(triangles) * coloured)
        self._corners = triangles.ravel()
        data = serialize_message(MarkerArray(markers=[marker]))
        at = data.find(struct.pack('<ddd', mark.x, mark.y, mark.z))
        count = 3 * len(self._corners) if at >= 0 else 0
        self._buffer = _aligned(data, max(at, 0))
        self._points = np.frombuffer(self._buffer, '<f8', count, max(at, 0)).reshape(-1, 3)
        at = data.find(struct.pack('<ff', hue.r, hue.g))
        count = 4 * len(self._corners) if at >= 0 else 0
        self._colours = np.frombuffer(self._buffer, '<f4', count, max(at, 0)).reshape(-1, 4)

    def bytes(self, x: np.ndarray, time_ns: int, colours: np.ndarray | None = None) -> bytes:
        """
        Return a serialized MarkerArray.

        Parameters
        ----------
        x : positions of all particles of the scene [m], shape (particles, 3)
        time_ns : stamp [ns]
        colours : r, g, b, a of all particles of the scene if coloured, shape (particles, 4)

        """
        struct.pack_into('<iI', self._buffer.data, 8, *divmod(time_ns, 10**9))
        if len(self._points):
            np.take(x, self._corners, axis=0, out=self._points, mode='clip')
        if colours is not None and len(self._colours):
            np.take(colours, self._corners, axis=0, out=self._colours, mode='clip')
        return self._buffer.tobytes()


def _aligned(data: bytes, at: int) -> np.ndarray:
    """Return a copy of bytes whose offset ``at`` is at a multiple of 8 in memory."""
    memory = np.empty(len(data) + 8, np.uint8)
    first = -(memory.ctypes.data + at) % 8
    memory[first:first + len(data)] = np.frombuffer(data, np.uint8)
    return memory[first:first + len(data)]


def colours(values: np.ndarray, least: float) -> np.ndarray:
    """
    Return colours from blue (0) over white to red (the largest value).

    Parameters
    ----------
    values : >= 0, shape (n,)
    least : the largest value is taken to be at least this

    Returns
    -------
    r, g, b, a; shape (n, 4)

    """
    share = values / max(least, float(values.max(initial=0.0)))
    found = np.ones((len(values), 4), np.float32)
    for k, stops in enumerate(zip(*RAMP)):
        found[:, k] = np.interp(share, np.linspace(0.0, 1.0, len(RAMP)), stops)
    return found


class ForceMarkers:
    """
    An arrow for the cloth's force on each body (10 cm per 1 N), and a ball at each pin.

    Parameters
    ----------
    frame_id : TF frame
    arrows : namespace of the arrows
    balls : namespace of the balls; '' for none

    """

    def __init__(self, frame_id: str, arrows: str, balls: str = ''):
        self._frame_id = frame_id
        self._arrows, self._balls = arrows, balls
        self._lay_out(())

    def _lay_out(self, numbers: tuple[int, ...]) -> None:
        # RViz clears one namespace per DELETEALL, and accepts each (ns, id) once per message.
        markers = [Marker(ns=each, id=-1, action=Marker.DELETEALL)
                   for each in (self._balls, self._arrows) if each]
        tail, tip, centre = Point(x=1.25e300), Point(x=-1.25e300), Point(x=1.5e300)
        for number in numbers:
            if self._balls:
                ball = Marker(ns=self._balls, id=number, type=Marker.SPHERE, action=Marker.ADD)
                ball.pose.position = centre
                ball.scale = Vector3(x=0.025, y=0.025, z=0.025)
                ball.color = ColorRGBA(r=0.95, g=0.75, b=0.1, a=1.0)
                markers.append(ball)
            arrow = Marker(ns=self._arrows, id=number, type=Marker.ARROW, action=Marker.ADD)
            arrow.points = [tail, tip]
            arrow.scale = Vector3(x=0.006, y=0.015, z=0.02)
            arrow.color = ColorRGBA(r=0.1, g=0.1, b=0.1, a=0.9)
            markers.append(arrow)
        for marker in markers:
            marker.header.frame_id = self._frame_id
            marker.header.stamp.sec, marker.header.stamp.nanosec = STAMP_MARK
        self._numbers, self._buffer = numbers, bytearray(
            serialize_message(MarkerArray(markers=markers)))
        self._stamps = self._places('<iI', *STAMP_MARK)
        self._tails, self._centres = (self._places('<d', mark.x) for mark in (tail, centre))

    def _places(self, form: str, *values) -> list[int]:
        """Return the offsets of all occurrences of values [bytes]."""
        return [found.start() for found in re.finditer(re.escape(struct.pack(form, *values)),
                                                       self._buffer)]

    def _filled(self, numbers: tuple[int, ...], places: np.ndarray, forces: np.ndarray,
                time_ns: int) -> bytes:
        """
        Return a serialized MarkerArray.

        Parameters
        ----------
        numbers : id of each body
        places : where the forces act [m], shape (bodies, 3)
        forces : [N], shape (bodies, 3)
        time_ns : stamp [ns]

        """
        if numbers != self._numbers:
            self._lay_out(numbers)
        stamp = divmod(time_ns, 10**9)
        for at in self._stamps:
            struct.pack_into('<iI', self._buffer, at, *stamp)
        for at, place in zip(self._centres, places.tolist()):
            struct.pack_into('<3d', self._buffer, at, *place)
        for at, ends in zip(self._tails, np.hstack([places, places + 0.1 * forces]).tolist()):
            struct.pack_into('<6d', self._buffer, at, *ends)
        return bytes(self._buffer)

    def of_pins(self, pins: PinStates, time_ns: int) -> bytes:
        """Return the serialized markers of all pins."""
        return self._filled(tuple(range(len(pins))), pins.poses[:, :3], pins.wrenches[:, :3],
                            time_ns)

    def of_colliders(self, colliders: ColliderStates, time_ns: int) -> bytes:
        """Return the serialized arrows of the colliders that the cloth touches."""
        forces, torques = colliders.wrenches[:, :3], colliders.wrenches[:, 3:]
        squares = (forces * forces).sum(axis=1)
        touched = np.flatnonzero(squares)
        arms = np.cross(forces, torques)[touched] / squares[touched, None]    # to the lines
        return self._filled(tuple(touched.tolist()), arms + colliders.poses[touched, :3],
                            forces[touched], time_ns)


def mesh_message(cloth: Cloth, x: np.ndarray) -> Mesh:
    """Return the initial vertices ``x`` [m] and the triangles of one cloth."""
    return Mesh(
        vertices=[vector(Point, row) for row in x[cloth.particles].tolist()],
        triangles=[MeshTriangle(vertex_indices=np.array(row, np.uint32))
                   for row in cloth.mesh.triangles])


class BodyArray:
    """``~/pin_states``, ``~/collider_wrenches``: pose, twist and wrench of the cloth of each."""

    MARKS = 1.25e300, -1.25e300, 1.5e300    # first numbers of poses, twists and wrenches

    def __init__(self, frame_id: str):
        self._frame_id = frame_id
        self._lay_out(())

    def _lay_out(self, names: tuple[str, ...]) -> None:
        pose, velocity, wrench = (Vector3(x=mark) for mark in self.MARKS)
        count = len(names)
        message = MultiDOFJointState(
            joint_names=names, transforms=[Transform(translation=pose)] * count,
            twist=[Twist(linear=velocity)] * count, wrench=[Wrench(force=wrench)] * count)
        message.header.frame_id = self._frame_id
        self._names, self._buffer = names, bytearray(serialize_message(message))
        self._poses, self._twists, self._wrenches = (
            np.frombuffer(self._buffer, '<f8', width * count,
                          max(0, self._buffer.find(struct.pack('<d', mark)))).reshape(count, width)
            for mark, width in zip(self.MARKS, (7, 6, 6)))

    def bytes(self, bodies: PinStates | ColliderStates, time_ns: int) -> bytes:
        """Return the serialized message."""
        if bodies.names != self._names:
            self._lay_out(bodies.names)
        struct.pack_into('<iI', self._buffer, 4, *divmod(time_ns, 10**9))
        self._poses[:], self._twists[:] = bodies.poses, bodies.twists
        self._wrenches[:] = bodies.wrenches
        return bytes(self._buffer)


def pin_wrench(pin: PinState | None, frame_id: str, time_ns: int) -> WrenchStamped:
    """Return the wrench of the cloth on a pin, about its pose; 0 for one that holds nothing."""
    message = stamped(WrenchStamped(), frame_id, time_ns)
    if pin is not None:
        message.wrench = Wrench(force=vector(Vector3, pin.force),
                                torque=vector(Vector3, pin.torque))
    return message


def text(value: str) -> String:
    """Return a String."""
    return String(data=value)


def number(value: int) -> bytes:
    """Return a serialized UInt64."""
    return HEADER + value.to_bytes(8, 'little')
