"""What a state is worth: momentum, energy, strain."""

import numpy as np

from xpbd_ros.sim.mesh import cross, length


def momentum(state) -> np.ndarray:
    """Return Σ m v [kg m/s], shape (3,)."""
    return (state.mass[:, None] * state.v).sum(0)


def angular_momentum(state) -> np.ndarray:
    """Return Σ m x × v about the origin [kg m²/s], shape (3,)."""
    return cross(state.x, state.mass[:, None] * state.v).sum(0)


def kinetic_energy(state) -> float:
    """Return Σ m v² / 2 [J]."""
    return float(0.5 * (state.mass * (state.v**2).sum(1)).sum())


def potential_energy(state) -> float:
    """Return -Σ m g·x [J]."""
    return float(-(state.mass * (state.x * state.gravity).sum(1)).sum())


def largest_strain(simulation) -> float:
    """Return the largest |l - L| / L over the grid edges of all cloths."""
    worst = 0.0
    x = simulation.state.x
    for cloth in simulation.cloths:
        for lines, rest in zip((cloth.grid, cloth.grid.T), cloth.mesh.spacing):
            if lines.shape[1] > 1:
                edges = length(x[lines[:, 1:]] - x[lines[:, :-1]])
                worst = max(worst, float(np.abs(edges / rest - 1.0).max()))
    return worst
