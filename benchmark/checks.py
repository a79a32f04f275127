"""Whether a kernel computes what it should, before it is timed: a wrong one must not win."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from native import BendBound, GridBound, LinesBound, Native, Textbook
from works import FRAME_DT, Hinges, LineWork, SUBSTEPS, Work

ROUNDING = {'float32': 2e-6, 'float64': 1e-13}
"""[m], on positions of 1 m"""
FRAMES = 2


class WrongResultError(Exception):
    """A kernel that does not compute what it should."""


def check_grid_bound(native: Native, work: Work, precision: str, bound: GridBound) -> None:
    """Compare whole steps with the textbook's, its edges put into the bound's own order."""
    order = _matching(work.edges.particles, bound.order())
    textbook = Textbook(native, replace(work, edges=work.edges.ordered(order)), precision)
    textbook.advance(FRAMES, FRAME_DT, SUBSTEPS)
    bound.reset()
    bound.advance(FRAMES * SUBSTEPS, FRAME_DT / SUBSTEPS)
    _near('grid bound', bound.positions(), textbook.positions(), ROUNDING[precision])


def check_bend_bound(native: Native, work: Work, precision: str, bound: BendBound) -> None:
    """Give the bound its weights, and compare a few passes with the textbook's in its order."""
    order, particles = _matching(work.hinges.particles, bound.order()), bound.order()
    theirs = work.hinges.particles[order]
    place = (particles[:, :, None] == theirs[:, None, :]).argmax(2)
    hinges = Hinges(particles, np.take_along_axis(work.hinges.weight[order], place, 1),
                    work.hinges.compliance[order])
    h = FRAME_DT / SUBSTEPS
    bound.weigh(hinges.weight, float(hinges.compliance[0] / h**2))
    bound.reset()
    bound.project(3)
    textbook = Textbook(native, replace(work, hinges=hinges), precision)
    textbook.project(3, h)
    _near('bend bound', bound.positions(), textbook.positions(), ROUNDING[precision])


def check_lines(works: Sequence[LineWork], precision: str, name: str,
                solve: Callable[[int], tuple[np.ndarray, ...]]) -> None:
    """
    Compare two passes with SciPy's banded solver; the second starts from the first's multipliers.

    Parameters
    ----------
    works : the directions that a pass solves, one after another; they share their particles
    solve : does so many passes from the works' start; returns x [m], shape (n, n, 3), and the
        multipliers [N s²] of each direction, shape (n, n)

    """
    x, *multipliers = solve(2)
    expected_x = works[0].x
    expected = [np.zeros((work.n, work.n)) for work in works]
    for _ in range(2):
        for k, work in enumerate(works):
            expected_x, expected[k] = solved_lines(work, expected_x, expected[k])
    _near(name, x, expected_x, ROUNDING[precision])
    for work, got, wanted in zip(works, multipliers, expected):
        last = (slice(None), -1) if work.along else -1    # stands for no edge
        got = got.copy()
        got[last] = 0.0
        scale = np.abs(wanted).max()
        _near(f"{name}'s multipliers", got / scale, wanted / scale, 50 * ROUNDING[precision])


def solved_lines(work: LineWork, x: np.ndarray,
                 multiplier: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x [m] and multipliers [N s²] after one pass, as ``LineWork`` has them, by SciPy."""
    from scipy.linalg import solveh_banded

    def by_line(array):
        return array if work.along else np.swapaxes(array, 0, 1)

    x, multiplier = by_line(x).copy(), by_line(multiplier).copy()
    w, rest = by_line(work.inv_mass), by_line(work.rest_length)[:, :-1]
    alpha = by_line(work.compliance)[:, :-1] / work.h**2
    d = np.diff(x, axis=1)
    l = np.linalg.norm(d, axis=2)
    u = d / l[..., None]
    diagonal = w[:, 1:] + w[:, :-1] + alpha
    beside = -w[:, 1:-1] * (u[:, 1:] * u[:, :-1]).sum(2)
    residual = l - rest + alpha * multiplier[:, :-1]
    change = np.stack([
        solveh_banded([np.append(0.0, beside[line]), diagonal[line]], -residual[line])
        for line in range(work.n)])
    multiplier[:, :-1] += change
    impulse = change[..., None] * u
    x[:, 1:] += w[:, 1:, None] * impulse
    x[:, :-1] -= w[:, :-1, None] * impulse
    return by_line(x), by_line(multiplier)


def check_lines_bound(work: LineWork, precision: str, bound: LinesBound) -> None:
    """Compare the bound with SciPy."""
    def solve(passes):
        bound.reset()
        bound.solve(passes)
        return bound.state()

    check_lines([work], precision, f'line bound {"along" if work.along else "across"}', solve)


def check_steps(native: Native, work: Work, precision: str, name: str,
                positions_after: Callable[[Work, int], np.ndarray]) -> None:
    """
    Compare whole steps with the textbook's, whatever the order of the sweep.

    On the same particles and edges, crumpled and so soft that the order hardly shows: an edge then
    takes back 1e-3 of its residual. In float64 a single edge left out is seen.

    Parameters
    ----------
    positions_after : advances a work by so many frames and returns x [m], shape (particles, 3)

    """
    h2 = (FRAME_DT / SUBSTEPS)**2
    kind = np.unique(work.edges.compliance, return_inverse=True)[1]
    compliance = 1e3 * 2 * work.inv_mass.max() * h2 * (1 + 0.5 * kind)
    jitter = 0.2 / (work.n - 1) * np.random.default_rng(3).standard_normal(work.x.shape)
    soft = replace(work, x=work.x + jitter, edges=replace(work.edges, compliance=compliance))

    def textbook(work):
        cloth = Textbook(native, work, 'float64')
        cloth.advance(FRAMES, FRAME_DT, SUBSTEPS)
        return cloth.positions()

    expected = textbook(soft)
    motion = expected - textbook(replace(soft, edges=None))
    tolerance = (0.02 * np.sqrt((motion**2).sum(1).mean())
                 + FRAMES * SUBSTEPS * ROUNDING[precision])
    _near(name, positions_after(soft, FRAMES), expected, float(tolerance))


def check_bend(native: Native, work: Work, precision: str, name: str,
               positions_after: Callable[[Work, int], np.ndarray]) -> None:
    """
    Compare after many passes: bending is linear, so the order of the sweep no longer shows.

    On the same hinges, so soft that few passes are many.

    Parameters
    ----------
    positions_after : does so many passes on a work and returns x [m], shape (particles, 3)

    """
    h, passes = FRAME_DT / SUBSTEPS, 200
    w = (work.inv_mass[work.hinges.particles] * work.hinges.weight**2).sum(1)
    compliance = np.full(len(w), np.median(w) * h**2)
    soft = replace(work, hinges=replace(work.hinges, compliance=compliance))
    textbook = Textbook(native, soft, precision)
    textbook.project(passes, h)
    _near(name, positions_after(soft, passes), textbook.positions(), 10 * ROUNDING[precision])


def _matching(particles: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return where in ``particles`` each wanted constraint stands; both hold the same ones."""
    ours, theirs = (np.sort(array.astype(np.int64), axis=1) for array in (particles, wanted))
    ours_by, theirs_by = np.lexsort(ours.T), np.lexsort(theirs.T)
    if ours.shape != theirs.shape or (ours[ours_by] != theirs[theirs_by]).any():
        raise WrongResultError('the bound projects other constraints than it should')
    order = np.empty(len(ours), np.int64)
    order[theirs_by] = ours_by
    return order


def _near(name: str, got: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    error = np.abs(got - expected).max()
    if not error <= tolerance:
        raise WrongResultError(f'{name}: off by {error:.1e} (at most {tolerance:.0e})')

