"""How much of the sun and of the sky a point sees."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xpbd_ros.study.picture.vectors import Array, basis
from xpbd_ros.study.picture.zbuffer import rasterise

SUN = 0.74 * np.array([1.02, 1.0, 0.96])
"""light of the sun on a surface that faces it, (3,)"""
SKY = 0.46 * np.array([0.97, 1.0, 1.05])
"""light of the whole sky on a level surface, (3,)"""
GROUND = 0.5
"""light that comes from below, as a share of the sky's"""
SUN_RADIUS = np.tan(np.radians(2.2))
"""wider than the real sun's 0.27 deg: a studio lamp, so that penumbrae show"""
SUN_TEXELS, SKY_TEXELS, SKY_DIRECTIONS = 1024, 144, 32
TAPS, PLANE_TAPS = 72, 128


def spiral(count: int) -> Array:
    """Return points (count, 2) spread evenly over the unit disc."""
    index = np.arange(count)
    angle = index * np.pi * (3 - np.sqrt(5))
    return (np.sqrt((index + 0.5) / count)[:, None]
            * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def directions(count: int) -> Array:
    """Return directions (count, 3) spread evenly over the sphere."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height ** 2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


class DepthMap:
    """How near to a far light things reach, by place across its rays."""

    def __init__(self, points: Array, triangles: Array, towards: Array, texels: int,
                 yields: Array | float = 0.0) -> None:
        self.axes = basis(towards)
        local = points @ self.axes.T
        low, high = local.min(axis=0), local.max(axis=0)
        self.texel = 1.02 * max((high - low)[:2].max(), 1e-9) / (texels - 2)
        self.low = (low + high)[:2] / 2 - self.texel * texels / 2
        self.reach = float((high - low)[2])
        self.texels = texels
        pixels = (local[:, :2] - self.low) / self.texel
        best, _ = rasterise(pixels, local[:, 2] - yields, triangles, texels, texels)
        nearest = best.reshape(texels, texels)
        nearest[[0, -1]] = nearest[:, [0, -1]] = -np.inf
        self.nearest = nearest.ravel()

    def local(self, points: Array) -> tuple[Array, Array, Array]:
        """Return texel coordinates and nearness of points (n, 3)."""
        local = points @ self.axes.T
        return ((local[:, 0] - self.low[0]) / self.texel,
                (local[:, 1] - self.low[1]) / self.texel, local[:, 2])

    def gap(self, u: Array, v: Array, s: Array) -> Array:
        """Return how much nearer to the light the nearest thing is [m]; -inf: nothing there."""
        last = self.texels - 1
        column = np.clip(u, 0, last).astype(np.int32)
        row = np.clip(v, 0, last).astype(np.int32)
        return self.nearest[row * self.texels + column] - s


@dataclass(frozen=True, eq=False)
class Lamps:
    """All the light of an instant."""

    towards: Array
    """(3,) unit, to the sun"""
    sun: DepthMap | None = None
    sky: tuple[DepthMap, ...] = ()


def lamps_on(points: Array, triangles: Array, yields: Array, towards: Array) -> Lamps:
    """Return the light on these triangles from the sun and from all around."""
    return Lamps(towards, DepthMap(points, triangles, towards, SUN_TEXELS, yields),
                 tuple(DepthMap(points, triangles, direction, SKY_TEXELS, yields)
                       for direction in directions(SKY_DIRECTIONS)))


def sun_share(sun: DepthMap, points: Array, normals: Array, taps: Array) -> Array:
    """
    Return the share (n,) of the sun that points see, with ``taps`` (n or 1, t, 2) a point.

    First some taps ask what stands in the way and how far off; the rest then look within the
    penumbra that this makes. Taps off the centre follow the receiver's own slope.
    """
    share = np.ones(len(points), dtype=np.float32)
    texel = sun.texel
    u, v, s = sun.local(points + normals * (1.5 * texel))
    widest = min(SUN_RADIUS * sun.reach / texel, 0.04 * sun.texels)
    inside = np.flatnonzero((u > -widest) & (u < sun.texels + widest)
                            & (v > -widest) & (v < sun.texels + widest))
    if not len(inside):
        return share
    tilt = normals[inside] @ sun.axes.T
    slope = np.clip(-tilt[:, :2] / np.maximum(tilt[:, 2:], 0.2), -3, 3) * texel
    u, v, s = (value[inside].astype(np.float32) for value in (u, v, s))
    slope_u, slope_v = slope.T.astype(np.float32)
    found = np.zeros(len(inside), dtype=np.float32)
    total = np.zeros(len(inside), dtype=np.float32)
    search = spiral(16) * widest
    for du, dv in search.astype(np.float32):
        gap = sun.gap(u + du, v + dv, s + slope_u * du + slope_v * dv)
        blocked = gap > texel
        found += blocked
        total += np.where(blocked, gap, 0)
    share[inside[found == len(search)]] = 0
    mixed = np.flatnonzero((found > 0) & (found < len(search)))
    if len(mixed):
        reach = np.clip(SUN_RADIUS * total[mixed] / found[mixed] / texel, 2.0, widest)
        u, v, s, slope_u, slope_v = (a[mixed] for a in (u, v, s, slope_u, slope_v))
        taps = taps if len(taps) == 1 else taps[inside[mixed]]
        seen = np.zeros(len(mixed), dtype=np.float32)
        for k in range(taps.shape[1]):
            du, dv = reach * taps[:, k, 0], reach * taps[:, k, 1]
            gap = sun.gap(u + du, v + dv, s + slope_u * du + slope_v * dv)
            seen += np.clip(2 - gap / texel, 0, 1)
        share[inside[mixed]] = seen / taps.shape[1]
    return share


def sky_light(maps: Sequence[DepthMap], points: Array, normals: Array) -> Array:
    """Return the light (n,) from all around, 1 where a level surface sees the whole sky."""
    if not maps:
        return np.ones(len(points))
    light, weights = np.zeros(len(points)), np.zeros(len(points))
    for depth in maps:
        towards = depth.axes[2]
        weight = np.maximum(normals @ towards, 0)
        seen = np.flatnonzero(weight)
        u, v, s = depth.local(points[seen] + normals[seen] * (1.5 * depth.texel))
        open_ = np.clip(2 - depth.gap(u, v, s) / depth.texel, 0, 1)
        light[seen] += weight[seen] * open_ * (1.0 if towards[2] > 0 else GROUND)
        weights[seen] += weight[seen]
    return light / np.maximum(weights, 1e-9)
