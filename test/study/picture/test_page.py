"""The page and its file."""

import os
import subprocess
import sys

import numpy as np
from PIL import Image
import pytest

from support.pictures import COARSE
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.study.picture import Arrow, Body, draw, Instant, need_view, Path, Surface


@pytest.fixture
def coarse(pyvista, monkeypatch):
    """Draw surfaces with long edges, and fast."""
    monkeypatch.setattr('xpbd_ros.study.picture.panel.FINENESS', COARSE)


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
            f't = {index} s', [cloth], [Body('plane'), Body('sphere', (0.1,), (0, 0, 0.1))],
            [Path(tracks, label='gripper'), Path(tracks[:1] - [0.6, 0, 0], '#2a9d64')],
            [Arrow((0, 0, 0.3), (0, 0, 0.2), '1 N'), Arrow((0, 0, 0), (0, 0, 0))]))
    return instants


@pytest.mark.parametrize(('count', 'columns'), [slow(1, 3), (2, 3), slow(4, 4)])
def test_a_picture_has_the_width_asked_for_and_is_small(tmp_path, count, columns, coarse, capfd):
    file = tmp_path / 'run.png'
    draw(little_run(count), file, title='A run', columns=columns, width_px=600)
    with Image.open(file) as image:
        assert image.format == 'PNG'
        assert image.width == 600
        assert len(image.getcolors(1 << 24)) > 500
    assert 5_000 < file.stat().st_size < 700 * 1024
    assert capfd.readouterr() == ('', ''), 'nor do the libraries write warnings'


def test_the_same_run_gives_the_same_file(tmp_path, coarse):
    for name in ('a.png', 'b.png'):
        draw(little_run(1), tmp_path / name, width_px=300)
    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()


def test_a_large_picture_loses_colours_then_pixels(tmp_path, coarse):
    file = tmp_path / 'run.png'
    draw(little_run(1), file, width_px=300)
    full = file.stat().st_size
    draw(little_run(1), file, width_px=300, limit=int(0.2 * full))
    assert file.stat().st_size < 0.2 * full
    with pytest.raises(ValueError, match='cannot be made smaller than 100 bytes'):
        draw(little_run(1), tmp_path / 'none.png', width_px=100, limit=100)
    assert not (tmp_path / 'none.png').exists()


@pytest.mark.parametrize('bodies', [[], [Body('plane')]])
def test_an_empty_cloth_is_a_picture_without_cloth(tmp_path, bodies, coarse):
    empty = Surface(np.empty((0, 3)), np.empty((0, 3)))
    draw([Instant('nothing', [empty], bodies, [Path(np.empty((0, 3)))])], tmp_path / 'e.png',
         width_px=300)
    with Image.open(tmp_path / 'e.png') as image:
        assert np.asarray(image).mean() > 200


def test_importing_it_needs_no_pyvista():
    code = ('import sys, xpbd_ros.study.picture; '
            "print([name for name in ('matplotlib.pyplot', 'pyvista', 'vtkmodules', 'rclpy') "
            'if name in sys.modules])')
    said = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == '[]'


def test_without_pyvista_it_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setattr('xpbd_ros.study.picture.offscreen.find_spec', lambda name: None)
    with pytest.raises(InputError, match=r"^it needs PyVista: pip install 'xpbd_ros\[view\]'$"):
        need_view('it')
    with pytest.raises(InputError, match='needs PyVista'):
        draw(little_run(1), tmp_path / 'none.png')
    assert list(tmp_path.iterdir()) == []


def test_where_vtk_does_not_load_it_says_so(monkeypatch, pyvista):
    monkeypatch.setitem(sys.modules, 'vtkmodules.vtkRenderingCore', None)
    with pytest.raises(InputError, match=r'^it needs VTK, which does not load: .*RenderingCore'):
        need_view('it')


def test_without_opengl_it_says_so_in_one_line(tmp_path, pyvista):
    """VTK alone would crash here. Files that are no libraries hide the real ones."""
    for name in ('libEGL.so.1', 'libEGL.so', 'libOSMesa.so.8', 'libOSMesa.so'):
        (tmp_path / name).touch()
    environment = {**os.environ, 'LD_LIBRARY_PATH': str(tmp_path)}
    environment.pop('DISPLAY', None)
    code = ("from xpbd_ros.study.picture import need_view\n"
            "try:\n    need_view('it')\nexcept ValueError as error:\n    print(error)")
    done = subprocess.run([sys.executable, '-c', code], env=environment, capture_output=True,
                          text=True, check=True)
    assert (done.stdout, done.stderr) == (
        'it needs OpenGL off screen, and VTK finds neither EGL nor OSMesa; install one, such as: '
        'apt install libegl1 libegl-mesa0\n', '')
