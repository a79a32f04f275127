"""Materials: what they give a cloth, and that the lattice then is what was measured."""

import numpy as np
import pytest
import yaml

from support.scenes import run, simulate
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping, scene_from_text
from xpbd_ros.scene.materials import Isotropic, lattice, MATERIALS, pulled, sheet_of
from xpbd_ros.scene.model import live_keys
from xpbd_ros.scene.save import scene_text
from xpbd_ros.sim.commands import MovePin, Pose

GRID = {'size': [0.5, 0.5], 'resolution': [3, 3]}
NAMED = {'stretch': {}, 'shear': None, 'bend': {}}
SOLID = {'young': 2e6, 'poisson': 0.3, 'thickness': 1e-3, 'density': 900.0}
NAMES = pytest.mark.parametrize('name', MATERIALS)


def cloth(material, effects=NAMED, **keys):
    keys = {'grid': GRID, 'material': material, 'effects': effects, **keys}
    return scene_from_mapping({'cloths': {'c': keys}}, where='f.yaml', name='f')


def refusal(*arguments, **keys) -> str:
    with pytest.raises(InputError) as error:
        cloth(*arguments, **keys)
    return str(error.value)


def test_a_material_sets_density_and_values_of_named_effects():
    scene = cloth('denim')
    assert scene.cloths['c'].density == 0.324
    assert set(scene.cloth_effects['c']) == {'stretch', 'shear', 'bend'}
    assert scene.cloth_effects['c']['bend'].stiffness == 78.2e-6
    assert scene.cloth_effects['c']['shear'].stiffness == 42.0
    assert 'cloths.c.effects.stretch.warp' in live_keys(scene)


def test_what_is_not_named_stays_absent():
    scene = cloth('denim', {'bend': {}})
    assert scene.effect_names == ('bend',)
    assert cloth('denim', {}).effect_names == ()
    assert cloth('denim', None).cloths['c'].density == 0.324


def test_what_is_given_stays_as_given():
    scene = cloth('denim', {'stretch': {'warp': 5.0}, 'bend': {'stiffness': 1.0}}, density=2.0)
    assert scene.cloths['c'].density == 2.0
    assert scene.cloth_effects['c']['stretch'].warp == 5.0
    assert scene.cloth_effects['c']['stretch'].weft == pytest.approx(1044.4, abs=0.1)
    assert scene.cloth_effects['c']['bend'].stiffness == 1.0
    rigid = cloth('denim', {'stretch': {'compliance': 0.0}}).cloth_effects['c']['stretch']
    assert (rigid.compliance, rigid.warp, rigid.weft) == (0.0, None, None)


@NAMES
@pytest.mark.parametrize('shears', [True, False])
def test_a_strip_of_the_lattice_pulls_like_the_material(name, shears):
    """
    C11 = warp + C66, C22 = weft + C66, C12 = C66 (doc/numerics.md 5.2).

    The sides of a strip are free.
    """
    sheet, found = MATERIALS[name], lattice(MATERIALS[name], shears=shears)
    c66 = found['shear']['stiffness'] if shears else 0.0
    c = np.array([[found['stretch']['warp'] + c66, c66], [c66, found['stretch']['weft'] + c66]])
    measured = np.array([[sheet.c11, sheet.c12], [sheet.c12, sheet.c22]])
    assert np.linalg.eigvalsh(c).min() > 0.0 and min(found['stretch'].values()) > 0.0
    np.testing.assert_allclose(1.0 / np.diag(np.linalg.inv(c)),
                               1.0 / np.diag(np.linalg.inv(measured)), rtol=1e-12)
    np.testing.assert_allclose(pulled(sheet), 1.0 / np.diag(np.linalg.inv(measured)), rtol=1e-12)
    assert found['shear']['stiffness'] == sheet.shear


@pytest.mark.parametrize('name', MATERIALS)
def test_a_membrane_carries_the_whole_material(name):
    (cloth_,) = cloth(name, {'membrane': {}}).cloth_effects.values()
    s11, s12, s22, s33 = cloth_['membrane'].compliance
    sheet = MATERIALS[name]
    np.testing.assert_allclose(np.linalg.inv([[s11, s12], [s12, s22]]), [
        [sheet.c11, sheet.c12], [sheet.c12, sheet.c22]], rtol=1e-12)
    assert 1.0 / s33 == pytest.approx(sheet.shear)


def test_a_membrane_with_young_takes_nothing_from_its_material():
    (cloth_,) = cloth('denim', {'membrane': {'young': 3.0}}).cloth_effects.values()
    assert cloth_['membrane'].moduli == (3.0, 3.0, 1.5)


def test_the_edges_that_are_built_store_what_the_material_would():
    """Energy of a square of the lattice, strained as a pulled strip is, against ½ Y ε² A."""
    found = lattice(MATERIALS['denim'], shears=True)
    simulation = simulate((4, 4), (1.0, 1.0), effects={k: found[k] for k in ('stretch', 'shear')})
    c66 = found['shear']['stiffness']
    narrow = c66 / (found['stretch']['weft'] + c66)
    strain = 1e-4
    simulation.state.x[0] *= 1.0 + strain
    simulation.state.x[1] *= 1.0 - narrow * strain
    energy = sum(simulation.effects[name].constraints.energy(simulation.state.x)
                 for name in ('stretch', 'shear'))
    assert energy == pytest.approx(0.5 * pulled(MATERIALS['denim'])[0] * strain**2, rel=1e-3)


CELLS = pytest.mark.parametrize('ratio', [1 / 3, 0.5, 0.9, 1.0, 1.2, 2.0, 3.0])
"""width over height of a cell"""


def strips(material, ratio):
    """
    Return what strips along warp and weft pull with, free aside, and the shear modulus [N/m].

    From the energy of all edges and diagonals: Y1 = 1 / (C⁻¹)11, Y2 = 1 / (C⁻¹)22, C66.
    """
    size = (0.5, 0.5 / ratio)
    simulation = compile_scene(cloth(material, {'stretch': {}, 'shear': {}},
                                     grid={'size': size, 'resolution': [5, 5]}))
    x, step = simulation.state.x, 1e-5

    def twice_the_energy(xx, yy, xy):
        strain = np.array([[xx, 0.5 * xy, 0.0], [0.5 * xy, yy, 0.0], [0.0, 0.0, 0.0]])
        return sum(built.constraints.energy(x + sign * step * strain @ x)
                   for built in simulation.effects.values() for sign in (1, -1)) / (
                       step**2 * size[0] * size[1])

    c11, c22 = twice_the_energy(1, 0, 0), twice_the_energy(0, 1, 0)
    c12 = 0.5 * (twice_the_energy(1, 1, 0) - c11 - c22)
    return c11 - c12**2 / c22, c22 - c12**2 / c11, twice_the_energy(0, 0, 1)


@CELLS
@pytest.mark.parametrize('name', MATERIALS)
def test_strips_of_any_cells_pull_and_shear_as_the_table_says(name, ratio):
    sheet = MATERIALS[name]
    assert strips(name, ratio) == pytest.approx((*pulled(sheet), sheet.shear), rel=1e-4)


@CELLS
@pytest.mark.parametrize('poisson', [-0.9, 0.0, 0.5])
def test_strips_of_a_solid_do_so_too(poisson, ratio):
    """Auxetic ones are stiffer in shear than along their threads."""
    solid = {**SOLID, 'poisson': poisson}
    assert strips(solid, ratio) == pytest.approx(
        (2000.0, 2000.0, 1000.0 / (1.0 + poisson)), rel=1e-4)


def test_a_row_of_particles_has_no_diagonals_to_allow_for():
    scene = cloth('interlock', grid={'size': [0.5, 0.1], 'resolution': [6, 1]})
    assert scene.cloth_effects['c']['stretch'].warp == pytest.approx(pulled(
        MATERIALS['interlock'])[0])


@pytest.mark.parametrize('name', ['interlock', pytest.param('blanket', marks=pytest.mark.slow)])
@pytest.mark.parametrize('resolution', [
    (7, 4), pytest.param((19, 2), marks=pytest.mark.slow)])
def test_a_pulled_strip_has_the_modulus_of_the_table(name, resolution):
    """
    At rest, with the solver that users get; cells three times as wide as high, and as high.

    Bending and a force of zero change nothing in the plane: the step of test_explicit.
    """
    length, width, strain = 0.6, 0.1, 0.01
    simulation = compile_scene(scene_from_mapping({
        'gravity': [0, 0, 0], 'effects': {
            'damping': {'rate': 20.0}, 'force': {'per_mass': [0.0, 0.0, 0.0]}},
        'cloths': {'c': {'grid': {'size': [length, width], 'resolution': resolution},
                         'material': name, 'effects': {'stretch': {}, 'shear': {}, 'bend': {}}}},
        'pins': {'left': {'cloth': 'c', 'at': 'edge_x0'},
                 'right': {'cloth': 'c', 'at': 'edge_x1'}}}, where='f.yaml', name='f'))
    frame = run(simulation, 150, [MovePin('right', Pose((
        length * (1.0 + strain), 0.5 * width, 0.0)))])
    assert -frame.pins['right'].force[0] / (strain * width) == pytest.approx(
        pulled(MATERIALS[name])[0], rel=0.03)


def test_a_solid_of_poisson_a_third_is_a_lattice_exactly():
    sheet = sheet_of(Isotropic(3e6, 1.0 / 3.0, 1e-3, 1000.0))
    found = lattice(sheet, shears=True)
    assert found['stretch'] == pytest.approx({'warp': 2250.0, 'weft': 2250.0}, rel=1e-12)
    assert found['shear']['stiffness'] == pytest.approx(1125.0, rel=1e-12)
    assert found['bend']['stiffness'] == pytest.approx(3e6 * 1e-9 / 12.0 / (8 / 9), rel=1e-12)
    assert sheet.density == pytest.approx(1.0)


@pytest.mark.parametrize('poisson', [-0.99, -0.3, 0.0, 0.2, 0.5])
def test_a_solid_keeps_its_moduli_at_any_poissons_ratio(poisson):
    sheet = sheet_of(Isotropic(2e6, poisson, 1e-3, 900.0))
    assert pulled(sheet) == pytest.approx((2000.0, 2000.0), rel=1e-12)
    assert sheet.shear == pytest.approx(1000.0 / (1.0 + poisson), rel=1e-12)
    values = lattice(sheet, shears=True)['stretch']
    assert values['warp'] == pytest.approx(values['weft']) and values['warp'] > 0.0


def test_a_solid_in_a_scene():
    scene = cloth(SOLID)
    assert scene.cloths['c'].density == pytest.approx(0.9)
    assert scene.cloth_effects['c']['shear'].stiffness == pytest.approx(2000.0 / 2.6)
    assert scene.cloths['c'].material == Isotropic(**SOLID)


@pytest.mark.parametrize('material', ['denim', SOLID])
def test_the_scene_as_it_runs_says_the_values(material):
    scene = cloth(material)
    text = scene_text(scene, compile_scene(scene).solver)
    said = yaml.safe_load(text)['cloths']['c']
    assert said['density'] == scene.cloths['c'].density
    assert said['effects']['stretch']['warp'] == scene.cloth_effects['c']['stretch'].warp
    again = scene_from_text(text, where='log', name='log')
    assert again.cloth_effects == scene.cloth_effects and again.cloths == scene.cloths


@pytest.mark.parametrize('material, text', [
    ('denin', "cloths.c.material: unknown material; did you mean 'denim'? (known: denim, "),
    (3, 'cloths.c.material: unknown material (known: denim, '),
    ({**SOLID, 'poisson': 0.6}, 'cloths.c.material.poisson: must be at most 0.5 (got 0.6)'),
    ({**SOLID, 'poisson': -1}, 'cloths.c.material.poisson: must be > -1 (got -1)'),
    ({**SOLID, 'thickness': 0}, 'cloths.c.material.thickness: must be > 0 m (got 0)'),
    ({**SOLID, 'yuong': 1}, "cloths.c.material.yuong: unknown key; did you mean 'young'?"),
    ({'young': 1e6}, 'cloths.c.material.poisson: missing')])
def test_a_mistake_is_told_with_the_way_out(material, text):
    assert refusal(material).startswith(f'f.yaml: {text}')


@pytest.mark.parametrize('effects, text', [
    ({'stretch': 3}, 'cloths.c.effects.stretch: must be a mapping (got 3)'),
    (3, 'cloths.c.effects: must be a mapping (got 3)'),
    ({'strech': {}}, "cloths.c.effects.strech: unknown effect; did you mean 'stretch'?")])
def test_effects_are_checked_as_without_a_material(effects, text):
    assert refusal('denim', effects).startswith(f'f.yaml: {text}')


def test_a_sheet_is_no_material_for_a_body(tmp_path, meshio):
    meshio.write_points_cells(tmp_path / 'b.vtk', np.eye(4, 3), [('tetra', [[0, 1, 2, 3]])])
    scene = scene_from_mapping({'cloths': {'c': {
        'mesh': {'file': 'b.vtk'}, 'material': 'denim'}}}, where='f.yaml', name='f',
        folder=tmp_path)
    with pytest.raises(InputError) as error:
        compile_scene(scene)
    assert str(error.value) == (
        f'f.yaml: cloths.c.material: materials are sheets, and {tmp_path}/b.vtk has tetrahedra; '
        'give density (kg/m³) and the parameters of the effects')
