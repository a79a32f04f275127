"""How much room the content takes, planes left out."""

from collections.abc import Sequence

import numpy as np

from xpbd_ros.study.picture.content import Instant
from xpbd_ros.study.picture.meshes import body_mesh, marker_meshes
from xpbd_ros.study.picture.vectors import Array

MARKER = 0.11
"""length of a gripper as a share of what is shown"""


def shown_points(instant: Instant, size: float = 0.0) -> Array:
    """
    Return points (n, 3) that a picture of this instant should show, planes left out.

    Markers, whose size depends on the rest, are counted if ``size`` is given.
    """
    parts = [np.empty((0, 3)), *(surface.points for surface in instant.surfaces)]
    parts += [body_mesh(body).points for body in instant.bodies if body.shape != 'plane']
    for path in instant.paths:
        parts.append(path.points)
        parts += [mesh.points for mesh in marker_meshes(path, MARKER * size) if size]
    for arrow in instant.arrows:
        origin = np.asarray(arrow.origin, dtype=float)
        parts.append(np.stack([origin, origin + arrow.vector]))
    return np.concatenate(parts)


def diagonal(low: Array, high: Array) -> float:
    return float(np.linalg.norm(high - low)) or 1.0


def extent(instants: Sequence[Instant]) -> tuple[Array, Array]:
    """Return the lowest and highest coordinates (3,) of what is shown, planes left out [m]."""
    points = np.concatenate([shown_points(instant) for instant in instants])
    if not len(points):
        return np.full(3, -0.5), np.full(3, 0.5)
    return points.min(axis=0), points.max(axis=0)


def grid_spacing(size: float) -> float:
    """Return a round distance between grid lines for an extent [m]."""
    wish = size / 9
    decade = 10.0 ** np.floor(np.log10(wish))
    return float(decade * max(step for step in (1, 2, 5) if step * decade <= wish * (1 + 1e-9)))
