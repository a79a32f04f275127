"""Wrenches of the cloth on pins, from the constraint forces on pinned particles."""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.pins.held_places import place_of


@jit(inline=True)
def deliver(pin, k, axis, f, part, a, b, share):
    """Add J / h of a force f on a held particle; ``share``, a and b are those of its history."""
    i = pin.particle[k]
    now = share * f + a * pin.last[i, axis] - b * pin.older[i, axis]
    pin.older[i, axis], pin.last[i, axis] = pin.last[i, axis], now
    pin.force[k, axis] += part * now


@jit
def weigh_pinned(pin, state, v_before, dt, rate, wrench):
    """
    Add Σ f + Σ m (g - a - rate v) and its torque to each pin's wrench, (max_pins, 6) [N, N m].

    ``rate`` is that of ``damping`` [1/s], v the mean velocity in the frame.
    """
    m, v, g = state.mass, state.v, state.gravity
    for k in range(pin.count[0]):
        i, f = pin.particle[k], pin.force[k]
        now, before = place_of(pin, k, 1.0), place_of(pin, k, 0.0)
        add_wrench(pin, k, (
            f[0] + m[i] * (g[0] - (v[0, i] - v_before[0, k] + rate * (now[0] - before[0])) / dt),
            f[1] + m[i] * (g[1] - (v[1, i] - v_before[1, k] + rate * (now[1] - before[1])) / dt),
            f[2] + m[i] * (g[2] - (v[2, i] - v_before[2, k] + rate * (now[2] - before[2])) / dt)),
            wrench)


@jit
def weigh_springs(spring, wrench):
    """Add the forces of the springs and their torque to each pin's wrench."""
    for k in range(spring.pin.count[0]):
        f = spring.pin.force[k]
        add_wrench(spring.pin, k, (f[0], f[1], f[2]), wrench)


@jit
def work_of(pin):
    """Return a bound of the work of moving pins in a frame, by the mean forces on them [J]."""
    found = 0.0
    for k in range(pin.count[0]):
        f, now, before = pin.force[k], place_of(pin, k, 1.0), place_of(pin, k, 0.0)
        found += abs(f[0] * (now[0] - before[0]) + f[1] * (now[1] - before[1])
                     + f[2] * (now[2] - before[2]))
    return found


@jit(inline=True)
def add_wrench(pin, k, f, wrench):
    """
    Add a mean force over the frame at a held particle, and its torque about the pin's position.

    The arm R q is that in the middle of the frame: a pin that turns by θ in a frame has turned by
    θ / 2 past the direction of a mean force that turns with it.
    """
    slot = pin.slot[k]
    x, y, z = place_of(pin, k, 0.5)
    total, p, q = wrench[slot], pin.start[slot], pin.goal[slot]
    rx, ry, rz = x - 0.5 * (p[0] + q[0]), y - 0.5 * (p[1] + q[1]), z - 0.5 * (p[2] + q[2])
    total[0] += f[0]
    total[1] += f[1]
    total[2] += f[2]
    total[3] += ry * f[2] - rz * f[1]
    total[4] += rz * f[0] - rx * f[2]
    total[5] += rx * f[1] - ry * f[0]
