"""``solver.method: auto``: a pure function of the scene; it reads no clock."""

from math import ceil, sqrt

from xpbd_ros.scene.model import SolverKeys
from xpbd_ros.sim.simulation import Solver

INTEGRATOR = {'auto': 'bdf2', 'line': 'bdf2', 'gauss_seidel_symmetric': 'bdf2',
              'gauss_seidel': 'backward_euler'}
"""what goes with each method: BDF2 wants a sweep that is symmetric"""
NS = {'gauss_seidel': {'slot': 2.0, 'edge': 3.0, 'hinge': 8.0},
      'gauss_seidel_symmetric': {'slot': 3.0, 'edge': 6.0, 'hinge': 16.0},
      'line': {'slot': 3.0, 'edge': 7.0, 'hinge': 16.0}}
"""cost of one substep on one core of a 2.6 GHz server CPU, per slot, edge and hinge [ns]"""
RESOLVE = {'gauss_seidel': 1.0, 'gauss_seidel_symmetric': 1.0, 'line': 0.25}
"""substeps that a method wants, for each that an explicit one would need"""
LEAST = 4


def resolve(keys: SolverKeys, effects, state, frame_dt: float) -> Solver:
    """
    Choose what the scene leaves open: method, integrator, substeps.

    An explicit solver is stable with N = frame_dt sqrt(Σ k / m) substeps or more, k summed over
    the edges at a particle along one direction. The line sweep with BDF2 needs about a quarter of
    them for a millimetre on a metre (NUMERICS 5.8); Gauss-Seidel needs all, to be as stiff as
    asked.
    ``budget_ms`` bounds the substeps by the cost table above.
    """
    method = 'line' if keys.method == 'auto' else keys.method
    integrator = keys.integrator or INTEGRATOR[method]
    table = NS[method]
    cost = table['slot'] * len(state.mass)
    rate = 0.0
    for built in effects.values():
        if built.constraints is None:
            continue
        particles = built.constraints.particles
        if particles.shape[1] == 2:
            cost += keys.iterations * table['edge'] * len(particles)
            rate += largest_rate(built.constraints, state.mass)
        else:
            cost += keys.iterations * table['hinge'] * len(particles)
    chosen = {'method': method, 'integrator': integrator, 'iterations': keys.iterations,
              'precision': keys.precision, 'threads': keys.threads}
    if keys.substeps is not None:
        return Solver(substeps=keys.substeps, reason=f'{method}, {integrator}, '
                      f'{keys.substeps} substeps as given', **chosen)
    affordable = max(1, int(keys.budget_ms * 1e6 / cost))
    wanted = RESOLVE[method] * frame_dt * sqrt(rate) if rate < 1e20 else float('inf')
    substeps = int(max(min(ceil(min(wanted, 1e9)), affordable), min(LEAST, affordable)))
    reason = f'auto: {method}, {integrator}, {substeps} substeps'
    if wanted <= affordable:
        reason += ' resolve the stretch'
    elif wanted < 1e9:
        reason += f' fill the budget of {keys.budget_ms:g} ms; {ceil(wanted)} would resolve it'
    else:
        reason += f' fill the budget of {keys.budget_ms:g} ms; rigid edges take what they get'
    return Solver(substeps=substeps, reason=f'{reason}, about {substeps * cost * 1e-6:.2g} ms '
                  'per frame', **chosen)


def largest_rate(edges, mass) -> float:
    """Return the largest (1/m1 + 1/m2) / (2 α) of some edges [1/s²]; inf where one is rigid."""
    if not len(edges.particles):
        return 0.0
    if (edges.compliance == 0.0).any():
        return float('inf')
    w = 1.0 / mass[edges.particles].astype(float)
    return float((0.5 * w.sum(1) / edges.compliance).max())
