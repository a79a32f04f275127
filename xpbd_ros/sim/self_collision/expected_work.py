"""
Work that self-collision is expected to take, for ``auto``, relative to cloth that touches nothing.

    substep   1 + OVERLAP o
    frame     SEARCH d besides, for searches

with the share o of the surface that overlaps at the start, and the distance d that the fastest pin
or collider moves in a frame, in spacings of the particles. The factors are fitted to frame times
of sheets that lie on one another, fall on their edges and are folded, and of the shipped scenes
(``benchmark/prediction.py``).
"""

import numpy as np

from xpbd_ros.sim.geometry.mesh import triangle_areas
from xpbd_ros.sim.particles.state import places
from xpbd_ros.sim.self_collision.neighbour_list import spacing_of

OVERLAP, SEARCH = 11.7, 337.0
"""work of cloth that overlaps, and of moving it by its spacing"""
CELL, OFFSET = 2.0, 0.3
"""side of the cells that tell the area of a projection, in mean particle spacings, and their
offset in sides: no row of particles is on a border"""


def overlap(cloths, state, pins: bool) -> float:
    """
    Return the share of the surface that others cover as seen along gravity, from 0 to below 1.

    Cloth that falls folds so much at least. What hangs from ``pins``, or has no weight, does not:
    there the least share as seen along an axis counts.
    """
    area, points = 0.0, []
    for cloth in cloths:
        x = places(state.x, cloth.slots)
        area += triangle_areas(cloth.mesh.positions[cloth.mesh.triangles]).sum()
        points.append(x[np.unique(cloth.mesh.triangles)])
    x, down = np.concatenate(points), np.abs(state.gravity)
    if not area:
        return 0.0
    side = CELL * np.sqrt(area / len(x))
    seen = [along for along in range(3) if pins or down[along] == down.max()]
    covered = max(len(np.unique(np.floor(np.delete(x, along, 1) / side + OFFSET), axis=0))
                  for along in seen)
    return max(0.0, 1.0 - covered * side**2 / area)


def moved(cloths, travel: float) -> float:
    """Return d from the distance ``travel`` that the fastest pin or collider moves [m]."""
    spacing = spacing_of(cloths)
    return travel / spacing if spacing else 0.0


def expected_work(o: float, d: float, substeps: int) -> float:
    """Return the work in one of so many substeps of a frame."""
    return 1.0 + OVERLAP * o + SEARCH * d / substeps
