"""
Unit quaternions (x, y, z, w) as floats, with IEEE operations only: same bits on all platforms.

The exception is ``turns``, which needs an arc tangent and is used for output only.
"""

from math import sqrt

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import cross

SHORT = 0.125
"""largest component of a rotation vector whose exponential is evaluated by its series [rad]"""
TERMS = 12
"""number of terms of the series; the truncation error is below the last bit"""


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
    """Return the orientation at fraction s of the shorter arc from p to q (normalised lerp)."""
    sign = 1.0 if p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3] >= 0.0 else -1.0
    x = p[0] + s * (sign * q[0] - p[0])
    y = p[1] + s * (sign * q[1] - p[1])
    z = p[2] + s * (sign * q[2] - p[2])
    w = p[3] + s * (sign * q[3] - p[3])
    n = sqrt(x * x + y * y + z * z + w * w)
    return x / n, y / n, z / n, w / n


def from_z_axis(normal) -> tuple[float, float, float, float]:
    """Return the shortest rotation from the z axis to a direction (nonzero, of any length)."""
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
    """Return the product a b: rotation by b, then by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz)


def turns(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return rotation vectors of the shorter rotations from a to b [rad], shape (n, 3)."""
    x, y, z, w = multiply(b.T, conjugate(a.T))
    sine = np.sqrt(x * x + y * y + z * z)
    angle = 2.0 * np.arctan2(sine, np.abs(w)) * np.where(w >= 0.0, 1.0, -1.0)
    share = np.divide(angle, sine, out=np.zeros_like(sine), where=sine > 0.0)
    return np.stack([x, y, z], 1) * share[:, None]


product = jit(multiply, inline=True)
"""``multiply`` for kernels"""


@jit
def flow(w, v):
    """
    Return the rotation q and translation t such that r' = w × r + v takes r to q r + t in time 1.

    Exponential map of a twist by scaling and squaring: the series over a time step of 2⁻ⁿ, in
    which no component of w exceeds SHORT, then n doublings.
    """
    doublings, size = 0, max(abs(w[0]), abs(w[1]), abs(w[2]))
    while size > SHORT:
        w, v = (0.5 * w[0], 0.5 * w[1], 0.5 * w[2]), (0.5 * v[0], 0.5 * v[1], 0.5 * v[2])
        doublings, size = doublings + 1, 0.5 * size
    t = v
    for n in range(TERMS, 1, -1):    # v + w × v / 2! + w × (w × v) / 3! …
        a = cross(w, t)
        t = v[0] + a[0] / n, v[1] + a[1] / n, v[2] + a[2] / n
    s = 0.25 * (w[0] * w[0] + w[1] * w[1] + w[2] * w[2])    # square of half the angle
    sine, cosine = 1.0, 1.0
    for n in range(TERMS, 1, -2):
        sine, cosine = 1.0 - s / (n * (n + 1)) * sine, 1.0 - s / (n * (n - 1)) * cosine
    q = 0.5 * sine * w[0], 0.5 * sine * w[1], 0.5 * sine * w[2], cosine
    for _ in range(doublings):
        a = rotate(q[0], q[1], q[2], q[3], t[0], t[1], t[2])
        t = t[0] + a[0], t[1] + a[1], t[2] + a[2]
        q = product(q, q)
        n = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        q = q[0] / n, q[1] / n, q[2] / n, q[3] / n
    return q, t


def conjugate(q) -> tuple[float, float, float, float]:
    """Return the inverse of a unit quaternion."""
    return -q[0], -q[1], -q[2], q[3]
