"""The warp of meshes: refused where it is normal to the whole mesh and would make a difference."""

from collections.abc import Iterable

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.geometry.mesh import cross, length, Mesh

LEAST = 1e-3
"""least part of the unit vector along warp in the plane of a triangle that has a warp"""


def check_warps(scene: Scene, meshes: Iterable[Mesh]) -> None:
    """
    Raise InputError if no triangle of a mesh has a warp, and an effect needs one.

    Of a curved mesh single triangles may have none: ``stretch`` takes their edges for weft,
    ``membrane`` lays the warp along their first edge.
    """
    for (name, keys), mesh in zip(scene.cloths.items(), meshes):
        if keys.mesh is None or not len(mesh.triangles):
            continue
        needing = [effect for effect, chosen in scene.cloth_effects[name].items()
                   if getattr(chosen, 'warp', None) is not None
                   and (effect == 'membrane' or chosen.warp != chosen.weft)]
        if not needing:
            continue
        a, b, c = (mesh.positions[mesh.triangles[:, k]] for k in range(3))
        normals = cross(b - a, c - a)
        inside = length(cross(normals, np.array(mesh.warp))) / length(normals)
        if inside.max() < LEAST:
            raise InputError(
                f'cloths.{name}.mesh.warp: must lie in the mesh, for effects.{needing[0]} (got '
                f'{list(keys.mesh.warp)}, which is normal to it); take a direction along '
                f'{_axis(normals.sum(0))}, or values for {needing[0]} that do not depend on one')


def _axis(normal: np.ndarray) -> str:
    """Return the axis that is furthest from a normal."""
    return 'xyz'[int(np.argmin(np.abs(normal)))]
