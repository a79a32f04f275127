"""Everything but planes becomes triangles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from xpbd_ros.study.picture.colour import Colour, linear
from xpbd_ros.study.picture.content import Arrow, Body, Instant, Path, Surface
from xpbd_ros.study.picture.solids import box, capsule, cylinder
from xpbd_ros.study.picture.vectors import Array, basis, rotation, unit


@dataclass(frozen=True, eq=False)
class Mesh:
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


def _placed(geometry: tuple, position: ArrayLike, turn: Array, colour: Colour, **rest) -> Mesh:
    points, triangles, normals = geometry
    light = linear(colour)
    return Mesh(points @ turn.T + np.asarray(position), triangles, normals @ turn.T,
                light, light, **rest)


def body_mesh(body: Body, coarseness: float = 0.0) -> Mesh:
    """Return a body that yields to cloth with triangles so coarse [m]."""
    size = body.size
    assert isinstance(size, tuple) and body.colour is not None
    thin = min(size) / 2 if body.shape == 'box' else size[0]
    if body.shape == 'sphere':
        geometry = capsule(size[0], 0.0)
    elif body.shape == 'capsule':
        geometry = capsule(*size)
    elif body.shape == 'cylinder':
        geometry = cylinder(*size)
    else:
        geometry = box(size)
    return _placed(geometry, body.position, rotation(body.orientation), body.colour,
                   gloss=0.1, yields=min(0.6 * coarseness, 0.25 * thin))


def _surface_mesh(surface: Surface) -> Mesh:
    a, b, c = (surface.points[surface.triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(surface.points)
    for axis in range(3):
        normals[:, axis] = np.bincount(surface.triangles.ravel(), np.repeat(area[:, axis], 3),
                                       minlength=len(normals))
    front = linear(surface.colour)
    back = linear(surface.back_colour) if surface.back_colour else 0.5 * front + 0.42
    return Mesh(surface.points, surface.triangles, unit(normals), front, back, solid=False)


def marker_meshes(path: Path, size: float) -> list[Mesh]:
    """Return a gripper whose finger tips, or a ball whose centre, is the present point."""
    if path.marker == 'none' or not len(path.points):
        return []
    here, turn = path.points[path.present], rotation(path.orientation)
    if path.marker == 'ball':
        return [_placed(capsule(size / 4, 0.0), here, turn, path.colour, gloss=0.2)]

    def part(geometry: tuple, offset: tuple, colour: Colour) -> Mesh:
        return _placed(geometry, here + turn @ (size * np.array(offset)), turn, colour, gloss=0.2)

    finger = box(size * np.array([0.09, 0.2, 0.52]), 2, 2)
    return [part(finger, (-0.1, 0.0, 0.2), '#3d434b'), part(finger, (0.1, 0.0, 0.2), '#3d434b'),
            part(box(size * np.array([0.5, 0.3, 0.2]), 2, 2), (0.0, 0.0, 0.54), path.colour),
            part(cylinder(0.11 * size, 0.36 * size), (0.0, 0.0, 0.82), '#c6cbd1')]


def _arrow_meshes(arrow: Arrow, size: float) -> list[Mesh]:
    length = float(np.linalg.norm(arrow.vector))
    if length == 0:
        return []
    turn = basis(np.asarray(arrow.vector)).T
    head = min(0.4 * length, 0.32 * size)
    radius = 0.17 * head
    along = turn[:, 2]
    return [_placed(cylinder(radius, length - head, around=20),
                    arrow.origin + along * (length - head) / 2, turn, arrow.colour),
            _placed(cylinder(2.3 * radius, head, top=0.0, around=32),
                    arrow.origin + along * (length - head / 2), turn, arrow.colour)]


def _coarseness(surfaces: Sequence[Surface]) -> float:
    """Return the mean length of the longest edges of the coarsest cloth [m]."""
    means = [np.linalg.norm(surface.points[surface.triangles]
                            - surface.points[np.roll(surface.triangles, 1, axis=1)],
                            axis=2).max(axis=1).mean()
             for surface in surfaces if len(surface.triangles)]
    return float(max(means, default=0.0))


def meshes_of(instant: Instant, size: float) -> list[Mesh]:
    coarseness = _coarseness(instant.surfaces)
    meshes = [body_mesh(body, coarseness) for body in instant.bodies if body.shape != 'plane']
    meshes += [_surface_mesh(surface) for surface in instant.surfaces]
    for path in instant.paths:
        meshes += marker_meshes(path, size)
    for arrow in instant.arrows:
        meshes += _arrow_meshes(arrow, size)
    return [mesh for mesh in meshes if len(mesh.triangles)]
