"""Laws that hold for any correct light, not the pixels of one picture."""

import numpy as np
import pytest

from support.pictures import SQUARE, TWO
from xpbd_ros.study.picture import Body, Surface

UP = np.array([[0.0, 0.0, 1.0]])


def level(height, scale=1.0):
    """Return a level square."""
    return Surface(scale * SQUARE + [0, 0, height], TWO)


@pytest.fixture(autouse=True)
def _pyvista(pyvista):
    pass


def meshes(*things):
    from xpbd_ros.study.picture.meshes import body, cloth
    return [(body(one) if isinstance(one, Body) else cloth(one)[0]).mesh for one in things]


@pytest.mark.parametrize('sun', [(1, 0, 1), (-1, 0, 1), (0, 1, 1), (0.7, -0.7, 1)])
def test_a_shadow_falls_away_from_the_sun(sun):
    """The shadow of a ball's centre lies one height further on; elsewhere nothing is missing."""
    from xpbd_ros.study.picture.light import sunlight, unit
    towards = unit(sun)
    lamps = sunlight(meshes(Body('sphere', (0.3,), (0, 0, 1.0))), towards)
    away = np.array([-sun[0], -sun[1], 0.0]) / sun[2]
    shadow, mirror, far = lamps.light(np.stack([away, -away, 50 * away]), np.repeat(UP, 3, axis=0))
    assert shadow == 0
    assert (mirror, far) == pytest.approx((towards[2], towards[2]), rel=0.01)


def test_light_is_lamberts_where_nothing_is_in_the_way():
    from xpbd_ros.study.picture.light import skylight, sunlight, unit
    far = meshes(Body('sphere', (0.01,), (0, 0, -30.0)))
    normals = unit(np.random.default_rng(4).normal(size=(50, 3)))
    towards = unit([0.3, -0.5, 0.7])
    light = sunlight(far, towards).light(np.zeros((50, 3)), normals)
    np.testing.assert_allclose(light, np.maximum(normals @ towards, 0), atol=0.02)
    sky = skylight(far).light(np.zeros((2, 3)), np.concatenate([UP, -UP]))
    assert sky == pytest.approx([1.0, 0.5], abs=0.05)    # less from below


def test_a_penumbra_widens_with_the_height_of_what_casts_it():
    from xpbd_ros.study.picture.light import sunlight, unit
    line = np.stack([np.linspace(-1.2, 0, 600), np.full(600, 0.13), np.zeros(600)], axis=1)

    def width(height):
        """Return how much of the line is partly lit: SUN_RADIUS each side, seen at a slant."""
        lamps = sunlight(meshes(level(height, 0.5)), unit([0.8, 0, 1]))
        light = lamps.light(line, np.repeat(UP, 600, axis=0))
        full = unit([0.8, 0, 1])[2]
        assert light.min() == 0 and light.max() == pytest.approx(full, rel=0.01)
        return ((light > 0.02 * full) & (light < 0.98 * full)).sum() * 1.2 / 599

    for height in (0.2, 0.45):    # two edges cast: at +- 0.5 - 0.8 height
        both = 1 if 0.5 - 0.8 * height > 0 else 2
        expected = both * 2 * np.tan(np.radians(2.2)) * height * 1.64    # 1 + tan^2 of the slant
        assert width(height) == pytest.approx(expected, rel=0.35)


def test_a_low_roof_blocks_the_light_of_the_sky():
    from xpbd_ros.study.picture.light import skylight
    lamps = skylight(meshes(level(0.5)))
    below, beside = lamps.light(np.array([[0.0, 0, 0], [6.0, 0, 0]]), np.repeat(UP, 2, axis=0))
    assert below < 0.5
    assert beside > 0.95


@pytest.mark.parametrize('slope', [0.0, 0.5, 2.0])
def test_cloth_in_the_open_does_not_shade_itself(slope):
    """Too small a bias shows as stripes; here every point of a flat cloth has one light."""
    from xpbd_ros.study.picture.light import sunlight, unit
    (mesh,) = meshes(Surface(SQUARE + np.outer(SQUARE[:, 0], [0, 0, slope]), TWO))
    mesh = mesh.subdivide_adaptive(max_edge_len=0.05)
    towards = unit([-0.6, 0.3, 0.5])
    light = sunlight([mesh], towards).light(mesh.points, unit(mesh['Normals']))
    np.testing.assert_allclose(light, unit([-slope, 0, 1]) @ towards, rtol=0.02)
