"""
Multistep history of the integrators, and their formulas (applied in ``particles.integration``).

    backward Euler   H = h        x̄ = x_n
    BDF2             H = 2h/3     x̄ = x_n + (x_n - x_{n-1}) / 3
    NDF2             H = 3h/5     x̄ = x_n + (x_n - x_{n-1}) / 2 - (x_{n-1} - x_{n-2}) / 10

NDF2 is BDF2 with a sixth of the third difference added: x' h = ∇x + ∇²x / 2 + ∇³x / 6. That halves
the error of BDF2, -h² x''' / 3. It is the largest such term that is still A-stable, and it damps
less: by (ω h)⁶ / 12 instead of (ω h)⁴ / 4 a step (L. F. Shampine, M. W. Reichelt, "The MATLAB ODE
suite", 1997, κ₂ = -1/9; V. N. Vatsa et al., "Re-evaluation of an optimized second order backward
difference scheme", 2010).

A particle without a history takes a step of backward Euler, and then, with NDF2, one of BDF2.

NDF2 barely damps period-two oscillations, and a line solve that starts from positions predicted by
such an oscillation can excite it: edges flip in every substep. A particle therefore takes BDF2
(order reduction) while

    v_n · v_{n-2} < 0   and   |v_n - 2 v_{n-1} + v_{n-2}| > |v_n - v_{n-2}| > REACH gap / h,

that is, while its velocity reverses, less smoothly than any motion that h resolves, and changes by
more than REACH times the distance of neighbours per substep.
"""

from typing import NamedTuple

from numba import types
import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import any_lane, both, fma, larger, load, select, splat, store
from xpbd_ros.sim.particles.memory_layout import zeros

FULL, HALF, NONE, TOUCHED = 0.0, 0.5, 1.0, 2.0
"""values of ``History.fresh``"""
REACH = 0.1
"""least amplitude of a detected period-two oscillation, relative to the distance of neighbours"""


class History(NamedTuple):
    """Positions and velocities of earlier substeps, in a substep that starts at x_n = x_prev."""

    x: np.ndarray
    """x_{n-1} [m], shape (3, slots)"""
    v: np.ndarray
    """v_n [m/s], shape (3, slots)"""
    older_x: np.ndarray | None
    """x_{n-2} [m], shape (3, slots); None with BDF2"""
    older_v: np.ndarray | None
    """v_{n-1} [m/s], shape (3, slots); None with BDF2"""
    fresh: np.ndarray
    """FULL: complete; HALF: one earlier substep, or order reduction (BDF2); NONE: no history
    (backward Euler); TOUCHED more than these: invalidated in this substep (backward Euler, then
    NONE); shape (slots,)"""
    fullest: np.ndarray | None
    """least value of ``fresh``: FULL, or HALF to take BDF2 with the storage of NDF2, shape (1,);
    None with BDF2"""


STEPS = {'backward_euler': 0, 'leapfrog': 0, 'bdf2': 1, 'ndf2': 2}
"""number of earlier substeps that each integrator uses"""


def new_history(integrator: str, slots: int, dtype) -> History | None:
    """Return an empty history, all particles NONE; None for integrators that need none."""
    steps = STEPS[integrator]
    if steps == 0:
        return None
    x, v = zeros((3, slots), dtype), zeros((3, slots), dtype)
    older_x, older_v = (zeros((3, slots), dtype) if steps == 2 else None for _ in range(2))
    return History(x, v, older_x, older_v, np.full_like(zeros(slots, dtype), NONE),
                   np.full(1, FULL, dtype) if steps == 2 else None)


def integrators_with(history: History | None) -> tuple[str, ...]:
    """Return the integrators that this storage serves."""
    if history is None:
        return 'backward_euler', 'leapfrog'
    return ('bdf2',) if history.fullest is None else ('ndf2', 'bdf2')


@jit
def invalidate_history(history, i):
    """Mark particle i as TOUCHED: end this substep with backward Euler, begin the next as NONE."""
    if history is not None and history.fresh[i] < TOUCHED:
        history.fresh[i] += TOUCHED


@jit(inline=True)
def touched(fresh, moved):
    """Return a vector of ``History.fresh``, marked as TOUCHED where the mask is true."""
    return select(both(moved, fresh < TOUCHED), fresh + TOUCHED, fresh)


@jit
def discard_history(history, i):
    """Let particle i predict its positions again, without its history, in this substep too."""
    if history is not None:
        history.fresh[i] = TOUCHED + NONE


def earlier_positions(history):
    """Return the arrays x_{n-1} and x_{n-2}; None where the integrator has none."""


def velocities(history, v):
    """Return the array v_n, and (v_{n-1}, v_{n-2}): the oldest is v, until it is overwritten."""


def age(history, q):
    """Return the vector ``fresh`` from slot q on; None with backward Euler."""


@inline(earlier_positions)
def _earlier_positions(history):
    if isinstance(history, types.NoneType):
        return lambda history: (None, None)
    return lambda history: (history.x, history.older_x)


@inline(velocities)
def _velocities(history, v):
    if isinstance(history, types.NoneType):
        return lambda history, v: (v, (None, None))
    if isinstance(history[history.fields.index('older_v')], types.NoneType):
        return lambda history, v: (history.v, (v, None))
    return lambda history, v: (history.v, (history.older_v, v))


@inline(age)
def _age(history, q):
    if isinstance(history, types.NoneType):
        return lambda history, q: None
    return lambda history, q: load(history.fresh, q)


def weights(past, w, fresh, h):
    """
    Return H, a, b of x̄ = x_n + a (x_n - x_{n-1}) - b (x_{n-1} - x_{n-2}) for a vector ``fresh``.

    ``past`` is as of ``earlier_positions``; ``w`` is any array of the state's dtype.
    """


@inline(weights)
def _weights(past, w, fresh, h):
    if isinstance(fresh, types.NoneType):
        return lambda past, w, fresh, h: (h, None, None)

    def bdf2(past, w, fresh, h):
        has = fresh < HALF
        return (select(has, splat(w, 2.0 / 3.0 * h), h), select(has, splat(w, 1.0 / 3.0), 0.0),
                splat(w, 0.0))

    def ndf2(past, w, fresh, h):
        has, half = fresh < HALF, fresh < NONE
        return (select(has, splat(w, 0.6 * h), select(half, splat(w, 2.0 / 3.0 * h), h)),
                select(has, splat(w, 0.5), select(half, splat(w, 1.0 / 3.0), 0.0)),
                select(has, splat(w, 0.1), 0.0))
    return bdf2 if isinstance(past[1], types.NoneType) else ndf2


def with_order_reduction(history, now, past, gap, q, h):
    """
    Return the vector ``fresh`` from slot q on, raised to HALF for period-two oscillations.

    The array ``fresh`` is updated too.

    Parameters
    ----------
    history : None with backward Euler
    now, past : v_n, and (v_{n-1}, v_{n-2}), of which BDF2 has one [m/s], each (3, slots)
    gap : distance of neighbours [m], shape (slots,)
    q : slot
    h : substep [s]

    """


@inline(with_order_reduction)
def _with_order_reduction(history, now, past, gap, q, h):
    if isinstance(past[1], types.NoneType):
        return lambda history, now, past, gap, q, h: age(history, q)

    def of_ndf2(history, now, past, gap, q, h):
        fresh, (last, older) = history.fresh, past
        slots, known, along = len(fresh), load(fresh, q), splat(fresh, 0.0)
        for k in range(3):
            i = k * slots + q
            along = fma(load(now, i), load(older, i), along)
        if not any_lane(along < 0.0):
            return known
        further, rougher = splat(fresh, 0.0), splat(fresh, 0.0)
        for k in range(3):
            i = k * slots + q
            v, before, first = load(now, i), load(last, i), load(older, i)
            change, turn = v - first, v - 2.0 * before + first
            further = fma(change, change, further)
            rougher = fma(turn, turn, rougher)
        far = load(gap, q) * (REACH / h)
        found = select(both(along < 0.0, both(further > far * far, rougher > further)),
                       larger(known, HALF), known)
        store(fresh, q, found)
        return found
    return of_ndf2


def mean(now, past, i, a, b):
    """
    Return x̄, or v̄, as a vector of the components from i on.

    ``now`` is the vector x_n; ``past`` as of ``earlier_positions``; a and b as of ``weights``.
    """


@inline(mean)
def _mean(now, past, i, a, b):
    if isinstance(past[0], types.NoneType):
        return lambda now, past, i, a, b: now
    if isinstance(past[1], types.NoneType):
        return lambda now, past, i, a, b: now + a * (now - load(past[0], i))

    def mean_of_three(now, past, i, a, b):
        before = load(past[0], i)
        return now + a * (now - before) - b * (before - load(past[1], i))
    return mean_of_three


def rotate_history(history, x, x_prev, v):
    """Return x, x_prev, v and history with the roles of the next substep; nothing is copied."""


@inline(rotate_history)
def rotate_history_of(history, x, x_prev, v):
    if isinstance(history, types.NoneType):
        return lambda history, x, x_prev, v: (x_prev, x, v, None)
    if isinstance(history[history.fields.index('older_x')], types.NoneType):
        return lambda history, x, x_prev, v: (
            history.x, x, history.v, History(x_prev, v, None, None, history.fresh, None))
    return lambda history, x, x_prev, v: (
        history.older_x, x, history.older_v,
        History(x_prev, v, history.x, history.v, history.fresh, history.fullest))


@jit(inline=True)
def restore_history(home, home_v, history, older_v, v, i):
    """
    Copy velocities and history from i on into the arrays that held them before the substeps.

    ``home`` and ``home_v`` are the history and velocity arrays of the frame's start; ``history``,
    ``older_v`` and ``v`` those after its last substep (see ``integration.restore_buffers``).
    """
    now, before = load(v, i), load(history.v, i)
    if older_v is not None:
        older = load(older_v, i)
        store(home.x, i, load(history.x, i))
        store(home.older_v, i, older)
    store(home_v, i, now)
    store(home.v, i, before)


def end_age(history, w, q):
    """
    Update ``fresh`` from slot q on for the next substep.

    Return the mask of the particles whose velocity was predicted by the history, and ``fresh`` of
    this substep, where pinned particles count as TOUCHED: v = (x - x_n) / h.
    """


@inline(end_age)
def _end_age(history, w, q):
    if isinstance(history, types.NoneType):
        return lambda history, w, q: (load(w, q) > 0.0, None)

    def end(history, w, q):
        fresh = load(history.fresh, q)
        store(history.fresh, q, _next_age(history.fullest, w, fresh))
        fresh = select(load(w, q) > 0.0, fresh, TOUCHED)
        return fresh < TOUCHED, fresh
    return end


def _next_age(kept, w, fresh):
    """Return the vector ``fresh`` of the next substep; ``kept`` is ``History.fullest``."""


@inline(_next_age)
def _next_age_of(kept, w, fresh):
    if isinstance(kept, types.NoneType):
        return lambda kept, w, fresh: select(fresh > NONE, splat(w, NONE), FULL)
    return lambda kept, w, fresh: select(fresh > NONE, splat(w, NONE), select(
        fresh > HALF, splat(w, HALF), splat(w, kept[0])))


@jit
def step_of(history, w, q, h):
    """Return the vector H [s] of the particles from slot q on."""
    if history is None:
        return splat(w, h)
    return weights(earlier_positions(history), w, age(history, q), h)[0]


@jit
def weights_at(history, i):
    """Return H / h, a, b of one particle."""
    if history is None:
        return 1.0, 0.0, 0.0
    return _weights_at(history.older_x, history.fresh[i])


@jit
def weights_before(history, i):
    """Return H / h, a, b with which the positions of one particle were predicted."""
    if history is None:
        return 1.0, 0.0, 0.0
    fresh = history.fresh[i]
    return _weights_at(history.older_x, fresh if fresh < TOUCHED else fresh - TOUCHED)


@jit
def step_at(history, i, h):
    """Return H of one particle [s]."""
    return weights_at(history, i)[0] * h


@jit
def usual_step(history, h):
    """Return H of a particle with a history [s]."""
    if history is None:
        return h
    return _weights_at(history.older_x, fullest(history))[0] * h


@jit
def weights_of(history, fresh):
    """Return H / h, a, b of a particle with this value of ``fresh``."""
    return _weights_at(history.older_x, fresh)


@jit
def later(history, fresh):
    """Return the value of ``fresh`` one substep later."""
    return HALF if history.older_x is not None and fresh > HALF else fullest(history)


@jit
def fullest(history):
    """Return the value of ``fresh`` of a particle with a history as long as it gets."""
    return _fullest(history.fullest)


@jit
def _fullest(kept):
    return FULL if kept is None else kept[0]


@jit
def _weights_at(older, fresh):    # Numba prunes a branch on None where that is an argument
    if fresh > HALF:
        return 1.0, 0.0, 0.0
    if older is not None and fresh < HALF:
        return 0.6, 0.5, 0.1
    return 2.0 / 3.0, 1.0 / 3.0, 0.0
