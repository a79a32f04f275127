"""
Dynamic pruning: the listed pairs that may be near in the next substeps come first in the list.

The rest of the list is not read until a particle's motion since the pruning exceeds its inner
margin; then all listed pairs are compared again, which costs much less than a search (S. Páll,
B. Hess, "A flexible algorithm for calculating pair interactions on SIMD architectures", 2013, and
the dual lists of GROMACS).
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, turns, wait_uneven
from xpbd_ros.sim.self_collision.list_order import bring_forward
from xpbd_ros.sim.self_collision.near_pairs import find_front, FRONT
from xpbd_ros.sim.self_collision.neighbour_list import (
    EDGES,
    empty_groups,
    POINTS,
    rounding_of,
    TRAVEL,
    TRIANGLES,
)

MANY = 0.5
"""share of unpruned pairs in front from which on pruning pays"""


@jit
def has_many_new(near):
    """Return True if many pairs in front have not been pruned since the search for them."""
    pairs = 0
    for kind in range(3):
        pairs += near.kind_front[kind] - near.kind_begin[kind]
    return near.unpruned[0] > MANY * pairs


@jit
def prune(team, near, thickness):
    """
    Bring the pairs closer than they have to keep + FRONT travels to the front of each kind.

    ``hits`` is set to the near ones.
    """
    set_inner_margins(team, near)
    find_front(team, near, POINTS, thickness)
    find_front(team, near, TRIANGLES, thickness)
    find_front(team, near, EDGES, thickness)
    wait_uneven(team)
    for kind in range(3):
        bring_forward(team, near, kind)
    if alone(team):
        near.unpruned[0] = 0
    empty_groups(team, near)
    wait_uneven(team)


@jit
def set_inner_margins(team, near):
    """Set the inner margins, from the positions at the substep's start on."""
    rounding = rounding_of(near)
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        near.inner[i] = min(near.margin[i], FRONT * near.x[i, TRAVEL] - rounding)
        for a in range(3):
            near.pruned[i, a] = near.x[i, a] - near.drift[a]
