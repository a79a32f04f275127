"""
Solver methods: each sweeps a substep's constraints in a few walks over the effects.

``gauss_seidel`` projects every effect once. ``gauss_seidel_symmetric`` continues in exactly the
reverse order, which BDF2 needs to stay stable.

``line`` (doc/numerics.md 3.2) solves the effects that have lines, or paths along the edges of
meshes, by whole lines, twice, sweeps the others forth before and back after, or once in between if
they are soft, and closes with one Gauss-Seidel pass over the edges of the lines, with the same
multipliers: it mends the single edges whose directions turned while the lines were solved.

``jacobi`` moves all particles at once, by a part of what each constraint asks for.

``explicit`` is the leapfrog (Störmer 1907, Verlet 1967): in the loop v lags by half a substep, and
the forces are those where the substep starts. Where a frame begins and ends, v is moved by half of
what acts there (``add_explicit_forces`` adds forces without a projection, ``damp_half_kick``
damps their sum), which pins and colliders feel; that half is left out for ``strain_limit`` and
``tether``.
"""

from typing import NamedTuple

from xpbd_ros.sim.backend.emit import written_out
from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.particles.explicit_updates import (
    accumulating,
    add_moves,
    apply_leapfrog_kick,
    at_start,
    half_kick,
    half_of,
)
from xpbd_ros.sim.particles.integration import set_mobility
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping import constraint_stages
from xpbd_ros.sim.stepping.stages import (
    add_explicit_forces,
    damp_half_kick,
    kernel_of,
    lap_integration,
    project,
    project_back,
    react_to_half_kick,
    solve_lines,
    walk,
    write_lap,
)


class GaussSeidel(NamedTuple):
    """One pass over all effects."""

    iterations: int


class Symmetric(NamedTuple):
    """One pass forth and one back."""

    iterations: int


class Line(NamedTuple):
    """Lines, between two passes over what has none; then a pass over the lines' edges."""

    iterations: int


class Jacobi(NamedTuple):
    """One pass from the same positions for all."""

    iterations: int


class Leapfrog(NamedTuple):
    """One pass that sums up forces."""

    iterations: int


METHODS = {'gauss_seidel': GaussSeidel, 'gauss_seidel_symmetric': Symmetric, 'line': Line,
           'jacobi': Jacobi, 'explicit': Leapfrog}


SOFT = 1.0
"""stiffness over mass, times h², for which one pass suffices if smaller (doc/numerics.md 3.2)"""


def forth(effects, state, substep):
    """Sweep forward, but not what is soft: by whole lines where an effect has them."""


def once_forth(effects, state, substep):
    """Sweep soft effects forward, in every other substep."""


def once_back(effects, state, substep):
    """Sweep soft effects backward, in the others."""


def lines_again(effects, state, substep):
    """Solve the lines a second time."""


def back(effects, state, substep):
    """Sweep backward over effects without lines, but not over soft ones."""


def close(effects, state, substep):
    """Do one Gauss-Seidel pass over the edges of the lines."""


def is_swept_once(rate: float, h: float) -> bool:
    """Return True if substeps of h [s] need a single pass, with stiffness over mass [1/s²]."""
    return rate * h * h < SOFT


@jit
def direction(k, substeps):
    """
    Return ``Substep.direction`` of substep k: forward and backward in turn.

    The last of an odd number has no partner, and sweeps soft effects both ways.
    """
    if k % 2 == 0 and k + 1 == substeps:
        return 0
    return 1 - 2 * (k % 2)


@jit
def of_lines(substep):
    """Return a substep of ``line``."""
    return Substep(substep.h, substep.begin, substep.end, substep.iteration,
                   0.0 if substep.direction == 0 else SOFT, substep.direction)


def goes_both_ways(effect, substep):
    """Tell whether an effect's data is swept forth and back: always if it has no ``rate``."""


@inline(goes_both_ways)
def _goes_both_ways(effect, substep):
    if 'rate' in effect.fields:
        return lambda effect, substep: not constraint_stages.is_soft(effect, substep)
    return lambda effect, substep: True


@jit(inline=True)
def goes_forth(effect, substep):
    """Return True if an effect's data is swept once, forward."""
    return constraint_stages.is_soft(effect, substep) and substep.direction > 0


@jit(inline=True)
def goes_back(effect, substep):
    """Return True if an effect's data is swept once, backward."""
    return constraint_stages.is_soft(effect, substep) and substep.direction < 0


def _once(stub, effect):
    """Return the kernel of an effect that may be soft."""
    return kernel_of(stub, effect) if 'rate' in getattr(effect, 'fields', ()) else None


def _has_lines(effect) -> bool:
    return kernel_of(solve_lines, effect) is not None


walk(forth, lambda effect, state: kernel_of(solve_lines, effect) or kernel_of(project, effect),
     opens=True, where=goes_both_ways)
walk(once_forth, lambda effect, state: _once(project, effect), opens=True, where=goes_forth)
walk(once_back, lambda effect, state: _once(project_back, effect), opens=True, backwards=True,
     where=goes_back)
walk(lines_again, lambda effect, state: kernel_of(solve_lines, effect))
walk(back, lambda effect, state: None if _has_lines(effect) else kernel_of(project_back, effect),
     backwards=True, where=goes_both_ways)
walk(close, lambda effect, state: kernel_of(project, effect) if _has_lines(effect) else None)


WALKS = {GaussSeidel: (project,), Symmetric: (project, project_back),
         Line: (forth, once_forth, once_back, lines_again, back, close)}
"""walks of the methods that update positions in place"""


def sweep(method, effects, state, substep):
    """One iteration of a method."""


@written_out(sweep)
def _sweep(writer, method, *values):
    effects, state, substep = values
    kind = method[0].instance_class
    if kind in (Jacobi, Leapfrog):
        start = writer.call(accumulating if kind is Jacobi else at_start, state)
        writer.call(project, effects, start, substep)
        if kind is Jacobi:
            writer.call(add_moves, state)
        else:
            writer.call(apply_leapfrog_kick, state, substep)
        write_lap(writer, state, len(effects[0]))
        return
    if kind is Line:
        substep = writer.call(of_lines, substep)
    for walk_ in WALKS[kind]:
        writer.call(walk_, effects, state, substep)


def enter(method, effects, state, substep):
    """Before the first substep of a frame."""


def leave(method, effects, state, substep):
    """After the last one."""


def _kick_if_leapfrog(stub):
    @written_out(stub)
    def write(writer, method, *values):
        if method[0].instance_class is Leapfrog:
            writer.call(kick, *values)


_kick_if_leapfrog(enter)
_kick_if_leapfrog(leave)


@jit
def kick(effects, state, substep):
    """Move the velocities on by half a substep: back where the frame begins."""
    set_mobility(state, substep.h)
    project(effects, accumulating(state), substep)
    add_explicit_forces(effects, state, substep)
    damp_half_kick(effects, state, substep)
    react_to_half_kick(effects, state, substep)
    half_kick(state, substep.h, half_of(substep))
    lap_integration(effects, state)
