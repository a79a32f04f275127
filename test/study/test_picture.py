"""Laws that hold for any correct picture, not the pixels of one."""

import subprocess
import sys

from matplotlib.figure import Figure
import numpy as np
from PIL import Image
import pytest

from xpbd_ros.study import picture
from xpbd_ros.study.picture import Arrow, Body, Camera, draw, fit, Instant, Path, render, Surface

RED, BLUE, GREY = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8), (0.7, 0.7, 0.7)
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])
ABOVE = Camera(azimuth=-90, elevation=89.9)


def square(height, colour, *, scale=1.0, **rest):
    return Surface(scale * SQUARE + [0, 0, height], TWO, colour, **rest)


def look(instant, camera=ABOVE, pixels=80, **options):
    view = fit(picture._content(instant), camera, pixels, pixels)
    return view, render(instant, view, over=2, **options)


def colour_at(view, image, point):
    """Return the mean colour of the few pixels around where a point is seen."""
    column, row = view.project(point)[0][0].astype(int)
    assert 1 <= row < view.height - 1 and 1 <= column < view.width - 1
    return image[row - 1:row + 2, column - 1:column + 2].mean(axis=(0, 1))


def is_red(colour):
    return colour[0] > 1.5 * colour[2]


def is_blue(colour):
    return colour[2] > 1.5 * colour[0]


# What hides what

@pytest.mark.parametrize('first', [0, 1])
def test_the_near_one_hides_the_far_one_whatever_their_order(first):
    """Seen from above the higher square is in front; drawn first or last, it wins."""
    pair = [square(0.3, RED, back_colour=RED), square(-0.3, BLUE, back_colour=BLUE)]
    view, seen = look(Instant(surfaces=[pair[first], pair[1 - first]]))
    assert is_red(colour_at(view, seen.image, [0, 0, 0]))
    view, seen = look(Instant(surfaces=pair), Camera(azimuth=-90, elevation=-89.9))
    assert is_blue(colour_at(view, seen.image, [0, 0, 0]))


def test_squares_that_cross_are_each_seen_where_they_are_higher():
    """No order of whole triangles can draw this one: it takes a comparison at each sample."""
    tilt = SQUARE * [1, 1, 0] + np.outer(SQUARE[:, 0], [0, 0, 0.4])
    view, seen = look(Instant(surfaces=[Surface(tilt, TWO, RED),
                                        Surface(tilt * [1, 1, -1], TWO, BLUE)]))
    assert is_red(colour_at(view, seen.image, [0.5, -0.8, 0]))    # both in the first triangles
    assert is_blue(colour_at(view, seen.image, [-0.5, -0.8, 0]))


def test_the_z_buffer_agrees_with_a_search_of_all_triangles():
    rng = np.random.default_rng(5)
    width, height = 37, 23
    pixels = rng.uniform(-8, 45, (60, 2))
    key = rng.uniform(0.2, 2.0, 60)
    triangles = np.concatenate([rng.integers(0, 60, (90, 3)), [[4, 4, 9]]])    # and a line
    best, which = picture._rasterise(pixels, key, triangles, width, height)
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
    _, which = picture._rasterise(pixels, np.ones(225), triangles, 60, 60)
    assert (which >= 0).all()


def test_a_plane_hides_what_is_below_it_but_not_a_cloth_that_lies_on_it():
    ground = Body('plane', colour=GREY)
    view, seen = look(Instant(surfaces=[square(-0.5, RED)], bodies=[ground]))
    assert not is_red(colour_at(view, seen.image, [0, 0, 0]))
    view, seen = look(Instant(surfaces=[square(-1e-5, RED)], bodies=[ground]))
    assert is_red(colour_at(view, seen.image, [0, 0, 0]))


def test_cloth_that_bridges_a_body_covers_it_but_never_shows_through_a_thin_one():
    """A flat triangle on a ball lies inside it by up to half its edge; a thin post stays whole."""
    cap = square(0.5 - 0.02, RED, scale=0.05)
    ball = Body('sphere', 0.5, colour=BLUE)
    view, seen = look(Instant(surfaces=[cap], bodies=[ball]))
    assert is_red(colour_at(view, seen.image, [0, 0, 0.5]))
    coarse, post = square(0.0, RED), Body('capsule', (0.03, 1.5), (0, 0, 0.04),
                                          (0, np.sqrt(0.5), 0, np.sqrt(0.5)), colour=BLUE)
    view, seen = look(Instant(surfaces=[coarse], bodies=[post]), pixels=200)
    assert is_blue(colour_at(view, seen.image, [0, 0, 0.04]))


def test_depth_is_the_distance_along_the_view():
    view, seen = look(Instant(surfaces=[square(0.3, RED)]))
    column, row = view.project([0.2, 0.1, 0.3])[0][0].astype(int)
    assert seen.depth[row, column] == pytest.approx(view.project([0, 0, 0.3])[1][0], rel=1e-3)
    assert np.isinf(seen.depth[0, 0])


# Light

@pytest.mark.parametrize('sun', [(1, 0, 0.3), (-1, 0, 0.3), (0, 1, 0.3), (0, -1, 0.3)])
def test_a_ball_is_brighter_on_the_side_of_the_sun(sun):
    view, seen = look(Instant(bodies=[Body('sphere', 1.0, colour=GREY)]), sun=sun)
    side = 0.8 * np.array(sun) * [1, 1, 0] + [0, 0, 0.55]
    lit = colour_at(view, seen.image, side).sum()
    dark = colour_at(view, seen.image, side * [-1, -1, 1]).sum()
    assert lit > 1.2 * dark


@pytest.mark.parametrize('sun', [(1, 0, 1), (-1, 0, 1), (0, 1, 1), (0.7, -0.7, 1)])
def test_a_shadow_falls_away_from_the_sun(sun):
    """The centre's shadow lies one height further on; the mirrored place stays as bright."""
    high, away = 1.0, np.array([-sun[0], -sun[1], 0]) * 1.0
    scene = Instant(surfaces=[square(0.01, GREY, scale=2.5)],
                    bodies=[Body('plane', colour=GREY), Body('sphere', 0.3, (0, 0, high))])
    view, seen = look(scene, sun=sun)
    shadow = colour_at(view, seen.image, away + [0, 0, 0.01]).sum()
    mirror = colour_at(view, seen.image, -away + [0, 0, 0.01]).sum()
    assert shadow < 0.85 * mirror
    view, seen = look(Instant(bodies=scene.bodies), Camera(-90, 60), sun=sun)    # on the plane
    wide = fit([[-2, -2, 0], [2, 2, 1]], Camera(-90, 60), 80, 80)
    image = render(Instant(bodies=scene.bodies), wide, sun=sun,
                   box=(np.full(3, -2.0), np.full(3, 2.0))).image
    assert colour_at(wide, image, away).sum() < 0.85 * colour_at(wide, image, -away).sum()


def test_a_penumbra_widens_with_the_height_of_what_casts_it():
    def soft(height):
        scene = Instant(surfaces=[square(height, GREY, scale=0.5)],
                        bodies=[Body('plane', colour='white')])
        view = fit([[-1, -1, 0], [1, 1, 0]], ABOVE, 400, 400)
        image = render(scene, view, sun=(0.8, 0, 1), box=(np.full(3, -2.0), np.full(3, 2.0)),
                       over=1).image
        line = np.linspace(-0.98, -0.56, 400)    # across the shadow's edge, clear of the square
        points = np.stack([line, np.full(400, 0.13), np.zeros(400)], axis=1)
        where = view.project(points)[0].astype(int)
        value = image[where[:, 1], where[:, 0]].sum(axis=1)
        low, high = value.min(), value.max()
        assert low < 0.85 * high
        return ((value > low + 0.2 * (high - low)) & (value < high - 0.2 * (high - low))).sum()

    assert soft(0.45) > 2 * soft(0.1)


def test_a_low_roof_takes_the_light_of_the_sky_from_what_is_below():
    roof = Instant(surfaces=[square(0.5, GREY)])
    points, triangles = roof.surfaces[0].points, roof.surfaces[0].triangles
    maps = [picture._DepthMap(points, triangles, direction, 64)
            for direction in picture._directions(32)]
    up = np.array([[0.0, 0, 1]])
    below = picture._sky(maps, np.array([[0.0, 0, 0]]), up)[0]
    beside = picture._sky(maps, np.array([[6.0, 0, 0]]), up)[0]
    assert beside > 0.95
    assert below < 0.5


def test_cloth_in_the_open_does_not_shade_itself():
    """Too small a bias shows as stripes; here every pixel of a flat cloth has one colour."""
    view, seen = look(Instant(surfaces=[square(0.0, GREY)]), sun=(0.6, 0.3, 0.5))
    inside = seen.image[20:60, 20:60].sum(axis=2)
    assert np.ptp(inside) < 0.02


def test_the_two_sides_of_a_cloth_have_their_own_colours():
    cloth = Instant(surfaces=[square(0.0, RED, back_colour=BLUE)])
    view, seen = look(cloth)
    assert is_red(colour_at(view, seen.image, [0, 0, 0]))
    view, seen = look(cloth, Camera(azimuth=-90, elevation=-89.9))
    assert is_blue(colour_at(view, seen.image, [0, 0, 0]))


def test_turning_the_triangles_swaps_the_sides():
    cloth = Surface(SQUARE, TWO[:, ::-1], RED, BLUE)
    view, seen = look(Instant(surfaces=[cloth]))
    assert is_blue(colour_at(view, seen.image, [0, 0, 0]))


def test_rest_coordinates_print_lines_where_they_are_whole():
    cloth = square(0.0, GREY, rest=SQUARE[:, :2], rest_spacing=0.5)
    view, seen = look(Instant(surfaces=[cloth]), pixels=200)
    on = view.project([[0.5, 0.25, 0], [-0.25, 0.0, 0]])[0].astype(int)
    off = view.project([[0.25, 0.25, 0], [-0.25, -0.25, 0]])[0].astype(int)
    image = seen.image.sum(axis=2)
    lines = [image[r - 1:r + 2, c - 1:c + 2].min() for c, r in on]
    fields = [image[r - 1:r + 2, c - 1:c + 2].min() for c, r in off]
    assert max(lines) < 0.97 * min(fields)


# Shapes and camera

@pytest.mark.parametrize(('body', 'volume'), [
    (Body('sphere', 0.5), 4 / 3 * np.pi * 0.125),
    (Body('capsule', (0.2, 0.6)), 4 / 3 * np.pi * 0.008 + np.pi * 0.04 * 0.6),
    (Body('cylinder', (0.3, 0.8)), np.pi * 0.09 * 0.8),
    (Body('box', (0.2, 0.3, 0.5)), 0.03)])
def test_a_body_is_closed_with_its_front_outside(body, volume):
    """Gauss: the volume of a closed mesh is the sum over its triangles, signed by their side."""
    turned = Body(body.shape, body.size, (0.3, -0.2, 0.5), (0.1, 0.5, -0.3, 0.8))
    mesh = picture._body_mesh(turned)
    a, b, c = (mesh.points[mesh.triangles[:, k]] - turned.position for k in range(3))
    assert np.einsum('ij,ij->', a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.01)
    face = np.cross(b - a, c - a)
    for k in range(3):
        cosine = (face * mesh.normals[mesh.triangles[:, k]]).sum(axis=1)
        assert (cosine >= -1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-12)


def test_a_body_lies_along_its_own_z():
    turned = Body('capsule', (0.1, 1.0), (1, 2, 3), (0.5, 0, 0, np.sqrt(0.75)))    # 60 deg, x
    points = picture._body_mesh(turned).points - turned.position
    assert (points @ [0, -np.sqrt(0.75), 0.5]).max() == pytest.approx(0.6, abs=1e-3)
    assert np.abs(points @ [0, 0.5, np.sqrt(0.75)]).max() == pytest.approx(0.1, abs=1e-3)


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


def test_a_given_target_is_in_the_middle_at_the_given_distance():
    view = fit(SQUARE, Camera(target=(1, 2, 3), distance=4), 300, 200)
    pixels, depth = view.project([1, 2, 3])
    np.testing.assert_allclose(pixels, [[150, 100]], atol=1e-9)
    assert depth[0] == pytest.approx(4)


def test_grid_lines_are_a_round_distance_apart():
    assert [picture.grid_spacing(s) for s in (0.45, 1.0, 2.0, 10.0)] == [0.05, 0.1, 0.2, 1.0]


def test_a_path_is_faint_where_hidden_and_dotted_ahead():
    view = fit(SQUARE, ABOVE, 100, 100)
    depth = np.full((100, 100), np.inf)
    depth[:, :50] = 0.1    # something near covers the left half
    line = np.array([[-0.9, 0.05, 0], [0.9, 0.05, 0]])

    def drawn(present):
        axes = Figure().add_axes((0, 0, 1, 1))
        picture._draw_path(axes, Path(line, present=present), view, depth, 0.5)
        collection, = axes.collections
        middle = np.array([segment[:, 0].mean() for segment in collection.get_segments()])
        return middle, collection.get_colors()[:, 3]

    middle, opacity = drawn(-1)
    assert (opacity[middle < 45] < 0.5).all() and (opacity[middle > 55] == 1).all()
    ahead, _ = drawn(0)
    assert len(ahead) < 0.8 * len(middle)


# Files

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


@pytest.mark.parametrize(('count', 'columns'), [(1, None), (2, None), (6, None), (5, 4)])
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


def test_a_picture_too_large_loses_colours_then_pixels_and_at_last_is_refused(
        tmp_path, monkeypatch):
    file = tmp_path / 'run.png'
    draw(little_run(1), file, width_px=300)
    full = file.stat().st_size
    for share in (0.7, 0.2):
        monkeypatch.setattr(picture, 'FILE_LIMIT', int(share * full))
        draw(little_run(1), file, width_px=300)
        assert file.stat().st_size < share * full
    monkeypatch.setattr(picture, 'FILE_LIMIT', 100)
    with pytest.raises(ValueError, match='cannot be made smaller than 100 bytes'):
        draw(little_run(1), tmp_path / 'none.png', width_px=500)
    assert not (tmp_path / 'none.png').exists()


@pytest.mark.parametrize('bodies', [[], [Body('plane')]])
def test_an_empty_cloth_is_a_picture_without_cloth(tmp_path, bodies):
    empty = Surface(np.empty((0, 3)), np.empty((0, 3)))
    draw([Instant('nothing', [empty], bodies, [Path(np.empty((0, 3)))])], tmp_path / 'e.png',
         width_px=300)
    with Image.open(tmp_path / 'e.png') as image:
        assert np.asarray(image).mean() > 200


def test_an_unloaded_plane_is_as_bright_as_one_far_from_everything():
    """A scene of planes alone has no depth maps, and must not go dark for it."""
    view = fit(SQUARE, Camera(), 60, 60)
    box = (np.full(3, -1.0), np.full(3, 1.0))
    plane = Body('plane', colour=GREY)
    alone = render(Instant(bodies=[plane]), view, box=box)
    loaded = render(Instant(bodies=[plane, Body('sphere', 0.01, (0, 0, 0.01))]), view, box=box)
    assert np.median(alone.image) == pytest.approx(np.median(loaded.image), abs=0.02)


def test_what_lies_behind_the_camera_is_left_out():
    view = fit(SQUARE, Camera(target=(0, 0, 0), distance=3), 60, 60)
    behind = Surface(SQUARE + 10 * (view.eye / np.linalg.norm(view.eye)), TWO, RED)
    image = render(Instant(surfaces=[behind]), view).image
    assert image.min() == pytest.approx(1)


# Refusals

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
    with pytest.raises(ValueError, match=r'Surface.rest: must be finite'):
        Surface(SQUARE, TWO, rest=points[:, :2])


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


def test_pictures_need_neither_a_display_nor_anything_beyond_matplotlib():
    code = ('import sys, xpbd_ros.study.picture; '
            "print([name for name in ('matplotlib.pyplot', 'scipy', 'vtk', 'rclpy', 'numba') "
            'if name in sys.modules])')
    said = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == '[]'
