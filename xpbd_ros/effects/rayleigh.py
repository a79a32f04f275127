"""
Rayleigh: stiffness-proportional damping of stretch and shear, with one relaxation time.

Beside each edge of stiffness k acts a damper β = k time (Kelvin and Voigt), which is γ = time / H
for every constraint (``constraints.damping``; Macklin et al. 2016, eq 26; doc/numerics.md 5.11).
So a mode of frequency ω decays at the rate ω² time / 2: fast modes before slow ones, and motion of
the cloth as a whole not at all.

Limits: it acts on ``stretch`` and ``shear``; rigid edges (compliance 0) have no damper. The
methods ``line`` and ``explicit`` have no such damping and are refused; ``auto`` takes
``gauss_seidel_symmetric``. One iteration of ``gauss_seidel`` or ``jacobi`` is of first order, two
are of the integrator's. In a substep without a history it is stronger, by h / H.
"""

from dataclasses import dataclass
from typing import NamedTuple

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone_on_device, turns_on_device
from xpbd_ros.sim.constraints.damping import Past
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.history import usual_step
from xpbd_ros.sim.particles.integration import write_starts
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import new_records
from xpbd_ros.sim.stepping.stages import prepare, stage


@dataclass(frozen=True)
class Parameters:
    """The relaxation time."""

    time: float = quantity(unit='s', minimum=0.0, live=True, doc='relaxation time')


class Rayleigh(NamedTuple):
    """Data of the kernel."""

    past: Past


@stage(prepare, Rayleigh, on_device=True)
@jit
def keep_past(rayleigh, state, substep):
    """Write x̄; for pinned particles that of their pin's velocity."""
    past, h = rayleigh.past, substep.h
    usual = usual_step(state.history, h)
    if alone_on_device(state.team):
        past.per_step[0] = 1.0 / usual
    write_starts(state, past.x, h)
    begin, end, step = turns_on_device(state.team, len(state.inv_mass))
    for i in range(begin, end, step):
        for k in range(3):
            if state.inv_mass[i] == 0.0:
                way = (state.x[k, i] - state.x_prev[k, i]) * (usual / h)
                past.x[k, i] = state.x[k, i] - way
            past.records[i, k] = past.x[k, i]


class BuiltRayleigh(Built):
    """The relaxation time of each cloth, which its constraints ask for when they are built."""

    incompatible_with = ('line', 'explicit')

    def __init__(self, parameters, world):
        super().__init__()
        dtype = world.state.x.dtype
        self.past = Past(zeros((3, world.slots), dtype), new_records(world.slots, dtype),
                         zeros(1, dtype))
        self.data = Rayleigh(self.past)
        self._time = {cloth.name: chosen.time for cloth, chosen in parameters.items()}

    def time(self, cloth) -> float:
        """Return the relaxation time of a cloth [s]; 0 for cloths without the effect."""
        return self._time.get(cloth.name, 0.0)


EFFECT = Effect('rayleigh', Parameters, BuiltRayleigh, needs=('stretch', 'shear'))
