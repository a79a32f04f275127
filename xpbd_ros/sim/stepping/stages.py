"""
The stages of a substep: stubs that each effect fills in for its own type.

An effect's data is a NamedTuple; its file registers a kernel with ``@stage(project, Stretch)``.
A stage called with a scene's tuple of effects walks the tuple while Numba compiles, and picks each
kernel by type. An effect that takes no part in a stage, or is not in the scene at all, leaves no
trace in the machine code.
"""

from collections.abc import Callable
from contextlib import nullcontext
from itertools import groupby

from numba import types
from numba.extending import lower_builtin, type_callable

from xpbd_ros.sim.backend.emit import Writer, written_out
from xpbd_ros.sim.backend.threads import alone, wait


def force(effects, state, substep):
    """Change predicted velocities v and mobilities; then x = x̄ + H v is predicted again."""


def has_force(effects):
    """Tell whether an effect takes part in ``force``."""


def prepare(effects, state, substep):
    """Once per substep, after the prediction: targets, candidates, forces back to zero."""


def project(effects, state, substep):
    """One Gauss-Seidel pass over an effect's constraints."""


def project_back(effects, state, substep):
    """Do the same pass in exactly reverse order."""


def solve_lines(effects, state, substep):
    """Solve whole lines of constraints at once, for an effect that has lines."""


def project_inequalities(effects, state, substep):
    """Project contact, friction, seams and limits, after an iteration's elastic constraints."""


def limit_motion(effects, state, substep):
    """Limit how far particles may move; last in an iteration."""


def are_inequalities_unmet(effects, state, turn):
    """Tell whether a later effect undid an earlier one, so that they must be projected again."""


def may_repeat_inequalities(effects):
    """Tell whether an effect takes part in ``are_inequalities_unmet``."""


def finish(effects, state, substep):
    """Once per substep, after the velocities are known."""


def has_finish(effects):
    """Tell whether an effect takes part in ``finish``, so that velocities must be known there."""


def add_explicit_forces(effects, state, substep):
    """
    Add up the moves h² F / m of what acts at x without a projection.

    The leapfrog asks at both ends of a frame, to tell the velocities there from those half a
    substep away; what is held by an impulse in every substep has no such difference.
    """


def damp_half_kick(effects, state, substep):
    """Damp the moves that all effects have added up in ``add_explicit_forces``."""


def accumulate_reactions(effects, state, substep):
    """
    Add up the forces on pinned particles; compiled only where ``state.reaction`` exists.

    In reverse order: pins, which come first among the effects, find what the others did.
    """


def react_to_half_kick(effects, state, substep):
    """
    Do what ``accumulate_reactions`` does, where the leapfrog moves v by half a substep.

    ``substep.end - substep.begin`` is the share of the frame, negative at the frame's start. For
    the effects that take part in these half kicks (doc/numerics.md 2.3).
    """


def accumulate_impulses(effects, state, substep):
    """
    Add up the impulses on outside bodies, once the positions of a substep are final.

    Velocities are still those predicted, and ``History.fresh`` is that of the substep.
    """


def lap(clock, row):
    """Add the time since the last call to a row, by a kernel for the type of ``state.clock``."""


def lap_integration(effects, state):
    """Do so for the row after those of the effects; nothing where there is no clock."""


KERNELS: dict[tuple[Callable, type | None], Callable] = {}
_SHARED: dict[Callable, bool | Callable] = {}
ON_DEVICE: set[Callable] = set()
"""kernels of one thread of a CPU that all threads of a GPU share"""
SWEEPS: set[Callable] = set()
QUESTIONS: dict[Callable, Callable] = {}


def stage(stub: Callable, kind: type, *, shared: bool | Callable = False,
          on_device: bool = False) -> Callable:
    """
    Register a compiled kernel as the given stage of one effect's type.

    One that is ``shared`` does this thread's part of the work and waits for the others
    (``backend.threads``); what is not shared is done by one thread. It may be a function that says
    so for an effect as Numba types it. One that is ``on_device`` is shared by the threads of a GPU
    only.
    """
    def register(kernel):
        KERNELS[stub, kind] = kernel
        _SHARED[kernel] = shared
        if on_device:
            ON_DEVICE.add(kernel)
        return kernel
    return register


def stage_of_sweeps(kind: type, kernel: Callable, *, shared: Callable) -> None:
    """
    Register one kernel for ``project`` and ``project_back``.

    Its fourth argument is True in ``project_back``. Its fifth is True in the first walk of an
    iteration for a type without ``prepare``, whose multipliers the first iteration has to zero.
    """
    for stub in (project, project_back):
        stage(stub, kind, shared=shared)(kernel)
    SWEEPS.add(kernel)


def is_shared(kernel: Callable, effect) -> bool:
    """Return True if threads share a kernel's work for an effect, given as Numba types it."""
    shared = _SHARED.get(kernel, False)
    return shared(effect) if callable(shared) else shared


def kernel_of(stub: Callable, effect) -> Callable | None:
    """Return the kernel for a stage of an effect, given as Numba types it; None: no part in it."""
    return KERNELS.get((stub, getattr(effect, 'instance_class', None)))


def answer(question: Callable, effects) -> bool:
    """Return the constant that Numba compiles for a question, for effects as it types them."""
    return any(kernel_of(QUESTIONS[question], effect) is not None for effect in effects)


def name_of(kernel: Callable) -> tuple[str, type] | None:
    """Return the name of a kernel's stage and its type; None for one that is no stage."""
    return next(((stub.__name__, kind) for (stub, kind), each in KERNELS.items()
                 if each is kernel and kind is not None), None)


def named(stage_: str, kind: type) -> Callable:
    """Return the kernel of a name that ``name_of`` gave."""
    return next(kernel for (stub, each), kernel in KERNELS.items()
                if each is kind and stub.__name__ == stage_)


def walk(stub: Callable, choose: Callable, *, backwards: bool = False, opens: bool = False,
         where: Callable | None = None) -> None:
    """
    Let Numba compile ``stub`` for a tuple of effects: one call after another, in their order.

    ``choose(effect, state)`` returns the kernel for an effect's type, or None. A walk that
    ``opens`` is the first of an iteration. It calls the kernels ``where`` a stub of the effect and
    the substep is true.
    """
    @written_out(stub)
    def write(writer, effects, state, substep):
        kernels = [(k, choose(kind, state[0])) for k, kind in enumerate(effects[0])]
        kernels = [(k, kernel) for k, kernel in kernels if kernel is not None]
        team = writer.item(state, 'team')
        for shared, group in groupby(kernels[::-1] if backwards else kernels,
                                     lambda each: is_shared(each[1], effects[0][each[0]])):
            apart = not (shared or isinstance(team[0], types.NoneType))
            with writer.only_if(writer.call(alone, team)) if apart else nullcontext():
                for k, kernel in group:
                    order = [writer.truth(backwards), writer.truth(
                        opens and kernel_of(prepare, effects[0][k]) is None)]
                    effect = writer.item(effects, k)
                    asked = where and writer.call(where, effect, substep)
                    with writer.only_if(asked) if asked else nullcontext():
                        writer.call(kernel, effect, state, substep, *order * (kernel in SWEEPS))
                    write_lap(writer, state, k)
            if apart:
                writer.call(wait, team)


def write_lap(writer: Writer, state, row: int) -> None:
    """Write a reading of the clock where the state has one."""
    clock = writer.item(state, 'clock')
    kernel = kernel_of(lap, clock[0])
    if kernel is not None:
        writer.call(kernel, clock, writer.integer(row))


@written_out(lap_integration)
def _lap_integration(writer, effects, state):
    write_lap(writer, state, len(effects[0]))


def is_none(state, name: str) -> bool:
    """Tell whether a state or a substep, as Numba types it, lacks a field."""
    return isinstance(state[state.fields.index(name)], types.NoneType)


def _tells_of(stub: Callable, question: Callable) -> None:
    """Let Numba compile ``question`` as a constant: whether an effect takes part in ``stub``."""
    QUESTIONS[question] = stub
    type_callable(question)(lambda typing: lambda effects: types.boolean)

    @lower_builtin(question, types.Any)
    def tell(context, builder, signature, arguments):
        return context.get_constant(types.boolean, answer(question, signature.args[0]))


def _asks_all(stub: Callable) -> None:
    """Let Numba compile ``stub`` as whether the kernel of any effect says so."""
    type_callable(stub)(lambda typing: lambda effects, state, turn: types.boolean)

    @lower_builtin(stub, *[types.Any] * 3)
    def ask(context, builder, signature, arguments):
        effects, state, turn = zip(signature.args, arguments)
        writer, found = Writer(context, builder), context.get_constant(types.boolean, False)
        for k, kind in enumerate(effects[0]):
            kernel = kernel_of(stub, kind)
            if kernel is not None:
                found = builder.or_(found, writer.call(kernel, writer.item(effects, k), state,
                                                       turn)[1])
        return found


_asks_all(are_inequalities_unmet)
_tells_of(force, has_force)
_tells_of(are_inequalities_unmet, may_repeat_inequalities)
_tells_of(finish, has_finish)
for _stub in (force, prepare, project, project_inequalities, limit_motion, finish,
              add_explicit_forces, damp_half_kick, accumulate_impulses):
    walk(_stub, lambda effect, state, stub=_stub: kernel_of(stub, effect),
         opens=_stub is project)
walk(project_back, lambda effect, state: kernel_of(project_back, effect), backwards=True)
for _stub in (accumulate_reactions, react_to_half_kick):
    walk(_stub, lambda effect, state, stub=_stub: None if is_none(state, 'reaction') else
         kernel_of(stub, effect), backwards=True)
