"""
Schemes that are known to be wrong, in NumPy, for negative controls.

They are a chain of distance constraints with Gauss-Seidel, as XPBD but for one mistake, and a
particle on a plane with friction that scales velocities (doc/numerics.md 4.4).
"""

import numpy as np

RIGHT = 'right'
DECAYED = 'multipliers kept and decayed'
DROPPED = 'multiplier dropped from the projection'
PBD = 'stiffness by share, as in PBD'


def chain(n: int, scheme: str, *, length=1.0, mass=1.0, stiffness=1000.0, gravity=9.80665,
          dt=1.0 / 60.0, iterations=1, steps=1500, kept=0.95, drag=10.0) -> np.ndarray:
    """
    Return the depth of the n + 1 particles of a hanging chain at rest, in one dimension [m].

    ``kept`` is the part of the last multipliers that DECAYED starts with.
    """
    rest, alpha = length / n, 1.0 / stiffness / (dt * dt)
    w = np.full(n + 1, n / mass)
    w[0], w[-1] = 0.0, 2.0 * n / mass
    share = stiffness / (stiffness + 1.0 / (dt * dt * w[1]))
    x = rest * np.arange(n + 1.0)
    v, multiplier = np.zeros(n + 1), np.zeros(n)
    for _ in range(steps):
        before = x.copy()
        v = np.where(w > 0.0, v / (1.0 + dt * drag) + dt * gravity, 0.0)
        x = x + dt * v
        multiplier *= kept if scheme == DECAYED else 0.0
        for _ in range(iterations):
            for j in range(n):
                residual, total = x[j + 1] - x[j] - rest, w[j] + w[j + 1]
                if scheme == PBD:
                    change = -share * residual / total
                elif scheme == DROPPED:
                    change = -residual / (total + alpha)
                else:
                    change = -(residual + alpha * multiplier[j]) / (total + alpha)
                multiplier[j] += change
                x[j] -= w[j] * change
                x[j + 1] += w[j + 1] * change
        v = (x - before) / dt
    return x


def slide(friction: float, gravity: tuple[float, float], *, speed=0.0, dt=1.0 / 240.0,
          steps=240) -> float:
    """
    Return the distance that a particle slides on a plane with friction that scales velocities [m].

    ``gravity`` has the components along and into the plane [m/s²].
    """
    x, v = 0.0, speed
    for _ in range(steps):
        v = (v + dt * gravity[0]) * (1.0 - friction)
        x += dt * v
    return x
