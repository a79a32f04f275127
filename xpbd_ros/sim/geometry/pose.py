"""Composition, inversion and interpolation of poses; IEEE operations only, like ``quaternion``."""

from math import sqrt

from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.quaternion import conjugate, interpolate, multiply, rotate


def compose(outer: Pose, inner: Pose) -> Pose:
    """Return a pose given in the axes of ``outer``, in those that ``outer`` is given in."""
    x, y, z = rotate.py_func(*outer.orientation, *inner.position)
    a, b, c = outer.position
    return Pose((a + x, b + y, c + z), unit(multiply(outer.orientation, inner.orientation)))


def unit(q) -> tuple[float, float, float, float]:
    """Return a quaternion with length 1; one of length 0 or not finite as it is."""
    n = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / n, q[1] / n, q[2] / n, q[3] / n) if n > 0.0 else tuple(q)


def from_matrix(matrix) -> Pose:
    """Return the pose of a homogeneous transform, shape (4, 4), by its largest component."""
    m = [[float(c) for c in row] for row in matrix]
    trace = m[0][0] + m[1][1] + m[2][2]
    i = max(range(3), key=lambda k: m[k][k])
    if trace >= m[i][i]:
        q = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1.0 + trace]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q = [0.0, 0.0, 0.0, m[k][j] - m[j][k]]
        q[i] = 1.0 + m[i][i] - m[j][j] - m[k][k]
        q[j], q[k] = m[j][i] + m[i][j], m[k][i] + m[i][k]
    return Pose((m[0][3], m[1][3], m[2][3]), unit(q))


def inverse(pose: Pose) -> Pose:
    """Return the pose of the outer axes in those of ``pose``."""
    q = conjugate(pose.orientation)
    x, y, z = rotate.py_func(*q, *pose.position)
    return Pose((-x, -y, -z), q)


def interpolated(a: Pose, b: Pose, s: float) -> Pose:
    """Return the pose at fraction s from a to b: linear, with the quaternion normalised."""
    x, y, z = (p + s * (q - p) for p, q in zip(a.position, b.position))
    return Pose((x, y, z), interpolate.py_func(a.orientation, b.orientation, s))
