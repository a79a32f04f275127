"""The trajectory of a run: positions, velocities, strain and energy after each frame."""

from dataclasses import dataclass, field

import numpy as np

from xpbd_ros.study.edges import Edges

END = 0.25
"""length of the end of a run that ``at_end`` covers [s]"""


@dataclass
class Trajectory:
    """One run, frame by frame; the first frame is the start."""

    dt: float
    """frame period [s]"""
    edges: Edges
    free: np.ndarray
    """True if a particle is free at the end, shape (particles,)"""
    triangles: np.ndarray
    """indices of particles, shape (triangles, 3)"""
    tetrahedra: tuple[np.ndarray, np.ndarray]
    """indices of particles, shape (tetrahedra, 4), and rest volumes [m³]"""
    x: list[np.ndarray] = field(default_factory=list)
    """positions by frame [m], each of shape (particles, 3)"""
    v: list[np.ndarray] = field(default_factory=list)
    """velocities by frame [m/s], each of shape (particles, 3)"""
    energy: list[float] = field(default_factory=list)
    """kinetic and gravitational energy by frame [J]"""
    elastic_energy: float = 0.0
    """elastic energy at the start [J]"""
    energy_scale: float = 1.0
    """energy that a rise is relative to [J]"""
    stats: dict[str, float] = field(default_factory=dict)
    """largest value of each counter of the simulation"""
    messages: list[str] = field(default_factory=list)
    """messages to the user"""
    force: dict[str, np.ndarray] = field(default_factory=dict)
    """force on each pin at the end [N]"""
    hash: int = 0
    """hash of the state at the end; 0 for the textbook solver"""

    @property
    def finite(self) -> bool:
        """True if all positions and the last velocities are finite."""
        return bool(np.isfinite(self.x[-1]).all() and np.isfinite(self.v[-1]).all()
                    and all(np.isfinite(x).all() for x in self.x))

    @property
    def strain(self) -> np.ndarray:
        """Largest |l - L| / L over the edges, shape (frames,)."""
        return np.array([np.abs(self.edges.strain(x)).max(initial=0.0) for x in self.x])

    @property
    def max_strain(self) -> float:
        """Largest strain after the start."""
        return float(self.strain[1:].max(initial=0.0))

    @property
    def speed(self) -> np.ndarray:
        """Largest speed of a particle [m/s], shape (frames,)."""
        return np.array([np.sqrt((v**2).sum(1).max(initial=0.0)) for v in self.v])

    @property
    def energy_rise(self) -> float:
        """Largest rise of ``energy`` above all energy at the start, over ``energy_scale``."""
        return float((max(self.energy) - self.energy[0] - self.elastic_energy)
                     / self.energy_scale)

    def at_end(self, values: np.ndarray) -> float:
        """Return the largest of values, shape (frames,), within END of the end of the run."""
        return float(values[-max(2, round(END / self.dt)):].max())

    def recovery_time(self, since: float, level: float, within: float = 2.0) -> float | None:
        """
        Return the time from ``since`` until the strain stays below ``level`` [s].

        None if that takes longer than ``within`` [s].
        """
        first, last = (round(t / self.dt) for t in (since, since + within))
        above = np.flatnonzero(~(self.strain[first:] <= level))
        count = 0 if not len(above) else int(above[-1]) + 1
        if count > last - first or count >= len(self.x) - first:
            return None
        return count * self.dt
