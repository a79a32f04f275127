"""
The stages of elastic constraints: sweeps and forces on pinned particles, by one registration.

    @constraint(Area, particles=3)
    @jit(inline=True)
    def solve_area(area, apart, c, x, m):

registers the kernel for one vector of constraints (``constraints.sweeps``) and, for the type of
their batch, the stages ``project`` and ``project_back``. The first sweep of a substep zeroes the
multipliers (algorithm 1, line 4), unless a ``prepare`` of the type does.
"""

from collections.abc import Callable
from types import FunctionType

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.constraints.coloured_sweeps import (
    is_coloured,
    sweep_coloured_packs,
    sweep_coloured_runs,
)
from xpbd_ros.sim.constraints.pinned_edges import react_edges
from xpbd_ros.sim.constraints.sweeps import (
    batch_of,
    batch_type,
    held_of,
    projection,
    sweep_packs,
    sweep_runs,
)
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    is_none,
    react_to_half_kick,
    stage,
    stage_of_sweeps,
)


def _react(data, state, substep):
    """Add the forces of edges between two immobile particles."""
    batch = batch_of(data)
    react_edges(held_of(batch), batch.force, state, substep)


def _project(data, state, substep, reverse, zeroes):
    """
    Project all constraints once, in reverse order if ``reverse``.

    With ``zeroes``, the first iteration zeroes the multipliers.
    """
    sweep(batch_of(data), state, substep, reverse, zeroes and substep.iteration == 0,
          share_of_mobility(data, substep))


@jit(inline=True)
def is_soft(data, substep):
    """Return True if data that has a ``rate`` is swept once in a substep."""
    return data.rate * substep.h * substep.h < substep.soft


def share_of_mobility(data, substep):
    """
    Return the share of W with which multipliers are solved for; None: all of it, always.

    That is so in methods other than ``line``, whose kernels then have no such factor.

    In a single pass a multiplier sees what earlier ones have done, not the later ones: half of
    its coupling. With half of the diagonal as well, smooth multipliers, whose coupling and
    diagonal cancel, come out right (doc/numerics.md 3.2).
    """


@inline(share_of_mobility)
def _share_of_mobility(data, substep):
    if 'rate' not in data.fields or is_none(substep, 'soft'):
        return lambda data, substep: None
    return lambda data, substep: 0.5 if is_soft(data, substep) else 1.0


def sweep(batch, state, substep, reverse, fresh, share):
    """Project the constraints of a batch, on grids or meshes, in sequential or coloured order."""


@inline(sweep)
def _sweep(batch, state, substep, reverse, fresh, share):
    if 'runs' in batch.fields:
        return sweep_coloured_runs if is_coloured(batch) else sweep_runs
    return sweep_coloured_packs if is_coloured(batch) else sweep_packs


def _is_shared(data) -> bool:
    """Return True if threads share a sweep of an effect's data, given as Numba types it."""
    batch = batch_type(data)
    return 'runs' in batch.fields or is_coloured(batch)


def _kernel_for(kind: type, stage_: str, function: Callable) -> Callable:
    """
    Return a kernel for one type of data, with a name of its own.

    The name separates it in machine code and in the disk cache, since reading a cache with the
    types of other effects would import these.
    """
    own = FunctionType(function.__code__, function.__globals__, f'{stage_}_{kind.__name__}')
    own.__module__, own.__qualname__ = function.__module__, own.__name__
    return jit(own)


def _register(kind: type) -> None:
    stage_of_sweeps(kind, _kernel_for(kind, 'project', _project), shared=_is_shared)


def constraint(kind: type, *, particles: int) -> Callable:
    """Register the kernel for a vector of constraints, and the stages of their batch."""
    def register(kernel):
        _register(kind)
        return projection(kind, particles=particles)(kernel)
    return register


def elastic_edges(kind: type) -> type:
    """Register the stages of data whose field ``edges`` holds elastic edges."""
    _register(kind)
    kernel = _kernel_for(kind, 'react', _react)
    for stub in (accumulate_reactions, react_to_half_kick):
        stage(stub, kind)(kernel)
    return kind
