"""
The stages of a substep: stubs that each effect fills in for its own type.

An effect's data is a NamedTuple; its file registers a kernel with ``@stage(project, Stretch)``.
A stage called with a scene's tuple of effects walks the tuple while Numba compiles, and picks each
kernel by type. An effect that takes no part in a stage, or is not in the scene at all, leaves no
trace in the machine code.
"""

from collections.abc import Callable

from numba import types
from numba.extending import overload

from xpbd_ros.sim.jit import INNER


def force(effects, state, substep):
    """Change predicted velocities v by some Δv, positions x by H Δv, and mobilities."""


def prepare(effects, state, substep):
    """Once per substep, after the prediction: targets, candidates, forces back to zero."""


def project(effects, state, substep):
    """One Gauss-Seidel pass over an effect's constraints."""


def project_back(effects, state, substep):
    """Do the same pass in exactly the reverse order."""


def solve_lines(effects, state, substep):
    """Solve whole lines of constraints at once, for an effect that has lines."""


def touch(effects, state, substep):
    """Contact and friction, after everything else of an iteration."""


def bound(effects, state, substep):
    """Last in an iteration: how far particles may get."""


def finish(effects, state, substep):
    """Once per substep, after the velocities are known."""


def kick(effects, state, substep):
    """
    Add up the moves h² F / m of what acts at x without a projection.

    The leapfrog asks at both ends of a frame, to tell the velocities there from those half a
    substep away; what is held by an impulse in every substep has no such difference.
    """


def react(effects, state, substep):
    """Add up the forces on pinned particles; compiled only where ``state.reaction`` exists."""


_KERNELS: dict[tuple[Callable, type], Callable] = {}


def stage(stub: Callable, kind: type) -> Callable:
    """Register a compiled kernel as the given stage of one effect's type."""
    def register(kernel):
        _KERNELS[stub, kind] = kernel
        return kernel
    return register


def kernel_of(stub: Callable, effect) -> Callable | None:
    """Return the kernel for a stage of an effect, given as Numba types it; None: no part in it."""
    return _KERNELS.get((stub, getattr(effect, 'instance_class', None)))


def walk(stub: Callable, choose: Callable, *, backwards: bool = False) -> None:
    """
    Let Numba compile ``stub`` for a tuple of effects: one call after another, in their order.

    ``choose(effect, state)`` returns the kernel for an effect's type, or None. The calls are
    written out in one function, since Numba optimises nested ones once per level.
    """
    @overload(stub, jit_options=INNER)
    def compile_stage(effects, state, substep):
        kernels = {k: choose(effect, state) for k, effect in enumerate(effects)}
        kernels = {f'kernel_{k}': kernel for k, kernel in kernels.items() if kernel is not None}
        names = list(kernels)[::-1] if backwards else list(kernels)
        calls = [f'{name}(effects[{name[7:]}], state, substep)' for name in names] or ['pass']
        exec('\n    '.join(['def compiled(effects, state, substep):', *calls]), kernels)
        return kernels['compiled']


def _asks_for_forces(state) -> bool:
    """Tell whether a state, as Numba types it, has a place for forces."""
    return not isinstance(state[state.fields.index('reaction')], types.NoneType)


for _stub in (force, prepare, project, touch, bound, finish, kick):
    walk(_stub, lambda effect, state, stub=_stub: kernel_of(stub, effect))
walk(project_back, lambda effect, state: kernel_of(project_back, effect), backwards=True)
walk(react, lambda effect, state: kernel_of(react, effect) if _asks_for_forces(state) else None)
