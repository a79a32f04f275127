"""
One frame, one native call: the substep loop of XPBD. It names no effect.

M. Macklin, M. Müller, N. Chentanez, "XPBD", 2016, algorithm 1, with the substeps of
Macklin et al., "Small steps in physics simulation", 2019.
"""

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.stages import finish, force, prepare, project, react
from xpbd_ros.sim.state import predict, Substep, update_velocity


def advance(effects, state, frame_dt, substeps, iterations):
    """
    Advance all particles by one frame.

    ``effects`` is a tuple of NamedTuples, one per effect that the scene calls for.
    """
    h = frame_dt / substeps
    for k in range(substeps):
        substep = Substep(h, k / substeps, (k + 1) / substeps)
        force(effects, state, substep)
        predict(state, substep)
        prepare(effects, state, substep)
        for _ in range(iterations):
            project(effects, state, substep)
        update_velocity(state, substep)
        finish(effects, state, substep)
        react(effects, state, substep)


_COMPILED = {}


def compiled(names: tuple[str, ...]):
    """Return the step for a set of effects; each set has a cache of its own (see ``jit``)."""
    if names not in _COMPILED:
        _COMPILED[names] = jit(advance, cache_name='-'.join(('step', *names)))
    return _COMPILED[names]
