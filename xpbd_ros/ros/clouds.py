"""Positions in point clouds: read from messages of any layout, and written as float64."""

from array import array
from collections.abc import Sequence

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField

from xpbd_ros.errors import InputError
from xpbd_ros.ros.messages import stamped
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.quaternion import rotate

KINDS = {PointField.FLOAT32: 'f4', PointField.FLOAT64: 'f8'}
"""types that coordinates may have"""


def points_of(message: PointCloud2) -> np.ndarray:
    """
    Return the positions of a cloud [m], shape (height, width, 3); NaN where a point is missing.

    Raises
    ------
    InputError : no x, y, z of type float32 or float64, or sizes that contradict each other

    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in 'xyz' if name not in fields]
    if missing:
        raise InputError(f'fields: no {", ".join(missing)} (there are: '
                         f'{", ".join(fields)[:80] or "none"})')
    order = '>' if message.is_bigendian else '<'
    for name in 'xyz':
        field = fields[name]
        if field.datatype not in KINDS or field.count != 1:
            raise InputError(f'fields: {name} must be one float32 or float64')
        if field.offset + int(KINDS[field.datatype][1]) > message.point_step:
            raise InputError(f'fields: {name} ends beyond point_step ({message.point_step} bytes)')
    height, width, step = message.height, message.width, message.point_step
    if message.row_step < width * step or height * message.row_step != len(message.data):
        raise InputError(f'{height} rows of {width} points of {step} bytes, row_step '
                         f'{message.row_step}: and there are {len(message.data)} bytes')
    kind = np.dtype({'names': list('xyz'), 'itemsize': step,
                     'formats': [order + KINDS[fields[name].datatype] for name in 'xyz'],
                     'offsets': [fields[name].offset for name in 'xyz']})
    table: np.ndarray = np.ndarray((height, width), kind, bytes(message.data),
                                   strides=(message.row_step, step))
    return np.stack([table[name].astype(float) for name in 'xyz'], axis=-1)


def positions_of(message: PointCloud2) -> np.ndarray:
    """Return the positions of a cloud in one row [m], float32, shape (points, 3)."""
    return points_of(message).reshape(-1, 3).astype(np.float32)


def cloud_of(positions: Sequence[float], frame_id: str, time_ns: int) -> PointCloud2:
    """Return a cloud of one row in float64; ``positions`` are x, y, z of each point [m]."""
    message = stamped(PointCloud2(is_dense=True), frame_id, time_ns)
    _write(message, np.reshape(positions, (1, -1, 3)))
    return message


def transform_points(message: PointCloud2, frame: Pose) -> None:
    """Transform the positions in a cloud by the pose of its TF frame; keep no other fields."""
    points = points_of(message)
    turned = rotate.py_func(*frame.orientation, *np.moveaxis(points, -1, 0))
    _write(message, np.stack(turned, axis=-1) + frame.position)


def _write(message: PointCloud2, points: np.ndarray) -> None:
    """Set the points of a cloud [m], float64, shape (height, width, 3)."""
    message.height, message.width = points.shape[:2]
    message.fields = [PointField(name=name, offset=8 * k, datatype=PointField.FLOAT64, count=1)
                      for k, name in enumerate('xyz')]
    message.is_bigendian = False
    message.point_step, message.row_step = 24, 24 * message.width
    message.data = array('B', np.asarray(points, '<f8').tobytes())
