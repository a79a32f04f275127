"""Errors of a run against the true solution."""

from dataclasses import dataclass
import math

import numpy as np

from xpbd_ros.study.accuracy.trajectory import Trajectory
from xpbd_ros.study.accuracy.truth import differences, settled, Truth
from xpbd_ros.study.edges import Edges
from xpbd_ros.study.reference import rms

NAN = math.nan


@dataclass(frozen=True)
class Errors:
    """
    Errors of one setting; NaN at times that the run did not reach.

    The errors of means are those of SETTLED, the last part of the run (``truth.settled``).
    """

    rms_m: tuple[float, ...] = ()
    """RMS error of positions at each time of the true solution [m]"""
    max_m: tuple[float, ...] = ()
    """largest error of a position at each time [m]"""
    strain: tuple[float, ...] = ()
    """RMS error of the strain over the edges, at each time"""
    energy: tuple[float, ...] = ()
    """error of the total energy at each time, over the largest kinetic energy"""
    residual_m: float | None = None
    """RMS of C + α f at the last time [m]; None without multipliers"""
    height_m: float = NAN
    """RMS error of the sorted heights of the particles, as means over the last part [m]"""
    mean_strain: float = NAN
    """error of the RMS strain, as mean over the last part"""
    mean_energy: float = NAN
    """error of the total energy, as mean over the last part, over the largest kinetic energy"""
    note: str = ''
    """remark for the table"""

    @property
    def finite(self) -> bool:
        """True if the run reached its end with finite numbers."""
        return math.isfinite(self.height_m)


def errors(track: Trajectory, truth: Truth, edges: Edges, dt: float) -> Errors:
    """Compare a run with the true solution; ``dt`` is the frame period [s]."""
    kinetic = truth.most_kinetic or 1.0
    found: list[list[float]] = [[], [], [], []]
    for k, frame in enumerate(truth.frames):
        if frame not in track.x:
            for column in found:
                column.append(NAN)
            continue
        d = track.x[frame] - truth.x[k]
        strain = edges.strain(track.x[frame]) - edges.strain(truth.x[k])
        values = (rms(d), float(np.sqrt((d**2).sum(1)).max()), rms(strain[:, None]),
                  float((track.energy[frame] - truth.energy[k]) / kinetic))
        for column, value in zip(found, values):
            column.append(value)
    notes = []
    if track.ended is not None:
        notes.append(f'not finite after {max(0, track.ended - 1) * dt:.3g} s')
        means = (NAN, NAN, NAN)
    else:
        off = differences(settled(track), (truth.heights, truth.strain, truth.mean_energy))
        means = (float(off[0]), float(off[1]), float(off[2] / kinetic))
    if track.redone:
        notes.append(f'{track.redone} of {len(track.kinetic) - 1} frames computed with line')
    residual = track.residual.get(int(truth.frames[-1])) if len(truth.frames) else None
    rms_m, max_m, strains, energies = (tuple(column) for column in found)
    return Errors(rms_m, max_m, strains, energies, residual, *means, '; '.join(notes))
