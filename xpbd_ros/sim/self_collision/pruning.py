"""
Dynamic pruning: the listed pairs that may be near in the next substeps come first in the list.

The rest of the list is not read until a particle's motion since the pruning exceeds its inner
margin; then all listed pairs are compared again, which costs much less than a search (S. Páll,
B. Hess, "A flexible algorithm for calculating pair interactions on SIMD architectures", 2013, and
the dual lists of GROMACS).
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import bits, lanes
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, assigned, turns, wait_uneven
from xpbd_ros.sim.self_collision.list_order import bring_forward
from xpbd_ros.sim.self_collision.near_pairs import packs_of, within
from xpbd_ros.sim.self_collision.neighbour_list import (
    any_thread,
    EDGES,
    empty_groups,
    gone,
    gone_since,
    POINTS,
    rounding_of,
    TRAVEL,
    TRIANGLES,
    UP,
)

SUBSTEPS = 4.0
"""substeps of the present motion for which the pairs in front are complete"""
LEAST = 0.25
"""least motion for which they are, relative to the thickness"""
MANY = 0.5
"""share of unpruned pairs in front from which on pruning pays"""


@jit
def is_front_incomplete(team, near):
    """Return True if a particle's travel and motion since the pruning exceed its inner margin."""
    found = False
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        moved = gone_since(near.x, near.pruned, near.drift, i)
        if near.x[i, TRAVEL] + moved > near.inner[i]:
            found = True
            break
    return any_thread(team, near, found)


@jit
def has_many_new(near):
    """Return True if many pairs in front have not been pruned since the search for them."""
    pairs = 0
    for kind in range(3):
        pairs += near.kind_front[kind] - near.kind_begin[kind]
    return near.unpruned[0] > MANY * pairs


@jit
def prune(team, near, x, thickness):
    """
    Bring the pairs closer than they have to keep + inner margins to the front of each kind.

    Parameters
    ----------
    team : threads that take part
    near : neighbour list
    x : present positions [m], shape (3, slots)
    thickness : [m]

    """
    load_inner_margins(team, near, x, LEAST * thickness)
    find_front(team, near, POINTS, thickness)
    find_front(team, near, TRIANGLES, thickness)
    find_front(team, near, EDGES, thickness)
    wait_uneven(team)
    if assigned(team, 0):
        for kind in range(3):
            bring_forward(team, near, kind)
    if alone(team):
        near.unpruned[0] = 0
    empty_groups(team, near)
    wait_uneven(team)


@jit
def load_inner_margins(team, near, x, least):
    """Set the inner margins, and load them with the positions at the substep's start."""
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        moved = gone(x, near.x, near.step, near.slot[i], i)
        near.inner[i] = min(near.margin[i], near.x[i, TRAVEL] + max(SUBSTEPS * moved, least))
        for a in range(3):
            near.pruned[i, a] = near.x[i, a] - near.drift[a]
            near.start[i, a] = near.x[i, a] - near.origin[a]
    wait_uneven(team)
    rounding = rounding_of(near)
    for i in range(first, end, step):
        near.start[i, TRAVEL] = UP * near.inner[i] + rounding
    wait_uneven(team)


@jit(inline=True)
def find_front(team, near, kind, thickness):
    """Set ``hits`` for this thread's part of a kind's pairs, in front or not."""
    end = near.kind_end[kind]
    first, last, step = packs_of(team, near.kind_begin[kind], end)
    for pack in range(first, last, step):
        found = 0
        for q in range(pack, pack + PACK, lanes(near.start)):
            found |= bits(within(near, kind, q, thickness, 0.0)[0]) << (q - pack)
        near.hits[pack // PACK] = found & ((1 << min(PACK, end - pack)) - 1)
