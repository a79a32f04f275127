"""What a picture shows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from xpbd_ros.study.picture.colour import Colour
from xpbd_ros.study.picture.vectors import Array

SHAPES = ('plane', 'sphere', 'capsule', 'cylinder', 'box')
MARKERS = ('jaws', 'ball', 'none')


def _points(value: ArrayLike, what: str) -> Array:
    """Return finite points (n, 3), as a private copy."""
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

    def __post_init__(self) -> None:
        points = _points(self.points, 'Surface.points')
        triangles = np.array(self.triangles, dtype=np.int64).reshape(-1, 3)
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
            raise ValueError(f'Surface.triangles: indices must be 0 .. {len(points) - 1} '
                             f'(got {triangles.min()} .. {triangles.max()})')
        object.__setattr__(self, 'points', points)
        object.__setattr__(self, 'triangles', triangles)


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
