"""The page: panels, text, legend, file."""

from collections.abc import Sequence
import io
from pathlib import Path as FilePath

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
import numpy as np
from PIL import Image

from xpbd_ros.study.chart import INK, MUTED
from xpbd_ros.study.picture.camera import Camera, fit
from xpbd_ros.study.picture.content import Instant
from xpbd_ros.study.picture.offscreen import need_view

FILE_LIMIT = 700 * 1024
"""a picture is smaller than this, whatever it shows [bytes]"""
CAMERA = Camera()


def draw(instants: Sequence[Instant], file: FilePath | str, *, title: str = '', columns: int = 3,
         camera: Camera = CAMERA, width_px: int = 1600, limit: int = FILE_LIMIT) -> None:
    """
    Write a PNG with one panel per instant.

    The camera is fitted to all instants together, planes left out; the sun stands to its left.
    Labels of paths make a legend. ``limit`` is what the file is smaller than [bytes].
    """
    need_view()
    from xpbd_ros.study.picture.meshes import grid_spacing, parts_of
    from xpbd_ros.study.picture.panel import render

    def points(size: float) -> np.ndarray:
        found = [part.mesh.points for one in instants for part in parts_of(one, size)]
        found += [np.reshape(path.points, (-1, 3)) for one in instants for path in one.paths]
        found = np.concatenate(found or [np.empty((0, 3))])
        return found if len(found) else np.array([[-0.5] * 3, [0.5] * 3])

    low, high = points(1e-9).min(axis=0), points(1e-9).max(axis=0)    # without grippers
    size = float(np.linalg.norm(high - low)) or 1.0
    columns = min(columns, len(instants))
    rows = -(-len(instants) // columns)
    px = width_px / 1600
    edge, gap, above = (round(px * length) for length in (16, 16, 40))
    panel = (width_px - 2 * edge - gap * (columns - 1)) // columns
    eye, aspect = fit(points(size), camera, {1: 1.5, 2: 1.3}.get(columns, 1.1), 2.0)
    tall = round(panel / aspect)
    labels = {path.label: path for one in instants for path in one.paths if path.label}
    planes = any(body.shape == 'plane' for one in instants for body in one.bodies)
    top = edge + round(52 * px) * bool(title)
    foot = edge + round(36 * px) * bool(labels or planes)
    height_px = top + rows * (tall + above) + (rows - 1) * gap + foot
    figure = Figure(figsize=(width_px / 200 / px, height_px / 200 / px), dpi=200 * px)
    canvas = FigureCanvasAgg(figure)

    def write(right: float, down: float, text: str, **options) -> None:
        figure.text(right / width_px, 1 - down / height_px, text, va='center',
                    **{'color': INK, **options})

    write(edge, edge + 18 * px, title, fontsize=11, fontweight='bold')
    for index, one in enumerate(instants):
        left = edge + index % columns * (panel + gap)
        down = top + above + index // columns * (tall + above + gap)
        axes = figure.add_axes((left / width_px, 1 - (down + tall) / height_px,
                                panel / width_px, tall / height_px), xticks=(), yticks=())
        axes.imshow(render(one, camera, eye, panel, tall, (low + high) / 2, size), aspect='auto')
        axes.spines[:].set(color='#d5dade', linewidth=0.6)
        write(left, down - 16 * px, one.title, fontsize=8.5)
    if planes:
        write(width_px - edge, height_px - foot + 26 * px, f'grid {grid_spacing(size):g} m',
              fontsize=7.5, color=MUTED, ha='right')
    if labels:
        figure.legend([Line2D([], [], color=path.colour) for path in labels.values()], labels,
                      loc='lower left', ncol=len(labels), frameon=False, fontsize=8,
                      bbox_to_anchor=(edge / width_px, 0), borderaxespad=0.3, borderpad=0.3)
    canvas.draw()
    save(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()), FilePath(file), limit)


def save(picture: Image.Image, file: FilePath, limit: int) -> None:
    """Write a PNG, with fewer colours or pixels if it would be too large."""
    for scale in (1.0, 0.8, 0.6, 0.4):
        small = picture.resize([round(scale * side) for side in picture.size], Image.LANCZOS)
        for attempt in (small, small.quantize(256), small.quantize(128)):
            data = io.BytesIO()
            attempt.save(data, 'PNG', optimize=True)
            if data.tell() < limit:
                file.write_bytes(data.getvalue())
                return
    raise ValueError(f'{file}: a picture of {picture.width} x {picture.height} px '
                     f'cannot be made smaller than {limit} bytes')
