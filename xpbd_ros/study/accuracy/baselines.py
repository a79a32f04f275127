"""
Baselines: other solvers, and one that is known to be wrong, for comparison in studies only.

They share no code with the simulation: scalar Gauss-Seidel loops on the arrays of the reference
solver's problem (edges, hinges, pins, damping).

``pbd``  position-based dynamics (Müller et al. 2006), one step per frame: each iteration corrects
a part of every residual, as much as one projection of XPBD does (nearly all of it for stiff
edges), and keeps no multiplier. Its stiffness depends on time step and iterations.
``textbook_xpbd``  XPBD as published (Macklin et al. 2016): Gauss-Seidel, one step per frame.
``decayed_multiplier``  XPBD that starts each substep with 0.95 of the last multipliers; wrong.
``mass_spring``  springs and point masses with symplectic Euler.
"""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.study.accuracy.solver_setting import Setting
from xpbd_ros.study.reference import Edges, LinearSums, problem_of, Slants

SCHEMES = {'textbook_xpbd': 0, 'pbd': 1, 'decayed_multiplier': 2, 'mass_spring': 3}
KEPT = 0.95
"""part of the last multipliers that ``decayed_multiplier`` keeps"""
KNOWN = ('stretch', 'shear', 'bend', 'pin', 'damping')
"""effects that baselines have; pins without compliance"""


def refusal(scene: Scene) -> str | None:
    """Return the reason why baselines cannot run a scene; None if they can."""
    simulation = compile_scene(scene)
    for name in simulation.effects:
        if name not in KNOWN:
            return f'effects.{name}: baselines do not have it (known: {", ".join(KNOWN)})'
    try:
        problem = problem_of(simulation)
    except InputError as error:
        return str(error)
    if problem.all_of(Slants):
        return 'effects.shear: baselines have edges along diagonals, which need square cells'
    if len(problem.x) > len(simulation.slot):
        return 'pins: baselines have rigid pins only; leave out compliance'
    return None


@dataclass(eq=False)
class BaselineFrame:
    """Positions of one frame."""

    x: np.ndarray
    """[m], shape (particles, 3)"""


class Baseline:
    """
    A scene solved by a baseline, with the interface of ``Simulation``; it takes no commands.

    Parameters
    ----------
    simulation : the scene, compiled; gives arrays and measures
    setting : baseline, substeps and iterations

    """

    def __init__(self, simulation: Simulation, setting: Setting):
        problem = problem_of(simulation)
        self._simulation, self._problem, self._setting = simulation, problem, setting
        self.frame_dt, self.cloths, self.slot = (
            simulation.frame_dt, simulation.cloths, simulation.slot)
        self.index = 0
        self._x, self._v = problem.x.copy(), problem.v.copy()
        self._w = np.where(problem.pinned, 0.0, 1.0 / problem.mass)
        self._pinned = np.flatnonzero(problem.pinned)
        self._edges = problem.all_of(Edges) or (np.zeros((0, 2), np.int64), *np.zeros((2, 0)))
        self._bends = problem.all_of(LinearSums) or (
            np.zeros((0, 4), np.int64), np.zeros((0, 4)), np.zeros(0))
        self._multiplier = np.zeros(len(self._edges[0]))
        self._moment = np.zeros((len(self._bends[0]), 3))
        self.effects = MappingProxyType(simulation.effects)

    @property
    def bytes(self) -> int:
        """Size of all arrays that it computes with [bytes]."""
        return sum(array.nbytes for array in (
            self._x, self._v, self._w, self._multiplier, self._moment, *self._edges,
            *self._bends))

    def frame(self) -> BaselineFrame:
        """Return the present positions."""
        return BaselineFrame(self._x)

    @property
    def state(self):
        """The state of the simulation, with the baseline's positions and velocities."""
        state, slot = self._simulation.state, self._simulation.slot
        state.x[:, slot], state.v[:, slot] = self._x.T, self._v.T
        return state

    def stats(self) -> dict:
        """Return no counters."""
        return {}

    def compile(self) -> None:
        """Compile the kernel, without a step."""
        self._advance(0)

    def step(self, commands=()) -> BaselineFrame:
        """Advance by one frame."""
        self._advance(self._setting.substeps)
        self.index += 1
        return self.frame()

    def _advance(self, substeps: int) -> None:
        p, s = self._problem, self._setting
        h = self.frame_dt / max(s.substeps, 1)
        path = np.empty((substeps, len(self._pinned), 3))
        if len(self._pinned):
            for n in range(substeps):
                path[n] = p.at(self.index * self.frame_dt + (n + 1) * h)
        _advance(SCHEMES[s.method], self._x, self._v, np.empty_like(self._x), self._w, p.gravity,
                 p.damping, *self._edges, *self._bends, self._multiplier, self._moment,
                 self._pinned, path, h, substeps, s.iterations)


@jit
def _advance(scheme, x, v, before, w, gravity, damping, edges, rest, stiffness, bends, weight,
             bend_stiffness, multiplier, moment, pinned, path, h, substeps, iterations):
    """Advance x [m] and v [m/s] in place by some substeps of length h [s]."""
    kept = np.exp(-damping * h)
    for n in range(substeps):
        for i in range(len(x)):
            for k in range(3):
                before[i, k] = x[i, k]
        if scheme == 3:
            _kick(x, v, w, edges, rest, stiffness, bends, weight, bend_stiffness, h)
        for i in range(len(x)):
            if w[i] > 0.0:
                for k in range(3):
                    v[i, k] = kept * v[i, k] + h * gravity[k]
                    x[i, k] += h * v[i, k]
        for p in range(len(pinned)):
            for k in range(3):
                x[pinned[p], k] = path[n, p, k]
        if scheme == 3:
            continue
        keep = KEPT if scheme == 2 else 0.0
        for e in range(len(multiplier)):
            multiplier[e] *= keep
        for b in range(len(moment)):
            for k in range(3):
                moment[b, k] *= keep
        for _ in range(iterations):
            _project(scheme, x, w, edges, rest, stiffness, bends, weight, bend_stiffness,
                     multiplier, moment, h)
        for i in range(len(x)):
            for k in range(3):
                v[i, k] = (x[i, k] - before[i, k]) / h


@jit
def _project(scheme, x, w, edges, rest, stiffness, bends, weight, bend_stiffness, multiplier,
             moment, h):
    """One Gauss-Seidel pass: hinges, then edges."""
    for b in range(len(bends)):
        total = 0.0
        for p in range(4):
            total += w[bends[b, p]] * weight[b, p] * weight[b, p]
        if total == 0.0:
            continue
        alpha = 1.0 / (bend_stiffness[b] * h * h)
        for k in range(3):
            c = 0.0
            for p in range(4):
                c += weight[b, p] * x[bends[b, p], k]
            if scheme == 1:
                change = -c / (total + alpha)
            else:
                change = -(c + alpha * moment[b, k]) / (total + alpha)
                moment[b, k] += change
            for p in range(4):
                x[bends[b, p], k] += w[bends[b, p]] * weight[b, p] * change
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        total = w[i] + w[j]
        dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        l = np.sqrt(dx * dx + dy * dy + dz * dz)
        if total == 0.0 or l == 0.0:
            continue
        c, alpha = l - rest[e], 1.0 / (stiffness[e] * h * h)
        if scheme == 1:
            change = -c / (total + alpha)
        else:
            change = -(c + alpha * multiplier[e]) / (total + alpha)
            multiplier[e] += change
        change /= l
        x[i, 0] += w[i] * change * dx
        x[i, 1] += w[i] * change * dy
        x[i, 2] += w[i] * change * dz
        x[j, 0] -= w[j] * change * dx
        x[j, 1] -= w[j] * change * dy
        x[j, 2] -= w[j] * change * dz


@jit
def _kick(x, v, w, edges, rest, stiffness, bends, weight, bend_stiffness, h):
    """Add the forces of springs and hinges to the velocities, for one substep."""
    for b in range(len(bends)):
        for k in range(3):
            c = 0.0
            for p in range(4):
                c += weight[b, p] * x[bends[b, p], k]
            for p in range(4):
                v[bends[b, p], k] -= (h * w[bends[b, p]] * bend_stiffness[b] * weight[b, p] * c)
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        l = np.sqrt(dx * dx + dy * dy + dz * dz)
        if l == 0.0:
            continue
        pull = h * stiffness[e] * (l - rest[e]) / l
        v[i, 0] -= w[i] * pull * dx
        v[i, 1] -= w[i] * pull * dy
        v[i, 2] -= w[i] * pull * dz
        v[j, 0] += w[j] * pull * dx
        v[j, 1] += w[j] * pull * dy
        v[j, 2] += w[j] * pull * dz
