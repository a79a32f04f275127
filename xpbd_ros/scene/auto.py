"""``solver.method: auto``: a pure function of the scene; it reads no clock."""

from math import ceil

import numpy as np

from xpbd_ros.scene.model import SolverKeys
from xpbd_ros.sim.simulation import Solver

NS = {'particle': 8.0, 'edge': 14.0, 'hinge': 18.0}
"""cost of one substep, per particle, edge and hinge [ns]; measured on one core of a 2.6 GHz CPU"""
DEFAULT_INTEGRATOR = {'auto': 'bdf2', 'line': 'bdf2', 'gauss_seidel_symmetric': 'bdf2',
                      'gauss_seidel': 'backward_euler'}
SOFTNESS = 0.1
"""stretch that an unresolved substep may add, relative to the stretch asked for"""


def resolve(keys: SolverKeys, effects, state, frame_dt: float) -> Solver:
    """
    Choose what the scene leaves open.

    A substep of h makes an edge softer, as by an extra compliance of (w1 + w2) h² / 2 per
    iteration (NUMERICS 0.2). Substeps are chosen so that this is at most SOFTNESS of the
    compliance asked for, as far as ``budget_ms`` allows.
    """
    method = 'line' if keys.method == 'auto' else keys.method
    integrator = keys.integrator or DEFAULT_INTEGRATOR[method]
    cost = NS['particle'] * len(state.mass)
    resolve_at = 1.0
    for built in effects.values():
        if built.constraints is None:
            continue
        particles = built.constraints.particles
        edges = particles.shape[1] == 2
        cost += keys.iterations * NS['edge' if edges else 'hinge'] * len(particles)
        if edges and len(particles):
            w = (1.0 / state.mass)[particles].sum(1)
            alpha = built.constraints.compliance
            if (alpha > 0.0).all():
                resolve_at = max(resolve_at, frame_dt * float(np.sqrt((w / alpha).max())))
    if keys.substeps is not None:
        return Solver(method, integrator, keys.substeps, keys.iterations, keys.precision,
                      keys.threads, 'substeps: given')
    affordable = max(1, int(keys.budget_ms * 1e6 / cost))
    wanted = ceil(resolve_at)
    substeps = max(min(wanted, affordable), min(4, affordable))
    reason = (f'{substeps} substeps')
    return Solver(method, integrator, substeps, keys.iterations, keys.precision, keys.threads,
                  f'auto: {reason}')
