"""One panel, without frame and title."""

from matplotlib.colors import to_rgb
import numpy as np
from numpy.typing import NDArray
import pyvista

from xpbd_ros.study.picture.camera import AXES, SUN, VIEW_ANGLE
from xpbd_ros.study.picture.content import Instant
from xpbd_ros.study.picture.light import skylight, sunlight, unit
from xpbd_ros.study.picture.meshes import NEARER, parts_of, plane

OVER = 3
"""OVER x OVER samples make a pixel"""
FINENESS = 120
"""longest edge of a surface: the size of the scene over this; light is computed at vertices"""
SUNSHINE, SKY = 0.72 * np.array([1.02, 1.0, 0.96]), 0.45 * np.array([0.97, 1.0, 1.05])
"""light (3,) of the sun on a surface that faces it, and of the whole sky on a level one"""
EVERYWHERE, GAMMA = 0.1, 2.2
"""share of the sky's light that reaches every place; of the screen"""


def render(instant: Instant, eye: NDArray, width: int, height: int, centre: NDArray,
           size: float) -> NDArray:
    """
    Return a picture (height, width, 3) of one instant, sRGB bytes.

    ``centre`` and ``size`` of all that the page shows say where planes fade, and how large
    grippers, arrow heads and the squares of the grid are [m].
    """
    parts = parts_of(instant, size)
    casters = [part.mesh.warp_by_vector('Normals', factor=0 if part.nearer else -NEARER * size)
               for part in parts if part.hidden == 'back']    # cloth may be a little inside bodies
    sky, sun = skylight(casters), sunlight(casters, SUN)
    plotter = pyvista.Plotter(off_screen=True, lighting=None,
                              window_size=(OVER * width, OVER * height))
    for body in instant.bodies:
        if body.shape == 'plane':
            parts += plane(body, centre, size, eye)
    for part in parts:
        mesh = part.mesh
        mesh['sky'] = sky.light(mesh.points, mesh['Normals'])
        if part.hidden:
            mesh = mesh.subdivide_adaptive(max_edge_len=size / FINENESS)
        elif not mesh.n_lines:    # a plane, which keeps its finer middle
            mesh = mesh.subdivide(2, 'linear')
        points, normals = np.asarray(mesh.points, float), unit(mesh['Normals'])
        sunny = sun.light(points, normals)
        halfway = unit(SUN + unit(eye - points))
        shine = part.gloss * sunny * np.maximum((normals * halfway).sum(axis=1), 0) ** 36
        light = np.outer(EVERYWHERE + (1 - EVERYWHERE) * mesh['sky'], SKY)
        light = (light + np.outer(sunny, SUNSHINE)) ** (1 / GAMMA)
        light = np.minimum(to_rgb(part.colour) * light + shine[:, None], 1.0)
        fade = mesh['fade'][:, None] if 'fade' in mesh.point_data else 1.0
        mesh['light'] = (255 * (1 - fade + fade * light) + 0.5).astype(np.uint8)
        mesh.points = eye + (points - eye) * (1 - part.nearer)
        plotter.add_mesh(mesh, scalars='light', rgb=True, lighting=False, reset_camera=False,
                         culling=part.hidden or False, line_width=1.2 * OVER)
    for path in instant.paths:
        if len(path.points) > 1:
            plotter.add_mesh(pyvista.MultipleLines(path.points), color=path.colour,
                             line_width=0.0055 * OVER * width, lighting=False, reset_camera=False)
    for arrow in instant.arrows:
        if arrow.label:
            beyond = np.add(arrow.origin, arrow.vector) + 0.03 * size * unit(arrow.vector)
            plotter.add_point_labels(
                [beyond], [arrow.label], text_color=arrow.colour, shape=None, show_points=False,
                font_size=round(0.026 * OVER * width), justification_horizontal='center',
                justification_vertical='center', always_visible=True, reset_camera=False)
    camera = plotter.camera
    camera.position, camera.focal_point, camera.up = eye, eye - AXES[0], AXES[2]
    camera.view_angle = VIEW_ANGLE
    plotter.renderer.ResetCameraClippingRange()
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return image.reshape(height, OVER, width, OVER, 3).mean(axis=(1, 3)).astype(np.uint8)
