"""``solver.method: auto``: a pure function of the scene; it reads no clock."""

from math import ceil, sqrt

from xpbd_ros.scene.model import SolverKeys
from xpbd_ros.sim.simulation import Solver

NS = {'particle': 8.0, 'edge': 14.0, 'hinge': 18.0}
"""cost of one substep, per particle, edge and hinge [ns]; measured on one core of a 2.6 GHz CPU"""
SOFTNESS = 0.1
"""stretch that an unresolved substep may add, relative to the stretch asked for"""


def resolve(keys: SolverKeys, effects, state, frame_dt: float) -> Solver:
    """
    Choose what the scene leaves open.

    A substep of h makes an edge softer, as by an extra compliance of (w1 + w2) h² / 2 per
    iteration (NUMERICS 0.2). Substeps are chosen so that this is at most SOFTNESS of the
    compliance asked for, as far as ``budget_ms`` allows.
    """
    if keys.substeps is not None:
        return Solver('gauss_seidel', keys.integrator, keys.substeps, keys.iterations,
                      keys.precision, keys.threads, 'substeps: given')
    ratio, cost = 0.0, NS['particle'] * len(state.x)
    for built in effects.values():
        if built.particles is None:
            continue
        edges = built.particles.shape[1] == 2
        cost += keys.iterations * NS['edge' if edges else 'hinge'] * len(built.particles)
        if edges and len(built.particles):
            w = (1.0 / state.mass)[built.particles].sum(1)
            alpha = built.batch.compliance
            extra = 0.5 * w * frame_dt**2 / keys.iterations
            ratio = max(ratio, float((extra / alpha).max()) if (alpha > 0.0).all()
                        else float('inf'))
    affordable = max(1, int(keys.budget_ms * 1e6 / cost))
    rigid = ratio > 1e12
    wanted = affordable if rigid else ceil(sqrt(ratio / SOFTNESS))
    substeps = max(min(wanted, affordable), min(4, affordable))
    if rigid:
        reason = (f'{substeps} substeps fill the budget of {keys.budget_ms:g} ms; no number of '
                  'them makes an edge rigid')
    elif wanted <= affordable:
        reason = (f'{substeps} substeps keep the added softness within {SOFTNESS:.0%}; about '
                  f'{substeps * cost * 1e-6:.1f} ms per frame')
    else:
        reason = (f'{substeps} substeps fill the budget of {keys.budget_ms:g} ms; '
                  f'{wanted} would keep the added softness within {SOFTNESS:.0%}')
    return Solver('gauss_seidel', keys.integrator, substeps, keys.iterations, keys.precision,
                  keys.threads, f'auto: {reason}')
