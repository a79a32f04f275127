"""What a run did: places, velocities, strain and energy after each frame."""

from dataclasses import dataclass, field

import numpy as np

STILL = 0.25
"""what counts as the end of a run [s]"""


@dataclass
class Track:
    """One run, frame by frame; the first is the start."""

    dt: float
    """[s]"""
    edges: np.ndarray
    """natural numbers, shape (edges, 2)"""
    rest: np.ndarray
    """[m], shape (edges,)"""
    free: np.ndarray
    """whether a particle is free at the end, shape (particles,)"""
    triangles: np.ndarray
    """shape (triangles, 3)"""
    tetrahedra: tuple[np.ndarray, np.ndarray]
    """shape (tetrahedra, 4), and their volume at rest [m³]"""
    x: list[np.ndarray] = field(default_factory=list)
    v: list[np.ndarray] = field(default_factory=list)
    energy: list[float] = field(default_factory=list)
    """of motion and height [J]"""
    stored: float = 0.0
    """in the constraints at the start [J]"""
    span: float = 1.0
    """what the energy is compared with [J]"""
    stats: dict[str, float] = field(default_factory=dict)
    """the largest of each that the simulation counts"""
    said: list[str] = field(default_factory=list)
    """what it told the user"""
    force: dict[str, np.ndarray] = field(default_factory=dict)
    """on each pin, at the end [N]"""
    hash: int = 0
    """of the state at the end"""

    @property
    def finite(self) -> bool:
        """Whether all that came out is."""
        return bool(np.isfinite(self.x[-1]).all() and np.isfinite(self.v[-1]).all()
                    and all(np.isfinite(x).all() for x in self.x))

    @property
    def strain(self) -> np.ndarray:
        """Largest |l - L| / L over the edges, by frame."""
        if not len(self.edges):
            return np.zeros(len(self.x))
        i, j = self.edges.T
        found = np.zeros(len(self.x))
        for k, x in enumerate(self.x):
            length = np.sqrt(((x[i] - x[j])**2).sum(1))
            found[k] = np.abs(length / self.rest - 1.0).max()
        return found

    @property
    def worst(self) -> float:
        """Largest strain there was after the start."""
        return float(self.strain[1:].max(initial=0.0))

    @property
    def speed(self) -> np.ndarray:
        """Largest speed, by frame [m/s]."""
        return np.array([np.sqrt((v**2).sum(1).max(initial=0.0)) for v in self.v])

    @property
    def rise(self) -> float:
        """How far the energy of motion and height rose above all that there was, by ``span``."""
        return float((max(self.energy) - self.energy[0] - self.stored) / self.span)

    def late(self, values: np.ndarray) -> float:
        """Return the largest of some values by frame at the end of the run."""
        return float(values[-max(2, round(STILL / self.dt)):].max())

    def back_after(self, since: float, level: float, within: float = 2.0) -> float | None:
        """Return when the strain came under a level to stay, after ``since`` [s]; or None."""
        first, last = (round(t / self.dt) for t in (since, since + within))
        above = np.flatnonzero(~(self.strain[first:] <= level))
        count = 0 if not len(above) else int(above[-1]) + 1
        if count > last - first or count >= len(self.x) - first:
            return None
        return count * self.dt
