"""
Shaded pictures of cloth runs, drawn off screen by PyVista (VTK).

Light is computed at the points of refined meshes: for directions all over the disc of the sun, and
all around for the sky, VTK renders a depth map as seen from there, and points behind it are in the
shade (Williams, Casting Curved Shadows on Curved Surfaces, 1978). The mean over the sun makes
penumbrae, that over the sky ambient occlusion. VTK then draws the meshes in these colours.

Limits: nothing is transparent and nothing mirrors; planes receive shadows and cast none; cloth is
drawn a little nearer to the camera than it is, so that it covers edges of bodies that it bridges;
z is up.
"""

from xpbd_ros.study.picture.content import Arrow, Body, Instant, Path, Surface
from xpbd_ros.study.picture.offscreen import need_view
from xpbd_ros.study.picture.page import draw, FILE_LIMIT

__all__ = ['Arrow', 'Body', 'draw', 'FILE_LIMIT', 'Instant', 'need_view', 'Path', 'Surface']
