"""Contact in the last iteration of a substep only (``effects.contact.when: after``)."""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, wait


@jit
def begin_waiting(done):
    """Reset the count of iterations."""
    if done is not None:
        done[0] = 0


@jit(inline=True)
def waits(done, team):
    """Tell whether contact waits for a later iteration."""
    if done is None:
        return False
    else:    # Numba prunes the branch that is not taken
        begun = done[0] + 1
        wait(team)    # until all have read it
        if alone(team):
            done[0] = begun
        return begun < done[1]
