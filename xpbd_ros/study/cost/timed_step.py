"""
The step of a scene with a clock in it: the same kernels in the same order, and the same bits.

Written out for the scene's effects like ``stepping.step.advance``, but each effect's stage is
called by itself and followed by a reading of the clock. So an effect is timed inside the running
scene, with the caches as the others leave them.
"""

from collections.abc import Iterator

from numba import typeof

from xpbd_ros.sim.backend.denormals import flush_denormals, restore_mode
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.particles.explicit_updates import (
    add_moves,
    apply_leapfrog_kick,
    at_start,
    half_kick,
)
from xpbd_ros.sim.particles.integration import (
    begin,
    predict,
    restore_buffers,
    set_mobility,
    turned,
    update_velocity,
    update_velocity_and_begin,
)
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping.methods import (
    back,
    close,
    forth,
    GaussSeidel,
    Leapfrog,
    Line,
    Symmetric,
)
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    add_explicit_forces,
    are_inequalities_unmet,
    finish,
    force,
    has_finish,
    has_force,
    kernel_of,
    limit_motion,
    prepare,
    project,
    project_back,
    project_inequalities,
    solve_lines,
)
from xpbd_ros.study.cost.clock import lap

SWEEPS = {GaussSeidel: ((project, False),),
          Symmetric: ((project, False), (project_back, True)),
          Line: ((forth, False), (back, True), (close, False))}
"""the walks of each method that moves particles at once (``stepping.methods``), and whether
backwards"""
SWEPT = (project, project_back, solve_lines)
NAMES = {each.__name__: each for each in (
    add_moves, apply_leapfrog_kick, are_inequalities_unmet, at_start, begin, flush_denormals,
    half_kick, has_finish, has_force, lap, predict, restore_buffers, restore_mode, set_mobility,
    Substep, turned, update_velocity, update_velocity_and_begin)}


def timed_step(effects: tuple, method: type):
    """
    Return ``advance(effects, state, method, frame_dt, substeps, book)`` for a scene.

    Row k of the book is effect k, the row after them the integration.
    """
    step = _Step(effects, method)
    exec('\n'.join(step.lines()), step.names)
    return jit(step.names['advance'], cache_name=None)


class _Step:
    """The lines of a step, and what they name."""

    def __init__(self, effects: tuple, method: type):
        self.effects, self.method, self.names = effects, method, dict(NAMES)

    def lines(self) -> Iterator[str]:
        """Yield ``stepping.step.advance``."""
        once, each, inner = ' ' * 4, ' ' * 8, ' ' * 12
        leaps = self.method is Leapfrog
        yield 'def advance(effects, state, method, frame_dt, substeps, book):'
        yield f'{once}mode = flush_denormals()'
        yield f'{once}h = frame_dt / substeps'
        yield f'{once}lap(book, -1)'
        if leaps:
            yield from self._kick(once, 0.0, -0.5)
        yield f'{once}home, begun = state, False'
        yield f'{once}for k in range(substeps):'
        yield f'{each}substep = Substep(h, k / substeps, (k + 1) / substeps)'
        yield f'{each}if not begun:'
        yield f'{inner}state = turned(state)'
        yield from self._integrate(inner, 'begin(state, substep)')
        yield from self._walk(each, force)
        yield f'{each}if has_force(effects):'
        yield from self._integrate(inner, 'predict(state, substep)')
        yield from self._walk(each, prepare)
        yield f'{each}for _ in range(method.iterations):'
        if self.method in SWEEPS:
            for stub, backwards in SWEEPS[self.method]:
                yield from self._walk(inner, stub, backwards=backwards)
        else:
            yield from self._sum_up(inner, 'at_start(state)' if leaps else 'state')
            yield from self._integrate(
                inner, 'apply_leapfrog_kick(state, substep)' if leaps else 'add_moves(state)')
        yield from self._walk(inner, project_inequalities)
        yield f'{inner}turn = 1'
        yield f'{inner}while are_inequalities_unmet(effects, state, turn):'
        yield f'{inner}    turn += 1'
        yield from self._walk(f'{inner}    ', project_inequalities)
        yield from self._walk(inner, limit_motion)
        yield f'{inner}pass'
        yield from self._walk(each, accumulate_reactions, backwards=True)
        yield f'{each}begun = k + 1 < substeps and not has_finish(effects)'
        yield f'{each}if begun:'
        yield from self._integrate(inner, 'update_velocity_and_begin(state, substep)')
        yield f'{inner}state = turned(state)'
        yield f'{each}else:'
        yield from self._integrate(inner, 'update_velocity(state, substep)')
        yield from self._walk(inner, finish)
        yield from self._integrate(once, 'restore_buffers(home, state)')
        yield f'{once}state = home'
        if leaps:
            yield from self._kick(once, 1.0, 0.5)
        yield f'{once}restore_mode(mode)'

    def _walk(self, indent: str, stub, *, state: str = 'state', backwards: bool = False):
        """Yield a call for each effect that takes part, and a reading of the clock."""
        order = range(len(self.effects))
        for k in reversed(order) if backwards else order:
            stubs = SWEPT if stub in (project, project_back, forth, back, close) else (stub,)
            if any(kernel_of(one, typeof(self.effects[k])) for one in stubs):
                self.names[stub.__name__] = stub
                yield f'{indent}{stub.__name__}((effects[{k}],), {state}, substep)'
                yield f'{indent}lap(book, {k})'

    def _integrate(self, indent: str, line: str):
        """Yield a line that is of no effect."""
        yield f'{indent}{line}'
        yield f'{indent}lap(book, {len(self.effects)})'

    def _sum_up(self, indent: str, where: str):
        """Yield a pass that adds up the moves of all constraints, from where they are read."""
        yield from self._integrate(indent, f'start = {where}')
        yield from self._walk(indent, project, state='start')

    def _kick(self, indent: str, place: float, share: float):
        """Yield what moves the velocities on by a share of a substep."""
        yield f'{indent}substep = Substep(h, {place}, {place})'
        yield f'{indent}set_mobility(state, h)'
        yield from self._sum_up(indent, 'state')
        yield from self._walk(indent, add_explicit_forces)
        yield from self._integrate(indent, f'half_kick(state, h, {share})')
