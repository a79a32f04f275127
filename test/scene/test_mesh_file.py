"""Meshes from files: in the order of the file, whatever wrote it; or a reason why not."""

import numpy as np
import pytest

from support.meshes import box, disc, obj_text
from xpbd_ros.errors import InputError
from xpbd_ros.scene.mesh_file import read_mesh_file

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
V = 'v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n'


def written(tmp_path, text, name='mesh.obj'):
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.parametrize('text', [
    V + 'f 1 2 3\nf 1 3 4\n',
    V + 'f 1 2 3 4\n',
    '# from a program\nmtllib none.mtl\no shirt\n' + V.replace('\n', ' 0.5 0.5 0.5\n')
    + 'vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\ns off\nusemtl red\nf 1/1/1 2/2/1 3/3/1\n'
      'usemtl blue\nf 1/3 3/2 4/1 # seam\n',
    V + 'f -4 -3 -2\nf 1//1 -2//1 \\\n4//1\n',
    V.replace('\n', '\r\n') + 'f 1 2 3\r\nf 1 3 4\r\nl 1 2\r\n'])
def test_obj_files_of_all_kinds_keep_their_vertices(text, tmp_path):
    """Seams and materials split a surface in other readers."""
    vertices, triangles, tetrahedra = read_mesh_file(written(tmp_path, text))
    np.testing.assert_array_equal(vertices, SQUARE)
    np.testing.assert_array_equal(triangles, [[0, 1, 2], [0, 2, 3]])
    assert tetrahedra.shape == (0, 4)


CONCAVE = {
    'an arrow head': [[1, 0], [.1, .1], [0, 1], [0, 0]],
    'an L': [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]],
    'a comb': [[0, 3], [0, 0], [5, 0], [5, 3], [4, 3], [4, 1], [3, 1], [3, 3], [2, 3], [2, 1],
               [1, 1], [1, 3]],
    'a square with a hole': [[0, 0], [3, 0], [3, 3], [0, 3], [0, 0], [1, 1], [1, 2], [2, 2],
                             [2, 1], [1, 1]]}


@pytest.mark.parametrize('shape', CONCAVE)
@pytest.mark.parametrize('turn', [0, 1, 3, -1])
def test_the_triangles_of_a_concave_polygon_cover_it_once(shape, turn, tmp_path):
    """Each turns as the polygon does, and their areas add up to it; from any first corner."""
    corners = np.roll(CONCAVE[shape], turn, 0)[::1 if turn >= 0 else -1] * 1e-3
    tilted = corners @ [[.6, .0, .8], [.0, 1., .0]] + 5.0
    faces = f'f {" ".join(str(k + 1) for k in range(len(tilted)))}\n'
    text = ''.join('v {} {} {}\n'.format(*v) for v in tilted) + faces
    vertices, triangles, _ = read_mesh_file(written(tmp_path, text))
    x = vertices[triangles]
    parts = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    whole = np.cross(vertices, np.roll(vertices, -1, 0)).sum(0)
    assert len(triangles) == len(corners) - 2
    assert (parts @ whole > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(parts, axis=1).sum(), np.linalg.norm(whole),
                               rtol=1e-6)


def test_a_polygon_that_crosses_itself_is_refused_with_its_line(tmp_path):
    path = written(tmp_path, f'{V}f 1 2 3\nf 1 2 4 3\n')
    with pytest.raises(InputError) as error:
        read_mesh_file(path)
    assert str(error.value) == (f'{path}: line 6: the polygon crosses itself or lies in a '
                                'line, so it cannot be split; split it into triangles in the '
                                'program that made the file')


def test_obj_numbers_keep_all_their_digits(tmp_path):
    vertices, triangles = disc()
    found = read_mesh_file(written(tmp_path, obj_text(vertices, triangles)))
    np.testing.assert_array_equal(found[0], vertices)
    np.testing.assert_array_equal(found[1], triangles)


@pytest.mark.parametrize('line', ['v 1 2', 'v a b c', 'f 1 2', 'f 1 2 0', 'f 1 2 x', 'f -5 1 2'])
def test_a_line_that_is_not_obj_is_told(line, tmp_path):
    path = written(tmp_path, f'{V}{line}\n')
    with pytest.raises(InputError) as error:
        read_mesh_file(path)
    assert str(error.value) == f'{path}: line 5: cannot be read as OBJ (got {line!r})'


def test_a_vertex_that_does_not_exist_is_told_with_its_line(tmp_path):
    path = written(tmp_path, f'{V}f 1 2 3\nf 1 2 7\nf 1 2 6\n')
    with pytest.raises(InputError) as error:
        read_mesh_file(path)
    assert str(error.value) == f'{path}: line 6: vertex 7 does not exist (there are 4)'


@pytest.mark.parametrize('name', ['disc.stl', 'disc.ply', 'disc.off', 'disc.vtk', 'disc.vtu',
                                  'disc.msh'])
def test_other_formats_hold_the_same_surface(name, tmp_path, meshio):
    vertices, triangles = disc(2)
    meshio.write_points_cells(tmp_path / name, vertices, [('triangle', triangles)])
    found, corners, tetrahedra = read_mesh_file(tmp_path / name)
    np.testing.assert_allclose(found[corners], vertices[triangles], atol=1e-7)
    assert tetrahedra.shape == (0, 4)
    if name != 'disc.stl':    # which has no vertices, only corners
        np.testing.assert_allclose(found, vertices, atol=1e-7)


@pytest.mark.parametrize('name', ['box.vtk', 'box.msh'])
def test_tetrahedra(name, tmp_path, meshio):
    vertices, tetrahedra = box()
    meshio.write_points_cells(tmp_path / name, vertices, [('tetra', tetrahedra)])
    found = read_mesh_file(tmp_path / name)
    np.testing.assert_allclose(found[0], vertices, atol=1e-7)
    np.testing.assert_array_equal(found[2], tetrahedra)


@pytest.mark.parametrize('name, text, reason', [
    ('m.ply', 'hello', 'cannot be read as a mesh (Expected ply'),
    ('m.stl', 'hello', 'cannot be read as a mesh (could not convert'),
    ('m.xyz', 'hello', 'cannot be read as a mesh (Could not deduce file format'),
    ('m.vtk', '', 'cannot be read as a mesh ('),
    ('m.stl', '', 'cannot be read as a mesh (it has no points)'),
    ('m.ply', 'ply\nformat ascii 1.0\nelement vertex 3\n',
     'cannot be read as a mesh (its header is cut off)'),
    ('m.OFF', 'OFF\n# of a program\n\n', 'cannot be read as a mesh (its header is cut off)')])
def test_what_is_no_mesh_is_refused_in_one_line(name, text, reason, tmp_path, capfd, meshio):
    path = written(tmp_path, text, name)
    with pytest.raises(InputError) as error:
        read_mesh_file(path)
    assert str(error.value).startswith(f'{path}: {reason}')
    assert '\n' not in str(error.value)
    assert capfd.readouterr() == ('', '')


def test_a_face_without_corners_has_no_triangles(tmp_path, meshio):
    corners = '\n'.join(' '.join(map(str, corner)) for corner in SQUARE)
    path = written(tmp_path, 'ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\n'
                   'property float y\nproperty float z\nelement face 2\n'
                   'property list uchar int vertex_indices\nend_header\n'
                   f'{corners}\n4 0 1 2 3\n0\n', 'm.ply')
    np.testing.assert_array_equal(read_mesh_file(path)[1], [[0, 1, 2], [0, 2, 3]])


def test_cells_that_cannot_be_simulated_are_refused(tmp_path, meshio):
    meshio.write_points_cells(tmp_path / 'm.vtk', np.random.default_rng(1).normal(size=(8, 3)),
                              [('hexahedron', np.arange(8)[None])])
    with pytest.raises(InputError, match="cells of type 'hexahedron'; only triangles"):
        read_mesh_file(tmp_path / 'm.vtk')


def test_a_file_that_is_gone_is_named(tmp_path):
    with pytest.raises(InputError) as error:
        read_mesh_file(tmp_path / 'none.obj')
    assert str(error.value).startswith(f"no such file: {tmp_path / 'none.obj'}; ")


def test_a_folder_is_no_mesh(tmp_path):
    with pytest.raises(InputError) as error:
        read_mesh_file(tmp_path)
    assert str(error.value) == f'{tmp_path} is a folder; name a file in it'
