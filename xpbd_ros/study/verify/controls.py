"""Controls: cases solved by schemes known to be wrong; each must fail the case that names it."""

from dataclasses import dataclass

import numpy as np

from xpbd_ros.study.verify.build import G
from xpbd_ros.study.verify.negative_controls import chain, DECAYED, DROPPED, PBD, slide


@dataclass(frozen=True)
class Control:
    """A wrong scheme on one case."""

    id: str
    scheme: str
    error: float
    """in the norm of the case"""
    tolerance: float
    """of the case"""

    @property
    def fails(self) -> bool:
        """Whether the case finds the scheme out."""
        return bool(self.error > self.tolerance)


def relative(got: float, expected: float) -> float:
    """Return the relative error."""
    return float(abs(got / expected - 1.0))


def controls() -> list[Control]:
    """Run the wrong schemes."""
    sag = G / 1000.0    # of 1 kg on one edge of 1 kN/m; half of the chain's mass hangs there
    found = [Control('V6', DECAYED, relative(chain(1, DECAYED)[-1] - 1.0, 0.5 * sag), 1e-9)]
    for scheme in (DROPPED, PBD):
        got = [chain(4, scheme, iterations=k, steps=400)[-1] - 1.0 for k in (20, 80)]
        found.append(Control('V26', scheme, relative(got[1], got[0]), 0.01))
        one = chain(1, scheme, iterations=10)[-1] - 1.0
        found.append(Control('V6', scheme, relative(one, 0.5 * sag), 1e-9))
    slope = np.radians(15.0)    # tan is 0.27 and μ 0.4: it must stick
    found.append(Control('V14', 'friction that shortens velocities',
                         slide(0.4, (G * float(np.sin(slope)), -G * float(np.cos(slope)))),
                         1e-9))
    expected = 2.0**2 / (2.0 * 0.4 * G)
    found.append(Control('V15', 'friction that shortens velocities',
                         relative(slide(0.4, (0.0, -G), speed=2.0), expected), 0.05))
    return found
