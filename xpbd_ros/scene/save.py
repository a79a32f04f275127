"""A scene as it runs, back to YAML."""

import yaml

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Solver


def scene_text(scene: Scene, solver: Solver) -> str:
    """
    Return a scene that runs the same way anywhere: overrides in place, ``auto`` resolved.

    Floats keep all their digits, so a simulation made from it has the same bits.
    """
    keys = dict(scene.raw.get('solver') or {})
    keys.update(method=solver.method, integrator=solver.integrator, substeps=solver.substeps,
                iterations=solver.iterations, precision=solver.precision)
    note = f'# {scene.name}; {solver.reason}\n'
    return note + yaml.safe_dump({**scene.raw, 'solver': keys}, sort_keys=False,
                                 default_flow_style=None)
