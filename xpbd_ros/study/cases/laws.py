"""Laws that hold whatever the numbers: momentum, invariance, symmetry, energy, repeatability."""

import numpy as np

from xpbd_ros.study.cases.build import build, place, run
from xpbd_ros.study.cases.case import case, value


@case('V20', 'momentum of a free body')
def momentum():
    """Every projection keeps Σ m v: what changes it is rounding, whatever the sweep."""
    for method in ('gauss_seidel', 'line'):
        simulation = build((9, 8), (0.8, 0.7), {
            'stretch': {'warp': 500.0, 'weft': 300.0}, 'shear': {'stiffness': 20.0},
            'bend': {'stiffness': 1e-3}}, gravity=(0, 0, 0), substeps=4, density=0.2,
            method=method, integrator='bdf2' if method == 'line' else 'backward_euler')
        rng = np.random.default_rng(1)
        x = simulation.frame().x
        v = rng.normal(0.0, 1.0, x.shape)
        place(simulation, x + rng.normal(0.0, 0.01, x.shape), v)
        mass = simulation.state.mass[simulation.slot]
        before, size = mass @ v, (mass * np.linalg.norm(v, axis=1)).sum()
        after = mass @ run(simulation, 60).v
        yield value(f'change in 240 substeps, {method}', 0.0,
                    np.abs(after - before).max() / size, '', 240e-12, absolute=True)
