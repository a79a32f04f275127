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

from xpbd_ros.study.picture.bounds import extent, grid_spacing
from xpbd_ros.study.picture.camera import Camera, fit, View
from xpbd_ros.study.picture.content import Arrow, Body, Instant, Path, Surface
from xpbd_ros.study.picture.page import draw, FILE_LIMIT
from xpbd_ros.study.picture.panel import render, Rendering

__all__ = ['Arrow', 'Body', 'Camera', 'draw', 'extent', 'FILE_LIMIT', 'fit',
           'grid_spacing', 'Instant', 'Path', 'render', 'Rendering', 'Surface', 'View']
