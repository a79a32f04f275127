"""One panel, without type."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from xpbd_ros.study.picture.bounds import diagonal, extent, grid_spacing, MARKER
from xpbd_ros.study.picture.camera import View
from xpbd_ros.study.picture.colour import encoded
from xpbd_ros.study.picture.content import Instant
from xpbd_ros.study.picture.light import Lamps, lamps_on
from xpbd_ros.study.picture.meshes import meshes_of
from xpbd_ros.study.picture.planes import shade_planes
from xpbd_ros.study.picture.shading import shade_meshes
from xpbd_ros.study.picture.solids import join
from xpbd_ros.study.picture.vectors import Array, unit


@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture without type, and how far it is to what it shows."""

    image: Array
    """(height, width, 3) sRGB in [0, 1]"""
    depth: Array
    """(height, width) of things other than planes, inf where there are none [m]"""


def render(instant: Instant, view: View, *, sun: ArrayLike = (-0.6, -0.3, 0.8),
           box: tuple[Array, Array] | None = None, over: int = 3) -> Rendering:
    """
    Render one instant.

    ``sun`` points to the sun; ``box``, the lowest and highest coordinates shown (None: those of
    this instant), sizes markers and the grid and says where planes fade; ``over`` x ``over``
    samples make a pixel.
    """
    low, high = extent([instant]) if box is None else box
    size = diagonal(low, high)
    meshes = meshes_of(instant, MARKER * size)
    lamps = Lamps(unit(sun))
    if meshes:
        points, triangles, _ = join([(m.points, m.triangles, m.normals) for m in meshes])
        yields = np.repeat([m.yields for m in meshes], [len(m.points) for m in meshes])
        lamps = lamps_on(points, triangles, yields, lamps.towards)
    planes = [body for body in instant.bodies if body.shape == 'plane']
    ground, nearness = shade_planes(planes, view, lamps, (low + high) / 2, 0.5 * size,
                                    grid_spacing(size))
    light, cover, depth = shade_meshes(meshes, view, lamps, over, nearness)
    light += ground * (1 - cover)[:, None]
    shape = (view.height, view.width)
    return Rendering(encoded(light).reshape(*shape, 3), depth.reshape(shape))
