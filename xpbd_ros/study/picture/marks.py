"""What is drawn over a panel: paths and the labels of arrows."""

from typing import Any

from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.patheffects import withStroke
import numpy as np

from xpbd_ros.study.picture.camera import View
from xpbd_ros.study.picture.content import Arrow, Path
from xpbd_ros.study.picture.vectors import Array


def draw_path(axes: Any, path: Path, view: View, depth: Array, scale: float) -> None:
    """Draw a path, faint where something hides it and dotted where it still lies ahead."""
    if len(path.points) < 2:
        return
    present = path.present % len(path.points)
    steps = [np.linspace(0, 1, 24, endpoint=False)[:, None] * (b - a) + a
             for a, b in zip(path.points[:-1], path.points[1:])]
    points = np.concatenate([*steps, path.points[-1:]])
    pixels, far = view.project(points)
    column = np.clip(pixels[:, 0], 0, view.width - 1).astype(int)
    row = np.clip(pixels[:, 1], 0, view.height - 1).astype(int)
    hidden = far > 1.004 * depth[row, column]
    ahead = np.arange(len(points) - 1) >= 24 * present
    segments = np.stack([pixels[:-1], pixels[1:]], axis=1)
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(pixels, axis=0).T))])[:-1]
    kept = ~ahead | (along % (9 * scale) < 4.5 * scale)
    opacity = np.where(hidden[1:] | hidden[:-1], 0.25, np.where(ahead, 0.75, 1.0))
    colours = np.column_stack([np.tile(to_rgb(path.colour), (len(segments), 1)), opacity])
    axes.add_collection(LineCollection(list(segments[kept]), colors=colours[kept],
                                       linewidths=1.1, capstyle='butt'))


def draw_arrow_label(axes: Any, arrow: Arrow, view: View, size: float) -> None:
    if not arrow.label:
        return
    ends, depth = view.project(np.stack([np.asarray(arrow.origin, dtype=float),
                                         np.asarray(arrow.origin) + arrow.vector]))
    if (depth <= 0).any():
        return
    if not (0 < ends[1, 0] < view.width and 0 < ends[1, 1] < view.height):
        return
    way = ends[1] - ends[0]
    half = 0.3 * size * len(arrow.label)    # of the text's width
    right, down = ends[1] + size * way / max(float(np.hypot(*way)), 1e-9)
    if abs(way[0]) > abs(way[1]):
        right = ends[1, 0] + np.sign(way[0]) * (half + 0.4 * size)
    axes.text(np.clip(right, half, view.width - half), np.clip(down, size, view.height - size),
              arrow.label, color=arrow.colour, fontsize=7.5, ha='center', va='center',
              path_effects=[withStroke(linewidth=2.2, foreground='white')])
