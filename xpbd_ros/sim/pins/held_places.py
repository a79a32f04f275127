"""Target positions of the particles that a pin holds, within a frame."""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.quaternion import interpolate, rotate


@jit(inline=True)
def place_of(pin, k, s):
    """Return p + R q of a held particle, at a fraction s of the frame."""
    a, b = pin.start[pin.slot[k]], pin.goal[pin.slot[k]]
    qx, qy, qz, qw = interpolate((a[3], a[4], a[5], a[6]), (b[3], b[4], b[5], b[6]), s)
    q = pin.offset[k]
    rx, ry, rz = rotate(qx, qy, qz, qw, q[0], q[1], q[2])
    return (a[0] + s * (b[0] - a[0]) + rx, a[1] + s * (b[1] - a[1]) + ry,
            a[2] + s * (b[2] - a[2]) + rz)
