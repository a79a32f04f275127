"""The z-buffer against a search, and without gaps."""

import numpy as np

from xpbd_ros.study.picture.zbuffer import rasterise


def test_the_z_buffer_agrees_with_a_search_of_all_triangles():
    rng = np.random.default_rng(5)
    width, height = 37, 23
    pixels = rng.uniform(-8, 45, (60, 2))
    key = rng.uniform(0.2, 2.0, 60)
    triangles = np.concatenate([rng.integers(0, 60, (90, 3)), [[4, 4, 9]]])    # and a line
    best, which = rasterise(pixels, key, triangles, width, height)
    expected, owner = np.full((height, width), -np.inf), np.full((height, width), -1)
    for index, triangle in enumerate(triangles):
        matrix = np.vstack([pixels[triangle].T, np.ones(3)])
        if abs(np.linalg.det(matrix)) < 1e-9:
            continue
        for row in range(height):
            for column in range(width):
                share = np.linalg.solve(matrix, [column + 0.5, row + 0.5, 1])
                value = share @ key[triangle]
                if share.min() >= 0 and value > expected[row, column]:
                    expected[row, column], owner[row, column] = value, index
    np.testing.assert_allclose(best.reshape(height, width), expected, rtol=1e-6)
    assert np.array_equal(which.reshape(height, width), owner)
    assert (owner >= 0).mean() > 0.3


def test_neighbouring_triangles_leave_no_gap_between_them():
    rng = np.random.default_rng(2)
    line = np.linspace(-5, 65, 15)
    pixels = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    pixels += rng.uniform(-1, 1, pixels.shape)
    i = (np.arange(14)[:, None] * 15 + np.arange(14)).ravel()
    triangles = np.concatenate([np.stack([i, i + 1, i + 16], 1), np.stack([i, i + 16, i + 15], 1)])
    _, which = rasterise(pixels, np.ones(225), triangles, 60, 60)
    assert (which >= 0).all()
