"""What is shown, as PyVista's meshes with normals at their points."""

from dataclasses import dataclass

from matplotlib.colors import to_rgb
import numpy as np
from numpy.typing import ArrayLike, NDArray
import pyvista
from scipy.spatial.transform import Rotation

from xpbd_ros.study.picture.content import Arrow, Body, Instant, Path, Surface
from xpbd_ros.study.picture.light import axes_of, unit

GRIPPER = 0.11
"""its length as a share of what is shown"""
REACH = 1.6
"""how far planes are drawn from the middle, in diagonals of what is shown"""
CELLS = 80
"""along the side of a plane"""
UP = (0, 0, 1)


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh of one colour a side."""

    mesh: pyvista.PolyData
    front: NDArray
    """(3,), sRGB"""
    back: NDArray | None = None
    """None: a solid, of which the inside is never seen"""
    gloss: float = 0.15
    yields: bool = False
    """cloth that has sunk a little into it is still drawn over it"""


def solid(mesh: pyvista.PolyData, colour: str, position: ArrayLike,
          turn: Rotation | None = None, **rest) -> Part:
    """Return a solid that is given about its own origin."""
    points = mesh.points.astype(float)
    mesh.points = (turn.apply(points) if turn else points) + position
    mesh = mesh.triangulate().compute_normals(cell_normals=False, split_vertices=True,
                                              feature_angle=40, consistent_normals=False)
    return Part(mesh, np.array(to_rgb(colour)), **rest)


def body(one: Body) -> Part:
    """Return a collider, which is not a plane."""
    size = one.size
    mesh = {
        'sphere': lambda: pyvista.Sphere(radius=size[0], theta_resolution=64, phi_resolution=48),
        'capsule': lambda: pyvista.Capsule(radius=size[0], cylinder_length=size[1], direction=UP,
                                           resolution=48),
        'cylinder': lambda: pyvista.Cylinder(radius=size[0], height=size[1], direction=UP,
                                             resolution=64),
        'box': lambda: pyvista.Box((-size[0] / 2, size[0] / 2, -size[1] / 2, size[1] / 2,
                                    -size[2] / 2, size[2] / 2), level=8),
    }[one.shape]()
    return solid(mesh, '#9aa3ad', one.position, Rotation.from_quat(one.orientation), yields=True)


def cloth(surface: Surface) -> Part:
    mesh = pyvista.PolyData.from_regular_faces(np.array(surface.points, float), surface.triangles)
    mesh = mesh.compute_normals(cell_normals=False, split_vertices=False, consistent_normals=False)
    front = np.array(to_rgb(surface.colour))
    return Part(mesh, front, 0.35 * front + 0.55, gloss=0.05)


def gripper(path: Path, size: float) -> list[Part]:
    """Return jaws whose tips are at the path's end."""
    boxes = {(-0.145, -0.055, -0.1, 0.1, -0.06, 0.46): '#3d434b',
             (0.055, 0.145, -0.1, 0.1, -0.06, 0.46): '#3d434b',
             (-0.25, 0.25, -0.15, 0.15, 0.44, 0.64): path.colour,
             (-0.1, 0.1, -0.1, 0.1, 0.64, 1.0): '#c6cbd1'}
    return [solid(pyvista.Box(size * np.array(sides), level=3), colour, path.points[-1])
            for sides, colour in boxes.items()]


def arrow(one: Arrow, size: float) -> Part:
    length = float(np.linalg.norm(one.vector))
    head = min(0.4, 0.32 * size / length)
    mesh = pyvista.Arrow(direction=UP, scale=length, tip_length=head, tip_radius=0.39 * head,
                         shaft_radius=0.17 * head, tip_resolution=32, shaft_resolution=24)
    turn = Rotation.from_matrix(axes_of(unit(one.vector)).T)
    return solid(mesh, one.colour, one.origin, turn)


def parts_of(instant: Instant, size: float) -> list[Part]:
    """Return all but planes and paths; grippers and arrows suit a scene of this size [m]."""
    return [*(body(one) for one in instant.bodies if one.shape != 'plane'),
            *(cloth(one) for one in instant.surfaces if len(one.triangles)),
            *(part for path in instant.paths if len(path.points)
              for part in gripper(path, GRIPPER * size)),
            *(arrow(one, GRIPPER * size) for one in instant.arrows if np.any(one.vector))]


def grid_spacing(size: float) -> float:
    """Return a round distance between grid lines for an extent [m]."""
    wish = size / 9
    decade = 10.0 ** np.floor(np.log10(wish))
    return float(decade * max(step for step in (1, 2, 5) if step * decade <= wish * (1 + 1e-9)))


def plane(one: Body, centre: NDArray, size: float,
          eye: NDArray) -> tuple[pyvista.PolyData, pyvista.PolyData]:
    """
    Return a plane around the middle of a scene, facing the eye, and its grid lines.

    Its points are dense in the middle. 'fade' is how much of it is seen: far away it passes into
    the white of the page.
    """
    turn = Rotation.from_quat(one.orientation).as_matrix()
    middle = (centre - one.position) @ turn * [1, 1, 0]
    reach, spacing = REACH * size, grid_spacing(size)
    ground = pyvista.Plane(i_size=2, j_size=2, i_resolution=CELLS,
                           j_resolution=CELLS).triangulate()
    ground.points = reach * (0.35 * ground.points + 0.65 * ground.points ** 3)
    far = np.clip(2 * REACH - 2 * np.linalg.norm(ground.points, axis=1) / size, 0, 2) / 2
    ground['fade'] = far * far * (3 - 2 * far)
    ground.points += middle
    levels = np.arange(-reach // spacing, reach // spacing + 1) * spacing
    lines = []
    for axis in (0, 1):
        ground['along'] = ground.points[:, axis]
        lines.append(ground.contour(levels + middle[axis] // spacing * spacing, 'along'))
    lines = lines[0].append_polydata(lines[1])
    for mesh in (ground, lines):
        mesh.points = mesh.points @ turn.T + one.position
        mesh['Normals'] = np.tile(turn[:, 2] * np.copysign(1.0, (eye - one.position) @ turn[:, 2]),
                                  (mesh.n_points, 1))
    return ground, lines
