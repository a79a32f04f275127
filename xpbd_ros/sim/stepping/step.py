"""
One frame, one native call: the substep loop of XPBD. It names no effect.

M. Macklin, M. Müller, N. Chentanez, "XPBD", 2016, algorithm 1, with the substeps of
Macklin et al., "Small steps in physics simulation", 2019.
"""

from collections.abc import Callable

from xpbd_ros.sim.backend.denormals import flush_denormals, restore_mode
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.packed_arguments import Packed, unpacked
from xpbd_ros.sim.backend.threads import wait
from xpbd_ros.sim.particles.integration import (
    begin,
    predict,
    restore_buffers,
    turned,
    update_velocity,
    update_velocity_and_begin,
)
from xpbd_ros.sim.particles.state import in_team, Substep
from xpbd_ros.sim.stepping.methods import direction, enter, leave, sweep
from xpbd_ros.sim.stepping.stages import (
    accumulate_impulses,
    accumulate_reactions,
    are_inequalities_unmet,
    finish,
    force,
    has_finish,
    has_force,
    lap_integration,
    limit_motion,
    may_repeat_inequalities,
    prepare,
    project_inequalities,
)


def advance(effects, state, method, frame_dt, substeps):
    """
    Advance all particles by one frame.

    ``effects`` is a tuple of NamedTuples, one per effect that the scene calls for; ``method`` says
    how they are swept (``stepping.methods``).
    """
    if substeps == 0:    # to compile
        return
    mode = flush_denormals()
    h = frame_dt / substeps
    half = 0.5 / substeps
    enter(method, effects, state, Substep(h, half, 0.0, 0, None, 0))    # back by half a substep
    now, begun = state, False
    for k in range(substeps):
        substep = Substep(h, k / substeps, (k + 1) / substeps, 0, None, direction(k, substeps))
        if not begun:
            now = turned(now)
            begin(now, substep)
            lap_integration(effects, now)
        force(effects, now, substep)
        if has_force(effects):
            predict(now, substep)
            lap_integration(effects, now)
        prepare(effects, now, substep)
        for iteration in range(method.iterations):
            sweep(method, effects, now, Substep(h, substep.begin, substep.end, iteration, None,
                                                substep.direction))
            project_inequalities(effects, now, substep)
            if may_repeat_inequalities(effects):
                turn = 1
                while are_inequalities_unmet(effects, now, turn):
                    wait(now.team)    # until all have asked
                    project_inequalities(effects, now, substep)
                    turn += 1
                wait(now.team)
            limit_motion(effects, now, substep)
        accumulate_reactions(effects, now, substep)
        accumulate_impulses(effects, now, substep)
        begun = k + 1 < substeps and not has_finish(effects)
        if begun:
            update_velocity_and_begin(now, substep)
            now = turned(now)
            lap_integration(effects, now)
        else:
            update_velocity(now, substep)
            lap_integration(effects, now)
            finish(effects, now, substep)
    restore_buffers(state, now)
    lap_integration(effects, state)
    leave(method, effects, state, Substep(h, 1.0 - half, 1.0, 0, None, 0))
    restore_mode(mode)


_advance = jit(advance, cache_name=None)    # a part of ``advance_packed``, which is cached
_COMPILED: dict[tuple[str, ...], Callable] = {}
KEPT = 4
"""most tuples of effects, and of states, that a step keeps packed"""


def advance_packed(effects, state, team, method, frame_dt, substeps):
    """Advance by one frame; effects and state are ``Packed``, the state without its team."""
    _advance(unpacked(effects), in_team(unpacked(state), team), method, frame_dt, substeps)


class Step:
    """``advance``, compiled. The arguments of the last calls are kept packed."""

    def __init__(self, kernel):
        self.kernel = kernel
        self._effects: dict[tuple[int, ...], Packed] = {}
        self._states: dict[tuple[int, ...], Packed] = {}

    def __deepcopy__(self, memo: dict) -> 'Step':
        """Return a step with nothing packed: copied arrays have other addresses."""
        return Step(self.kernel)

    def __call__(self, effects, state, method, frame_dt, substeps):
        """Advance all particles by one frame."""
        self.kernel(_packed(effects, self._effects),
                    _packed(state._replace(team=None), self._states), state.team, method,
                    frame_dt, substeps)


def _packed(values: tuple, known: dict[tuple[int, ...], Packed]) -> Packed:
    key = tuple(map(id, values))    # unique, since ``Packed`` keeps the objects alive
    found = known.get(key)
    if found is None:
        if len(known) >= KEPT:
            known.clear()
        found = known[key] = Packed(values)
    return found


def compiled(names: tuple[str, ...]) -> Step:
    """Return the step for a set of effects; each set has a cache of its own (see ``jit``)."""
    if names not in _COMPILED:
        _COMPILED[names] = jit(advance_packed, cache_name='-'.join(('step', *names)))
    return Step(_COMPILED[names])
