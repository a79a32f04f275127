"""
The stages of a substep: stubs that each effect fills in for its own type.

An effect's data is a NamedTuple; its file registers a kernel with ``@stage(project, Stretch)``.
A stage called with a scene's tuple of effects is resolved while Numba compiles, by their types,
into one call per kernel. An effect that takes no part in a stage, or is not in the scene at all,
leaves no trace in the machine code.
"""

from collections.abc import Callable

from numba import types
from numba.extending import overload


def force(effects, state, substep):
    """Change velocities before the prediction."""


def prepare(effects, state, substep):
    """Once per substep, after the prediction: targets, candidates, forces back to zero."""


def project(effects, state, substep):
    """Move the particles towards the constraints' surface, once per iteration."""


def finish(effects, state, substep):
    """Once per substep, after the velocities are known."""


def react(effects, state, substep):
    """Add up the forces on pinned particles; compiled only where ``state.reaction`` exists."""


_KERNELS: dict[tuple[Callable, type], Callable] = {}


def stage(stub: Callable, kind: type) -> Callable:
    """Register a compiled kernel as the given stage of one effect's type."""
    def register(kernel):
        _KERNELS[stub, kind] = kernel
        return kernel
    return register


def _asks_for_forces(state) -> bool:
    """Tell whether a state, as Numba types it, has a place for forces."""
    return not isinstance(state[state.fields.index('reaction')], types.NoneType)


def _walk(stub: Callable) -> None:
    """
    Let Numba compile a stage for a tuple of effects: their kernels, first to last.

    The calls are written out flat, one line each: a walk that splits the tuple recursively is a
    function per effect and stage, which took half of the cold compile time.
    """
    @overload(stub)
    def compile_stage(effects, state, substep):
        kinds = [getattr(effect, 'instance_class', None) for effect in effects]
        kernels = {k: _KERNELS[stub, kind] for k, kind in enumerate(kinds)
                   if (stub, kind) in _KERNELS}
        if stub is react and not _asks_for_forces(state):
            kernels = {}
        calls = [f'    kernel_{k}(effects[{k}], state, substep)' for k in kernels]
        names = {f'kernel_{k}': kernel for k, kernel in kernels.items()}
        exec('\n'.join(['def walk(effects, state, substep):', *calls, '    return']), names)
        return names['walk']


for _stub in (force, prepare, project, finish, react):
    _walk(_stub)
