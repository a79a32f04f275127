"""
How a substep's constraints are swept: each method is a few walks over the scene's effects.

``gauss_seidel`` projects every effect once. ``gauss_seidel_symmetric`` goes on in exactly the
reverse order, which BDF2 needs to stay stable. ``line`` (NUMERICS 5.8) solves the effects that
have lines by whole lines, sweeps the others forth before and back after, and closes with one
Gauss-Seidel pass over the edges of the lines, with the same multipliers: it mends the single edges
whose directions turned while the lines were solved.
"""

from typing import NamedTuple

from numba.extending import overload

from xpbd_ros.sim.jit import INNER
from xpbd_ros.sim.stages import kernel_of, project, project_back, solve_lines, walk


class GaussSeidel(NamedTuple):
    """One pass over all effects."""

    iterations: int


class Symmetric(NamedTuple):
    """One pass forth and one back."""

    iterations: int


class Line(NamedTuple):
    """Lines, between two passes over what has none; then a pass over the lines' edges."""

    iterations: int


METHODS = {'gauss_seidel': GaussSeidel, 'gauss_seidel_symmetric': Symmetric, 'line': Line}


def forth(effects, state, substep):
    """Sweep on: whole lines where an effect has them."""


def back(effects, state, substep):
    """Sweep back over what has no lines."""


def close(effects, state, substep):
    """Pass once more over the edges of the lines."""


def _has_lines(effect) -> bool:
    return kernel_of(solve_lines, effect) is not None


walk(forth, lambda effect, state: kernel_of(solve_lines, effect) or kernel_of(project, effect))
walk(back, lambda effect, state: None if _has_lines(effect) else kernel_of(project_back, effect),
     backwards=True)
walk(close, lambda effect, state: kernel_of(project, effect) if _has_lines(effect) else None)


def sweep(method, effects, state, substep):
    """One iteration of a method."""


@overload(sweep, jit_options=INNER)
def _sweep(method, effects, state, substep):
    if method.instance_class is GaussSeidel:
        def gauss_seidel(method, effects, state, substep):
            project(effects, state, substep)
        return gauss_seidel
    if method.instance_class is Symmetric:
        def symmetric(method, effects, state, substep):
            project(effects, state, substep)
            project_back(effects, state, substep)
        return symmetric

    def line(method, effects, state, substep):
        forth(effects, state, substep)
        back(effects, state, substep)
        close(effects, state, substep)
    return line
