"""What a picture shows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

SHAPES = ('plane', 'sphere', 'capsule', 'cylinder', 'box')


@dataclass(frozen=True, eq=False)
class Surface:
    """A cloth at one instant; its back is paler than its front."""

    points: np.ndarray
    """(n, 3) [m]"""
    triangles: np.ndarray
    """(m, 3) indices of points; the front is the side from which they run counterclockwise"""
    colour: str = '#2a78b5'


@dataclass(frozen=True, eq=False)
class Body:
    """A collider at one instant."""

    shape: str
    """one of SHAPES"""
    size: Sequence[float] = ()
    """radius; radius and length (capsule: between centres); a box's sides; none of a plane [m]"""
    position: ArrayLike = (0.0, 0.0, 0.0)
    """centre; a point of the plane [m]"""
    orientation: ArrayLike = (0.0, 0.0, 0.0, 1.0)
    """unit quaternion x, y, z, w; local z is the axis, and the plane's normal"""


@dataclass(frozen=True, eq=False)
class Path:
    """Where a gripper has been; it is drawn at the last point."""

    points: np.ndarray
    """(k, 3) [m]"""
    colour: str = '#d1495b'
    label: str = ''
    """its name in the legend; paths of one label are named once"""


@dataclass(frozen=True, eq=False)
class Arrow:
    """A vector, such as a force."""

    origin: ArrayLike
    """(3,) [m]"""
    vector: ArrayLike
    """(3,), as long as it is drawn [m]"""
    label: str = ''
    """written at the tip"""
    colour: str = '#c1440e'


@dataclass(frozen=True, eq=False)
class Instant:
    """What one panel shows."""

    title: str = ''
    surfaces: Sequence[Surface] = ()
    bodies: Sequence[Body] = ()
    paths: Sequence[Path] = ()
    arrows: Sequence[Arrow] = ()
