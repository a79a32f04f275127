"""Wrenches of the cloth on pins, from the constraint forces on pinned particles."""

from xpbd_ros.sim.backend.jit import jit


@jit(inline=True)
def deliver(pin, k, axis, f, part, a, b, share):
    """Add the impulse J of a force f on a held particle, ``part`` of the mean over the frame."""
    i = pin.particle[k]
    now = share * f + a * pin.last[i, axis] - b * pin.older[i, axis]
    pin.older[i, axis], pin.last[i, axis] = pin.last[i, axis], now
    pin.force[k, axis] += part * now


@jit
def weigh_pinned(pin, state, v_before, dt, wrench):
    """Add Σ f + Σ m (g - a) and its torque to each pin's wrench, (max_pins, 6) [N, N m]."""
    m, v, g = state.mass, state.v, state.gravity
    for k in range(pin.count[0]):
        i, f = pin.particle[k], pin.force[k]
        add_wrench(pin, state.x, k, (
            f[0] + m[i] * (g[0] - (v[0, i] - v_before[0, k]) / dt),
            f[1] + m[i] * (g[1] - (v[1, i] - v_before[1, k]) / dt),
            f[2] + m[i] * (g[2] - (v[2, i] - v_before[2, k]) / dt)), wrench)


@jit
def weigh_springs(spring, state, wrench):
    """Add the forces of the springs and their torque to each pin's wrench."""
    for k in range(spring.pin.count[0]):
        f = spring.pin.force[k]
        add_wrench(spring.pin, state.x, k, (f[0], f[1], f[2]), wrench)


@jit(inline=True)
def add_wrench(pin, x, k, f, wrench):
    """Add a force at a held particle, and its torque about the pin's pose at the frame's end."""
    i, total, p = pin.particle[k], wrench[pin.slot[k]], pin.goal[pin.slot[k]]
    rx, ry, rz = x[0, i] - p[0], x[1, i] - p[1], x[2, i] - p[2]
    total[0] += f[0]
    total[1] += f[1]
    total[2] += f[2]
    total[3] += ry * f[2] - rz * f[1]
    total[4] += rz * f[0] - rx * f[2]
    total[5] += rx * f[1] - ry * f[0]
