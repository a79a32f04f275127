"""
The step of a scene with a clock in it: the same kernels in the same order, and the same bits.

Written out for the scene's effects like ``sim.step.advance``, but each effect's stage is called by
itself and followed by a reading of the clock. So an effect is timed inside the running scene, with
the caches as the others leave them.
"""

from numba import njit, typeof

from xpbd_ros.errors import InputError
from xpbd_ros.sim.denormals import flush_denormals, restore_mode
from xpbd_ros.sim.jit import FLAGS
from xpbd_ros.sim.stages import (
    bound,
    finish,
    force,
    kernel_of,
    prepare,
    project,
    project_back,
    react,
    solve_lines,
    touch,
)
from xpbd_ros.sim.state import begin, Substep, update_velocity
from xpbd_ros.sim.sweeps import back, close, forth, GaussSeidel, Line, METHODS, Symmetric
from xpbd_ros.study.cost.clock import lap

SWEEPS = {GaussSeidel: ((project, False),),
          Symmetric: ((project, False), (project_back, True)),
          Line: ((forth, False), (back, True), (close, False))}
"""the walks of each method (``sim.sweeps``), and whether they go backwards"""
SWEPT = (project, project_back, solve_lines)


def timed_step(effects: tuple, method: type):
    """
    Return ``advance(effects, state, method, frame_dt, substeps, book)`` for a scene.

    Row k of the book is effect k, the row after them the integration.

    Raises
    ------
    InputError : naming a method whose step cannot be taken apart

    """
    if method not in SWEEPS:
        known = {kind: name for name, kind in METHODS.items()}
        raise InputError(f"solver.method: cost cannot take a step of '{known[method]}' apart "
                         f'(it can: {", ".join(known[kind] for kind in SWEEPS)})')
    names = {'begin': begin, 'update_velocity': update_velocity, 'Substep': Substep, 'lap': lap,
             'flush_denormals': flush_denormals, 'restore_mode': restore_mode}
    integration = len(effects)

    def walk(stub, indent, backwards=False):
        order = range(len(effects))
        for k in reversed(order) if backwards else order:
            stubs = SWEPT if stub in (project, project_back, forth, back, close) else (stub,)
            if any(kernel_of(one, typeof(effects[k])) for one in stubs):
                names[stub.__name__] = stub
                yield f'{indent}{stub.__name__}((effects[{k}],), state, substep)'
                yield f'{indent}lap(book, {k})'

    inner, deep = ' ' * 8, ' ' * 12
    lines = ['def advance(effects, state, method, frame_dt, substeps, book):',
             '    mode = flush_denormals()',
             '    h = frame_dt / substeps',
             '    lap(book, -1)',
             '    for k in range(substeps):',
             f'{inner}substep = Substep(h, k / substeps, (k + 1) / substeps)',
             f'{inner}begin(state, substep)',
             f'{inner}lap(book, {integration})',
             *walk(force, inner), *walk(prepare, inner),
             f'{inner}for _ in range(method.iterations):']
    for stub, backwards in SWEEPS[method]:
        lines += walk(stub, deep, backwards)
    lines += [*walk(touch, deep), *walk(bound, deep), f'{deep}pass',
              f'{inner}update_velocity(state, substep)',
              f'{inner}lap(book, {integration})',
              *walk(finish, inner), *walk(react, inner), '    restore_mode(mode)']
    exec('\n'.join(lines), names)
    return njit(**FLAGS)(names['advance'])
