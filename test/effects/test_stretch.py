"""Stretch and shear: the moduli of the sheet, whatever its cells."""

import numpy as np
import pytest
from sim.small import run, simulate

from xpbd_ros.effects.shear import EFFECT as SHEAR
from xpbd_ros.effects.stretch import EFFECT as STRETCH
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping

WARP, WEFT, G = 70.0, 40.0, 15.0
CELLS = pytest.mark.parametrize('grid, size', [((5, 5), (0.8, 0.8)), ((4, 7), (0.9, 0.6)),
                                               ((2, 2), (0.3, 0.5)), ((9, 3), (0.4, 0.9))])


def energy(grid, size, strain, *, stretch=True, shear=True):
    """Return the energy per area over ½, of an affine strain (exx, eyy, γ), to second order."""
    simulation = simulate(grid, size, effects={'stretch': {'warp': WARP, 'weft': WEFT},
                                               'shear': {'stiffness': G}})
    (exx, eyy, gamma), x = strain, simulation.state.x
    step, total = 1e-5, 0.0
    for sign in (step, -step):    # what is odd in the strain cancels
        deformed = x + sign * x @ np.array([[exx, 0.5 * gamma, 0.0], [0.5 * gamma, eyy, 0.0],
                                            [0.0, 0.0, 0.0]])
        if stretch:
            total += STRETCH.energy(simulation.effects['stretch'].data, deformed)
        if shear:
            total += SHEAR.energy(simulation.effects['shear'].data, deformed)
    return total / step**2 / (size[0] * size[1])


@CELLS
def test_stretch_alone_has_the_moduli_asked_for_and_no_more(grid, size):
    """On oblong cells too, because the rim has half: C11 = warp, C22 = weft, C12 = C66 = 0."""
    for strain, expected in (((1, 0, 0), WARP), ((0, 1, 0), WEFT), ((1, 1, 0), WARP + WEFT),
                             ((1, -1, 0), WARP + WEFT)):
        assert energy(grid, size, strain, shear=False) == pytest.approx(expected, rel=1e-6)
    assert energy(grid, size, (0, 0, 1), shear=False) < 1e-6


def test_with_shear_a_sheet_of_square_cells_is_the_lattice_of_the_book():
    """NUMERICS 2.7: C11 = warp + shear, C22 = weft + shear, C12 = C66 = shear."""
    grid, size = (5, 4), (0.8, 0.6)
    c11, c22 = (energy(grid, size, strain) for strain in ((1, 0, 0), (0, 1, 0)))
    assert c11 == pytest.approx(WARP + G, rel=1e-6)
    assert c22 == pytest.approx(WEFT + G, rel=1e-6)
    assert energy(grid, size, (1, 1, 0)) == pytest.approx(c11 + c22 + 2.0 * G, rel=1e-6)
    assert energy(grid, size, (0, 0, 1)) == pytest.approx(G, rel=1e-6)


@CELLS
def test_shear_has_its_modulus_on_oblong_cells_and_adds_what_its_limits_say(grid, size):
    dx, dy = size[0] / (grid[0] - 1), size[1] / (grid[1] - 1)
    for strain, expected in (((0, 0, 1), 1.0), ((1, 0, 0), (dx / dy)**2),
                             ((0, 1, 0), (dy / dx)**2),
                             ((1, 1, 0), (dx / dy)**2 + (dy / dx)**2 + 2.0)):
        assert energy(grid, size, strain, stretch=False) == pytest.approx(
            expected * G, rel=1e-6)


def test_the_rim_has_half_the_stiffness():
    simulation = simulate((4, 3), (0.3, 0.2), effects={'stretch': {'warp': WARP, 'weft': WEFT}})
    edges = simulation.effects['stretch'].batch
    x = simulation.state.x[edges.particles]
    across = np.where(x[:, 0, 1] == x[:, 1, 1], 1, 0)
    middle = x.mean(1)[np.arange(len(x)), across]
    rim = np.isclose(middle, 0.0) | np.isclose(middle, np.array([0.3, 0.2])[across])
    stiffness = 1.0 / edges.compliance
    for side, modulus in ((1, WARP), (0, WEFT)):
        np.testing.assert_allclose(stiffness[(across == side) & ~rim], modulus, rtol=1e-12)
        np.testing.assert_allclose(stiffness[(across == side) & rim], 0.5 * modulus, rtol=1e-12)
    assert len(x) == 3 * 3 + 4 * 2


def test_a_compliance_is_that_of_every_edge():
    simulation = simulate((4, 3), effects={'stretch': {'compliance': 0.02}}, scale=0.5)
    np.testing.assert_array_equal(simulation.effects['stretch'].batch.compliance, 0.01)


@pytest.mark.parametrize('stretch, text', [
    ({}, 'needs either warp and weft (N/m) or compliance (m/N), not both'),
    ({'warp': 1, 'weft': 1, 'compliance': 0},
     'needs either warp and weft (N/m) or compliance (m/N), not both'),
    ({'weft': 1, 'compliance': 0},
     'needs either warp and weft (N/m) or compliance (m/N), not both'),
    ({'warp': 1}, 'needs warp and weft (N/m), and only one of them is given')])
def test_both_forms_and_neither_are_refused(stretch, text):
    with pytest.raises(InputError) as error:
        simulate(effects={'stretch': stretch})
    assert str(error.value) == f'small.yaml: cloths.c.effects.stretch: {text}'


def test_each_cloth_of_a_scene_moves_as_it_would_alone():
    """Whatever their stiffness and resolution, and though one of them does not stretch."""
    cloths = {
        'a': {'grid': {'size': [0.5, 0.4], 'resolution': [4, 3]}, 'density': 0.2,
              'effects': {'stretch': {'warp': 30, 'weft': 20}, 'shear': {'stiffness': 3},
                          'bend': {'stiffness': 1e-3}}},
        'b': {'grid': {'size': [0.3, 0.3], 'resolution': [2, 5]}, 'density': 0.1,
              'effects': {'bend': {'stiffness': 1e-4}, 'shear': {'stiffness': 1}}},
        'd': {'grid': {'size': [0.3, 0.3], 'resolution': [5, 2]}, 'density': 0.3,
              'effects': {'stretch': {'compliance': 0.0}, 'shear': {'stiffness': 9},
                          'bend': {'stiffness': 1e-2}}}}

    def build(chosen):
        return compile_scene(scene_from_mapping({
            'cloths': {name: cloths[name] for name in chosen}, 'solver': {'substeps': 5},
            'pins': {name: {'cloth': name, 'at': 'corner_01'} for name in chosen},
            'effects': {'damping': {'rate': 0.2}}}, where='x', name='x'))

    together = build('abd')
    frame = run(together, 40)
    for cloth in together.cloths:
        alone = build(cloth.name)
        np.testing.assert_array_equal(frame.x[cloth.particles], run(alone, 40).x)
        np.testing.assert_array_equal(frame.pins[cloth.name].force,
                                      alone.frame().pins[cloth.name].force)
