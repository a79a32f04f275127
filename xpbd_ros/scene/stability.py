"""Substeps that the constraints of a scene need, from the frequencies of its springs."""

from math import inf, sqrt

import numpy as np

LINE = {'backward_euler': 0.25, 'bdf2': 0.25, 'ndf2': 0.2}
"""substeps of method ``line`` over those that an explicit solver needs for all edges, by
integrator; constraints that are in no line of a grid need all of theirs"""
TAUT = 1 / 3
"""the same ratio, where colliders or wind may stretch the cloth: particles in contact take
backward Euler, with which lines that zigzag are stable up to a strain of about 3/4 of the ratio's
square, that is 1/12"""
BENDING = 0.6
"""the same ratio for bending alone, which is in no line: about a millimetre on a metre"""


def substep_ratio(method: str, integrator: str) -> float:
    """Return the substeps that a setting needs over those that an explicit solver needs."""
    return LINE[integrator] if method == 'line' else 1.0


def needed_substeps(method: str, integrator: str, effects, state, frame_dt: float) -> float:
    """
    Return the substeps for an error of about 1e-3 of the length (doc/numerics.md 3.2).

    An explicit solver is stable with N = frame_dt sqrt(Σ k / m) substeps or more, k summed over
    the edges at a particle along one direction. ``line`` needs about a quarter of them with BDF2,
    a fifth with NDF2, and a third where colliders or wind may stretch the cloth. Gauss-Seidel
    needs all of them to be as stiff as asked, as does stretch in no line; bending takes
    ``BENDING`` of its own. An effect may need a number of its own (``Built.least_substeps``).
    """
    if method == 'explicit':
        return stable_substeps(effects, state, frame_dt)
    for_all, for_swept = explicit_substeps(effects, state, frame_dt)
    needed = [substep_ratio(method, integrator) * for_all,
              *(built.least_substeps(frame_dt) for built in effects.values())]
    if method == 'line':
        needed += [for_swept, BENDING * frame_dt * stability_limit(_bending(effects), state)]
        if any(built.pulls_taut for built in effects.values()):
            needed.append(TAUT * for_all)
    return max(needed)


def stable_substeps(effects, state, frame_dt: float) -> float:
    """Return the substeps that ``explicit`` needs; infinite with rigid constraints."""
    return max([frame_dt * stability_limit(effects, state),
                *(built.least_substeps(frame_dt) for built in effects.values())])


def stability_limit(effects, state) -> float:
    """
    Return an upper bound of half the highest angular frequency [1/s].

    Leapfrog is stable with at least so many substeps per second; infinite with rigid constraints.

    x K x = Σ k (n·(x_i - x_j))² ≤ Σ x_i (2 Σ k n nᵀ) x_i, so ω² is at most the largest eigenvalue
    of 2 Σ k n nᵀ / m_i over the particles; for edges, whichever way n turns, 2 Σ k / m_i.
    """
    total = np.zeros((state.x.shape[1], 3, 3))
    for built in effects.values():
        if built.constraints is None:
            continue
        if is_rigid(built):
            return inf
        total += built.constraints.stiffness_bound(state.x)
    there = state.mass > 0.0
    rate = np.linalg.eigvalsh(total[there])[:, -1] / state.mass[there]
    return 0.5 * sqrt(rate.max(initial=0.0))


def explicit_substeps(effects, state, frame_dt: float) -> tuple[float, float]:
    """Return what an explicit solver needs: for all edges, for those in no line of a grid."""
    on_lines, swept = 0.0, 0.0
    for name, built in effects.items():
        if built.constraints is None:
            continue
        size = built.constraints.particles.shape[1]
        if size == 2 or name == 'shear':
            for part, edges in zip(built.parts, built.by_part):
                rate = largest_rate(edges, state.mass)
                if hasattr(part, 'lines'):
                    on_lines += rate
                else:
                    swept += rate
        elif is_swept_stretch(name, built):
            swept += stability_limit({name: built}, state)**2
    for_all, for_swept = (frame_dt * sqrt(rate) if rate < 1e20 else inf
                          for rate in (on_lines + swept, swept))
    return for_all, for_swept


def _bending(effects) -> dict:
    """Return the effects that ``explicit_substeps`` leaves out."""
    return {name: built for name, built in effects.items()
            if built.constraints is not None and built.constraints.particles.shape[1] != 2
            and name != 'shear' and not is_swept_stretch(name, built)}


def is_swept_stretch(name: str, built) -> bool:
    """Return True for effects that stretch without edges: membranes, areas, bodies, gas."""
    if built.constraints is None or name == 'shear':
        return False
    size = built.constraints.particles.shape[1]
    return size != 2 and (size < 4 or hasattr(built.constraints, 'stretch'))


def is_rigid(built) -> bool:
    """Return True if a constraint of the effect has no compliance."""
    return built.constraints is not None and bool((built.constraints.compliance == 0.0).any())


def largest_rate(edges, mass) -> float:
    """
    Return the largest Σ 1/m / (2 α) of edges, or of the shear constraints of cells [1/s²].

    The sum is over the particles of a constraint. Infinite if one of them is rigid.
    """
    if not len(edges.particles):
        return 0.0
    if (edges.compliance == 0.0).any():
        return inf
    w = 1.0 / mass[edges.particles].astype(float)
    return float((0.5 * w.sum(1) / edges.compliance).max())
