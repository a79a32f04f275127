"""Numerical damping: the loss of amplitude of undamped oscillations by the integrator."""

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.solver import Solver


@dataclass(frozen=True)
class Decay:
    """The numerical damping of one mode of one cloth."""

    cloth: str
    mode: str
    """'swing' or 'stretch'"""
    frequency_hz: float
    lost_per_second: float
    """part of the amplitude that is lost per second"""


def factor(integrator: str, angle: float) -> float:
    """
    Return the amplification |z| of one step for x'' = -ω² x, with angle = ω h [rad].

    Backward Euler: 1 / (1 - i angle). BDF2: the root near 1 of (3/2 - i angle) z² - 2 z + 1/2.
    NDF2: the largest root of (5/3 - i angle) z³ - (5/2) z² + z - 1/6. Leapfrog: 1 while stable.
    """
    if integrator == 'leapfrog':
        return 1.0
    if integrator == 'bdf2':
        return abs((2.0 + (1.0 + 2j * angle)**0.5) / (3.0 - 2j * angle))
    if integrator == 'ndf2':
        return float(abs(np.roots([5.0 / 3.0 - 1j * angle, -2.5, 1.0, -1.0 / 6.0])).max())
    return 1.0 / sqrt(1.0 + angle * angle)


def decays(scene: Scene, simulation: Simulation, solver: Solver) -> list[Decay]:
    """
    Return the decay of the slowest swing and of the longest stretch wave of each cloth.

    The swing is that of a chain as long as the cloth, ω = 1.2024 √(g / l). The wave is four times
    as long as the cloth, ω = π c / 2 l with c = √(modulus / density).
    """
    found = []
    g = sqrt(sum(c * c for c in scene.top.gravity))
    scale = scene.top.solver.compliance_scale
    h = simulation.frame_dt / solver.substeps
    for cloth in simulation.cloths:
        effects = scene.cloth_effects[cloth.name]
        mass = simulation.state.mass[simulation.slot[cloth.particles]]
        density = float(mass.sum(dtype=float) / cloth.mesh.area.sum())
        long = float((cloth.mesh.positions.max(0) - cloth.mesh.positions.min(0)).max())
        modes = {}
        if g > 0.0 and long > 0.0:
            modes['swing'] = 1.2024 * sqrt(g / long)
        stretch = effects.get('stretch')
        if long > 0.0 and stretch is not None and stretch.warp is not None:
            modes['stretch'] = 0.5 * pi / long * sqrt(max(stretch.warp, stretch.weft)
                                                      / (scale * density))
        found += [Decay(cloth.name, mode, omega / (2.0 * pi),
                        max(0.0, 1.0 - factor(solver.integrator, omega * h)**(1.0 / h)))
                  for mode, omega in modes.items()]
    return found
