"""
Seam: pairs of particles of two cloths, or of one, sewn together rigidly or elastically.

C = x1 - x2 in R³, gradients 1 and -1, so with mobilities m = w H² and a 3-vector f = λ / H²

    Δf = -(C + α f) / (m1 + m2 + α),   x1 += m1 Δf,   x2 -= m2 Δf.

The two sides are matched particle by particle, in their order. ``compliance`` is that of the whole
seam under an even pull: each of its n pairs has α = n times as much. Seams follow all elastic
constraints in each iteration and precede contact, so a substep ends with them closed, or open by
their force.

A rigid seam whose sides start apart closes at the speed CLOSING: until then C is only the part of
|C| that exceeds a gap shrinking at that speed.

With ``explicit`` an elastic seam is Newmark's mean of three gaps instead, of second order, as the
springs of pins are (doc/numerics.md 7.2).

Limits: particles are sewn, not surfaces, so sides of different lengths gather. Both sides need the
same number of particles. A pass closes one pair after the other, so a heavy cloth that hangs on a
single pair needs more substeps.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import turns_on_device, wait_on_device
from xpbd_ros.sim.constraints.projection import at_the_end, max_compliance
from xpbd_ros.sim.effect import Built, Cloth, cloth_of, Effect
from xpbd_ros.sim.parameters import check_place, quantity
from xpbd_ros.sim.particles.explicit_updates import displacement_before, half_of, newmark
from xpbd_ros.sim.particles.rounding import add_move
from xpbd_ros.sim.particles.state import places
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    add_explicit_forces,
    prepare,
    project_inequalities,
    react_to_half_kick,
    stage,
)

CLOSING = 1.0
"""speed at which an open rigid seam closes [m/s]"""


@dataclass(frozen=True)
class Parameters:
    """None; the section ``seams`` of the scene lists the seams."""


@dataclass(frozen=True)
class Side:
    """One side of a seam."""

    cloth: str = quantity(doc='cloth of this side')
    at: str | tuple[int, ...] = quantity(doc='corner_00 …, edge_0x …, or indices in order')

    def __post_init__(self):
        """Check the place."""
        check_place(self.at)


@dataclass(frozen=True)
class Entry:
    """One entry of the scene's ``seams``."""

    between: tuple[Side, Side] = quantity(doc='the two sides')
    compliance: float = quantity(0.0, unit='m/N', minimum=0.0, live=True,
                                 doc='compliance of the whole seam; 0 is rigid')


class Seam(NamedTuple):
    """Data of the kernels: all pairs of all seams, in the scene's order."""

    runs: np.ndarray
    """first pair of each run of pairs without a common particle, and their number, (runs + 1,)"""
    first: np.ndarray
    """slot, shape (pairs,)"""
    second: np.ndarray
    """slot, shape (pairs,)"""
    compliance: np.ndarray
    """α [m/N], shape (pairs,)"""
    force: np.ndarray
    """f on the first of each pair [N], shape (pairs, 3)"""
    aim: np.ndarray
    """with ``explicit`` x1 - x2 where the implicit step has no force [m], shape (pairs, 3)"""
    softness: np.ndarray
    """compliance of that step [m/N], shape (pairs,)"""
    before: np.ndarray
    """x1 - x2 a substep before [m], shape (pairs, 3)"""


@stage(prepare, Seam, on_device=True)
@jit
def prepare_seams(seam, state, substep):
    """Zero the multipliers."""
    begin, end, turn = turns_on_device(state.team, len(seam.force))
    for p in range(begin, end, turn):
        seam.force[p, 0] = seam.force[p, 1] = seam.force[p, 2] = 0.0
        if not at_the_end(state.apart):
            _aim(seam, p, state)


@jit(inline=True)
def _aim(seam, p, state):
    """
    Set gap and compliance of the implicit step of ``explicit``.

    The seam acts at D = d_n + γ u + β (d_n+1 - d_n - u), u = d_n - d_n-1 of the gap d = x1 - x2:
    as a softer one, α / β, with a gap of its own.
    """
    x, i, j, alpha = state.x_prev, seam.first[p], seam.second[p], seam.compliance[p]
    late, beta = newmark(state.mobility[i] + state.mobility[j], alpha)
    for a in range(3):
        d = x[a, i] - x[a, j]
        u = d - seam.before[p, a]
        seam.aim[p, a] = d + u - (d + late * u) / beta
        seam.before[p, a] = d
    seam.softness[p] = alpha / beta


@jit(inline=True)
def pairs_of(seam, team, run):
    """Return the pairs of a run as arguments of ``range``: on a GPU, this thread's."""
    begin, end, turn = turns_on_device(team, seam.runs[run + 1] - seam.runs[run])
    return seam.runs[run] + begin, seam.runs[run] + end, turn


@stage(project_inequalities, Seam, on_device=True)
@jit
def sew(seam, state, substep):
    """Project each pair, one after the other; with ``explicit`` once more in reverse order."""
    runs = len(seam.runs) - 1
    for run in range(runs):
        _close_run(seam, run, state, substep)
    if not at_the_end(state.apart):
        for run in range(runs - 2, -1, -1):
            _close_run(seam, run, state, substep)


@jit
def _close_run(seam, run, state, substep):
    """Project the pairs of a run."""
    begin, end, turn = pairs_of(seam, state.team, run)
    for p in range(begin, end, turn):
        _close(seam, p, state, substep)
    wait_on_device(state.team)


@jit(inline=True)
def _close(seam, p, state, substep):
    """Project pair p."""
    x, before, f = state.x, state.x_prev, seam.force
    i, j, alpha = seam.first[p], seam.second[p], seam.compliance[p]
    m, n = state.mobility[i], state.mobility[j]
    if m + n + alpha == 0.0:
        return
    dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
    if not at_the_end(state.apart):
        alpha = seam.softness[p]
        dx, dy, dz = dx - seam.aim[p, 0], dy - seam.aim[p, 1], dz - seam.aim[p, 2]
    part = -1.0 / (m + n + alpha)
    if alpha == 0.0:
        gap = sqrt((before[0, i] - before[0, j])**2 + (before[1, i] - before[1, j])**2
                   + (before[2, i] - before[2, j])**2) - CLOSING * substep.h
        if gap > 0.0:
            part *= max(0.0, 1.0 - gap / sqrt(dx * dx + dy * dy + dz * dz))
    for a, d in enumerate((dx, dy, dz)):
        df = part * (d + alpha * f[p, a])
        f[p, a] += df
        add_move(x, state.rounding, a, i, m * df)
        add_move(x, state.rounding, a, j, -n * df)


@stage(add_explicit_forces, Seam, on_device=True)
@jit
def kick_seams(seam, state, substep):
    """H² w f: of the gap where the substep resolves it, else with the last substep's force."""
    x, move, m = state.x, state.apart.move, state.mobility
    for run in range(len(seam.runs) - 1):
        begin, end, turn = pairs_of(seam, state.team, run)
        for p in range(begin, end, turn):
            i, j, alpha = seam.first[p], seam.second[p], seam.compliance[p]
            for a in range(3):
                if alpha > m[i] + m[j]:
                    seam.force[p, a] = (x[a, j] - x[a, i]) / alpha
                move[a, i] += m[i] * seam.force[p, a]
                move[a, j] -= m[j] * seam.force[p, a]
        wait_on_device(state.team)
    if half_of(substep) < 0.0:
        begin, end, turn = turns_on_device(state.team, len(seam.force))
        for p in range(begin, end, turn):
            i, j = seam.first[p], seam.second[p]
            for a in range(3):
                seam.before[p, a] = (x[a, i] - displacement_before(state, i, a, substep.h)) - (
                    x[a, j] - displacement_before(state, j, a, substep.h))


@stage(react_to_half_kick, Seam, on_device=True)
@stage(accumulate_reactions, Seam, on_device=True)
@jit
def react_seams(seam, state, substep):
    """Forces on pinned particles."""
    part, w = substep.end - substep.begin, state.inv_mass
    for run in range(len(seam.runs) - 1):
        begin, end, turn = pairs_of(seam, state.team, run)
        for p in range(begin, end, turn):
            i, j = seam.first[p], seam.second[p]
            if w[i] == 0.0 or w[j] == 0.0:
                for a in range(3):
                    state.reaction[a, i] += part * seam.force[p, a]
                    state.reaction[a, j] -= part * seam.force[p, a]
        wait_on_device(state.team)


def runs_of(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """
    Divide pairs of slots, in their order, into runs whose pairs have no particle in common.

    Returns
    -------
    first pair of each run, and the number of pairs, shape (runs + 1,)

    """
    begins = [0]
    seen: set[int] = set()
    for p, ends in enumerate(zip(first.tolist(), second.tolist())):
        if not seen.isdisjoint(ends):
            begins.append(p)
            seen.clear()
        seen.update(ends)
    return np.array([*begins, len(first)])


class BuiltSeam(Built):
    """The seams of a scene."""

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        cloths = {cloth.name: cloth for cloth in world.cloths}
        first, second, compliance = [], [], []
        for name, entry in world.sections.get('seams', {}).items():
            one, other = (side_of(cloths, side, f'seams.{name}.between[{k}]')
                          for k, side in enumerate(entry.between))
            if len(one) != len(other):
                raise InputError(f'seams.{name}: its sides must have as many particles each '
                                 f'(got {len(one)} and {len(other)})')
            if (one == other).any():
                raise InputError(f'seams.{name}: sews a particle to itself')
            first.append(one)
            second.append(other)
            compliance.append(np.full(len(one), min(
                len(one) * entry.compliance * world.compliance_scale,
                max_compliance(world.state.x.dtype))))
        self.names = tuple(world.sections.get('seams', {}))
        self.data = None
        if first:
            sides = np.concatenate(first), np.concatenate(second)
            pairs, late = len(sides[0]), len(sides[0]) if world.explicit else 0
            self.data = Seam(runs_of(*sides), *sides, np.concatenate(compliance),
                             np.zeros((pairs, 3)), np.zeros((late, 3)), np.zeros(late),
                             np.zeros((late, 3)))
            self.implicit_with_explicit = True
            if 'strain_limit' in world.built:
                world.built['strain_limit'].take_turns()

    def stored_energy(self, state):
        total = 0.0
        for seam in self.parts:
            soft = seam.compliance > 0.0
            gap = (places(state.x, seam.first) - places(state.x, seam.second))[soft]
            total += 0.5 * float((gap**2 / seam.compliance[soft, None]).sum())
        return total

    def again(self):
        for seam in self.parts:
            seam.force[:] = 0.0

    def moved(self, slots):
        for seam in self.parts:
            seam.force[np.isin(seam.first, slots) | np.isin(seam.second, slots)] = 0.0

    def reset(self, state):
        self.again()

    def adopt(self, old):
        for seam, before in zip(self.parts, old.parts):
            seam.force[:] = before.force


def side_of(cloths: dict[str, Cloth], side: Side, path: str) -> np.ndarray:
    """Return the slots of one side, in its order."""
    cloth = cloth_of(cloths, side.cloth, f'{path}.cloth')
    slots = cloth.at(side.at, f'{path}.at')
    if isinstance(side.at, str):
        return slots
    if len(slots) != len(side.at):
        raise InputError(f'{path}.at: names a particle twice')
    return cloth.slots[list(side.at)]    # not sorted


EFFECT = Effect('seam', Parameters, BuiltSeam, entry=Entry)
