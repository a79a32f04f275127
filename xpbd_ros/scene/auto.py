"""Resolve ``solver.method: auto``: a pure function of the scene, which reads no clock."""

from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np

from xpbd_ros.errors import counted, InputError
from xpbd_ros.scene.cost_table import CostTable, read_table, SHIPPED
from xpbd_ros.scene.model import SolverKeys
from xpbd_ros.scene.stability import (
    explicit_substeps,
    is_rigid,
    is_swept_stretch,
    LINE,
    needed_substeps,
    stability_limit,
    stable_substeps,
)
from xpbd_ros.sim.particles.accumulators import Explicit
from xpbd_ros.sim.particles.history import integrators_with
from xpbd_ros.sim.particles.state import SHORT
from xpbd_ros.sim.stepping.solver import Solver

INTEGRATOR = {'line': 'bdf2', 'gauss_seidel_symmetric': 'bdf2', 'gauss_seidel': 'backward_euler',
              'jacobi': 'backward_euler', 'explicit': 'leapfrog'}
"""default integrator of each method: BDF2 needs a symmetric sweep"""
NDF2_STABLE = 0.08
"""smallest substeps of ``line``, over those that an explicit solver needs for all edges, with
which NDF2 is as stable as BDF2 after a violent start"""
COMPENSATED = 4 / 3
"""time of a substep with compensation of its rounding errors over that without"""
APART = ('jacobi', 'explicit')
"""methods with which it takes at most a seventh more"""
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
        solver = _as_stored(solver, effects, state, frame_dt)
    if keys.error_target is not None and solver.substeps > keys.max_substeps:
        raise InputError(f'solver.max_substeps: must be at least {solver.substeps}, the substeps '
                         f'that the run starts with (got {keys.max_substeps})')
    return solver


def _as_stored(solver: Solver, effects, state, frame_dt: float) -> Solver:
    """Return the setting of a simulation that runs, and refuse what it has no storage for."""
    known = integrators_with(state.history)
    if solver.with_history not in known:
        raise InputError(f'solver.integrator: {solver.with_history} cannot begin while running '
                         f'(these can: {", ".join(known)}); start with it')
    if state.x.dtype == np.float32 and state.rounding is None and (
            frame_dt / solver.substeps < SHORT) and rounds_moves(type(state.apart), effects):
        return replace(solver, reason=f'{solver.reason}; rounding errors are not compensated, as '
                       'it began with longer substeps')
    return solver


def _choose(keys: SolverKeys, effects, state, frame_dt: float, *, live: bool) -> Solver:
    """Choose what the scene leaves open: method, integrator, substeps within ``budget_ms``."""
    barred = {method: name for name, built in effects.items()
              for method in built.incompatible_with}
    method = keys.method
    if method == 'auto':
        method = 'gauss_seidel_symmetric' if 'line' in barred else 'line'
    affordable = _affordable(keys, method, effects, state, frame_dt, live)
    costly = [name for name, built in effects.items()
              if method != 'explicit' and built.fewest_substeps > affordable]
    affordable = max([affordable, *(effects[name].fewest_substeps for name in costly)])
    integrator = keys.integrator or INTEGRATOR[method]
    if (keys.integrator is None and method == 'line' and 'ndf2' not in barred
            and (not live or 'ndf2' in integrators_with(state.history))
            and NDF2_STABLE * explicit_substeps(effects, state, frame_dt)[0]
            <= (keys.substeps or affordable)):
        integrator = 'ndf2'
    _check(keys, method, integrator, barred, effects)
    chosen: dict[str, Any] = {
        'method': method, 'integrator': integrator, 'iterations': keys.iterations,
        'precision': keys.precision, 'threads': keys.threads}
    if method == 'explicit':
        stable = frame_dt * stability_limit(effects, state)
        chosen['rough_frames'] = keys.rough_frames or 0
        chosen['rough_integrator'] = keys.rough_integrator or (
            'bdf2' if keys.rough_frames else 'backward_euler')
        chosen['rough_substeps'] = keys.rough_substeps or _bounded(
            LINE['backward_euler'] * stable, _affordable(
                keys, 'line', effects, state, frame_dt, live))
    if keys.substeps is not None:
        reason = f'{method}, {integrator}, {counted(keys.substeps, "substep")} as given'
        if method == 'explicit' and keys.substeps < stable:
            reason += f'; {ceil(min(stable, 1e9))} would be stable in every orientation'
        return Solver(substeps=keys.substeps, reason=reason, **chosen)
    wanted = needed_substeps(method, integrator, effects, state, frame_dt)
    if method == 'explicit' and wanted > affordable:
        raise InputError(f'solver.method: explicit needs {wanted:.4g} substeps to be stable, '
                         f'and budget_ms ({keys.budget_ms:g} ms) allows {affordable}; take '
                         'line, raise budget_ms or give substeps')
    substeps = _bounded(wanted, affordable)
    h = frame_dt / substeps
    took = 1e-6 * substeps * compensation(method, state, h, live) * table_of(keys).substep_ns(
        method, keys.iterations, effects, state, h, substeps)
    met = _what_they_meet(wanted, affordable, keys.budget_ms, costly)
    return Solver(substeps=substeps, reason=f'auto: {method}, {integrator}, '
                  f'{counted(substeps, "substep")} '
                  f'{met}, about {took:.2g} ms per frame', **chosen)


def _check(keys: SolverKeys, method: str, integrator: str, barred, effects) -> None:
    """
    Raise InputError if the settings of the solver are incompatible with each other or an effect.

    ``barred`` maps a method or integrator to the name of an effect that is incompatible with it.
    """
    if method in barred:
        raise InputError(f"solver.method: '{method}' cannot be combined with {barred[method]}, "
                         'which the scene has; take gauss_seidel_symmetric, gauss_seidel or '
                         'jacobi')
    for key, name in ('integrator', integrator), ('rough_integrator', keys.rough_integrator):
        if name in barred:
            raise InputError(f"solver.{key}: '{name}' is unstable with {barred[name]}, which the "
                             'scene has; take bdf2 or backward_euler')
    if (integrator == 'leapfrog') != (method == 'explicit'):
        fitting = 'leapfrog' if method == 'explicit' else 'backward_euler, bdf2 or ndf2'
        raise InputError(f"solver.integrator: method '{method}' goes with {fitting} "
                         f"(got '{integrator}')")
    if method != 'explicit':
        return
    if keys.iterations > 1:
        raise InputError('solver.iterations: must be 1 with method explicit (got '
                         f'{keys.iterations}); increase substeps instead')
    rigid = next((name for name, built in effects.items() if is_rigid(built)), None)
    if rigid:
        raise InputError(f'solver.method: explicit cannot do rigid constraints, and {rigid} has '
                         'some; give them a compliance or stiffness, or take line')


def _what_they_meet(wanted: float, affordable: int, budget_ms: float, costly: list[str]) -> str:
    """Return whether substeps resolve the stretch or meet the budget, in words."""
    s = 's' * (affordable == 1)    # MIN_SUBSTEPS are taken where they can be
    if wanted <= affordable:
        return f'resolve{s} the stretch'
    if costly:
        return (f'exceed{s} the budget of {budget_ms:g} ms, but fewer take no less time with '
                f'{", ".join(costly)}')
    fill = (f'fill{s} the budget of {budget_ms:g} ms; ' if affordable < MAX_SUBSTEPS else
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
    unfit = any(built.explicit_velocity_lags or is_swept_stretch(name, built)
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
        reason=f'auto: explicit, leapfrog, {counted(substeps, "substep")}, about '
        f'{1e-6 * substeps * per:.2g} ms per frame; rough frames: '
        f'{rough.reason.removeprefix("auto: ")}')


def _is_stable(keys: SolverKeys, effects, state, frame_dt: float) -> bool:
    """Return True if ``explicit`` is stable with the given substeps, or they are left open."""
    return keys.substeps is None or keys.iterations == 1 and (
        keys.substeps >= stable_substeps(effects, state, frame_dt))


def _lines_as_given(keys: SolverKeys) -> Solver:
    """Return ``line`` with the substeps given for a mix, which are too few for ``explicit``."""
    assert keys.substeps is not None
    integrator = keys.rough_integrator or INTEGRATOR['line']
    return Solver('line', integrator, keys.substeps, keys.iterations, keys.precision, keys.threads,
                  f'line, {integrator}, {counted(keys.substeps, "substep")} as given',
                  keys.rough_frames, integrator, keys.rough_substeps or keys.substeps)


def rounds_away(state, h: float) -> bool:
    """Return True if float32 rounds away the distance of a fall in a substep of h [s]."""
    fall = float(np.linalg.norm(state.gravity)) * h * h
    far = np.abs(state.x).max(initial=0.0)
    return bool(state.x.dtype == np.float32 and 0.0 < fall < 0.5 * np.spacing(far))


def rounds_moves(apart: type | None, effects) -> bool:
    """Return True if moves are added to positions, not to the velocities of ``Explicit``."""
    return apart is not Explicit or any(
        built.implicit_with_explicit for built in effects.values())


def _bounded(wanted: float, affordable: int) -> int:
    return int(max(min(ceil(min(wanted, 1e9)), affordable), min(MIN_SUBSTEPS, affordable)))


def compensation(method: str, state, h: float, live: bool = False) -> float:
    """Return the time of a substep of h [s] over that without compensation of its rounding."""
    short = state.rounding is not None if live else h < SHORT
    return COMPENSATED if short and state.x.dtype == np.float32 and method not in APART else 1.0


def _affordable(keys: SolverKeys, method: str, effects, state, frame_dt: float,
                live: bool) -> int:
    """Return the most substeps that fit the budget; the more there are, the less each takes."""
    def fitting(h: float, substeps: int) -> int:
        per = table_of(keys).substep_ns(method, keys.iterations, effects, state, h, substeps)
        return _compensated(keys.budget_ms * 1e6 / per, method, state, frame_dt, live)

    most, found = min(fitting(0.0, MAX_SUBSTEPS), MAX_SUBSTEPS), 0
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
