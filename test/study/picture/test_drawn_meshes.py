"""Bodies as triangles."""

import numpy as np
import pytest

from xpbd_ros.study.picture import Body
from xpbd_ros.study.picture.meshes import body_mesh


@pytest.mark.parametrize(('body', 'volume'), [
    (Body('sphere', 0.5), 4 / 3 * np.pi * 0.125),
    (Body('capsule', (0.2, 0.6)), 4 / 3 * np.pi * 0.008 + np.pi * 0.04 * 0.6),
    (Body('cylinder', (0.3, 0.8)), np.pi * 0.09 * 0.8),
    (Body('box', (0.2, 0.3, 0.5)), 0.03)])
def test_a_body_is_closed_with_its_front_outside(body, volume):
    """Gauss: the volume of a closed mesh is the sum over its triangles, signed by their side."""
    turned = Body(body.shape, body.size, (0.3, -0.2, 0.5), (0.1, 0.5, -0.3, 0.8))
    mesh = body_mesh(turned)
    a, b, c = (mesh.points[mesh.triangles[:, k]] - turned.position for k in range(3))
    assert np.einsum('ij,ij->', a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.01)
    face = np.cross(b - a, c - a)
    for k in range(3):
        cosine = (face * mesh.normals[mesh.triangles[:, k]]).sum(axis=1)
        assert (cosine >= -1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-12)


def test_a_body_lies_along_its_own_z():
    turned = Body('capsule', (0.1, 1.0), (1, 2, 3), (0.5, 0, 0, np.sqrt(0.75)))    # 60 deg, x
    points = body_mesh(turned).points - turned.position
    assert (points @ [0, -np.sqrt(0.75), 0.5]).max() == pytest.approx(0.6, abs=1e-3)
    assert np.abs(points @ [0, 0.5, np.sqrt(0.75)]).max() == pytest.approx(0.1, abs=1e-3)
