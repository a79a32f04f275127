"""Contact in the last iteration of a substep only (``effects.contact.when: after``)."""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone_on_device, wait_on_device


@jit
def begin_waiting(wait):
    """Reset the count of iterations."""
    if wait is not None:
        wait[0] = 0


@jit(inline=True)
def waits(wait, team):
    """Tell whether contact waits for a later iteration."""
    if wait is None:
        return False
    else:    # Numba prunes the branch that is not taken
        begun = wait[0] + 1
        wait_on_device(team)    # until all have read it
        if alone_on_device(team):
            wait[0] = begun
        return begun < wait[1]
