"""The order of particles in memory and in results."""

import numpy as np


def natural_indices(simulation) -> np.ndarray:
    """Return the natural index of the particle in each slot, shape (slots,); -1 if it is empty."""
    found = np.full(len(simulation.state.mass), -1)
    found[simulation.slot] = np.arange(len(simulation.slot))
    return found
