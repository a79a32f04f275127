"""The page and its file."""

import subprocess
import sys

import numpy as np
from PIL import Image
import pytest

from support.tiers import slow
from xpbd_ros.study.picture import Arrow, Body, draw, grid_spacing, Instant, Path, Surface


def test_grid_lines_are_a_round_distance_apart():
    assert [grid_spacing(s) for s in (0.45, 1.0, 2.0, 10.0)] == [0.05, 0.1, 0.2, 1.0]


def little_run(count):
    u, v = np.meshgrid(np.linspace(-0.3, 0.3, 7), np.linspace(-0.3, 0.3, 9), indexing='ij')
    corner = (np.arange(6)[:, None] * 9 + np.arange(8)).ravel()
    triangles = np.concatenate([np.stack([corner, corner + 9, corner + 10], 1),
                                np.stack([corner, corner + 10, corner + 1], 1)])
    tracks = np.stack([np.full(5, 0.3), np.full(5, 0.3), np.linspace(0.1, 0.6, 5)], axis=1)
    instants = []
    for index in range(count):
        z = 0.3 + 0.05 * np.sin(8 * u + index)
        cloth = Surface(np.stack([u, v, z], -1).reshape(-1, 3), triangles)
        instants.append(Instant(
            f't = {index} s', [cloth], [Body('plane'), Body('sphere', 0.1, (0, 0, 0.1))],
            [Path(tracks, label='gripper', present=min(index, 4)),
             Path(tracks - [0.6, 0, 0], '#2a9d64', marker='ball')],
            [Arrow((0, 0, 0.3), (0, 0, 0.2), label='1 N'), Arrow((0, 0, 0), (0, 0, 0))]))
    return instants


@pytest.mark.parametrize(('count', 'columns'), [
    (1, None), slow(2, None), slow(6, None), (5, 4)])
def test_a_picture_has_the_width_asked_for_and_is_small(tmp_path, count, columns):
    file = tmp_path / 'run.png'
    draw(little_run(count), file, title='A run', columns=columns, width_px=600)
    with Image.open(file) as image:
        assert image.format == 'PNG'
        assert image.width == 600
        assert len(image.getcolors(1 << 24)) > 500
    assert 5_000 < file.stat().st_size < 700 * 1024


def test_the_same_run_gives_the_same_file(tmp_path):
    for name in ('a.png', 'b.png'):
        draw(little_run(1), tmp_path / name, width_px=300)
    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()


def test_a_large_picture_loses_colours_then_pixels(tmp_path):
    file = tmp_path / 'run.png'
    draw(little_run(1), file, width_px=300)
    full = file.stat().st_size
    for share in (0.7, 0.2):
        draw(little_run(1), file, width_px=300, limit=int(share * full))
        assert file.stat().st_size < share * full
    with pytest.raises(ValueError, match='cannot be made smaller than 100 bytes'):
        draw(little_run(1), tmp_path / 'none.png', width_px=500, limit=100)
    assert not (tmp_path / 'none.png').exists()


@pytest.mark.parametrize('bodies', [[], [Body('plane')]])
def test_an_empty_cloth_is_a_picture_without_cloth(tmp_path, bodies):
    empty = Surface(np.empty((0, 3)), np.empty((0, 3)))
    draw([Instant('nothing', [empty], bodies, [Path(np.empty((0, 3)))])], tmp_path / 'e.png',
         width_px=300)
    with Image.open(tmp_path / 'e.png') as image:
        assert np.asarray(image).mean() > 200


def test_pictures_need_no_display_and_only_matplotlib():
    code = ('import sys, xpbd_ros.study.picture; '
            "print([name for name in ('matplotlib.pyplot', 'scipy', 'vtk', 'rclpy', 'numba') "
            'if name in sys.modules])')
    said = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == '[]'
