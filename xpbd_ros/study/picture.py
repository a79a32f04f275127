"""
Shaded pictures of cloth runs: NumPy draws, matplotlib sets the type. No display, no GPU.

One panel per instant, all through the same camera. Each panel is rendered in three steps:

1. a z-buffer says which triangle each sample sees (nine samples a pixel). A plane seen in
   perspective has 1/depth affine in the picture, so 1/depth is what is interpolated and compared;
2. light: the same rasteriser, looking along the sun's rays, gives a depth map, hence shadows whose
   penumbra widens with the distance to what casts them (Fernando, Percentage-Closer Soft Shadows,
   2005); small maps from directions all around give the share of sky that each vertex sees;
3. colour, in linear light: Lambert for the sun, the sky's share for the rest, a weak highlight.
   Normals are interpolated, so that cloth looks smooth; its two sides may differ in colour.

Limits: nothing is transparent and nothing mirrors; planes receive shadows and cast none; boxes
have slightly rounded edges, and bodies step back from the camera by less than an edge of the
cloth, so that cloth which bridges their edges covers them; a triangle that reaches behind the
camera is left out; z is up.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import io
from pathlib import Path as FilePath
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

Colour = str | tuple[float, float, float]
"""whatever matplotlib takes for a colour"""
Array = NDArray[Any]

SHAPES = ('plane', 'sphere', 'capsule', 'cylinder', 'box')
MARKERS = ('jaws', 'ball', 'none')
MARKER = 0.11
"""length of a gripper as a share of what is shown"""
FILE_LIMIT = 700 * 1024
"""a picture is smaller than this, whatever it shows [bytes]"""


# What a picture shows

def _points(value: ArrayLike, what: str) -> Array:
    """Return finite points (n, 3) that nobody else writes to."""
    points = np.array(value, dtype=float) if np.size(value) else np.empty((0, 3))
    points = points[None] if points.ndim == 1 else points
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f'{what}: must be (n, 3) (got {np.shape(value)})')
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise ValueError(f'{what}: point {bad} is not finite: {points[bad].tolist()}')
    points.setflags(write=False)
    return points


@dataclass(frozen=True, eq=False)
class Surface:
    """A cloth at one instant."""

    points: Array
    """(n, 3) [m]"""
    triangles: Array
    """(m, 3) indices of points; the front is the side from which they run counterclockwise"""
    colour: Colour = '#2a78b5'
    """front"""
    back_colour: Colour | None = None
    """back; None: a paler front"""
    rest: Array | None = None
    """(n, 2) rest coordinates [m]; when given, a faint square grid is printed on the cloth"""
    rest_spacing: float = 0.1
    """between the printed lines [m]"""

    def __post_init__(self) -> None:
        points = _points(self.points, 'Surface.points')
        triangles = np.array(self.triangles, dtype=np.int64).reshape(-1, 3)
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
            raise ValueError(f'Surface.triangles: indices must be 0 .. {len(points) - 1} '
                             f'(got {triangles.min()} .. {triangles.max()})')
        object.__setattr__(self, 'points', points)
        object.__setattr__(self, 'triangles', triangles)
        if self.rest is not None:
            rest = np.array(self.rest, dtype=float)
            if rest.shape != (len(points), 2) or not np.isfinite(rest).all():
                raise ValueError(f'Surface.rest: must be finite, ({len(points)}, 2) '
                                 f'(got {rest.shape})')
            object.__setattr__(self, 'rest', rest)


@dataclass(frozen=True, eq=False)
class Body:
    """A collider at one instant."""

    shape: str
    """plane, sphere, capsule, cylinder or box"""
    size: tuple[float, ...] | float = ()
    """
    sphere: radius; capsule: radius, length between centres; cylinder: radius, length; box: its
    three sides; plane: nothing, it has no end [m]
    """
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """centre; a point of the plane [m]"""
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """unit quaternion x, y, z, w; local z is the axis, and the plane's normal"""
    colour: Colour | None = None
    """None: nearly white for a plane, grey for the rest"""

    def __post_init__(self) -> None:
        counts = {'plane': 0, 'sphere': 1, 'capsule': 2, 'cylinder': 2, 'box': 3}
        if self.shape not in counts:
            raise ValueError(f'Body.shape: must be one of {", ".join(SHAPES)} '
                             f'(got {self.shape!r})')
        size = tuple(float(value) for value in np.ravel(self.size))
        if self.shape == 'plane':
            size = ()
        if len(size) != counts[self.shape] or not all(0 < s < np.inf for s in size):
            raise ValueError(f'Body.size: a {self.shape} takes {counts[self.shape]} finite '
                             f'lengths > 0 m (got {self.size})')
        object.__setattr__(self, 'size', size)
        if self.colour is None:
            object.__setattr__(self, 'colour', '#eef0f2' if self.shape == 'plane' else '#9aa3ad')
        _points(self.position, 'Body.position')
        if not 0.5 < float(np.linalg.norm(self.orientation)) < 2.0:
            raise ValueError(f'Body.orientation: must be a unit quaternion x, y, z, w '
                             f'(got {self.orientation})')


@dataclass(frozen=True, eq=False)
class Path:
    """Where something has been and goes, such as a gripper, with a marker where it is now."""

    points: Array
    """(k, 3) [m]"""
    colour: Colour = '#d1495b'
    label: str = ''
    """its name in the legend; paths of one label are named once"""
    present: int = -1
    """index of the point where it is now; the path is dotted from there on"""
    marker: str = 'jaws'
    """jaws, ball or none"""
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """of the jaws, unit quaternion x, y, z, w; they reach along local -z and close along x"""
    marker_size: float | None = None
    """length of the jaws, four radii of the ball [m]; None: suits the picture"""

    def __post_init__(self) -> None:
        object.__setattr__(self, 'points', _points(self.points, 'Path.points'))
        if self.marker not in MARKERS:
            raise ValueError(f'Path.marker: must be one of {", ".join(MARKERS)} '
                             f'(got {self.marker!r})')
        count = len(self.points)
        if count and not -count <= self.present < count:
            raise ValueError(f'Path.present: must be < {count} (got {self.present})')


@dataclass(frozen=True, eq=False)
class Arrow:
    """A vector, such as a force."""

    origin: tuple[float, float, float]
    """[m]"""
    vector: tuple[float, float, float]
    """as long as it is drawn [m]"""
    colour: Colour = '#c1440e'
    label: str = ''
    """written at the tip"""

    def __post_init__(self) -> None:
        _points(self.origin, 'Arrow.origin')
        _points(self.vector, 'Arrow.vector')


@dataclass(frozen=True, eq=False)
class Instant:
    """What one panel shows."""

    title: str = ''
    surfaces: Sequence[Surface] = ()
    bodies: Sequence[Body] = ()
    paths: Sequence[Path] = ()
    arrows: Sequence[Arrow] = ()


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from."""

    azimuth: float = -60.0
    """where the camera stands as seen from what it looks at, from x towards y [deg]"""
    elevation: float = 24.0
    """above the horizon [deg]"""
    field_of_view: float = 24.0
    """vertical, of the whole panel [deg]"""
    target: tuple[float, float, float] | None = None
    """looked at [m]; None: fitted to what is shown"""
    distance: float | None = None
    """from the target [m]; None: fitted to what is shown"""


@dataclass(frozen=True, eq=False)
class View:
    """A camera in its place, with a picture of so many pixels."""

    eye: Array
    """(3,) [m]"""
    axes: Array
    """(3, 3), rows: right, up and forward in the world"""
    focal: float
    """focal length [px]"""
    width: int
    height: int

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return pixels (n, 2), x to the right and y down, and the depth (n,) of points [m]."""
        local = (np.asarray(points, dtype=float).reshape(-1, 3) - self.eye) @ self.axes.T
        depth = local[:, 2]
        with np.errstate(divide='ignore', invalid='ignore'):
            right = self.width / 2 + self.focal * local[:, 0] / depth
            down = self.height / 2 - self.focal * local[:, 1] / depth
        return np.stack([right, down], axis=1), depth

    def rays(self, right: Array, down: Array) -> Array:
        """Return directions (..., 3) through pixels, one metre deep."""
        side = (right - self.width / 2) / self.focal
        rise = (self.height / 2 - down) / self.focal
        return (side[..., None] * self.axes[0] + rise[..., None] * self.axes[1] + self.axes[2])


# Meshes: everything but planes becomes triangles

@dataclass(frozen=True, eq=False)
class _Mesh:
    """Triangles of one colour a side."""

    points: Array
    """(n, 3)"""
    triangles: Array
    """(m, 3)"""
    normals: Array
    """(n, 3), unit, front side"""
    front: Array
    """(3,) linear colour"""
    back: Array
    gloss: float = 0.035
    yields: float = 0.0
    """how far it steps back, so that cloth whose triangles cut its corners still covers it [m]"""
    solid: bool = True
    """its back is never seen"""
    rest: Array | None = None
    rest_spacing: float = 0.1


def _linear(colour: Colour) -> Array:
    """Return a colour as light, (3,) (sRGB, IEC 61966-2-1)."""
    value = np.array(to_rgb(colour))
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _pressed(light: Array) -> Array:
    """Return light with its brightest part pressed together below 1 rather than cut."""
    knee = 0.8
    over = np.maximum(light - knee, 0)
    return np.minimum(light, knee) + (1 - knee) * (1 - np.exp(-over / (1 - knee)))


def _encoded(light: Array) -> Array:
    """Return light as sRGB in [0, 1]."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def _unit(vectors: ArrayLike) -> Array:
    vectors = np.asarray(vectors, dtype=float)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _rotation(quaternion: Sequence[float]) -> Array:
    """Return the matrix (3, 3) of a quaternion x, y, z, w."""
    x, y, z, w = _unit(quaternion)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def _frame(axis: Array) -> Array:
    """Return a right-handed rotation (3, 3) whose last row is the axis."""
    axis = _unit(axis)
    side = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0], axis)
    side = _unit(side)
    return np.stack([side, np.cross(axis, side), axis])


def _lathe(radius: ArrayLike, height: ArrayLike, normal: ArrayLike, around: int) -> tuple:
    """Turn a profile, from the bottom up and with its normals (k, 2), about z."""
    radius, height, normal = (np.asarray(value, dtype=float) for value in (radius, height, normal))
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    points = radius[:, None, None] * ring + height[:, None, None] * up
    normals = normal[:, :1, None] * ring + normal[:, 1:, None] * up
    row, column = np.meshgrid(np.arange(len(radius) - 1), np.arange(around), indexing='ij')
    following = (column + 1) % around
    a, b = row * around + column, row * around + following
    c, d = a + around, b + around
    triangles = np.stack([np.stack([a, b, d], -1), np.stack([a, d, c], -1)], -2)
    return points.reshape(-1, 3), triangles.reshape(-1, 3), normals.reshape(-1, 3)


def _join(parts: Sequence[tuple]) -> tuple:
    starts = np.cumsum([0] + [len(points) for points, _, _ in parts])
    return (np.concatenate([points for points, _, _ in parts]),
            np.concatenate([t + start for (_, t, _), start in zip(parts, starts)]),
            np.concatenate([normals for _, _, normals in parts]))


def _capsule(radius: float, length: float) -> tuple:
    """Two half balls and the wall between; a length of 0 makes a ball."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 26)
    shift = np.where(angle < 0, -length / 2, length / 2)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rise = radius * normal[:, 1] + shift
    if length:    # rings along the wall, where the light of the sky changes
        wall = np.linspace(-length / 2, length / 2, 12)
        rise = np.concatenate([rise[:13], wall, rise[13:]])
        normal = np.concatenate([normal[:13], np.tile([1.0, 0.0], (12, 1)), normal[13:]])
    return _lathe(radius * normal[:, 0], rise, normal, 56)


def _cylinder(radius: float, length: float, *, top: float = 1.0, around: int = 56) -> tuple:
    """Wall and two lids; ``top`` is the share of the radius at the upper end (0: a cone)."""
    level, share = np.linspace(-length / 2, length / 2, 10), np.linspace(0, 1, 8)
    slope = _unit([length, radius * (1 - top)])
    wall = _lathe(np.linspace(radius, radius * top, 10), level, np.tile(slope, (10, 1)), around)
    under = _lathe(radius * share, np.full(8, -length / 2), np.tile([0.0, -1.0], (8, 1)), around)
    above = _lathe(radius * top * share[::-1], np.full(8, length / 2),
                   np.tile([0.0, 1.0], (8, 1)), around)
    return _join([under, wall, above])


def _box(size: ArrayLike, cells: int = 10, bend: int = 4) -> tuple:
    """
    Six faces, in cells so that the light of the sky can change across them, and rounded edges.

    Rounding pushes each point of the sharp box out from a smaller box by the radius. Without it,
    the edges would cut through cloth whose triangles bridge them.
    """
    half = np.asarray(size, dtype=float) / 2
    radius = 0.12 * half.min()
    inner = half - radius
    curve = radius * np.tan(np.linspace(0, np.pi / 4, bend + 1)[1:])
    lines = [np.concatenate([-c - curve[::-1], np.linspace(-c, c, cells + 1), c + curve])
             for c in inner]
    last = cells + 2 * bend
    i, j = np.meshgrid(np.arange(last), np.arange(last), indexing='ij')
    a = i * (last + 1) + j
    b, c, d = a + last + 1, a + last + 2, a + 1
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2).reshape(-1, 3)
    faces = []
    for axis in range(3):
        side, rise = (axis + 1) % 3, (axis + 2) % 3
        sharp = np.empty((last + 1, last + 1, 3))
        sharp[..., side], sharp[..., rise] = np.meshgrid(lines[side], lines[rise], indexing='ij')
        for sign in (1, -1):
            sharp[..., axis] = sign * half[axis]
            core = np.clip(sharp, -inner, inner).reshape(-1, 3)
            normals = _unit(sharp.reshape(-1, 3) - core)
            faces.append((core + radius * normals, triangles[:, ::sign], normals))
    return _join(faces)


def _placed(geometry: tuple, position: ArrayLike, turn: Array, colour: Colour, **rest) -> _Mesh:
    points, triangles, normals = geometry
    light = _linear(colour)
    return _Mesh(points @ turn.T + np.asarray(position), triangles, normals @ turn.T,
                 light, light, **rest)


def _body_mesh(body: Body, coarseness: float = 0.0) -> _Mesh:
    """Return a body that yields to cloth with triangles so coarse [m]."""
    size = body.size
    thin = min(size) / 2 if body.shape == 'box' else size[0]
    if body.shape == 'sphere':
        geometry = _capsule(size[0], 0.0)
    elif body.shape == 'capsule':
        geometry = _capsule(*size)
    elif body.shape == 'cylinder':
        geometry = _cylinder(*size)
    else:
        geometry = _box(size)
    return _placed(geometry, body.position, _rotation(body.orientation), body.colour,
                   gloss=0.1, yields=min(0.6 * coarseness, 0.25 * thin))


def _surface_mesh(surface: Surface) -> _Mesh:
    a, b, c = (surface.points[surface.triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(surface.points)
    for axis in range(3):
        normals[:, axis] = np.bincount(surface.triangles.ravel(), np.repeat(area[:, axis], 3),
                                       minlength=len(normals))
    front = _linear(surface.colour)
    back = _linear(surface.back_colour) if surface.back_colour else 0.5 * front + 0.42
    return _Mesh(surface.points, surface.triangles, _unit(normals), front, back, solid=False,
                 rest=surface.rest, rest_spacing=surface.rest_spacing)


def _marker_meshes(path: Path, size: float) -> list[_Mesh]:
    """Return a gripper whose finger tips, or a ball whose centre, is the present point."""
    if path.marker == 'none' or not len(path.points):
        return []
    here, turn = path.points[path.present], _rotation(path.orientation)
    size = path.marker_size or size
    if path.marker == 'ball':
        return [_placed(_capsule(size / 4, 0.0), here, turn, path.colour, gloss=0.2)]

    def part(geometry: tuple, offset: tuple, colour: Colour) -> _Mesh:
        return _placed(geometry, here + turn @ (size * np.array(offset)), turn, colour, gloss=0.2)

    finger = _box(size * np.array([0.09, 0.2, 0.52]), 2, 2)
    return [part(finger, (-0.1, 0.0, 0.2), '#3d434b'), part(finger, (0.1, 0.0, 0.2), '#3d434b'),
            part(_box(size * np.array([0.5, 0.3, 0.2]), 2, 2), (0.0, 0.0, 0.54), path.colour),
            part(_cylinder(0.11 * size, 0.36 * size), (0.0, 0.0, 0.82), '#c6cbd1')]


def _arrow_meshes(arrow: Arrow, size: float) -> list[_Mesh]:
    length = float(np.linalg.norm(arrow.vector))
    if length == 0:
        return []
    turn = _frame(np.asarray(arrow.vector)).T
    head = min(0.4 * length, 0.32 * size)
    radius = 0.17 * head
    along = turn[:, 2]
    return [_placed(_cylinder(radius, length - head, around=20),
                    arrow.origin + along * (length - head) / 2, turn, arrow.colour),
            _placed(_cylinder(2.3 * radius, head, top=0.0, around=32),
                    arrow.origin + along * (length - head / 2), turn, arrow.colour)]


# The z-buffer: what is seen where

def _fragments(pixels: Array, key: Array, triangles: Array, width: int, height: int,
               at_once: int = 1 << 19) -> Iterator[tuple[Array, Array, Array]]:
    """
    Yield which samples lie in which triangles: sample, interpolated key, triangle.

    ``pixels`` (n, 2) are the corners and ``key`` (n,) is affine in each triangle. A row of samples
    meets a triangle in one span, bounded by the edges that cross it.
    """
    corner, value = pixels[triangles], key[triangles]
    (x0, y0), (x1, y1), (x2, y2) = (corner[:, k].T for k in range(3))
    twice_area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    low, high = corner[:, :, 1].min(axis=1), corner[:, :, 1].max(axis=1)
    left, right = corner[:, :, 0].min(axis=1), corner[:, :, 0].max(axis=1)
    first = np.ceil(np.clip(low, 0, height) - 0.5).astype(np.int64)
    last = np.floor(np.clip(high, 0, height) - 0.5).astype(np.int64)
    rows = np.where((np.abs(twice_area) > 1e-12) & (right > 0) & (left < width),
                    np.maximum(last - first + 1, 0), 0)
    kept = np.flatnonzero(rows)
    rows, first, corner, value = rows[kept], first[kept], corner[kept], value[kept]
    twice_area = twice_area[kept]
    # key = slope_x x + slope_y y + level
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    rise1, rise2 = value[:, 1] - value[:, 0], value[:, 2] - value[:, 0]
    slope_x = (rise1 * edge2[:, 1] - rise2 * edge1[:, 1]) / twice_area
    slope_y = (rise2 * edge1[:, 0] - rise1 * edge2[:, 0]) / twice_area
    level = value[:, 0] - slope_x * corner[:, 0, 0] - slope_y * corner[:, 0, 1]

    triangle = np.repeat(np.arange(len(kept)), rows)
    row = np.arange(len(triangle)) - np.repeat(np.cumsum(rows) - rows, rows) + first[triangle]
    y = row + 0.5
    start, stop = np.zeros(len(row)), np.full(len(row), float(width))
    sign = np.sign(twice_area)
    for k in range(3):    # inside is where (p - here) x (there - here) has the area's sign
        here, there = corner[:, k], corner[:, (k + 1) % 3]
        across, along = (sign * (there - here)[:, 1])[triangle], (there - here)[triangle, 0]
        with np.errstate(divide='ignore', invalid='ignore'):
            cut = (here[triangle, 0] + (y - here[triangle, 1]) * along
                   / (there - here)[triangle, 1])
        np.maximum(start, cut, out=start, where=across < 0)
        np.minimum(stop, cut, out=stop, where=across > 0)
    start = np.ceil(start - 0.5).astype(np.int64)
    counts = np.maximum(np.floor(stop - 0.5).astype(np.int64) - start + 1, 0)
    base = slope_x[triangle] * 0.5 + slope_y[triangle] * y + level[triangle]
    slope = slope_x[triangle]
    offset = row * width

    ends = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        done = ends[begin - 1] if begin else 0
        end = max(int(np.searchsorted(ends, done + at_once, side='right')), begin + 1)
        count = counts[begin:end]
        span = np.repeat(np.arange(begin, end), count)
        column = (np.arange(len(span)) - np.repeat(np.cumsum(count) - count, count)
                  + start[span])
        yield (offset[span] + column, (base[span] + slope[span] * column).astype(np.float32),
               kept[triangle[span]])
        begin = end


def _rasterise(pixels: Array, key: Array, triangles: Array, width: int,
               height: int) -> tuple[Array, Array]:
    """Return the greatest key (samples,), -inf where nothing is, and its triangle, -1 if none."""
    best = np.full(width * height, -np.inf, dtype=np.float32)
    which = np.full(width * height, -1, dtype=np.int32)
    # far ones first: then nearly every sample is right at once
    order = np.argsort(key[triangles].sum(axis=1), kind='stable')
    for sample, value, triangle in _fragments(pixels, key, triangles[order], width, height):
        while True:
            nearer = np.flatnonzero(value > best[sample])
            if not len(nearer):
                break
            sample, value, triangle = sample[nearer], value[nearer], triangle[nearer]
            best[sample], which[sample] = value, order[triangle]
    return best, which


# Light

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


def _spiral(count: int) -> Array:
    """Return points (count, 2) spread evenly over the unit disc."""
    index = np.arange(count)
    angle = index * np.pi * (3 - np.sqrt(5))
    return (np.sqrt((index + 0.5) / count)[:, None]
            * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _directions(count: int) -> Array:
    """Return directions (count, 3) spread evenly over the sphere."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height ** 2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


class _DepthMap:
    """How near to a far light things reach, by place across its rays."""

    def __init__(self, points: Array, triangles: Array, towards: Array, texels: int,
                 yields: Array | float = 0.0) -> None:
        self.axes = _frame(towards)
        local = points @ self.axes.T
        low, high = local.min(axis=0), local.max(axis=0)
        self.texel = 1.02 * max((high - low)[:2].max(), 1e-9) / (texels - 2)
        self.low = (low + high)[:2] / 2 - self.texel * texels / 2
        self.reach = float((high - low)[2])
        self.texels = texels
        pixels = (local[:, :2] - self.low) / self.texel
        best, _ = _rasterise(pixels, local[:, 2] - yields, triangles, texels, texels)
        self.nearest = best.reshape(texels, texels)
        self.nearest[[0, -1]] = self.nearest[:, [0, -1]] = -np.inf
        self.nearest = self.nearest.ravel()

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


def _lit(sun: _DepthMap, points: Array, normals: Array, taps: Array) -> Array:
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
    search = _spiral(16) * widest
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


def _sky(maps: Sequence[_DepthMap], points: Array, normals: Array) -> Array:
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


# One panel

@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture without type, and how far it is to what it shows."""

    image: Array
    """(height, width, 3) sRGB in [0, 1]"""
    depth: Array
    """(height, width) of things other than planes, inf where there are none [m]"""


@dataclass(frozen=True, eq=False)
class _Lamps:
    """All the light of an instant."""

    towards: Array
    """(3,) unit, to the sun"""
    sun: _DepthMap | None
    sky: tuple[_DepthMap, ...]


def _coarseness(surfaces: Sequence[Surface]) -> float:
    """Return the mean length of the longest edges of the coarsest cloth [m]."""
    means = [np.linalg.norm(surface.points[surface.triangles]
                            - surface.points[np.roll(surface.triangles, 1, axis=1)],
                            axis=2).max(axis=1).mean()
             for surface in surfaces if len(surface.triangles)]
    return float(max(means, default=0.0))


def _meshes(instant: Instant, size: float) -> list[_Mesh]:
    coarseness = _coarseness(instant.surfaces)
    meshes = [_body_mesh(body, coarseness) for body in instant.bodies if body.shape != 'plane']
    meshes += [_surface_mesh(surface) for surface in instant.surfaces]
    for path in instant.paths:
        meshes += _marker_meshes(path, size)
    for arrow in instant.arrows:
        meshes += _arrow_meshes(arrow, size)
    return [mesh for mesh in meshes if len(mesh.triangles)]


def _shade_meshes(meshes: Sequence[_Mesh], view: View, lamps: _Lamps, over: int,
                  plane_nearness: Array) -> tuple[Array, Array, Array]:
    """
    Return the light (pixels, 3) and cover (pixels,) of all meshes, and their depth.

    ``over`` x ``over`` samples a pixel; ``plane_nearness`` (pixels,) is 1/depth of the planes.
    """
    width, height = view.width * over, view.height * over
    count = view.width * view.height
    if not meshes:
        return np.zeros((count, 3)), np.zeros(count), np.full(count, np.inf)
    points, triangles, normals = _join([(m.points, m.triangles, m.normals) for m in meshes])
    owner = np.repeat(np.arange(len(meshes)), [len(m.triangles) for m in meshes])
    pixels, depth = view.project(points)
    pixels *= over
    shown = (depth[triangles] > 1e-6).all(axis=1)
    triangles, owner = triangles[shown], owner[shown]
    counts = [len(m.points) for m in meshes]
    steps_back = np.array([1 - m.yields / max(float(view.project(m.points.mean(axis=0))[1][0]),
                                              2 * m.yields, 1e-6) for m in meshes])
    nearness = np.where(depth > 1e-6, 1 / np.where(depth > 1e-6, depth, 1), 0)
    best, which = _rasterise(pixels, nearness * np.repeat(steps_back, counts), triangles,
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
    sky_front = _sky(lamps.sky, points, normals)
    sky_back = sky_front.copy()
    soft = np.repeat([not m.solid for m in meshes], counts)
    if soft.any():
        sky_back[soft] = _sky(lamps.sky, points[soft], -normals[soft])
        cloth = triangles[~solid]
        sky_front, sky_back = _smoothed(sky_front, cloth), _smoothed(sky_back, cloth)
    printed = _printed(meshes, triangles, owner, edge1, edge2, inverse, len(points))

    light = np.zeros((count, 3))
    taps = _spiral(max(TAPS // over ** 2, 1) * over ** 2).astype(np.float32)    # shared out
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
        normal = _unit(np.einsum('nk,nkc->nc', weight, normals[corners]) * side[:, None])
        rays = view.rays(x / over, y / over)
        place = view.eye + rays * (steps_back[tri] / best[sample[part]])[:, None]
        sky = np.where(back[tri], (weight * sky_back[corners]).sum(axis=1),
                       (weight * sky_front[corners]).sum(axis=1))
        facing = np.maximum(normal @ lamps.towards, 0)
        lit = np.zeros(len(tri), dtype=np.float32)
        day = np.flatnonzero(facing)
        phase = (right[part] % over + down[part] % over * over)[day]
        lit[day] = _lit(lamps.sun, place[day], normal[day], phases[phase])
        halfway = _unit(lamps.towards - _unit(rays))
        shine = (gloss[tri] * lit * np.maximum((normal * halfway).sum(axis=1), 0) ** 36)
        shade = np.outer(facing * lit, SUN) + np.outer(0.1 + 0.9 * sky, SKY)
        tone = colour[tri]
        if printed is not None:
            tone = tone * _print_tone(printed, tri, corners, weight)[:, None]
        result = _pressed(tone * shade + shine[:, None])
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


def _printed(meshes: Sequence[_Mesh], triangles: Array, owner: Array, edge1: Array, edge2: Array,
             inverse: Array, count: int) -> tuple[Array, Array] | None:
    """Return grid coordinates (n, 2) of points and how fast they change per sample (m, 2)."""
    if all(mesh.rest is None for mesh in meshes):
        return None
    grid = np.concatenate([np.full((len(m.points), 2), 0.5) if m.rest is None
                           else m.rest / m.rest_spacing for m in meshes])
    a, b, c = (grid[triangles[:, k]] for k in range(3))
    d1, d2, inverse = b - a, c - a, inverse[:, None]
    change_x = (d1 * edge2[:, 1:] - d2 * edge1[:, 1:]) * inverse
    change_y = (d2 * edge1[:, :1] - d1 * edge2[:, :1]) * inverse
    return grid, np.hypot(change_x, change_y)


def _print_tone(printed: tuple[Array, Array], tri: Array, corners: Array,
                weight: Array) -> Array:
    grid, change = printed
    place = np.einsum('nk,nkc->nc', weight, grid[corners])
    off = np.abs(place - np.round(place))
    width = np.maximum(change[tri], 1e-9)
    ink = np.clip(1.6 - off / width, 0, 1) * np.clip(0.3 / width, 0, 1)
    return 1 - 0.25 * ink.max(axis=1)


def _shade_planes(bodies: Sequence[Body], view: View, lamps: _Lamps, centre: Array,
                  radius: float, spacing: float, background: Array) -> tuple[Array, Array]:
    """Return the light (pixels, 3) of the planes against the background, and their 1/depth."""
    count = view.width * view.height
    light = np.tile(background, (count, 1))
    nearness = np.zeros(count)
    down, right = np.mgrid[0:view.height, 0:view.width] + 0.5
    rays = view.rays(right, down).reshape(-1, 3)
    for body in bodies:
        turn = _rotation(body.orientation)
        normal, origin = turn[:, 2], np.asarray(body.position)
        height = float(normal @ (view.eye - origin))
        if height == 0:
            continue
        key = -(rays @ normal) / height
        shown = np.flatnonzero(key > np.maximum(nearness, 1e-9))
        middle = turn.T @ (centre - origin)
        place = (view.eye + rays[shown] / key[shown, None] - origin) @ turn
        far = np.hypot(place[:, 0] - middle[0], place[:, 1] - middle[1]) / radius
        near = far < 3.2
        shown, place, far = shown[near], place[near], far[near]
        nearness[shown] = key[shown]
        facing = normal * np.sign(height)
        sky = _plane_sky(lamps, place, middle, radius, origin, turn, facing)
        shade = np.outer(0.1 + 0.9 * sky, SKY)
        slant = float(facing @ lamps.towards)
        if slant > 0:
            lit = np.ones(len(place))
            if lamps.sun is not None:
                taps = _spiral(PLANE_TAPS).astype(np.float32)[None]
                for begin in range(0, len(place), 1 << 16):
                    part = slice(begin, begin + (1 << 16))
                    lit[part] = _lit(lamps.sun, origin + place[part] @ turn.T,
                                     np.broadcast_to(facing, (len(place[part]), 3)), taps)
            shade += np.outer(slant * lit, SUN)
        ink = _plane_grid(place, shown, count, view.width, spacing)
        fade = np.clip((3.2 - far) / 2.0, 0, 1)
        fade = (fade * fade * (3 - 2 * fade))[:, None]
        tone = _pressed(_linear(body.colour) * (1 - 0.16 * ink[:, None]) * shade)
        light[shown] = light[shown] * (1 - fade) + tone * fade
    return light, nearness


def _plane_sky(lamps: _Lamps, place: Array, middle: Array, radius: float, origin: Array,
               turn: Array, facing: Array, cells: int = 72) -> Array:
    """Return the sky's light at points of a plane, from a table around the middle."""
    extent = 1.6 * radius
    line = np.linspace(-extent, extent, cells)
    table = np.zeros((cells * cells, 3))
    table[:, 0] = np.repeat(line, cells) + middle[0]
    table[:, 1] = np.tile(line, cells) + middle[1]
    value = _sky(lamps.sky, origin + table @ turn.T,
                 np.broadcast_to(facing, table.shape)).reshape(cells, cells)
    for _ in range(3):    # the few directions leave spots
        wide = np.pad(value, 1, mode='edge')
        value = (wide[:-2, 1:-1] + 2 * value + wide[2:, 1:-1]) / 4
        wide = np.pad(value, 1, mode='edge')
        value = (wide[1:-1, :-2] + 2 * value + wide[1:-1, 2:]) / 4
    clear = value.max()
    edge = np.clip(8 * (1 - np.abs(line) / extent), 0, 1)
    value = clear + (value - clear) * edge[:, None] * edge
    at = np.clip((place[:, :2] - middle[:2] + extent) / (2 * extent) * (cells - 1),
                 0, cells - 1.001)
    i, j = at.astype(np.int64).T
    s, t = (at - np.stack([i, j], axis=1)).T
    return ((value[i, j] * (1 - s) + value[i + 1, j] * s) * (1 - t)
            + (value[i, j + 1] * (1 - s) + value[i + 1, j + 1] * s) * t)


def _plane_grid(place: Array, shown: Array, count: int, width: int, spacing: float) -> Array:
    """Return how much of each pixel is grid line, thin lines a pixel wide."""
    ink = np.zeros(len(place))
    for axis in range(2):
        along = np.zeros(count)
        along[shown] = place[:, axis] / spacing
        picture = along.reshape(-1, width)
        step = np.hypot(*np.gradient(picture)).ravel()[shown]
        line = along[shown]
        off = np.abs(line - np.round(line)) / np.maximum(step, 1e-9)
        ink = np.maximum(ink, np.clip(1.2 - off, 0, 1) * np.clip(0.35 - step, 0, 0.25) * 4)
    return ink


def render(instant: Instant, view: View, *, sun: ArrayLike = (-0.6, -0.3, 0.8),
           background: Colour = 'white', box: tuple[Array, Array] | None = None,
           over: int = 3) -> Rendering:
    """
    Render one instant.

    ``sun`` points to the sun; ``box``, the lowest and highest coordinates shown (None: those of
    this instant), sizes markers and the grid and says where planes fade; ``over`` x ``over``
    samples make a pixel.
    """
    low, high = extent([instant]) if box is None else box
    size = _size(low, high)
    meshes = _meshes(instant, MARKER * size)
    towards = _unit(sun)
    sun_map, sky_maps = None, ()
    if meshes:
        points, triangles, _ = _join([(m.points, m.triangles, m.normals) for m in meshes])
        yields = np.repeat([m.yields for m in meshes], [len(m.points) for m in meshes])
        sun_map = _DepthMap(points, triangles, towards, SUN_TEXELS, yields)
        sky_maps = tuple(_DepthMap(points, triangles, direction, SKY_TEXELS, yields)
                         for direction in _directions(SKY_DIRECTIONS))
    lamps = _Lamps(towards, sun_map, sky_maps)
    planes = [body for body in instant.bodies if body.shape == 'plane']
    ground, nearness = _shade_planes(planes, view, lamps, (low + high) / 2, 0.5 * size,
                                     grid_spacing(size), _linear(background))
    light, cover, depth = _shade_meshes(meshes, view, lamps, over, nearness)
    light += ground * (1 - cover)[:, None]
    shape = (view.height, view.width)
    return Rendering(_encoded(light).reshape(*shape, 3), depth.reshape(shape))


def grid_spacing(size: float) -> float:
    """Return a round distance between grid lines for an extent [m]."""
    wish = size / 9
    decade = 10.0 ** np.floor(np.log10(wish))
    return float(decade * max(step for step in (1, 2, 5) if step * decade <= wish * (1 + 1e-9)))


# The camera

def _content(instant: Instant, size: float = 0.0) -> Array:
    """
    Return points (n, 3) that a picture of this instant should show, planes left out.

    Markers, whose size depends on the rest, are counted if ``size`` is given.
    """
    parts = [np.empty((0, 3)), *(surface.points for surface in instant.surfaces)]
    parts += [_body_mesh(body).points for body in instant.bodies if body.shape != 'plane']
    for path in instant.paths:
        parts.append(path.points)
        parts += [mesh.points for mesh in _marker_meshes(path, MARKER * size) if size]
    for arrow in instant.arrows:
        origin = np.asarray(arrow.origin, dtype=float)
        parts.append(np.stack([origin, origin + arrow.vector]))
    return np.concatenate(parts)


def _size(low: Array, high: Array) -> float:
    return float(np.linalg.norm(high - low)) or 1.0


def extent(instants: Sequence[Instant]) -> tuple[Array, Array]:
    """Return the lowest and highest coordinates (3,) of what is shown, planes left out [m]."""
    points = np.concatenate([_content(instant) for instant in instants])
    if not len(points):
        return np.full(3, -0.5), np.full(3, 0.5)
    return points.min(axis=0), points.max(axis=0)


def _camera_axes(camera: Camera) -> Array:
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    forward = -np.array([np.cos(elevation) * np.cos(azimuth),
                         np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(right, forward), forward])


def fit(points: ArrayLike, camera: Camera, width: int, height: int, *,
        margin: float = 0.06) -> View:
    """
    Place a camera so that all points just fit, with a margin of the picture on each side.

    A side of the frustum is a plane: with r right and f forward, points are inside the left one
    where r + f t >= a, inside the right one where r - f t <= b. The tightest a and b meet where
    the eye is; of the two distances, from the sides and from above and below, the larger holds.
    """
    axes = _camera_axes(camera)
    slope = np.tan(np.radians(camera.field_of_view) / 2)
    focal = height / 2 / slope
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    points = points if len(points) else np.zeros((1, 3))
    local = points @ axes.T
    inner = slope * (1 - 2 * margin) * np.array([width / height, 1.0])
    low = (local[:, :2] + local[:, 2:] * inner).min(axis=0)
    high = (local[:, :2] - local[:, 2:] * inner).max(axis=0)
    eye = np.append((low + high) / 2, ((low - high) / (2 * inner)).min())
    if camera.target is not None or camera.distance is not None:
        target = (axes @ np.asarray(camera.target) if camera.target is not None
                  else np.append(eye[:2], np.median(local[:, 2])))
        distance = camera.distance if camera.distance is not None else target[2] - eye[2]
        eye = target - [0.0, 0.0, distance]
    eye[2] = min(eye[2], local[:, 2].min() - 1e-3) if camera.distance is None else eye[2]
    return View(eye @ axes, axes, focal, width, height)


# The page

def _best_aspect(points: Array, camera: Camera, low: float, high: float) -> float:
    """Return the width over height, within bounds, of a panel that the points fill both ways."""
    local = points[::max(1, len(points) // 4000)] @ _camera_axes(camera).T
    slope = 0.88 * np.tan(np.radians(camera.field_of_view) / 2)

    def distance(axis: int, t: float) -> float:
        return float((local[:, axis] - local[:, 2] * t).max()
                     - (local[:, axis] + local[:, 2] * t).min()) / t

    wanted = distance(1, slope)
    for _ in range(30):
        middle = (low + high) / 2
        if distance(0, slope * middle) > wanted:
            low = middle
        else:
            high = middle
    return low


def _default_sun(camera: Camera) -> Array:
    """Return a sun to the left of the camera and behind it."""
    azimuth, elevation = np.radians([camera.azimuth - 75, 50])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                     np.sin(elevation)])


def _draw_path(axes: Any, path: Path, view: View, depth: Array, scale: float) -> None:
    """Draw a path, faint where something hides it and dotted where it still lies ahead."""
    if len(path.points) < 2:
        return
    present = path.present % len(path.points)
    steps = [np.linspace(0, 1, 24, endpoint=False)[:, None] * (b - a) + a
             for a, b in zip(path.points[:-1], path.points[1:])]
    points = np.concatenate([*steps, path.points[-1:]])
    pixels, far = view.project(points)
    column = np.clip(pixels[:, 0], 0, view.width - 1).astype(int)
    row = np.clip(pixels[:, 1], 0, view.height - 1).astype(int)
    hidden = far > 1.004 * depth[row, column]
    ahead = np.arange(len(points) - 1) >= 24 * present
    segments = np.stack([pixels[:-1], pixels[1:]], axis=1)
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(pixels, axis=0).T))])[:-1]
    kept = ~ahead | (along % (9 * scale) < 4.5 * scale)
    opacity = np.where(hidden[1:] | hidden[:-1], 0.25, np.where(ahead, 0.75, 1.0))
    colours = np.column_stack([np.tile(to_rgb(path.colour), (len(segments), 1)), opacity])
    axes.add_collection(LineCollection(list(segments[kept]), colors=colours[kept],
                                       linewidths=1.1, capstyle='butt'))


def _draw_arrow_label(axes: Any, arrow: Arrow, view: View, size: float) -> None:
    if not arrow.label:
        return
    ends, depth = view.project(np.stack([np.asarray(arrow.origin, dtype=float),
                                         np.asarray(arrow.origin) + arrow.vector]))
    if (depth <= 0).any():
        return
    if not (0 < ends[1, 0] < view.width and 0 < ends[1, 1] < view.height):
        return
    way = ends[1] - ends[0]
    half = 0.3 * size * len(arrow.label)    # of the text's width
    right, down = ends[1] + size * way / max(float(np.hypot(*way)), 1e-9)
    if abs(way[0]) > abs(way[1]):
        right = ends[1, 0] + np.sign(way[0]) * (half + 0.4 * size)
    axes.text(np.clip(right, half, view.width - half), np.clip(down, size, view.height - size),
              arrow.label, color=arrow.colour, fontsize=7.5, ha='center', va='center',
              path_effects=[withStroke(linewidth=2.2, foreground='white')])


def _columns(count: int) -> int:
    return count if count <= 3 else 2 if count == 4 else 3 if count <= 9 else 4


def _save(canvas: FigureCanvasAgg, file: FilePath) -> None:
    """Write a PNG, with fewer colours or pixels if it would be too large."""
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    attempt = picture
    for scale in (1.0, 0.8, 0.6, 0.4):
        small = picture if scale == 1 else picture.resize(
            (round(picture.width * scale), round(picture.height * scale)), Image.LANCZOS)
        for attempt in (small, small.point(lambda value: value | 1), small.quantize(256)):
            data = io.BytesIO()
            attempt.save(data, 'PNG', optimize=True)
            if data.tell() < FILE_LIMIT:
                file.write_bytes(data.getvalue())
                return
    raise ValueError(f'{file}: a picture of {picture.width} x {picture.height} px '
                     f'cannot be made smaller than {FILE_LIMIT} bytes')


def draw(instants: Sequence[Instant], file: FilePath | str, *, title: str = '',
         columns: int | None = None, camera: Camera | None = None, width_px: int = 1600,
         sun: ArrayLike | None = None) -> None:
    """
    Write a PNG with one panel per instant.

    The camera is fitted to all instants together, planes left out. ``sun`` points to the sun;
    None: it stands to the left of the camera. Labels of paths make a legend.
    """
    if not instants:
        raise ValueError('draw: needs at least one instant')
    camera = camera or Camera()
    sun = _default_sun(camera) if sun is None else sun
    box = extent(instants)
    size = _size(*box)
    points = np.concatenate([_content(instant, size) for instant in instants])
    points = points if len(points) else np.zeros((1, 3))
    unit = width_px / 1600
    columns = min(columns or _columns(len(instants)), len(instants))
    rows = -(-len(instants) // columns)
    outer, gap = round(16 * unit), round(16 * unit)
    panel = (width_px - 2 * outer - gap * (columns - 1)) // columns
    least = {1: 1.5, 2: 1.3}.get(columns, 1.1)    # or tall content makes a page of two screens
    tall = round(panel / _best_aspect(points, camera, least, 2.0))
    above = round(40 * unit) if any(instant.title for instant in instants) else 0
    labels = {path.label: path for instant in instants for path in instant.paths if path.label}
    top = outer + (round(52 * unit) if title else 0)
    planes = any(body.shape == 'plane' for instant in instants for body in instant.bodies)
    foot = outer + (round(36 * unit) if labels or planes else 0)
    height_px = top + rows * (tall + above) + (rows - 1) * gap + foot

    dpi = 200 * unit
    figure = Figure(figsize=(width_px / dpi, height_px / dpi), dpi=dpi, facecolor='white')
    canvas = FigureCanvasAgg(figure)
    ink, muted = '#1f2328', '#6b737c'
    if title:
        figure.text(outer / width_px, 1 - (outer + 18 * unit) / height_px, title, fontsize=11,
                    fontweight='bold', color=ink, ha='left', va='center')
    view = fit(points, camera, panel, tall)
    for index, instant in enumerate(instants):
        row, column = divmod(index, columns)
        left = outer + column * (panel + gap)
        down = top + above + row * (tall + above + gap)
        axes = figure.add_axes((left / width_px, 1 - (down + tall) / height_px,
                                panel / width_px, tall / height_px))
        rendering = render(instant, view, sun=sun, box=box)
        axes.imshow(rendering.image, interpolation='nearest', aspect='auto',
                    extent=(0, panel, tall, 0))
        for path in instant.paths:
            _draw_path(axes, path, view, rendering.depth, unit)
        for arrow in instant.arrows:
            _draw_arrow_label(axes, arrow, view, 20 * unit)
        axes.set(xlim=(0, panel), ylim=(tall, 0), xticks=(), yticks=())
        for spine in axes.spines.values():
            spine.set(color='#d5dade', linewidth=0.6)
        if instant.title:
            figure.text(left / width_px, 1 - (down - 16 * unit) / height_px, instant.title,
                        fontsize=8.5, color=ink, ha='left', va='center')
    level = (foot - 26 * unit) / height_px
    if labels:
        handles = [Line2D([], [], color=path.colour, linewidth=1.6, label=label,
                          solid_capstyle='butt')
                   for label, path in labels.items()]
        figure.legend(handles=handles, loc='center left', ncol=len(handles), frameon=False,
                      bbox_to_anchor=(outer / width_px, level), fontsize=8,
                      labelcolor=ink, borderpad=0, borderaxespad=0, handlelength=1.6,
                      columnspacing=1.6)
    if planes:
        figure.text(1 - outer / width_px, level, f'grid {grid_spacing(size):g} m', fontsize=7.5,
                    color=muted, ha='right', va='center')
    canvas.draw()
    _save(canvas, FilePath(file))
