"""Resolve ``solver.method: auto``: a pure function of the scene, which reads no clock."""

from dataclasses import replace
from math import ceil, inf, sqrt
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.cost_table import CostTable, read_table, SHIPPED
from xpbd_ros.scene.model import SolverKeys
from xpbd_ros.sim.particles.history import integrators_with
from xpbd_ros.sim.particles.state import SHORT
from xpbd_ros.sim.stepping.solver import Solver

INTEGRATOR = {'line': 'bdf2', 'gauss_seidel_symmetric': 'bdf2', 'gauss_seidel': 'backward_euler',
              'jacobi': 'backward_euler', 'explicit': 'leapfrog'}
"""default integrator of each method: BDF2 needs a symmetric sweep"""
LINE = {'backward_euler': 0.25, 'bdf2': 0.25, 'ndf2': 0.2}
"""substeps of method ``line`` over those that an explicit solver needs for all edges, by
integrator; constraints that are in no line of a grid need all of theirs"""
NDF2_STABLE = 0.08
"""smallest such ratio with which NDF2 is as stable as BDF2 after a violent start"""
TAUT = 1 / 3
"""the same ratio, where colliders or wind may stretch the cloth: particles in contact take
backward Euler, with which lines that zigzag are stable up to a strain of about 3/4 of the ratio's
square, that is 1/12"""
BENDING = 0.6
"""the same ratio for bending alone, which is in no line: about a millimetre on a metre"""
COMPENSATED = 4 / 3
"""time of a substep with compensation of its rounding errors over that without"""
APART = ('jacobi', 'explicit')
"""methods without it"""
MIN_SUBSTEPS = 4
"""substeps that ``auto`` chooses at least, if the budget allows"""
ROUGH = ('rough_frames', 'rough_integrator', 'rough_substeps')
"""keys of the frames where ``explicit`` is unstable"""
MAX_SUBSTEPS = 10_000
"""substeps that ``auto`` chooses at most, as ``solver.substeps`` allows"""
EXCESS = 1.1
"""time of ``explicit`` over ``budget_ms`` that a mix may have at most: the cost table cannot tell
so little, and the error is several times smaller than that of ``line``"""
CALM_FRAMES = 30
"""calm frames of ``line`` after an unstable one of ``explicit``, in a mix"""


def substep_ratio(method: str, integrator: str) -> float:
    """Return the substeps that a setting needs over those that an explicit solver needs."""
    return LINE[integrator] if method == 'line' else 1.0


def resolve(keys: SolverKeys, effects, state, frame_dt: float, *, live: bool = False) -> Solver:
    """
    Return the solver setting of a scene, with all that it leaves open chosen.

    Parameters
    ----------
    keys : section ``solver`` of the scene
    effects : built effects by name
    state : particles
    frame_dt : frame period [s]
    live : True if a simulation runs, whose storage and kernels cannot change

    Raises
    ------
    InputError : if settings are incompatible, or need more substeps than ``budget_ms`` or
        ``max_substeps`` allows

    """
    given = next((name for name in ROUGH if getattr(keys, name) is not None), None)
    if given and keys.method != 'explicit':
        raise InputError(f'solver.{given}: goes with method explicit (got {keys.method})')
    if keys.method == 'explicit' and keys.rough_frames and not _is_stable(
            keys, effects, state, frame_dt):
        solver = _lines_as_given(keys)
    else:
        solver = _choose(keys, effects, state, frame_dt, live=live)
        if keys.method == 'auto' and (not live or state.apart is not None):
            solver = _with_explicit(solver, keys, effects, state, frame_dt, live=live)
    if live:
        solver = _as_stored(solver, state, frame_dt)
    if keys.error_target is not None and solver.substeps > keys.max_substeps:
        raise InputError(f'solver.max_substeps: must be at least {solver.substeps}, the substeps '
                         f'that the run starts with (got {keys.max_substeps})')
    return solver


def _as_stored(solver: Solver, state, frame_dt: float) -> Solver:
    """Return the setting of a simulation that runs, and refuse what it has no storage for."""
    known = integrators_with(state.history)
    if solver.with_history not in known:
        raise InputError(f'solver.integrator: {solver.with_history} cannot begin while running '
                         f'(these can: {", ".join(known)}); start with it')
    if state.x.dtype == np.float32 and state.rounding is None and state.apart is None and (
            frame_dt / solver.substeps < SHORT):
        return replace(solver, reason=f'{solver.reason}; rounding errors are not compensated, as '
                       'it began with longer substeps')
    return solver


def _choose(keys: SolverKeys, effects, state, frame_dt: float, *, live: bool) -> Solver:
    """
    Choose what the scene leaves open: method, integrator, substeps.

    An explicit solver is stable with N = frame_dt sqrt(Σ k / m) substeps or more, k summed over
    the edges at a particle along one direction. For an error of 1e-3 of the length, the line sweep
    needs about a quarter of them with BDF2 (doc/numerics.md 3.2), a fifth with NDF2, and a third
    where colliders or wind may stretch the cloth. Gauss-Seidel needs all of them to be as stiff as
    asked, as does stretch in no line; bending takes ``BENDING`` of its own. An effect may need a
    number of its own (``Built.least_substeps``), and ``explicit`` that of ``stability_limit``.
    ``budget_ms`` bounds them by the cost table, but not below ``Built.fewest_substeps``.
    """
    barred = {method: name for name, built in effects.items()
              for method in built.incompatible_with}
    method = keys.method
    if method == 'auto':
        method = 'gauss_seidel_symmetric' if 'line' in barred else 'line'
    if method in barred:
        raise InputError(f"solver.method: '{method}' cannot be combined with {barred[method]}, "
                         'which the scene has; take gauss_seidel_symmetric, gauss_seidel or '
                         'jacobi')
    affordable = _affordable(keys, method, effects, state, frame_dt, live)
    costly = [name for name, built in effects.items()
              if method != 'explicit' and built.fewest_substeps > affordable]
    affordable = max([affordable, *(effects[name].fewest_substeps for name in costly)])
    needed, swept = _needed(effects, state, frame_dt)
    integrator = keys.integrator or INTEGRATOR[method]
    if integrator in barred:
        raise InputError(f"solver.integrator: '{integrator}' is unstable with "
                         f'{barred[integrator]}, which the scene has; take bdf2 or backward_euler')
    if (keys.integrator is None and method == 'line' and 'ndf2' not in barred
            and (not live or 'ndf2' in integrators_with(state.history))
            and NDF2_STABLE * needed <= (keys.substeps or affordable)):
        integrator = 'ndf2'
    if (integrator == 'leapfrog') != (method == 'explicit'):
        fitting = 'leapfrog' if method == 'explicit' else 'backward_euler, bdf2 or ndf2'
        raise InputError(f"solver.integrator: method '{method}' goes with {fitting} "
                         f"(got '{integrator}')")
    if keys.rough_integrator in barred:
        raise InputError(f"solver.rough_integrator: '{keys.rough_integrator}' is unstable with "
                         f'{barred[keys.rough_integrator]}, which the scene has; take bdf2 or '
                         'backward_euler')
    if method == 'explicit' and keys.iterations > 1:
        raise InputError('solver.iterations: must be 1 with method explicit (got '
                         f'{keys.iterations}); increase substeps instead')
    chosen: dict[str, Any] = {
        'method': method, 'integrator': integrator, 'iterations': keys.iterations,
        'precision': keys.precision, 'threads': keys.threads}
    if method == 'explicit':
        needed = frame_dt * stability_limit(effects, state)
        chosen['rough_frames'] = keys.rough_frames or 0
        chosen['rough_integrator'] = keys.rough_integrator or (
            'bdf2' if keys.rough_frames else 'backward_euler')
        chosen['rough_substeps'] = keys.rough_substeps or _bounded(
            LINE['backward_euler'] * needed, _affordable(
                keys, 'line', effects, state, frame_dt, live))
    if keys.substeps is not None:
        reason = f'{method}, {integrator}, {keys.substeps} substeps as given'
        if method == 'explicit' and keys.substeps < needed:
            reason += f'; {ceil(min(needed, 1e9))} would be stable in every orientation'
        return Solver(substeps=keys.substeps, reason=reason, **chosen)
    wanted = max([substep_ratio(method, integrator) * needed,
                  *(built.least_substeps(frame_dt) for built in effects.values())])
    if method == 'line':
        taut = any(built.pulls_taut for built in effects.values())
        wanted = max(wanted, swept, TAUT * needed if taut else 0.0,
                     _needed_for_bending(effects, state, frame_dt))
    if method == 'explicit':
        if wanted > affordable:
            raise InputError(f'solver.method: explicit needs {wanted:.4g} substeps to be stable, '
                             f'and budget_ms ({keys.budget_ms:g} ms) allows {affordable}; take '
                             'line, raise budget_ms or give substeps')
        affordable = max(affordable, ceil(wanted))
    substeps = _bounded(wanted, affordable)
    h = frame_dt / substeps
    took = 1e-6 * substeps * compensation(method, state, h, live) * table_of(keys).substep_ns(
        method, keys.iterations, effects, state, h, substeps)
    met = _what_they_meet(wanted, affordable, keys.budget_ms, costly)
    return Solver(substeps=substeps, reason=f'auto: {method}, {integrator}, {substeps} substeps '
                  f'{met}, about {took:.2g} ms per frame', **chosen)


def _what_they_meet(wanted: float, affordable: int, budget_ms: float, costly: list[str]) -> str:
    """Return whether substeps resolve the stretch or meet the budget, in words."""
    if wanted <= affordable:
        return 'resolve the stretch'
    if costly:
        return (f'exceed the budget of {budget_ms:g} ms, but fewer take no less time with '
                f'{", ".join(costly)}')
    fill = (f'fill the budget of {budget_ms:g} ms; ' if affordable < MAX_SUBSTEPS else
            'are the largest number allowed; ')
    if wanted < 1e9:
        return f'{fill}{ceil(wanted)} would resolve it'
    return f'{fill}no number resolves rigid edges'


def _with_explicit(lines: Solver, keys: SolverKeys, effects, state, frame_dt: float, *,
                   live: bool) -> Solver:
    """
    Return a mix of ``explicit`` and ``line`` where its substeps fit the budget, else ``line``.

    They may exceed it by ``EXCESS``.

    Effects whose force is not in the velocities at a frame's ends have no mix, as a change of
    method would change momentum; nor have those that stretch without edges or ``sides``, as the
    check of ``explicit`` frames looks at these. A simulation that began with a mix keeps its
    storage, and returns to ``explicit`` when it can.
    """
    barred = {method for built in effects.values() for method in built.incompatible_with}
    unfit = any(built.explicit_velocity_lags or _is_swept_stretch(name, built)
                and built.sides is None for name, built in effects.items())
    if (lines.method != 'line' or 'explicit' in barred or unfit or keys.integrator is not None
            or keys.error_target is not None or keys.substeps is not None and not live):
        return lines
    rough = lines if keys.substeps is None else _choose(
        replace(keys, substeps=None), effects, state, frame_dt, live=live)
    per = table_of(keys).substep_ns('explicit', 1, effects, state)
    wanted = stable_substeps(effects, state, frame_dt)
    affordable = max(1, int(EXCESS * keys.budget_ms * 1e6 / per))
    substeps = keys.substeps or _bounded(wanted, affordable)
    fits = (keys.iterations == 1 and MAX_SUBSTEPS >= substeps >= wanted
            and not rounds_away(state, frame_dt / substeps))
    if not fits and not live:
        return lines
    mixed = replace(lines, rough_frames=CALM_FRAMES, rough_substeps=rough.substeps,
                    rough_integrator=rough.integrator if fits else lines.integrator)
    if not fits:
        return mixed
    return replace(
        mixed, method='explicit', integrator='leapfrog', substeps=substeps,
        reason=f'auto: explicit, leapfrog, {substeps} substeps, about {1e-6 * substeps * per:.2g} '
        f'ms per frame; rough frames: {rough.reason.removeprefix("auto: ")}')


def _is_stable(keys: SolverKeys, effects, state, frame_dt: float) -> bool:
    """Return True if ``explicit`` is stable with the given substeps, or they are left open."""
    return keys.substeps is None or keys.iterations == 1 and (
        keys.substeps >= stable_substeps(effects, state, frame_dt))


def _lines_as_given(keys: SolverKeys) -> Solver:
    """Return ``line`` with the substeps given for a mix, which are too few for ``explicit``."""
    assert keys.substeps is not None
    integrator = keys.rough_integrator or INTEGRATOR['line']
    return Solver('line', integrator, keys.substeps, keys.iterations, keys.precision, keys.threads,
                  f'line, {integrator}, {keys.substeps} substeps as given', keys.rough_frames,
                  integrator, keys.rough_substeps or keys.substeps)


def stable_substeps(effects, state, frame_dt: float) -> float:
    """Return the substeps that ``explicit`` needs; infinite with rigid constraints."""
    if any((built.constraints.compliance == 0.0).any() for built in effects.values()
           if built.constraints is not None):
        return inf
    return max([frame_dt * stability_limit(effects, state),
                *(built.least_substeps(frame_dt) for built in effects.values())])


def rounds_away(state, h: float) -> bool:
    """Return True if float32 rounds away the distance of a fall in a substep of h [s]."""
    fall = float(np.linalg.norm(state.gravity)) * h * h
    far = np.abs(state.x).max(initial=0.0)
    return bool(state.x.dtype == np.float32 and 0.0 < fall < 0.5 * np.spacing(far))


def _bounded(wanted: float, affordable: int) -> int:
    return int(max(min(ceil(min(wanted, 1e9)), affordable), min(MIN_SUBSTEPS, affordable)))


def compensation(method: str, state, h: float, live: bool = False) -> float:
    """Return the time of a substep of h [s] over that without compensation of its rounding."""
    short = state.rounding is not None if live else h < SHORT
    return COMPENSATED if short and state.x.dtype == np.float32 and method not in APART else 1.0


def _affordable(keys: SolverKeys, method: str, effects, state, frame_dt: float,
                live: bool) -> int:
    """Return the most substeps that fit the budget; short ones take less time (``SOFT``)."""
    def fitting(h: float, substeps: int = 2) -> int:
        per = table_of(keys).substep_ns(method, keys.iterations, effects, state, h, substeps)
        return _compensated(keys.budget_ms * 1e6 / per, method, state, frame_dt, live)

    most, found = min(fitting(0.0), MAX_SUBSTEPS), 0
    while found != most:    # fewer are longer, so that the number only falls
        found, most = most, min(most, fitting(frame_dt / most, most))
    return most


def _compensated(uncompensated: float, method: str, state, frame_dt: float, live: bool) -> int:
    """Return the substeps that fit the budget, from their number without compensation."""
    count = max(1, int(uncompensated))
    factor = compensation(method, state, frame_dt / count, live)
    fewest = 1 if live else int(frame_dt / SHORT)    # below which there is no compensation
    return count if factor == 1.0 else max(fewest, int(uncompensated / factor))


def table_of(keys: SolverKeys) -> CostTable:
    """Return the cost table of a scene: the shipped one unless it names a file."""
    return SHIPPED if keys.cost_table is None else read_table(keys.cost_table)


def stability_limit(effects, state) -> float:
    """
    Return an upper bound of half the highest angular frequency [1/s].

    Leapfrog is stable with at least so many substeps per second.

    x K x = Σ k (n·(x_i - x_j))² ≤ Σ x_i (2 Σ k n nᵀ) x_i, so ω² is at most the largest eigenvalue
    of 2 Σ k n nᵀ / m_i over the particles; for edges, whichever way n turns, 2 Σ k / m_i.
    """
    total = np.zeros((state.x.shape[1], 3, 3))
    for name, built in effects.items():
        if built.constraints is None:
            continue
        if (built.constraints.compliance == 0.0).any():
            raise InputError(f'solver.method: explicit cannot do rigid constraints, and {name} '
                             'has some; give them a compliance or stiffness, or take line')
        total += built.constraints.stiffness_bound(state.x)
    there = state.mass > 0.0
    rate = np.linalg.eigvalsh(total[there])[:, -1] / state.mass[there]
    return 0.5 * sqrt(rate.max(initial=0.0))


def _needed(effects, state, frame_dt: float) -> tuple[float, float]:
    """Return the explicit substeps: for all edges, for those in no line of a grid."""
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
        elif _is_swept_stretch(name, built):
            swept += stability_limit({name: built}, state)**2
    for_all, for_swept = (frame_dt * sqrt(rate) if rate < 1e20 else inf
                          for rate in (on_lines + swept, swept))
    return for_all, for_swept


def _needed_for_bending(effects, state, frame_dt: float) -> float:
    """Return the substeps of ``line`` for what ``_needed`` leaves out; 0 if that is rigid."""
    bending = {name: built for name, built in effects.items()
               if built.constraints is not None and built.constraints.particles.shape[1] != 2
               and name != 'shear' and not _is_swept_stretch(name, built)}
    if any((built.constraints.compliance == 0.0).any() for built in bending.values()):
        return 0.0
    return BENDING * frame_dt * stability_limit(bending, state) if bending else 0.0


def _is_swept_stretch(name: str, built) -> bool:
    """Return True for effects that stretch without edges: membranes, areas, bodies, gas."""
    if built.constraints is None or name == 'shear':
        return False
    size = built.constraints.particles.shape[1]
    return size != 2 and (size < 4 or hasattr(built.constraints, 'stretch'))


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
