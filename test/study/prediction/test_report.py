"""What ``check`` says about a scene: in the user's terms, and true."""

from dataclasses import replace
import json
import math
import subprocess
import sys

import numpy as np
import pytest

from support.meshes import box_surface, disc, obj_text
from support.shipped_scenes import each_scene, WITH_MESHIO
from support.tiers import slow
from xpbd_ros.cli.check import lines
from xpbd_ros.cli.main import main
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import SHIPPED, table_text
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.scene.stability import explicit_substeps, substep_ratio
from xpbd_ros.sim.contact.collider_entries import SHAPES
from xpbd_ros.sim.measure import elastic_energy, kinetic_energy
from xpbd_ros.study.prediction import check
from xpbd_ros.study.prediction.decay import factor
from xpbd_ros.study.prediction.stiffness import stiffness
from xpbd_ros.study.prediction.substeps import resolving, stretch_error

COARSE = {'cloths.sheet.grid.resolution': [9, 9]}
COARSE_COVER = {'cloths.cover.grid.resolution': [9, 9]}
SOFT = {'solver.method': 'gauss_seidel', 'solver.substeps': 16}


@each_scene(slow=('arch', 'bag', 'balloon', 'curtain', 'drum', 'flag', 'fold', 'fold_towel',
                  'sheet', 'softbox', 'towel'), without=['shirt'])    # too slow: scene/test_shirt
def test_a_shipped_scene_gives_what_it_asks_for(name):
    found = check(load_scene(name))
    assert found.ok, found.warnings
    for row in found.stiffness:
        assert row.effective == pytest.approx(row.asked, rel=0.05)
        assert row.effective_min <= row.effective <= row.effective_max


@pytest.mark.slow
def test_too_few_substeps_are_said_with_the_way_out():
    found = check(load_scene('swing', SOFT))
    (text,) = [text for text in found.warnings if 'along warp' in text]
    assert text == ('sheet: 41x41 at 16 substeps behaves like 117 N/m along warp (stretch), not '
                    f"5000; {found.substeps_for['0.1']} substeps or method line would do")
    cured = check(load_scene('swing', {**SOFT, 'solver.substeps': found.substeps_for['0.1']}))
    assert cured.ok, cured.warnings
    assert check(load_scene('swing', {'solver.method': 'line', 'solver.substeps': 16})).ok


@pytest.mark.slow
def test_a_taut_skin_that_is_too_soft_is_said_in_pascal():
    """As measured: 668 Pa of 1100 (test_stiffness)."""
    found = check(load_scene('balloon', {'solver.substeps': 22}))
    (text,) = [text for text in found.warnings if 'Pa' in text]
    assert text == ('balloon at 22 substeps has an overpressure of 710 Pa, not 1175; '
                    f"{found.substeps_for['0.1']} substeps would do")
    cured = check(load_scene('balloon', {'solver.substeps': found.substeps_for['0.1']}))
    assert cured.ok, cured.warnings


def test_the_pressure_of_a_pad_is_said():
    scene = load_scene('drape', {**COARSE_COVER, 'colliders.ball.pad': {'stiffness': 2e8}})
    pressure, tension = check(scene).notes
    assert pressure == (
        'colliders.ball.pad: presses with 20 N/cm² per mm of indentation (2e+08 Pa/m)')
    assert tension.startswith('cloths.cover: ') and tension.endswith(' into a grip of pads')


@WITH_MESHIO
def test_what_nothing_is_predicted_of_is_said():
    found = check(load_scene('softbox'))
    (note,) = found.notes
    assert note.startswith('volume: no stiffness is predicted: its constraints have no direction')
    assert found.substeps_for == {}
    assert not any('substeps for' in line for line in lines('softbox', found))


def test_the_substeps_asked_for_are_the_fewest_that_do():
    scene = load_scene('swing', {**SOFT, **COARSE})
    simulation = compile_scene(scene)
    found = check(scene)
    for error, count in found.substeps_for.items():
        below, at = (stretch_error(stiffness(scene, simulation, replace(
            simulation.solver, substeps=n))) for n in (count - 1, count))
        assert at <= float(error) < below


def cloth(grid, effects, **keys):
    """Return what is predicted of a cloth of 1 m that hangs from a corner."""
    return check(scene_from_mapping(
        {'cloths': {'c': {'grid': {'size': [1.0, 1.0], 'resolution': grid}, 'density': 0.2,
                          'effects': effects}},
         'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}}, **keys}, where='x', name='x'))


SPRINGS = {'stretch': {'warp': 1000.0, 'weft': 1000.0}}


@pytest.mark.parametrize('grid, effects', [
    ([1, 5], SPRINGS), ([5, 1], SPRINGS), ([6, 6], {**SPRINGS, 'bend': {'stiffness': 100.0}}),
    ([6, 6], {'membrane': {'warp': 1000.0, 'weft': 1000.0, 'shear': 300.0, 'poisson': 0.3}})])
def test_explicit_is_told_to_take_the_substeps_that_are_stable(grid, effects):
    found = cloth(grid, effects)
    assert found.solver.method == 'explicit' and found.ok, found.warnings
    assert set(found.substeps_for.values()) == {found.solver.substeps}


@pytest.mark.parametrize('grid, count', [([1, 5], 1), ([5, 1], 1), ([5, 5], 1), ([2, 2], 0)])
def test_a_strip_bends_along_its_length_and_a_single_cell_not_at_all(grid, count):
    rows = [row for row in cloth(grid, {**SPRINGS, 'bend': {'stiffness': 1e-4}}).stiffness
            if row.effect == 'bend']
    assert [row.effective for row in rows] == [pytest.approx(1e-4)] * count


def test_two_rigidities_have_a_row_each():
    found = cloth([11, 11], {**SPRINGS, 'bend': {'warp': 1e-4, 'weft': 1.0}},
                  solver={'method': 'gauss_seidel', 'substeps': 4})
    warp, weft = (row for row in found.stiffness if row.effect == 'bend')
    assert (warp.direction, warp.asked, weft.direction, weft.asked) == ('warp', 1e-4, 'weft', 1.0)
    assert abs(warp.error) < 0.1 < weft.error
    assert any(text.startswith('c: 11x11 at 4 substeps behaves like ') and
               ' N m along weft (bend), not 1; about ' in text for text in found.warnings)


@pytest.mark.parametrize('method', ['gauss_seidel', slow('jacobi')])
def test_substeps_that_are_said_to_do_do(method):
    """Beyond the largest number of substeps, iterations or another method are suggested."""
    def told(substeps, shear=50.0):
        found = cloth([6, 6], {**SPRINGS, 'shear': {'stiffness': shear}},
                      solver={'method': method, 'substeps': substeps})
        (text,) = [text for text in found.warnings if '(shear)' in text] or ['']
        return text, next(row.error for row in found.stiffness if row.effect == 'shear')
    text, _ = told(1)
    enough = int(text.split('; about ')[1].split(' substeps would do')[0])
    assert abs(told(enough)[1]) <= 0.2
    assert told(1, 1e12)[0].endswith(
        '; more substeps would not do; take more iterations or another method')


def test_a_compliance_scale_slows_the_waves_of_stretch():
    def wave(**solver):
        (found,) = [row for row in cloth([6, 6], SPRINGS, solver=solver).decay
                    if row.mode == 'stretch']
        return found.frequency_hz
    assert wave(compliance_scale=4.0) == pytest.approx(0.5 * wave())


def test_a_cloth_that_sweeps_compress_is_not_taken_for_right():
    found = cloth([11, 11], {'stretch': {'warp': 1e7, 'weft': 1e7}, 'shear': {'stiffness': 2e5}},
                  frame_rate=5.0, solver={'method': 'line', 'integrator': 'bdf2', 'substeps': 5})
    assert any('along warp (stretch), not 1e+07' in text for text in found.warnings)


def test_what_is_rigid_is_out_of_reach_or_there_already():
    rigid = {'cloths.c.effects.stretch': {'compliance': 0.0}}
    for grid, method, counts in (([5, 4], 'gauss_seidel', [None] * 3), ([2, 2], 'line', [1] * 3)):
        found = check(scene_from_mapping(
            {'cloths': {'c': {'grid': {'size': [0.4, 0.3], 'resolution': grid}, 'density': 0.2,
                              'effects': {}}}, 'solver': {'method': method},
             'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}}}, where='x', name='x',
            overrides=rigid))
        assert list(found.substeps_for.values()) == counts
        assert found.ok, found.warnings


def test_edges_that_ought_to_be_rigid_and_are_not_are_warned_about():
    """With the substeps that are named a cloth hung by its side is 1 % longer at most."""
    def warnings(substeps):
        return check(scene_from_mapping(
            {'cloths': {'c': {'grid': {'size': [0.5, 0.5], 'resolution': [6, 6]}, 'density': 0.2,
                              'effects': {'stretch': {'compliance': 0.0}}}},
             'solver': {'method': 'gauss_seidel', 'substeps': substeps},
             'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}}}, where='x', name='x')).warnings
    found = warnings(1)
    assert found[0].startswith('c: 6x6 at 1 substep behaves like ') and len(found) == 2
    enough = max(int(text.split('; about ')[1].split(' substeps')[0]) for text in found)
    stiffness, longer = (float(found[0].split(text)[1].split(' ')[0]) for text in (
        'behaves like ', 'not like rigid edges: hung by a side it is '))
    assert longer == pytest.approx(100.0 * 0.5 * 0.2 * 9.80665 * 0.5 / stiffness, rel=0.05)
    assert enough > 1
    assert warnings(enough - 1) and not warnings(enough)


def test_lines_that_cannot_follow_the_waves_are_warned_about():
    found = check(load_scene('swing', {'solver.method': 'line', 'solver.substeps': 2}))
    assert any('behaves like' in text or 'too few for the stretch waves' in text
               for text in found.warnings)


@pytest.mark.parametrize('changes, text', [
    ({'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [3, 3]}, 'density': 0.2}}},
     'no pins and no contact: the cloth falls for ever'),
    ({'colliders': {'rod': {'capsule': {'radius': 0.01, 'length': 1}}},
      'effects': {'contact': {'thickness': 0.001}}},
     'colliders.rod: 0.02 m across, and particles are 0.25 m apart: it can pass between them; use '
     'a finer cloth'),
    ({'cloths': {'c': {'grid': {'size': [300, 400], 'resolution': [3, 3]}, 'density': 0.2}}},
     'cloths.c: is 400 m large; sizes are in metres'),
    ({'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [3, 3]}, 'density': 250}}},
     "cloths.c.density: 250 kg/m² is no cloth's; 250 g/m² are 0.25"),
    ({'effects': {'contact': {'thickness': 4}}},
     'effects.contact.thickness: 4 m, and the largest cloth is 1 m; thicknesses are in metres'),
    ({'effects': {'self_collision': {'thickness': 0.3}}},
     'effects.self_collision.thickness: 0.3 m, and particles are 0.25 m apart: its time grows '
     'with the square of the ratio; choose a smaller one'),
    ({'solver': {'substeps': 9000, 'method': 'line'},
      'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [64, 64]}, 'density': 0.2,
                       'effects': {'stretch': {'warp': 1, 'weft': 1}}}}}, 'would hold real time'),
    ({'solver': {'substeps': 64, 'precision': 'float32'},
      'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [5, 5]}, 'density': 0.2,
                       'pose': {'position': [900, 0, 0]}}}}, 'float32 rounds positions'),
    ({'solver': {'substeps': 64, 'precision': 'float32'}},
     'float32 rounds positions to 1.2e-07 m here, and gravity moves a particle by 6.7e-07 m in a '
     'substep: up to 9% of gravity is lost'),
])
def test_what_will_go_wrong_is_said(changes, text):
    scene = {'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [5, 5]}, 'density': 0.2}},
             'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}}, **changes}
    if 'for ever' in text:
        del scene['pins']
    found = check(scene_from_mapping(scene, where='x', name='x'))
    assert [one for one in found.warnings if text in one], found.warnings


@pytest.mark.parametrize('own', [False, True])
def test_the_time_of_a_frame_is_said_of_the_cpu_whose_table_it_is_from(tmp_path, own):
    keys = {'solver.substeps': 8}
    if own:
        keys['solver.cost_table'] = str(tmp_path / 'table.yaml')
        (tmp_path / 'table.yaml').write_text(table_text(SHIPPED, 'my CPU'))
    time, = (line for line in lines('swing', check(load_scene('swing', keys)))
             if line.startswith('a frame'))
    assert time.endswith('on one core of ' + ('my CPU' if own else SHIPPED.cpu))


def test_each_kind_of_collider_is_checked(tmp_path):
    """What is narrower than the gaps between particles is named; what has no far side is not."""
    for name, half in (('pole', (0.02, 0.5, 0.02)), ('crate', (0.2, 0.2, 0.2))):
        vertices, faces = box_surface(*half)
        (tmp_path / f'{name}.obj').write_text(obj_text(vertices, faces))
    colliders = {
        'ground': {'plane': {}}, 'ball': {'sphere': {'radius': 0.2}},
        'rod': {'capsule': {'radius': 0.02, 'length': 1}},
        'can': {'cylinder': {'radius': 0.3, 'length': 1}}, 'block': {'box': {'size': [1, 1, 1]}},
        'plate': {'box': {'size': [1, 1, 0.01]}},
        'pole': {'mesh': {'file': str(tmp_path / 'pole.obj')}},
        'crate': {'mesh': {'file': str(tmp_path / 'crate.obj')}},
        'hills': {'heights': {'size': [1, 1], 'values': [[0, 1], [1, 0]]}}}
    assert {next(iter(entry)) for entry in colliders.values()} == set(SHAPES)
    found = check(scene_from_mapping({
        'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [5, 5]}, 'density': 0.2}},
        'effects': {'contact': {'thickness': 0.01}}, 'colliders': colliders}, where='x', name='x'))
    assert found.warnings == [
        f'colliders.{name}: 0.04 m across, and particles are 0.25 m apart: it can pass between '
        'them; use a finer cloth' for name in ('rod', 'pole')]


@pytest.mark.parametrize('angle', [1e-3, 0.1, 1.0, 10.0])
def test_numerical_damping_is_that_of_the_recurrences(angle):
    z = 1.0 / (1.0 - 1j * angle)
    assert factor('backward_euler', angle) == pytest.approx(abs(z), rel=1e-12)
    roots = np.roots([1.5 - 1j * angle, -2.0, 0.5])
    assert factor('bdf2', angle) == pytest.approx(np.abs(roots).max(), rel=1e-12)
    assert factor('bdf2', 0.01) == pytest.approx(1.0 - 0.01**4 / 4.0, abs=1e-11)
    roots = np.roots([5.0 - 3j * angle, -7.5, 3.0, -0.5])
    assert factor('ndf2', angle) == pytest.approx(np.abs(roots).max(), rel=1e-12)
    assert factor('ndf2', angle) <= 1.0


def test_decay_goes_with_the_integrator():
    slow, fast = (check(load_scene('swing', {
        'solver.substeps': 32, 'solver.integrator': name, **COARSE}))
                  for name in ('ndf2', 'backward_euler'))
    for a, b in zip(slow.decay, fast.decay):
        assert (a.mode, a.frequency_hz) == (b.mode, b.frequency_hz)
        assert 0.0 < a.lost_per_second < b.lost_per_second <= 1.0
    assert slow.decay[0].frequency_hz == pytest.approx(
        1.2024 * math.sqrt(9.80665) / (2 * math.pi))


def test_a_stretch_wave_loses_what_is_said():
    """A strip oscillates along its length, a quarter of the wavelength; its energy decays."""
    chosen = scene_from_mapping({
        'gravity': [0.0, 0.0, 0.0],
        'solver': {'method': 'line', 'integrator': 'ndf2', 'substeps': 2},
        'cloths': {'c': {'grid': {'size': [1.0, 1.0], 'resolution': [21, 1]}, 'density': 0.2,
                         'effects': {'stretch': {'warp': 400.0, 'weft': 200.0}}}},
        'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}}, 'effects': {'damping': {'rate': 0.0}}},
        where='x', name='x')
    (mode,) = check(chosen).decay
    simulation, energies = compile_scene(chosen), []
    simulation.state.x[0] += 1e-3 * np.sin(0.5 * np.pi * simulation.state.x[0])
    for _ in range(75):
        simulation.step()
        energies.append(kinetic_energy(simulation.state) + elastic_energy(simulation))
    assert mode.lost_per_second > 0.1
    assert 1.0 - math.sqrt(energies[74] / energies[14]) == pytest.approx(
        mode.lost_per_second, rel=0.01)


def test_waves_of_stretch_and_shear_are_resolved_at_second_order():
    """``substep_ratio`` times an explicit solver's substeps give a relative error of 1e-3."""
    simulation = compile_scene(scene_from_mapping({
        'cloths': {'c': {'grid': {'size': [1.0, 1.0], 'resolution': [6, 6]}, 'density': 0.2,
                         'effects': {**SPRINGS, 'shear': {'stiffness': 500.0}}}},
        'solver': {'method': 'line', 'integrator': 'bdf2', 'substeps': 8}}, where='x', name='x'))
    share = substep_ratio('line', 'bdf2') * explicit_substeps(
        simulation.effects, simulation.state, simulation.frame_dt)[0]
    assert [resolving(simulation, simulation.solver, error) / share for error in (
        1e-1, 1e-2, 1e-3, 1e-4)] == pytest.approx([0.1, 0.1**0.5, 1.0, 1.0])


def test_the_verb_prints_and_fails_with_a_warning(capsys, tmp_path):
    coarse = ['--set', 'cloths.sheet.grid.resolution=[21, 21]']
    keys = [*coarse, '--set', 'solver.method=gauss_seidel', '--set', 'solver.substeps=8']
    assert main(['check', 'swing', *coarse]) == 0
    capsys.readouterr()
    assert main(['check', 'swing', *keys, '--json', str(tmp_path / 'c.json')]) == 1
    said = capsys.readouterr().out
    numbers = json.loads((tmp_path / 'c.json').read_text())
    assert numbers['ok'] is False
    assert numbers['solver']['substeps'] == 8
    assert set(numbers['substeps_for']) == {'0.1', '0.01', '0.001'}
    assert {'cloth', 'effect', 'asked', 'effective', 'effective_min',
            'effective_max'} <= set(numbers['stiffness'][0])
    for warning in numbers['warnings']:
        assert f'warning: {warning}' in said


def test_a_mesh_is_checked_as_far_as_it_can_be(tmp_path):
    (tmp_path / 'quad.obj').write_text('v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n')
    found = check(scene_from_mapping({'cloths': {'c': {
        'mesh': {'file': str(tmp_path / 'quad.obj')}, 'density': 0.2}},
        'pins': {'a': {'cloth': 'c', 'at': [0]}}}, where='x', name='x'))
    assert (found.ok, found.stiffness, found.particles) == (True, [], 4)
    assert [row.mode for row in found.decay] == ['swing']


def test_a_scene_that_makes_no_sense_is_refused(capsys):
    assert main(['check', 'swing', '--set', 'cloths.sheet.density=-1']) == 2
    assert 'must be > 0 kg/m²' in capsys.readouterr().err


def test_nothing_is_compiled_to_machine_code():
    code = ('from xpbd_ros.scene.load import load_scene; '
            'from xpbd_ros.study.prediction import check; '
            'from xpbd_ros.sim.stepping import step; check(load_scene("swing")); '
            'print([len(f.signatures) for f in step._COMPILED.values()])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[0]'


def test_a_mesh_in_centimetres_is_warned_about(tmp_path):
    vertices, triangles = disc(4, 35.0)
    (tmp_path / 'disc.obj').write_text(obj_text(vertices, triangles))
    raw = {'cloths': {'c': {'mesh': {'file': 'disc.obj'}, 'density': 0.2}},
           'effects': {'pin': {}}}
    for keys, told in (({}, ['cloths.c: is 70 m large; unless its file is in metres, give '
                             'mesh.scale, such as 0.01 for centimetres']),
                       ({'cloths.c.mesh.scale': 0.01}, [])):
        found = check(scene_from_mapping(raw, where='x', name='x', overrides=keys,
                                         folder=tmp_path))
        assert found.warnings == told


def test_a_mesh_is_checked_like_a_grid(tmp_path, capsys):
    vertices, triangles = disc(4, 0.5)
    (tmp_path / 'disc.obj').write_text(obj_text(vertices, triangles) + 'v 0 0 0\n')
    (tmp_path / 'disc.yaml').write_text(
        'cloths: {c: {mesh: {file: disc.obj}, density: 0.2}}\n'
        'effects: {contact: {thickness: 0.01}}\n'
        'colliders: {rod: {sphere: {radius: 0.05}, position: [0, 0, -1]}}\n')
    assert main(['check', str(tmp_path / 'disc.yaml')]) == 1
    said = capsys.readouterr().out
    assert 'disc: 61 particles, 0 constraints' in said
    assert 'note: cloths.c.mesh: 1 vertex that no triangle uses; left out' in said
    assert 'warning: colliders.rod: 0.1 m across, and particles are 0.169 m apart' in said


@pytest.mark.parametrize(('scene', 'precision'), [
    ('swing', 'float32'), slow('towel', 'float64'), ('drum', 'float64')])
def test_a_frame_is_expected_to_take_what_auto_reckons_with(scene, precision):
    """Also in float32, on meshes, and with contacts."""
    report = check(load_scene(scene, {'solver.precision': precision}))
    assert f'about {report.frame_ms:.2g} ms per frame' in report.solver.reason
