"""Newton's second law of a whole scene: pins, colliders and gravity against the momentum."""

from typing import NamedTuple

import numpy as np


class Balance(NamedTuple):
    """Forces in each frame of a run."""

    residual: np.ndarray
    """dp/dt - M g + Σ forces of the cloth on pins and colliders - damping [N], (frames, 3)"""
    largest: np.ndarray
    """largest force on a pin or a collider [N], shape (frames,)"""

    def worst(self, window: int = 1) -> float:
        """Return the largest mean of the residual over some frames, per largest force of all."""
        sums = np.cumsum(np.vstack([np.zeros(3), self.residual]), axis=0)
        means = (sums[window:] - sums[:-window]) / window
        return float(np.linalg.norm(means, axis=1).max() / self.largest.max())


def balance(simulation, script) -> Balance:
    """
    Run frames, and return the balance of the forces.

    Parameters
    ----------
    simulation : in it, only gravity and ``damping`` act at a distance
    script : commands of each frame, or a function that takes the frame before and returns them

    """
    mass, dt, frame = simulation.state.mass[simulation.slot], simulation.frame_dt, None
    damping = simulation.effects.get('damping')
    rate = damping.data.rate[0] if damping else 0.0
    frame = simulation.frame()
    before, residual, largest = mass @ frame.v, [], []
    for commands in script:
        frame = simulation.step(commands(frame) if callable(commands) else commands)
        assert not frame.refused
        bodies = [*frame.pins.values(), *frame.colliders.values()]
        forces = np.array([body.force for body in bodies]).reshape(-1, 3)
        now = mass @ frame.v
        residual.append((now - before) / dt - mass.sum() * simulation.state.gravity
                        + forces.sum(axis=0) + 0.5 * rate * (now + before))
        largest.append(np.linalg.norm(forces, axis=1).max(initial=0.0))
        before = now
    return Balance(np.array(residual), np.array(largest))
