"""
Friction: Coulomb friction in position form, kinetic and static, for all contacts.

With Δp = (x - x_prev) - (motion of the collider's surface), its tangential part Δp_t and the
contact's push d along the normal (Macklin et al. 2014, eq 24; without the part that separates an
old overlap),

    s <- s - Δp_t, if |s| > μ_s d shortened to μ_k d,   x += change of s

so a contact sticks where |Δp_t| ≤ μ_s d, and slides against the friction μ_k d elsewhere. At rest
on a slope d = g cos(θ) h²: sticking is exact, and a sliding particle decelerates by exactly
μ_k g cos(θ). ``friction`` of a surface is its μ_k, and its μ_s too unless it has a
``static_friction``. μ of a pair is the geometric mean of the two surfaces' unless ``pairs`` gives
one. With ``self_collision`` in the scene, cloths have the same friction against one another
(``self_collision.pair_contacts``).

Limits: a contact that slides slower than μ_s g cos(θ) h sticks at once. A collider's velocity is
constant within a frame and jumps between frames, so cloth on an accelerating collider slips a
little where smooth motion would carry it along.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, either, root, select, smaller
from xpbd_ros.sim.backend.simd_wide import (
    any_true,
    load_columns,
    load_wide,
    store_columns,
    WIDTH,
)
from xpbd_ros.sim.backend.threads import wait, worker, workers
from xpbd_ros.sim.contact.clamp_friction import (
    across,
    clamp_at,
    place_clamped,
    shared_friction,
)
from xpbd_ros.sim.contact.collider_motion import surface_motion, surface_motions
from xpbd_ros.sim.contact.contacts import Contacts, push_once, shortened, wait_for_others
from xpbd_ros.sim.contact.corners import leave_corners
from xpbd_ros.sim.contact.friction_limits import holds, limits
from xpbd_ros.sim.contact.pads import is_clamped, meets_pad, partner, without_pushes
from xpbd_ros.sim.contact.particle_lanes import place, positions
from xpbd_ros.sim.contact.pieces import candidate, rounds
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import check_static, quantity
from xpbd_ros.sim.stepping.stages import project_inequalities, stage


@dataclass(frozen=True)
class Pair:
    """Friction between one cloth and one collider."""

    friction: float = quantity(minimum=0.0, doc='kinetic coefficient')
    static_friction: float | None = quantity(
        None, minimum=0.0, doc='static coefficient; the kinetic one unless given')

    def __post_init__(self):
        """Require μ_s ≥ μ_k."""
        check_static(self.static_friction, self.friction)


@dataclass(frozen=True)
class Parameters:
    """Coefficients of pairs; all other pairs take the geometric mean of the two surfaces."""

    pairs: dict[str, dict[str, float | Pair]] = quantity(
        {}, minimum=0.0, doc='cloth: {collider: coefficient μ, or both of them}')


class Friction(NamedTuple):
    """Data of the kernels."""

    contacts: Contacts
    cloth: np.ndarray
    """index of each particle's cloth, shape (slots,)"""
    coefficient: np.ndarray
    """μ_k by cloth and collider, shape (cloths, capacity)"""
    static: np.ndarray | None
    """μ_s likewise; None where it is μ_k everywhere"""


@jit(inline=True)
def tangential(contacts, k, state):
    """Return Δp_t of contact k [m]."""
    i, n, x, before = contacts.particle[k], contacts.normal, state.x, state.x_prev
    ux, uy, uz = surface_motion(contacts, k, state)
    # in float64, as by lanes: the difference of two float32 numbers may not be one
    px = np.float64(x[0, i]) - before[0, i] - ux
    py = np.float64(x[1, i]) - before[1, i] - uy
    pz = np.float64(x[2, i]) - before[2, i] - uz
    pn = px * n[k, 0] + py * n[k, 1] + pz * n[k, 2]
    return px - pn * n[k, 0], py - pn * n[k, 1], pz - pn * n[k, 2]


@jit
def resist_clamped(pads, friction, state):
    """Project particles between two colliders, for both at once (``contact.clamp_friction``)."""
    if pads is not None:
        contacts, x = friction.contacts, state.x
        s = contacts.slip
        begin, step = worker(state.team), workers(state.team)
        for k in range(begin, contacts.count[0], step):
            pads.clamped[k] = 0
        wait(state.team)
        for k in range(begin, contacts.count[0], step):
            if hold(pads, friction, k, state):
                continue
            j = partner(pads, contacts, k)
            if j < 0:
                continue
            pads.clamped[j] = pads.clamped[k] = 1
            i = contacts.particle[k]
            px, py, pz = tangential(contacts, j, state)
            rx, ry, rz = tangential(contacts, k, state)
            tx, ty, tz = s[j, 0] + s[k, 0], s[j, 1] + s[k, 1], s[j, 2] + s[k, 2]
            one, other = limits(friction, j), limits(friction, k)
            first, second = shared_friction(
                (px - tx, py - ty, pz - tz), (rx - tx, ry - ty, rz - tz),
                (one[0], other[0]), (one[1], other[1]))
            for a in range(3):
                s[j, a], s[k, a] = first[a], second[a]
            x[0, i] += s[j, 0] + s[k, 0] - tx
            x[1, i] += s[j, 1] + s[k, 1] - ty
            x[2, i] += s[j, 2] + s[k, 2] - tz
        wait(state.team)


@jit(inline=True)
def hold(pads, friction, k, state):
    """
    Solve normal forces and friction of a clamped particle together; return False if it is not.

    The particle's last candidate is k. The forces are those where it moves with the mean of both
    surfaces (``contact.clamp_friction``).
    """
    contacts, x, s, before = friction.contacts, state.x, friction.contacts.slip, state.x_prev
    i, j = contacts.particle[k], contacts.earlier[k]
    if not (j >= 0 and contacts.latest[i] == k and contacts.earlier[j] < 0
            and state.mobility[i] > 0.0 and pads.area[i] > 0.0 and meets_pad(pads, contacts, k)):
        return False
    now, pushed = (x[0, i], x[1, i], x[2, i]), (contacts.push[j], contacts.push[k])
    free = without_pushes(pads, contacts, k, (
        now[0] - s[j, 0] - s[k, 0], now[1] - s[j, 1] - s[k, 1], now[2] - s[j, 2] - s[k, 2]))
    x[0, i], x[1, i], x[2, i] = free
    px, py, pz = surface_motion(contacts, j, state)
    rx, ry, rz = surface_motion(contacts, k, state)
    clamp = clamp_at(pads, contacts, j, k, free, (
        before[0, i] + 0.5 * (px + rx), before[1, i] + 0.5 * (py + ry),
        before[2, i] + 0.5 * (pz + rz)))
    if clamp.holds:
        contacts.push[j], contacts.push[k] = clamp.push
        one, other = limits(friction, j), limits(friction, k)
        p = across(clamp, before[0, i] + px, before[1, i] + py, before[2, i] + pz)
        r = across(clamp, before[0, i] + rx, before[1, i] + ry, before[2, i] + rz)
        first, second = shared_friction(p, r, (one[0], other[0]), (one[1], other[1]))
        if place_clamped(pads, contacts, j, k, i, state, clamp, free, (
                now[0] - s[j, 0] - s[k, 0], now[1] - s[j, 1] - s[k, 1],
                now[2] - s[j, 2] - s[k, 2]), sqrt((px - rx)**2 + (py - ry)**2 + (pz - rz)**2),
                first, second):
            for a in range(3):
                s[j, a], s[k, a] = first[a], second[a]
            pads.clamped[j] = pads.clamped[k] = 1
            return True
    contacts.push[j], contacts.push[k] = pushed
    x[0, i], x[1, i], x[2, i] = now
    return False


@jit(inline=True)
def resist_candidate(friction, k, state):
    """Project candidate k."""
    contacts, x, s = friction.contacts, state.x, friction.contacts.slip
    if contacts.push[k] == 0.0 and s[k, 0] == 0.0 and s[k, 1] == 0.0 and s[k, 2] == 0.0:
        return
    if is_clamped(contacts.pads, k):
        return
    i = contacts.particle[k]
    tx, ty, tz = tangential(contacts, k, state)
    sticks, slides = limits(friction, k)
    sx, sy, sz = shortened(s[k, 0] - tx, s[k, 1] - ty, s[k, 2] - tz, sticks, slides)
    x[0, i] += sx - s[k, 0]
    x[1, i] += sy - s[k, 1]
    x[2, i] += sz - s[k, 2]
    s[k, 0], s[k, 1], s[k, 2] = sx, sy, sz


@jit(inline=True)
def resist_pack(friction, c, k, state):
    """
    Project the candidates k, k + 1, … of collider c by lanes, with the same bits.

    Return False if some are clamped, or if they are of several cloths.
    """
    contacts = friction.contacts
    index, last = contacts.particle, k + WIDTH - 1
    a = friction.cloth[index[k]]
    if a != friction.cloth[index[last]] or are_clamped(contacts.pads, k):
        return False
    push, (ox, oy, oz) = load_wide(contacts.push, k), load_columns(contacts.slip, k)
    active = either(either(differs(push), differs(ox)), either(differs(oy), differs(oz)))
    if not any_lane(active):
        return True
    x, y, z = positions(state.x, index, k)
    x0, y0, z0 = positions(state.x_prev, index, k)
    ux, uy, uz = surface_motions(contacts, c, x, y, z)
    nx, ny, nz = load_columns(contacts.normal, k)
    px, py, pz = x - x0 - ux, y - y0 - uy, z - z0 - uz
    pn = px * nx + py * ny + pz * nz
    sx, sy, sz = ox - (px - pn * nx), oy - (py - pn * ny), oz - (pz - pn * nz)
    load = push - smaller(push, load_wide(contacts.overlap, k))
    mu = friction.coefficient[a, c]
    slides = mu * load
    l = root(sx * sx + sy * sy + sz * sz)
    far, f = l > holds(friction.static, a, c, mu) * load, slides / l
    sx, sy, sz = select(far, f * sx, sx), select(far, f * sy, sy), select(far, f * sz, sz)
    place(state.x, index, k, select(active, x + (sx - ox), x), select(active, y + (sy - oy), y),
          select(active, z + (sz - oz), z))
    store_columns(contacts.slip, k, select(active, sx, ox), select(active, sy, oy),
                  select(active, sz, oz))
    return True


@jit(inline=True)
def differs(a):
    """Return the mask of the lanes that are not 0."""
    return either(a > 0.0, a < 0.0)


@jit(inline=True)
def are_clamped(pads, k):
    """Return True if the friction of a candidate of a pack has been solved with another's."""
    if pads is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return any_true(pads.clamped, k)


@stage(project_inequalities, Friction, shared=True)
@jit
def resist(friction, state, substep):
    """Undo tangential motion, within the cone |s| ≤ μ d."""
    contacts, team = friction.contacts, state.team
    resist_clamped(contacts.pads, friction, state)
    for c in range(contacts.colliders.count[0] if contacts.count[0] > 0 else 0):
        begin, last = contacts.first[c], contacts.first[c + 1]
        for n in range(rounds(team, begin, last)):
            k = candidate(team, n, begin)
            if not (WIDTH > 1 and k + WIDTH <= last and resist_pack(friction, c, k, state)):
                for j in range(k, min(k + WIDTH, last)):
                    resist_candidate(friction, j, state)
        wait_for_others(contacts, team)
    fast = contacts.count[2] != 0    # friction too moves them far
    wait(team)
    if fast:
        push_once(contacts, state, not fast, False)    # compiled once: no literal of its own
    if contacts.count[3]:
        leave_corners(contacts, state)


class BuiltFriction(Built):
    """The coefficients of all pairs of a cloth and a collider, and of two cloths."""

    ns_per_particle = 3.5

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        self.contact = contact = world.built.get('contact')
        self.cloths = world.cloths
        self.pairs = parameters.pairs
        if 'self_collision' in world.built:
            world.built['self_collision'].let_rub(*self._between_cloths())
        unknown = set(self.pairs) - {cloth.name for cloth in world.cloths}
        if unknown:
            raise InputError(f'effects.friction.pairs: unknown cloth {sorted(unknown)}')
        entries = contact.entries if contact else {}
        for cloth in world.cloths:
            unknown = set(self.pairs.get(cloth.name, {})) - set(entries)
            if unknown:
                raise InputError(f'effects.friction.pairs.{cloth.name}: unknown collider '
                                 f'{sorted(unknown)} (known: {", ".join(entries)})')
        self.data = None
        if contact is None:
            return
        cloth_of = np.zeros(world.slots, np.int64)
        for k, cloth in enumerate(world.cloths):
            cloth_of[cloth.slots] = k
        surfaces = [*world.cloths, *entries.values(), *(
            pair for pairs in self.pairs.values() for pair in pairs.values())]
        shape = len(world.cloths), len(contact.colliders.shape)
        self.data = Friction(contact.contacts, cloth_of, np.zeros(shape),
                             np.zeros(shape) if sticks(surfaces) else None)
        if 'self_collision' in world.built:
            world.built['self_collision'].let_rub_on_colliders(self.data)
        self.changes = None
        """``changes`` of the contact effect when the coefficients were written"""

    def _between_cloths(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Return μ_k and μ_s by cloth and cloth: geometric means; None where all are μ_k."""
        kinetic, static = np.transpose([both_of(cloth) for cloth in self.cloths])
        return np.sqrt(np.outer(kinetic, kinetic)), (
            np.sqrt(np.outer(static, static)) if sticks(self.cloths) else None)

    def begin(self, clock, state):
        if self.contact is not None and self.changes != self.contact.changes:
            self.changes = self.contact.changes
            for k, cloth in enumerate(self.cloths):
                for c, (name, placed) in enumerate(self.contact.placed.items()):
                    kinetic, static = self._pair(cloth, name, placed.entry)
                    self.data.coefficient[k, c] = kinetic
                    if self.data.static is not None:
                        self.data.static[k, c] = static

    def _pair(self, cloth, name: str, entry) -> tuple[float, float]:
        """Return μ_k and μ_s of a cloth and a collider."""
        given = self.pairs.get(cloth.name, {}).get(name)
        if given is not None:
            return both_of(given if isinstance(given, Pair) else Pair(given))
        kinetic, static = (sqrt(a * b) for a, b in zip(both_of(cloth), both_of(entry)))
        return kinetic, static


def sticks(surfaces) -> bool:
    """Return True if a static coefficient is given for one of them."""
    return any(getattr(surface, 'static_friction', None) is not None for surface in surfaces)


def both_of(surface) -> tuple[float, float]:
    """Return μ_k and μ_s of a surface or a pair."""
    static = surface.static_friction
    return surface.friction, surface.friction if static is None else static


EFFECT = Effect('friction', Parameters, BuiltFriction, needs=('contact', 'self_collision'))
