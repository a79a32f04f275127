"""
The further turn: where pads press, cloth and colliders are projected once more in an iteration.

Pair contacts and contacts alternate, and one turn transmits only about 1 / κ of the force between
pads (κ: ``contact.pads``). So in a further turn, layers of cloth between a pad and another
collider are solved together with these (``squeeze``).
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, wait_uneven
from xpbd_ros.sim.self_collision.islands import solve_islands
from xpbd_ros.sim.self_collision.stacks import list_stack


@jit
def begin_first_turn(team, squeeze):
    """Tell pads that a further turn may follow."""
    if squeeze is not None and alone(team):
        squeeze.contacts.pads.again[0] = True


@jit
def begin_turn(squeeze, turn):
    """Begin the further turn if pads press; return False if there is none."""
    if squeeze is None:
        return False
    else:    # Numba prunes the branch that is not taken
        contacts = squeeze.contacts
        contacts.pads.again[0] = False
        squeeze.again[0] = turn == 1 and presses(contacts)
        return squeeze.again[0]


@jit(inline=True)
def presses(contacts):
    """Return True if a pad pushes a particle."""
    found = False
    for k in range(contacts.count[0]):
        found |= contacts.pads.soft[k] and contacts.push[k] > 0.0
    return found


@jit(inline=True)
def is_further_turn(squeeze):
    """Return True in the further turn."""
    if squeeze is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return squeeze.again[0]


@jit
def squeeze_layers(squeeze, near, pairs, state, thickness, h):
    """List the layers that pads squeeze, and solve them."""
    if squeeze is not None:
        team, stack = state.team, squeeze.stack
        list_stack(team, stack, squeeze.contacts, near, pairs, state, thickness, h)
        if stack.count[0] > 0:
            solve_islands(team, squeeze, near, pairs, state, h)
        wait_uneven(team)
