"""What cannot be drawn is refused where it is made."""

import numpy as np
import pytest

from support.pictures import SQUARE, TWO
from xpbd_ros.study.picture import Arrow, Body, draw, Path, Surface


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused_and_named(bad):
    points = SQUARE.copy()
    points[2, 1] = bad
    with pytest.raises(ValueError, match=r'Surface.points: point 2 is not finite'):
        Surface(points, TWO)
    with pytest.raises(ValueError, match=r'Path.points: point 2 is not finite'):
        Path(points)
    with pytest.raises(ValueError, match=r'Arrow.vector: point 0 is not finite'):
        Arrow((0, 0, 0), (0, bad, 0))
    with pytest.raises(ValueError, match=r'Body.position: point 0 is not finite'):
        Body('sphere', 1.0, (bad, 0, 0))
    with pytest.raises(ValueError, match=r'Body.orientation: must be a unit quaternion'):
        Body('sphere', 1.0, orientation=(bad, 0, 0, 1))
    with pytest.raises(ValueError, match=r'Body.size: a sphere takes 1 finite length'):
        Body('sphere', bad)


@pytest.mark.parametrize(('make', 'message'), [
    (lambda: Surface(SQUARE, [[0, 1, 4]]), r'indices must be 0 .. 3 \(got 0 .. 4\)'),
    (lambda: Surface(SQUARE[:, :2], TWO), r'Surface.points: must be \(n, 3\) \(got \(4, 2\)\)'),
    (lambda: Body('cone', 1.0), r"must be one of plane, sphere.*\(got 'cone'\)"),
    (lambda: Body('box', (1.0, 1.0)), r'a box takes 3 finite lengths > 0 m'),
    (lambda: Body('sphere', -1.0), r'> 0 m \(got -1.0\)'),
    (lambda: Path(SQUARE, marker='hand'), r"must be one of jaws, ball, none \(got 'hand'\)"),
    (lambda: Path(SQUARE, present=4), r'Path.present: must be < 4 \(got 4\)'),
    (lambda: draw([], 'x.png'), r'needs at least one instant')])
def test_what_cannot_be_drawn_is_refused_with_the_value(make, message):
    with pytest.raises(ValueError, match=message):
        make()
