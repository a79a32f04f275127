"""
Unit quaternions (x, y, z, w) as plain floats; IEEE operations alone, so same bits anywhere.

``turn`` is only told to people: it takes an arc tangent, and nothing moves by it.
"""

from math import atan2, sqrt

import numpy as np

from xpbd_ros.sim.jit import jit


@jit(inline=True)
def rotate(qx, qy, qz, qw, x, y, z):
    """Rotate a vector: v + 2 w (q × v) + 2 q × (q × v)."""
    tx = 2.0 * (qy * z - qz * y)
    ty = 2.0 * (qz * x - qx * z)
    tz = 2.0 * (qx * y - qy * x)
    return (x + qw * tx + qy * tz - qz * ty,
            y + qw * ty + qz * tx - qx * tz,
            z + qw * tz + qx * ty - qy * tx)


@jit
def interpolate(p, q, s):
    """Return the orientation a fraction s of the short way from p to q (normalised lerp)."""
    sign = 1.0 if p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3] >= 0.0 else -1.0
    x = p[0] + s * (sign * q[0] - p[0])
    y = p[1] + s * (sign * q[1] - p[1])
    z = p[2] + s * (sign * q[2] - p[2])
    w = p[3] + s * (sign * q[3] - p[3])
    n = sqrt(x * x + y * y + z * z + w * w)
    return x / n, y / n, z / n, w / n


def from_z_axis(normal) -> tuple[float, float, float, float]:
    """Return the shortest rotation that takes z to a direction (not zero, of any length)."""
    largest = max(abs(c) for c in normal)
    x, y, z = (c / largest for c in normal)
    n = sqrt(x * x + y * y + z * z)
    x, y, z = x / n, y / n, z / n
    square = x * x + y * y
    if z < 0.0 and square < 1e-200:
        return 1.0, 0.0, 0.0, 0.0
    w = sqrt(0.5 * (1.0 + z if z >= 0.0 else square / (1.0 - z)))
    return -0.5 * y / w, 0.5 * x / w, 0.0, w


def multiply(a, b) -> tuple[float, float, float, float]:
    """Return the rotation b followed by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz)


def turn(a, b) -> np.ndarray:
    """Return the rotation from a to b, the shorter way, as axis times angle [rad]."""
    x, y, z, w = multiply(b, conjugate(a))
    sine = sqrt(x * x + y * y + z * z)
    angle = 2.0 * atan2(sine, abs(w)) * (1.0 if w >= 0.0 else -1.0)
    return np.array((x, y, z)) * (angle / sine if sine > 0.0 else 0.0)


def conjugate(q) -> tuple[float, float, float, float]:
    """Return the inverse of a unit quaternion."""
    return -q[0], -q[1], -q[2], q[3]
