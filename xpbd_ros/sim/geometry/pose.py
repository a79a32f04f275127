"""Composition of poses of rigid bodies; IEEE operations only, like ``quaternion``."""

from math import sqrt

from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.quaternion import multiply, rotate


def compose(outer: Pose, inner: Pose) -> Pose:
    """Return a pose given in the axes of ``outer``, in those that ``outer`` is given in."""
    x, y, z = rotate.py_func(*outer.orientation, *inner.position)
    a, b, c = outer.position
    return Pose((a + x, b + y, c + z), unit(multiply(outer.orientation, inner.orientation)))


def unit(q) -> tuple[float, float, float, float]:
    """Return a quaternion with length 1; one of length 0 or not finite as it is."""
    n = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / n, q[1] / n, q[2] / n, q[3] / n) if n > 0.0 else tuple(q)
