"""The light that meshes send to the camera."""

from collections.abc import Sequence

import numpy as np

from xpbd_ros.study.picture.camera import View
from xpbd_ros.study.picture.colour import pressed
from xpbd_ros.study.picture.light import Lamps, SKY, sky_light, spiral, SUN, sun_share, TAPS
from xpbd_ros.study.picture.meshes import Mesh
from xpbd_ros.study.picture.solids import join
from xpbd_ros.study.picture.vectors import Array, unit
from xpbd_ros.study.picture.zbuffer import rasterise


def shade_meshes(meshes: Sequence[Mesh], view: View, lamps: Lamps, over: int,
                 plane_nearness: Array) -> tuple[Array, Array, Array]:
    """
    Return the light (pixels, 3) and cover (pixels,) of all meshes, and their depth.

    ``over`` x ``over`` samples a pixel; ``plane_nearness`` (pixels,) is 1/depth of the planes.
    """
    width, height = view.width * over, view.height * over
    count = view.width * view.height
    if not meshes:
        return np.zeros((count, 3)), np.zeros(count), np.full(count, np.inf)
    points, triangles, normals = join([(m.points, m.triangles, m.normals) for m in meshes])
    owner = np.repeat(np.arange(len(meshes)), [len(m.triangles) for m in meshes])
    pixels, depth = view.project(points)
    pixels *= over
    shown = (depth[triangles] > 1e-6).all(axis=1)
    triangles, owner = triangles[shown], owner[shown]
    counts = [len(m.points) for m in meshes]
    steps_back = np.array([1 - m.yields / max(float(view.project(m.points.mean(axis=0))[1][0]),
                                              2 * m.yields, 1e-6) for m in meshes])
    nearness = np.where(depth > 1e-6, 1 / np.where(depth > 1e-6, depth, 1), 0)
    best, which = rasterise(pixels, nearness * np.repeat(steps_back, counts), triangles,
                            width, height)

    sample = np.flatnonzero(which >= 0)
    down, right = np.divmod(sample, width)
    pixel = down // over * view.width + right // over
    in_front = best[sample] >= plane_nearness[pixel] * 0.998
    sample, right, down, pixel = (a[in_front] for a in (sample, right, down, pixel))
    cover = np.bincount(pixel, minlength=count) / over ** 2
    seen_depth = np.full(count, np.inf)
    seen_depth[pixel] = 1 / best[sample]

    # what a triangle has everywhere
    corner = pixels[triangles]
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    twice_area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    inverse = 1 / np.where(np.abs(twice_area) > 1e-12, twice_area, 1)
    solid = np.array([m.solid for m in meshes])[owner]
    back = (twice_area > 0) & ~solid    # y runs down, so the front runs clockwise
    colour = np.where(back[:, None], np.stack([m.back for m in meshes])[owner],
                      np.stack([m.front for m in meshes])[owner]).astype(np.float32)
    gloss = np.array([m.gloss for m in meshes], dtype=np.float32)[owner]
    steps_back = steps_back[owner]
    sky_front = sky_light(lamps.sky, points, normals)
    sky_back = sky_front.copy()
    soft = np.repeat([not m.solid for m in meshes], counts)
    if soft.any():
        sky_back[soft] = sky_light(lamps.sky, points[soft], -normals[soft])
        cloth = triangles[~solid]
        sky_front, sky_back = _smoothed(sky_front, cloth), _smoothed(sky_back, cloth)

    light = np.zeros((count, 3))
    taps = spiral(max(TAPS // over ** 2, 1) * over ** 2).astype(np.float32)    # shared out
    phases = np.stack([taps[k::over ** 2] for k in range(over ** 2)])
    for begin in range(0, len(sample), 1 << 16):
        part = slice(begin, begin + (1 << 16))
        x, y, tri = right[part] + 0.5, down[part] + 0.5, which[sample[part]]
        corners = triangles[tri]
        dx, dy = x - corner[tri, 0, 0], y - corner[tri, 0, 1]
        b1 = (dx * edge2[tri, 1] - dy * edge2[tri, 0]) * inverse[tri]
        b2 = (dy * edge1[tri, 0] - dx * edge1[tri, 1]) * inverse[tri]
        weight = np.stack([1 - b1 - b2, b1, b2], axis=1) * nearness[corners]
        weight = np.clip(weight / weight.sum(axis=1, keepdims=True), 0, 1)
        side = np.where(back[tri], -1.0, 1.0)
        normal = unit(np.einsum('nk,nkc->nc', weight, normals[corners]) * side[:, None])
        rays = view.rays(x / over, y / over)
        place = view.eye + rays * (steps_back[tri] / best[sample[part]])[:, None]
        sky = np.where(back[tri], (weight * sky_back[corners]).sum(axis=1),
                       (weight * sky_front[corners]).sum(axis=1))
        facing = np.maximum(normal @ lamps.towards, 0)
        lit = np.zeros(len(tri), dtype=np.float32)
        day = np.flatnonzero(facing)
        phase = (right[part] % over + down[part] % over * over)[day]
        assert lamps.sun is not None
        lit[day] = sun_share(lamps.sun, place[day], normal[day], phases[phase])
        halfway = unit(lamps.towards - unit(rays))
        shine = (gloss[tri] * lit * np.maximum((normal * halfway).sum(axis=1), 0) ** 36)
        shade = np.outer(facing * lit, SUN) + np.outer(0.1 + 0.9 * sky, SKY)
        result = pressed(colour[tri] * shade + shine[:, None])
        for channel in range(3):
            light[:, channel] += np.bincount(pixel[part], result[:, channel], minlength=count)
    return light / over ** 2, cover, seen_depth


def _smoothed(value: Array, triangles: Array, passes: int = 2) -> Array:
    """Return values (n,) at points averaged over the triangles that meet there."""
    corners = triangles.ravel()
    counts = np.bincount(corners, minlength=len(value))
    for _ in range(passes):
        mean = np.bincount(corners, np.repeat(value[triangles].mean(axis=1), 3),
                           minlength=len(value))
        value = np.where(counts > 0, mean / np.maximum(counts, 1), value)
    return value
