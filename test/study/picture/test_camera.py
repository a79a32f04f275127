"""Where the camera stands, and where points are seen."""

import numpy as np
import pytest

from xpbd_ros.study.picture import Camera, fit


@pytest.mark.parametrize('camera', [Camera(), Camera(30, 5, 60), Camera(200, -40, 10)])
def test_the_camera_is_as_near_as_it_can_be_and_cuts_nothing(camera):
    points = np.random.default_rng(1).normal(size=(300, 3)) * [3, 1, 0.5] + [5, 6, 7]
    for width, height in ((300, 200), (150, 400)):
        view = fit(points, camera, width, height, margin=0.1)
        pixels, depth = view.project(points)
        share = pixels / [width, height]
        assert depth.min() > 0
        assert share.min() > 0.1 - 1e-9 and share.max() < 0.9 + 1e-9
        tight = np.isclose(share.min(axis=0), 0.1) & np.isclose(share.max(axis=0), 0.9)
        assert tight.any()


def test_rays_go_through_the_pixels_that_points_project_to():
    points = np.random.default_rng(3).normal(size=(20, 3))
    view = fit(points, Camera(), 320, 200)
    pixels, depth = view.project(points)
    np.testing.assert_allclose(view.eye + view.rays(*pixels.T) * depth[:, None], points,
                               atol=1e-12)
