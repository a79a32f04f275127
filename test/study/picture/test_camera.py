"""Where the camera stands."""

import numpy as np
import pytest

from xpbd_ros.study.picture.camera import Camera, fit, MARGIN


@pytest.mark.parametrize('camera', [Camera(), Camera(30, 5, 60), Camera(200, -40, 10)])
@pytest.mark.parametrize(('low', 'high'), [(1.5, 1.5), (0.4, 0.4), (0.5, 3.0)])
def test_the_camera_is_as_near_as_it_can_be_and_cuts_nothing(camera, low, high):
    points = np.random.default_rng(1).normal(size=(300, 3)) * [3, 1, 0.5] + [5, 6, 7]
    eye, aspect = fit(points, camera, low, high)
    right, up, back = camera.axes @ (points - eye).T
    assert back.max() < 0
    slope = np.tan(np.radians(camera.view_angle) / 2)
    share = np.stack([right / aspect, up]) / -back / slope    # 1 at the edges of the picture
    inner = 1 - 2 * MARGIN
    assert np.abs(share).max() < inner + 1e-9
    filled = np.isclose(share.max(axis=1), inner) & np.isclose(share.min(axis=1), -inner)
    assert filled.any()
    if low < aspect < high:
        np.testing.assert_allclose(share.max(axis=1), inner, atol=0.03)


def test_a_camera_has_right_handed_axes_and_a_level_horizon():
    axes = Camera(20, 35).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[0, 2] == 0 and axes[1, 2] > 0
