"""
Tension that a cloth carries into a grip of pads (doc/scenes.md, Pads).

A clamped particle feels the tension of the cloth beside it after the solver has distributed it. In
a strip that hangs from a grip, it was seen to be held up to 0.97 of 2 μ F as long as

    T ≤ c ρ (l / h)²

with ρ the density, l the distance of neighbours, h the substep and c by method: the load of a row
would move a single particle by c l in a substep. Beyond that the cloth is pulled out early.
"""

from collections.abc import Iterable
from math import ceil, inf, sqrt

import numpy as np

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.effect import Cloth

CARRIED = {'line': 2.0, 'gauss_seidel_symmetric': 0.6, 'gauss_seidel': 0.3, 'jacobi': 0.06,
           'explicit': inf}
"""c by method, for one iteration"""


def carried_tension(method: str, cloth: Cloth, density: float, h: float) -> float:
    """Return the tension that a sheet of a density [kg/m²] carries into a grip [N/m]."""
    return CARRIED[method] * density * (cloth.mesh.gap / h)**2


def weak_grips(scene: Scene, cloths: Iterable[Cloth], method: str, substeps: int) -> list[str]:
    """Return warnings for sheets that pads cannot hold by their own weight, and the way out."""
    if not has_pads(scene):
        return []
    found, h = [], 1.0 / (scene.top.frame_rate * substeps)
    for cloth in cloths:
        density = scene.cloths[cloth.name].density
        if len(cloth.mesh.tetrahedra) or density is None:
            continue
        tension = carried_tension(method, cloth, density, h)
        weight = density * float(np.linalg.norm(scene.top.gravity)) * float(
            np.ptp(cloth.mesh.positions, axis=0).max())
        if tension < weight:
            found.append(
                f'cloths.{cloth.name}: {substeps} substeps of {method} carry {tension:.3g} N/m '
                f'into a grip of pads, and it weighs {weight:.3g} N/m, so it may be pulled out; '
                f'take {ceil(substeps * sqrt(weight / tension))} substeps, or method line')
    return found


def has_pads(scene: Scene) -> bool:
    """Return True if a collider of a scene has a pad."""
    return any(entry.pad is not None for entry in scene.sections.get('colliders', {}).values())
