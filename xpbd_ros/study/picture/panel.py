"""One panel, without frame and title."""

import numpy as np
from numpy.typing import NDArray
import pyvista

from xpbd_ros.study.picture.camera import Camera
from xpbd_ros.study.picture.content import Instant
from xpbd_ros.study.picture.light import shade, skylight, sunlight, unit
from xpbd_ros.study.picture.meshes import parts_of, plane

OVER = 3
"""OVER x OVER samples make a pixel"""
PLANE = np.array([0.93, 0.94, 0.95])
NEARER = 0.004
"""how much nearer to the eye cloth is drawn than it is, as a share of the distance"""


def render(instant: Instant, camera: Camera, eye: NDArray, width: int, height: int,
           centre: NDArray, size: float) -> NDArray:
    """
    Return a picture (height, width, 3) of one instant, sRGB bytes.

    ``centre`` and ``size`` of all that the page shows say where planes fade, and how large
    grippers, arrow heads and the squares of the grid are [m].
    """
    parts = parts_of(instant, size)
    casters = [part.mesh.copy() for part in parts]
    for part, caster in zip(parts, casters):
        if part.yields:
            caster.points -= NEARER * size * caster['Normals']
    sky, sun = skylight(casters), sunlight(casters, camera.sun)
    plotter = pyvista.Plotter(off_screen=True, lighting=None,
                              window_size=(OVER * width, OVER * height))

    def add(mesh: pyvista.PolyData, colour: NDArray, *, refine=lambda mesh: mesh,
            gloss: float = 0.0, nearer: float = 0.0, **options) -> None:
        mesh['sky'] = sky.light(mesh.points, mesh['Normals'])
        mesh = refine(mesh)
        points, normals = np.asarray(mesh.points, float), unit(mesh['Normals'])
        sunny = sun.light(points, normals)
        halfway = unit(camera.sun + unit(eye - points))
        shine = gloss * sunny * np.maximum((normals * halfway).sum(axis=1), 0) ** 36
        light = np.minimum(shade(colour, mesh['sky'], sunny) + shine[:, None], 1.0)
        fade = mesh['fade'][:, None] if 'fade' in mesh.point_data else 1.0
        mesh['light'] = (255 * (1 - fade + fade * light) + 0.5).astype(np.uint8)
        mesh.points = eye + (points - eye) * (1 - nearer)
        plotter.add_mesh(mesh, scalars='light', rgb=True, lighting=False, reset_camera=False,
                         **options)

    def finer(mesh: pyvista.PolyData) -> pyvista.PolyData:
        return mesh.subdivide_adaptive(max_edge_len=size / 120)

    for body in instant.bodies:
        if body.shape == 'plane':
            ground, lines = plane(body, centre, size, eye)
            add(ground, PLANE, refine=lambda mesh: mesh.subdivide(2, 'linear'))
            add(lines, 0.92 * PLANE, nearer=0.001, line_width=1.2 * OVER)
    for part in parts:
        options = {'refine': finer, 'gloss': part.gloss, 'nearer': 0 if part.yields else NEARER}
        add(part.mesh.copy(), part.front, culling='back', **options)
        if part.back is not None:
            part.mesh['Normals'] *= -1
            add(part.mesh, part.back, culling='front', **options)
    for path in instant.paths:
        if len(path.points) > 1:
            plotter.add_mesh(pyvista.MultipleLines(path.points), color=path.colour,
                             line_width=0.0055 * OVER * width, lighting=False, reset_camera=False)
    for arrow in instant.arrows:
        if arrow.label:
            plotter.add_point_labels([np.add(arrow.origin, arrow.vector)], [arrow.label],
                                     font_size=round(0.03 * OVER * width), text_color=arrow.colour, shape=None,
                                     show_points=False, always_visible=True, reset_camera=False,
                                     justification_horizontal='center',
                                     justification_vertical='top')
    place = plotter.camera
    place.position, place.focal_point, place.up = eye, eye - camera.axes[2], camera.axes[1]
    place.view_angle = camera.view_angle
    plotter.renderer.ResetCameraClippingRange()
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return image.reshape(height, OVER, width, OVER, 3).mean(axis=(1, 3)).astype(np.uint8)
