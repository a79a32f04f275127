"""Colliders, arrows and grippers as triangles."""

import numpy as np
import pytest

from xpbd_ros.study.picture import Arrow, Body, Instant, Path


@pytest.fixture(autouse=True)
def _pyvista(pyvista):
    pass


@pytest.mark.parametrize(('shape', 'size', 'volume'), [
    ('sphere', (0.5,), 4 / 3 * np.pi * 0.125),
    ('capsule', (0.2, 0.6), 4 / 3 * np.pi * 0.008 + np.pi * 0.04 * 0.6),
    ('cylinder', (0.3, 0.8), np.pi * 0.09 * 0.8),
    ('box', (0.2, 0.3, 0.5), 0.03)])
def test_a_body_is_closed_with_its_front_outside(shape, size, volume):
    """Gauss: the volume of a closed mesh is the sum over its triangles, signed by their side."""
    from xpbd_ros.study.picture.meshes import body
    mesh = body(Body(shape, size, (0.3, -0.2, 0.5), (0.1, 0.5, -0.3, 0.8))).mesh
    triangles = mesh.regular_faces
    a, b, c = (np.asarray(mesh.points[triangles[:, k]]) - [0.3, -0.2, 0.5] for k in range(3))
    assert np.einsum('ij,ij->', a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.01)
    face = np.cross(b - a, c - a)
    for k in range(3):
        assert ((face * mesh['Normals'][triangles[:, k]]).sum(axis=1) >= -1e-9).all()


def test_a_body_lies_along_its_own_z():
    from xpbd_ros.study.picture.meshes import body
    turned = Body('capsule', (0.1, 1.0), (1, 2, 3), (0.5, 0, 0, np.sqrt(0.75)))    # 60 deg, x
    points = body(turned).mesh.points - [1, 2, 3]
    assert (points @ [0, -np.sqrt(0.75), 0.5]).max() == pytest.approx(0.6, abs=1e-3)
    assert np.abs(points @ [0, 0.5, np.sqrt(0.75)]).max() == pytest.approx(0.1, abs=1e-3)


def test_an_arrow_reaches_from_its_origin_to_its_tip():
    from xpbd_ros.study.picture.meshes import arrow
    vector = np.array([0.3, -0.2, 0.4])
    points = arrow(Arrow((1, 2, 3), vector), 0.2).mesh.points - [1, 2, 3]
    along = points @ vector / np.linalg.norm(vector)
    grown = 2e-5 * np.linalg.norm(vector)    # so that the sides of an edge stay two
    assert (along.min(), along.max()) == pytest.approx((0, np.linalg.norm(vector)), abs=grown)
    aside = np.linalg.norm(points - np.outer(along, vector / np.linalg.norm(vector)), axis=1)
    assert aside[along.argmax()] < grown and aside.max() < 0.05


def test_a_gripper_holds_the_end_of_its_path_between_its_jaws():
    from xpbd_ros.study.picture.meshes import parts_of
    parts = parts_of(Instant(paths=[Path([[0, 0, 0], [1, 2, 3]])]), 1.0)
    points = np.concatenate([part.mesh.points for part in parts]) - [1, 2, 3]
    assert np.linalg.norm(points, axis=1).max() < 0.2
    assert points[:, 2].max() == pytest.approx(0.11, rel=1e-4)
    assert points[:, 0].min() < 0 < points[:, 0].max()
    assert parts_of(Instant(paths=[Path([])]), 1.0) == []


def test_grid_lines_are_on_the_plane_a_round_distance_apart():
    from xpbd_ros.study.picture.meshes import grid_spacing, plane
    assert [grid_spacing(s) for s in (0.45, 1.0, 2.0, 10.0)] == [0.05, 0.1, 0.2, 1.0]
    turn = (np.sin(0.2), 0.0, 0.0, np.cos(0.2))    # 0.4 rad about x
    normal = np.array([0.0, -np.sin(0.4), np.cos(0.4)])
    one = Body('plane', (), (0.03, 0.0, 0.1), turn)
    parts = plane(one, np.array([0.5, 0.2, 0.3]), 1.0, np.array([0, -3.0, 1.0]))
    for mesh in (part.mesh for part in parts):
        np.testing.assert_allclose((mesh.points - [0.03, 0, 0.1]) @ normal, 0, atol=1e-6)
        np.testing.assert_allclose(mesh['Normals'] @ normal, 1, atol=1e-6)
    axes = np.array([[1, 0, 0], [0, np.cos(0.4), np.sin(0.4)]])
    lines = parts[1].mesh
    local = (lines.points - [0.03, 0, 0.1]) @ axes.T
    off = np.abs(local / 0.1 - np.round(local / 0.1))
    assert (off.min(axis=1) < 1e-4).all()
