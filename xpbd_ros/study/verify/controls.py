"""Negative controls: cases solved by schemes that are known to be wrong, and must fail them."""

from dataclasses import dataclass

import numpy as np

from xpbd_ros.study.verify.build import G
from xpbd_ros.study.verify.negative_controls import chain, DECAYED, DROPPED, PBD, slide


@dataclass(frozen=True)
class Control:
    """The error of a wrong scheme in one case."""

    id: str
    scheme: str
    error: float
    """error in the norm of the case"""
    tolerance: float
    """tolerance of the case"""

    @property
    def fails(self) -> bool:
        """True if the scheme fails the case, as it must."""
        return bool(self.error > self.tolerance)


def relative(got: float, expected: float) -> float:
    """Return the relative error."""
    return float(abs(got / expected - 1.0))


def controls() -> list[Control]:
    """Run the wrong schemes, and return their errors."""
    sag = G / 1000.0    # of 1 kg on one edge of 1 kN/m; half of the chain's mass hangs on it
    found = [Control('V6', DECAYED, relative(chain(1, DECAYED)[-1] - 1.0, 0.5 * sag), 1e-9)]
    for scheme in (DROPPED, PBD):
        got = [chain(4, scheme, iterations=k, steps=400)[-1] - 1.0 for k in (20, 80)]
        found.append(Control('V26', scheme, relative(got[1], got[0]), 0.01))
        one = chain(1, scheme, iterations=10)[-1] - 1.0
        found.append(Control('V6', scheme, relative(one, 0.5 * sag), 1e-9))
    slope = np.radians(15.0)    # tan is 0.27 and μ 0.4: it must stick
    found.append(Control('V14', 'friction that scales velocities',
                         slide(0.4, (G * float(np.sin(slope)), -G * float(np.cos(slope)))),
                         1e-9))
    expected = 2.0**2 / (2.0 * 0.4 * G)
    found.append(Control('V15', 'friction that scales velocities',
                         relative(slide(0.4, (0.0, -G), speed=2.0), expected), 0.05))
    return found
