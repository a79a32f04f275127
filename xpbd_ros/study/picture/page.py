"""The page: panels, type, legend, file."""

from collections.abc import Sequence
import io
from pathlib import Path as FilePath

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
import numpy as np
from PIL import Image

from xpbd_ros.study.picture.bounds import diagonal, extent, grid_spacing, shown_points
from xpbd_ros.study.picture.camera import best_aspect, Camera, fit, sun_beside
from xpbd_ros.study.picture.content import Instant
from xpbd_ros.study.picture.marks import draw_arrow_label, draw_path
from xpbd_ros.study.picture.panel import render

FILE_LIMIT = 700 * 1024
"""a picture is smaller than this, whatever it shows [bytes]"""


def _columns(count: int) -> int:
    return count if count <= 3 else 2 if count == 4 else 3 if count <= 9 else 4


def _save(canvas: FigureCanvasAgg, file: FilePath, limit: int) -> None:
    """Write a PNG, with fewer colours or pixels if it would be too large."""
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    for scale in (1.0, 0.8, 0.6, 0.4):
        small = picture if scale == 1 else picture.resize(
            (round(picture.width * scale), round(picture.height * scale)),
            Image.Resampling.LANCZOS)
        for attempt in (small, small.point(lambda value: value | 1), small.quantize(256)):
            data = io.BytesIO()
            attempt.save(data, 'PNG', optimize=True)
            if data.tell() < limit:
                file.write_bytes(data.getvalue())
                return
    raise ValueError(f'{file}: a picture of {picture.width} x {picture.height} px '
                     f'cannot be made smaller than {limit} bytes')


def draw(instants: Sequence[Instant], file: FilePath | str, *, title: str = '',
         columns: int | None = None, camera: Camera | None = None, width_px: int = 1600,
         limit: int = FILE_LIMIT) -> None:
    """
    Write a PNG with one panel per instant.

    The camera is fitted to all instants together, planes left out; the sun stands to its left.
    Labels of paths make a legend. ``limit`` is what the file is smaller than [bytes].
    """
    if not instants:
        raise ValueError('draw: needs at least one instant')
    camera = camera or Camera()
    sun = sun_beside(camera)
    box = extent(instants)
    size = diagonal(*box)
    points = np.concatenate([shown_points(instant, size) for instant in instants])
    points = points if len(points) else np.zeros((1, 3))
    unit = width_px / 1600
    columns = min(columns or _columns(len(instants)), len(instants))
    rows = -(-len(instants) // columns)
    outer, gap = round(16 * unit), round(16 * unit)
    panel = (width_px - 2 * outer - gap * (columns - 1)) // columns
    least = {1: 1.5, 2: 1.3}.get(columns, 1.1)    # or tall content makes a page of two screens
    tall = round(panel / best_aspect(points, camera, least, 2.0))
    above = round(40 * unit) if any(instant.title for instant in instants) else 0
    labels = {path.label: path for instant in instants for path in instant.paths if path.label}
    top = outer + (round(52 * unit) if title else 0)
    planes = any(body.shape == 'plane' for instant in instants for body in instant.bodies)
    foot = outer + (round(36 * unit) if labels or planes else 0)
    height_px = top + rows * (tall + above) + (rows - 1) * gap + foot

    dpi = 200 * unit
    figure = Figure(figsize=(width_px / dpi, height_px / dpi), dpi=dpi, facecolor='white')
    canvas = FigureCanvasAgg(figure)
    ink, muted = '#1f2328', '#6b737c'
    if title:
        figure.text(outer / width_px, 1 - (outer + 18 * unit) / height_px, title, fontsize=11,
                    fontweight='bold', color=ink, ha='left', va='center')
    view = fit(points, camera, panel, tall)
    for index, instant in enumerate(instants):
        row, column = divmod(index, columns)
        left = outer + column * (panel + gap)
        down = top + above + row * (tall + above + gap)
        axes = figure.add_axes((left / width_px, 1 - (down + tall) / height_px,
                                panel / width_px, tall / height_px))
        rendering = render(instant, view, sun=sun, box=box)
        axes.imshow(rendering.image, interpolation='nearest', aspect='auto',
                    extent=(0, panel, tall, 0))
        for path in instant.paths:
            draw_path(axes, path, view, rendering.depth, unit)
        for arrow in instant.arrows:
            draw_arrow_label(axes, arrow, view, 20 * unit)
        axes.set(xlim=(0, panel), ylim=(tall, 0), xticks=(), yticks=())
        for spine in axes.spines.values():
            spine.set(color='#d5dade', linewidth=0.6)
        if instant.title:
            figure.text(left / width_px, 1 - (down - 16 * unit) / height_px, instant.title,
                        fontsize=8.5, color=ink, ha='left', va='center')
    level = (foot - 26 * unit) / height_px
    if labels:
        handles = [Line2D([], [], color=path.colour, linewidth=1.6, label=label,
                          solid_capstyle='butt')
                   for label, path in labels.items()]
        figure.legend(handles=handles, loc='center left', ncol=len(handles), frameon=False,
                      bbox_to_anchor=(outer / width_px, level), fontsize=8,
                      labelcolor=ink, borderpad=0, borderaxespad=0, handlelength=1.6,
                      columnspacing=1.6)
    if planes:
        figure.text(1 - outer / width_px, level, f'grid {grid_spacing(size):g} m', fontsize=7.5,
                    color=muted, ha='right', va='center')
    canvas.draw()
    _save(canvas, FilePath(file), limit)
