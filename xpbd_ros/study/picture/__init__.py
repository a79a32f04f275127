"""
Shaded pictures of cloth runs, drawn off screen by PyVista (VTK); matplotlib adds text and frames.

One panel per instant, all through the same camera. Light is computed at the vertices of refined
meshes: for each of many directions, over the disc of the sun and all around for the sky, VTK
renders a depth map as seen from there, and vertices behind it are in the shade (Williams, Casting
Curved Shadows on Curved Surfaces, 1978). The mean over the sun's disc makes penumbrae, that over
the sky ambient occlusion. VTK then draws the meshes with these colours.

Limits: nothing is transparent and nothing mirrors; planes receive shadows and cast none; cloth is
drawn slightly nearer to the camera than it is, by less than one of its edges, so that cloth which
bridges the edges of a body covers them; z is up.
"""

from xpbd_ros.study.picture.content import Arrow, Body, Instant, Path, Surface
from xpbd_ros.study.picture.offscreen import need_view
from xpbd_ros.study.picture.page import draw, FILE_LIMIT

__all__ = ['Arrow', 'Body', 'draw', 'FILE_LIMIT', 'Instant', 'need_view', 'Path', 'Surface']
