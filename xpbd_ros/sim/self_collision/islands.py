"""
Islands of squeezed layers (``stacks``), which the threads share out among themselves.

An island is a ``Squeeze`` whose arrays are parts of those of all layers.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, share, wait_uneven
from xpbd_ros.sim.self_collision.springs import Springs
from xpbd_ros.sim.self_collision.squeeze import press_colliders, solve_squeeze, Squeeze
from xpbd_ros.sim.self_collision.squeeze_friction import FrictionalContacts
from xpbd_ros.sim.self_collision.stacks import Stack


@jit
def solve_islands(team, squeeze, near, pairs, state, h):
    """Solve the islands whose middle pair is in this thread's share of the pairs."""
    begin = squeeze.stack.begin
    first, end = share(team, squeeze.stack.count[0])
    for c in range(squeeze.stack.count[2]):
        if first <= (begin[c, 0] + begin[c + 1, 0]) // 2 < end:
            solve_squeeze(island(squeeze, c), near, pairs, state)
    wait_uneven(team)
    if alone(team):
        press_colliders(squeeze, near, state, h)


@jit
def island(squeeze, c):
    """Return island c."""
    stack, begin = squeeze.stack, squeeze.stack.begin
    m, q, t = begin[c]
    n, r, u = begin[c + 1]
    sizes = stack.sizes[c]
    sizes[0], sizes[1] = n - m, r - q
    part = Stack(sizes, stack.begin, stack.sizes, stack.pairs[m:n], stack.particles[q:r],
                 stack.place, stack.close, stack.axis, stack.behind, stack.since, stack.low,
                 stack.high, stack.about, stack.island, stack.unsorted)
    return Squeeze(squeeze.contacts, part, springs_of(squeeze.springs, c, q, r, t, u),
                   squeeze.deficit[t:u], squeeze.y[q:r], squeeze.u[q:r], squeeze.start[q:r],
                   squeeze.given[q:r], squeeze.moved[q:r], contacts_of(squeeze.frictional, t, u),
                   squeeze.friction, squeeze.again)


@jit(inline=True)
def springs_of(springs, c, q, r, t, u):
    """Return the springs t to u, of island c with the particles q to r."""
    return Springs(springs.count[c], springs.ends[t:u], springs.weight[t:u],
                   springs.stiffness[t:u], springs.active[t:u], springs.mass[q:r],
                   springs.axis[q:r], springs.x[3 * q:3 * r], springs.residual[3 * q:3 * r],
                   springs.diagonal[q:r], springs.step[3 * q:3 * r],
                   springs.direction[3 * q:3 * r], springs.preconditioned[3 * q:3 * r],
                   springs.product[3 * q:3 * r])


@jit(inline=True)
def contacts_of(frictional, t, u):
    """Return the frictional contacts t to u."""
    return FrictionalContacts(frictional.holds[t:u], frictional.slides[t:u], frictional.axis[t:u],
                              frictional.carried[t:u], frictional.slip[t:u])
