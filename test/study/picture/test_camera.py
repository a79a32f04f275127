"""Camera position and framing."""

import numpy as np
import pytest

from xpbd_ros.study.picture.camera import AXES, AZIMUTH, ELEVATION, fit, MARGIN, SUN, VIEW_ANGLE


@pytest.mark.parametrize(('low', 'high'), [(1.5, 1.5), (0.4, 0.4), (0.5, 6.0)])
def test_the_camera_is_as_near_as_it_can_be_and_cuts_nothing(low, high):
    points = np.random.default_rng(1).normal(size=(300, 3)) * [3, 1, 0.5] + [5, 6, 7]
    eye, aspect = fit(points, low, high)
    back, right, up = AXES @ (points - eye).T
    assert back.max() < 0
    share = np.stack([right / aspect, up]) / -back / np.tan(np.radians(VIEW_ANGLE) / 2)
    inner = 1 - 2 * MARGIN    # of 1 at the edges of the picture
    assert np.abs(share).max() < inner + 1e-9
    filled = np.isclose(share.max(axis=1), inner) & np.isclose(share.min(axis=1), -inner)
    assert filled.any()
    assert low <= aspect <= high
    if low < high:
        np.testing.assert_allclose([share.max(axis=1), share.min(axis=1)],
                                   [[inner] * 2, [-inner] * 2], atol=0.05)


def test_the_camera_has_a_level_horizon_and_the_sun_behind_it():
    np.testing.assert_allclose(AXES @ AXES.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(AXES) == pytest.approx(1)
    back, right, up = AXES
    assert right[2] == pytest.approx(0) and up[2] > 0
    assert np.degrees(np.arctan2(back[1], back[0])) == pytest.approx(AZIMUTH)
    assert np.degrees(np.arcsin(back[2])) == pytest.approx(ELEVATION)
    assert SUN @ back > 0 > SUN @ right
