"""How far a run is from the truth."""

from dataclasses import dataclass
import math

import numpy as np

from xpbd_ros.study.accuracy.trajectory import Edges, Track
from xpbd_ros.study.accuracy.truth import differences, settled, Truth
from xpbd_ros.study.reference import rms

NAN = math.nan


@dataclass(frozen=True)
class Errors:
    """Errors of one setting; not a number where it did not get that far."""

    rms_m: tuple[float, ...] = ()
    """of positions, at each time of the truth [m]"""
    max_m: tuple[float, ...] = ()
    strain: tuple[float, ...] = ()
    """root mean square over the edges, at each time"""
    energy: tuple[float, ...] = ()
    """at each time, of the run's largest kinetic energy"""
    residual_m: float | None = None
    """root mean square of C + α f at the last time [m]; None where no multipliers are kept"""
    height_m: float = NAN
    """of the heights of the particles, lowest first, mean over the last part of the run [m]"""
    mean_strain: float = NAN
    """of the root mean square, mean over the last part of the run"""
    mean_energy: float = NAN
    """mean over the last part of the run, of the largest kinetic energy"""
    note: str = ''

    @property
    def finite(self) -> bool:
        """Whether the run came to its end."""
        return math.isfinite(self.height_m)


def errors(track: Track, truth: Truth, edges: Edges, dt: float) -> Errors:
    """Compare a run with the truth; ``dt`` is a frame's length [s]."""
    kinetic = truth.most_kinetic or 1.0
    found = [[], [], [], []]
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
    note = ''
    if track.ended is not None:
        note = f'not finite after {max(0, track.ended - 1) * dt:.3g} s'
        means = (NAN, NAN, NAN)
    else:
        means = differences(settled(track), (truth.heights, truth.strain, truth.mean_energy))
        means = (float(means[0]), float(means[1]), float(means[2] / kinetic))
    if track.redone:
        note = f'{track.redone} of {len(track.kinetic) - 1} frames done again with line'
    residual = track.residual.get(int(truth.frames[-1])) if len(truth.frames) else None
    return Errors(*map(tuple, found), residual, *means, note)
