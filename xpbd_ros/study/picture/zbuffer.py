"""The z-buffer: what is seen where."""

from collections.abc import Iterator

import numpy as np

from xpbd_ros.study.picture.vectors import Array


def _fragments(pixels: Array, key: Array, triangles: Array, width: int, height: int,
               at_once: int = 1 << 19) -> Iterator[tuple[Array, Array, Array]]:
    """
    Yield which samples lie in which triangles: sample, interpolated key, triangle.

    ``pixels`` (n, 2) are the corners and ``key`` (n,) is affine in each triangle. A row of samples
    meets a triangle in one span, bounded by the edges that cross it.
    """
    corner, value = pixels[triangles], key[triangles]
    (x0, y0), (x1, y1), (x2, y2) = (corner[:, k].T for k in range(3))
    twice_area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    low, high = corner[:, :, 1].min(axis=1), corner[:, :, 1].max(axis=1)
    left, right = corner[:, :, 0].min(axis=1), corner[:, :, 0].max(axis=1)
    first = np.ceil(np.clip(low, 0, height) - 0.5).astype(np.int64)
    last = np.floor(np.clip(high, 0, height) - 0.5).astype(np.int64)
    rows = np.where((np.abs(twice_area) > 1e-12) & (right > 0) & (left < width),
                    np.maximum(last - first + 1, 0), 0)
    kept = np.flatnonzero(rows)
    rows, first, corner, value = rows[kept], first[kept], corner[kept], value[kept]
    twice_area = twice_area[kept]
    # key = slope_x x + slope_y y + level
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    rise1, rise2 = value[:, 1] - value[:, 0], value[:, 2] - value[:, 0]
    slope_x = (rise1 * edge2[:, 1] - rise2 * edge1[:, 1]) / twice_area
    slope_y = (rise2 * edge1[:, 0] - rise1 * edge2[:, 0]) / twice_area
    level = value[:, 0] - slope_x * corner[:, 0, 0] - slope_y * corner[:, 0, 1]

    triangle = np.repeat(np.arange(len(kept)), rows)
    row = np.arange(len(triangle)) - np.repeat(np.cumsum(rows) - rows, rows) + first[triangle]
    y = row + 0.5
    start, stop = np.zeros(len(row)), np.full(len(row), float(width))
    sign = np.sign(twice_area)
    for k in range(3):    # inside is where (p - here) x (there - here) has the area's sign
        here, there = corner[:, k], corner[:, (k + 1) % 3]
        across, along = (sign * (there - here)[:, 1])[triangle], (there - here)[triangle, 0]
        with np.errstate(divide='ignore', invalid='ignore'):
            cut = (here[triangle, 0] + (y - here[triangle, 1]) * along
                   / (there - here)[triangle, 1])
        np.maximum(start, cut, out=start, where=across < 0)
        np.minimum(stop, cut, out=stop, where=across > 0)
    start = np.ceil(start - 0.5).astype(np.int64)
    counts = np.maximum(np.floor(stop - 0.5).astype(np.int64) - start + 1, 0)
    base = slope_x[triangle] * 0.5 + slope_y[triangle] * y + level[triangle]
    slope = slope_x[triangle]
    offset = row * width

    ends = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        done = ends[begin - 1] if begin else 0
        end = max(int(np.searchsorted(ends, done + at_once, side='right')), begin + 1)
        count = counts[begin:end]
        span = np.repeat(np.arange(begin, end), count)
        column = (np.arange(len(span)) - np.repeat(np.cumsum(count) - count, count)
                  + start[span])
        yield (offset[span] + column, (base[span] + slope[span] * column).astype(np.float32),
               kept[triangle[span]])
        begin = end


def rasterise(pixels: Array, key: Array, triangles: Array, width: int,
              height: int) -> tuple[Array, Array]:
    """Return the greatest key (samples,), -inf where nothing is, and its triangle, -1 if none."""
    best = np.full(width * height, -np.inf, dtype=np.float32)
    which = np.full(width * height, -1, dtype=np.int32)
    # far ones first: then nearly every sample is right at once
    order = np.argsort(key[triangles].sum(axis=1), kind='stable')
    for sample, value, triangle in _fragments(pixels, key, triangles[order], width, height):
        while True:
            nearer = np.flatnonzero(value > best[sample])
            if not len(nearer):
                break
            sample, value, triangle = sample[nearer], value[nearer], triangle[nearer]
            best[sample], which[sample] = value, order[triangle]
    return best, which
