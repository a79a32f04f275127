"""The page: panels, text, legend, file."""

from collections.abc import Sequence
import io
from pathlib import Path as FilePath

from matplotlib.font_manager import findfont, FontProperties
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from xpbd_ros.study.chart import INK, MUTED
from xpbd_ros.study.picture.camera import fit
from xpbd_ros.study.picture.content import Instant
from xpbd_ros.study.picture.offscreen import need_view

FILE_LIMIT = 700 * 1024
"""a picture is smaller than this, whatever it shows [bytes]"""


def draw(instants: Sequence[Instant], file: FilePath | str, *, title: str = '', columns: int = 3,
         width_px: int = 1600, limit: int = FILE_LIMIT) -> None:
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
    edge, above = round(16 * px), round(40 * px)
    wide = (width_px - edge * (columns + 1)) // columns
    eye, aspect = fit(points(size), {1: 1.5, 2: 1.3}.get(columns, 1.1), 2.0)
    tall = round(wide / aspect)
    labels = {path.label: path for one in instants for path in one.paths if path.label}
    planes = any(body.shape == 'plane' for one in instants for body in one.bodies)
    top = edge + round(52 * px) * bool(title)
    foot = top + rows * (tall + above + edge)
    page = Image.new('RGB', (width_px, foot + round(36 * px) * bool(labels or planes)), 'white')
    pen = ImageDraw.Draw(page)

    def write(right: float, middle: float, text: str, points: float = 8.5, colour: str = INK,
              anchor: str = 'lm', weight: str = 'normal') -> float:
        font = ImageFont.truetype(findfont(FontProperties(weight=weight)), points * px * 200 / 72)
        pen.text((right, middle), text, colour, font, anchor)
        return right + pen.textlength(text, font)

    write(edge, edge + 18 * px, title, 11, weight='bold')
    for index, one in enumerate(instants):
        left = edge + index % columns * (wide + edge)
        down = top + above + index // columns * (tall + above + edge)
        page.paste(Image.fromarray(render(one, eye, wide, tall, (low + high) / 2, size)),
                   (left, down))
        pen.rectangle((left, down, left + wide, down + tall), outline='#d5dade')
        write(left, down - 16 * px, one.title)
    at = edge
    for label, path in labels.items():
        pen.line((at, foot + 10 * px, at + 36 * px, foot + 10 * px), path.colour, round(4.5 * px))
        at = write(at + 54 * px, foot + 10 * px, label, 8) + 36 * px
    if planes:
        write(width_px - edge, foot + 10 * px, f'grid {grid_spacing(size):g} m', 7.5, MUTED, 'rm')
    save(page, FilePath(file), limit)


def save(picture: Image.Image, file: FilePath, limit: int) -> None:
    """Write a PNG, with fewer colours or pixels if it would be too large."""
    for scale in (1.0, 0.8, 0.6, 0.4):
        small = picture.resize([round(scale * side) for side in picture.size],
                               Image.Resampling.LANCZOS)
        for colours in (None, 256, 192, 128):
            data = io.BytesIO()
            attempt = small.quantize(colours, kmeans=1) if colours else small
            attempt.save(data, 'PNG', optimize=True)
            if data.tell() < limit:
                file.write_bytes(data.getvalue())
                return
    raise ValueError(f'{file}: a picture of {picture.width} x {picture.height} px '
                     f'cannot be made smaller than {limit} bytes')
