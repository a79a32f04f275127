"""What is shown, as PyVista's meshes with normals at their points."""

from dataclasses import dataclass

from matplotlib.colors import to_rgb
import numpy as np
from numpy.typing import ArrayLike, NDArray
import pyvista
from scipy.spatial.transform import Rotation

from xpbd_ros.study.picture.content import Arrow, Body, Instant, Path, Surface

GRIPPER = 0.11
"""its length as a share of what is shown"""
REACH = 1.6
"""how far planes are drawn from the middle, in diagonals of what is shown"""
NEARER = 0.004
"""how much nearer to the eye all but bodies and planes is drawn, as a share of the distance"""
UP = (0, 0, 1)


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles or lines of one colour."""

    mesh: pyvista.PolyData
    colour: str | tuple[float, float, float]
    hidden: str | None = 'back'
    """side that is not drawn; a cloth is two parts"""
    gloss: float = 0.15
    nearer: float = NEARER


def solid(mesh: pyvista.PolyData, colour: str, position: ArrayLike, turn: Rotation | None = None,
          **rest) -> Part:
    """Return a solid that is given about its own origin."""
    points = mesh.points.astype(float)
    mesh.points = (turn.apply(points) if turn else points) + position
    mesh = mesh.triangulate().compute_normals(cell_normals=False, split_vertices=True,
                                              feature_angle=40, consistent_normals=False)
    mesh.points += 1e-5 * mesh.length * mesh['Normals']    # or refining joins the sides of edges
    return Part(mesh, colour, **rest)


def body(one: Body) -> Part:
    """Return a collider, which is not a plane."""
    size = one.size
    mesh = {
        'sphere': lambda: pyvista.Sphere(radius=size[0], theta_resolution=64, phi_resolution=48),
        'capsule': lambda: pyvista.Capsule(radius=size[0], cylinder_length=size[1], direction=UP,
                                           resolution=48),
        'cylinder': lambda: pyvista.Cylinder(radius=size[0], height=size[1], direction=UP,
                                             resolution=64),
        'box': lambda: pyvista.Box(np.outer(size, [-0.5, 0.5]).ravel(), level=8),
    }[one.shape]()
    return solid(mesh, '#9aa3ad', one.position, Rotation.from_quat(one.orientation), nearer=0.0)


def cloth(one: Surface) -> list[Part]:
    """Return the front and the paler back."""
    mesh = pyvista.PolyData.from_regular_faces(np.array(one.points, float), one.triangles)
    front = mesh.compute_normals(cell_normals=False, split_vertices=False,
                                 consistent_normals=False)
    back = front.copy()
    back['Normals'] *= -1
    red, green, blue = (0.35 * value + 0.55 for value in to_rgb(one.colour))
    return [Part(front, one.colour, gloss=0.05),
            Part(back, (red, green, blue), 'front', gloss=0.05)]


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
    return solid(mesh, one.colour, one.origin, Rotation.align_vectors([one.vector], [UP])[0])


def parts_of(instant: Instant, size: float) -> list[Part]:
    """Return all but planes and paths; grippers and arrows suit a scene of this size [m]."""
    return [*(body(one) for one in instant.bodies if one.shape != 'plane'),
            *(part for one in instant.surfaces if len(one.triangles) for part in cloth(one)),
            *(part for path in instant.paths if len(path.points)
              for part in gripper(path, GRIPPER * size)),
            *(arrow(one, GRIPPER * size) for one in instant.arrows if np.any(one.vector))]


def grid_spacing(size: float) -> float:
    """Return a round distance between grid lines for an extent [m]."""
    wish = size / 9
    decade = 10.0 ** np.floor(np.log10(wish))
    return float(decade * max(step for step in (1, 2, 5) if step * decade <= wish * (1 + 1e-9)))


def plane(one: Body, centre: NDArray, size: float, eye: NDArray) -> list[Part]:
    """
    Return a plane around the middle of a scene, facing the eye, and its grid lines.

    Its points are denser in the middle. 'fade' is how much of it is seen: far away it passes into
    the white of the page.
    """
    turn = Rotation.from_quat(one.orientation).as_matrix()
    middle = (centre - one.position) @ turn * [1, 1, 0]
    ground = pyvista.Plane(i_size=2, j_size=2, i_resolution=96, j_resolution=96).triangulate()
    ground.points = 0.5 * ground.points + 0.5 * ground.points ** 5
    ground['fade'] = (1.6 - 1.6 * np.linalg.norm(ground.points, axis=1)).clip(0, 1)
    ground.points = middle + REACH * size * ground.points
    ground['Normals'] = np.tile(turn[:, 2] * np.sign((eye - one.position) @ turn[:, 2]),
                                (ground.n_points, 1))
    spacing = grid_spacing(size)
    lines = pyvista.PolyData()
    for along, first in zip(ground.points.T[:2], middle - REACH * size):
        levels = spacing * np.arange(first // spacing, (first + 2 * REACH * size) / spacing)
        lines = lines.append_polydata(ground.contour(levels, along))
    for mesh in (ground, lines):
        mesh.points = mesh.points @ turn.T + one.position
    return [Part(ground, '#edf0f2', None, 0.0, 0.0), Part(lines, '#dadddf', None, 0.0, 0.001)]
