"""Cost tables: read from files, and taken only where a scene says so."""

import pytest
import yaml

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import CostTable, read_table, SHIPPED, table_text
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.save import explicit
from xpbd_ros.sim.stepping.methods import direction, METHODS

RIGID = {'cloths.sheet.effects.stretch': {'compliance': 0.0}, 'solver.budget_ms': 4.0}


def scaled(factor):
    """Return the shipped table with all times multiplied."""
    return CostTable({name: {key: factor * value for key, value in entries.items()}
                      for name, entries in SHIPPED.methods.items()}, SHIPPED.single,
                     {'contact': 7.0})


def test_a_table_is_read_as_it_was_written(tmp_path):
    file = tmp_path / 'table.yaml'
    file.write_text(table_text(scaled(2.0), 'some CPU'))
    assert read_table(str(file)) == scaled(2.0)


def test_auto_takes_a_table_only_if_the_scene_names_it(tmp_path):
    """Twice the times, half the substeps; and the log of the scene needs no file."""
    (tmp_path / 'table.yaml').write_text(table_text(scaled(2.0), 'some CPU'))
    usual = compile_scene(load_scene('swing', RIGID))
    scene = load_scene('swing', {**RIGID, 'solver.cost_table': str(tmp_path / 'table.yaml')})
    solver = compile_scene(scene).solver
    assert solver.substeps == pytest.approx(0.5 * usual.solver.substeps, abs=1)
    assert 'cost_table' not in explicit(scene, solver)['solver']


def test_the_path_is_relative_to_the_scene_file(tmp_path):
    (tmp_path / 'table.yaml').write_text(table_text(SHIPPED, 'some CPU'))
    raw = {**load_scene('swing').raw, 'solver': {'cost_table': 'table.yaml'}}
    (tmp_path / 'scene.yaml').write_text(yaml.safe_dump(raw))
    scene = load_scene(str(tmp_path / 'scene.yaml'))
    assert scene.top.solver.cost_table == str(tmp_path / 'table.yaml')
    assert compile_scene(scene).solver == compile_scene(load_scene('swing')).solver


def test_an_effect_of_the_table_replaces_that_of_the_code():
    simulation = compile_scene(load_scene('drape'))
    contact, particles = simulation.effects['contact'], len(simulation.slot)
    parts = [table.substep_ns('line', 1, simulation.effects, simulation.state)
             for table in (SHIPPED, CostTable(SHIPPED.methods, SHIPPED.single, {'contact': 7.0}))]
    assert parts[0] - parts[1] == pytest.approx((contact.ns_per_particle - 7.0) * particles)


@pytest.mark.parametrize('name, entries', [
    ('arch', {'stretch': 'mesh_edge', 'cross_bend': 'mesh_edge', 'hinge': 'mesh_hinge'}),
    ('drape', {'stretch': 'edge', 'shear': 'edge', 'bend': 'hinge'}),
    ('sheet', {'membrane': 'membrane'}),
    ('softbox', {'volume': 'volume'})])
def test_constraints_count_by_their_kind_and_on_meshes_apart(name, entries):
    simulation = compile_scene(load_scene(name, {'solver.method': 'line'}))
    counts = SHIPPED.counts('line', 2, simulation.effects, simulation.state)
    kinds = set(entries.values())
    for kind in kinds:
        assert counts['line', kind] == 2 * sum(
            len(simulation.effects[effect].constraints.particles)
            for effect, its in entries.items() if its == kind)
    assert not any(counts['line', kind] for kind in SHIPPED.methods['line']
                   if kind not in kinds | {'substep', 'slot'})


@pytest.mark.parametrize(('substeps', 'sweeps'), [(1, 2), (2, 2), (3, 4), (4, 4), (35, 36)])
def test_soft_constraints_are_swept_once_but_in_the_last_of_an_odd_number(substeps, sweeps):
    """In half of a pass forth and back, as the substeps do it (``methods.direction``)."""
    assert sum(2 if direction.py_func(k, substeps) == 0 else 1
               for k in range(substeps)) == sweeps
    simulation = compile_scene(load_scene('drape', {'solver.method': 'line'}))
    counts = SHIPPED.counts('line', 1, simulation.effects, simulation.state, 1e-6, substeps)
    assert substeps * counts['line', 'hinge'] == pytest.approx(
        0.5 * sweeps * len(simulation.effects['bend'].constraints.particles))


def broken(change):
    """Return the text of a table after a change of its mapping."""
    raw = yaml.safe_load(table_text(scaled(1.0), 'some CPU'))
    change(raw)
    return yaml.safe_dump(raw)


@pytest.mark.parametrize('text, why', [
    (broken(lambda raw: raw.update(version=7)), 'has version 7, and this release reads 1; write '
                                                'it again with xpbd_ros cost --calibrate'),
    ('3', 'no version'), ('a: [', 'is no YAML file'), ('{}', 'no version'),
    (broken(lambda raw: raw['methods'].pop('line')), 'methods.line: is missing'),
    (broken(lambda raw: raw['methods'].update(lines={})), 'methods.lines: unknown key'),
    (broken(lambda raw: raw['methods']['line'].pop('edge')), 'methods.line.edge: is missing'),
    (broken(lambda raw: raw['methods'].update(line=3)), 'methods.line: must be a mapping'),
    (broken(lambda raw: raw['methods']['line'].update(mesh_edge='much')),
     r'line.mesh_edge: must be a number of at least 0 \(got much\)'),
    (broken(lambda raw: raw['methods']['line'].update(slot=float('nan'))), 'line.slot: must be a'),
    (broken(lambda raw: raw['methods']['line'].update(slot=0.0)), 'slot: must be .* least 0.001'),
    (broken(lambda raw: raw['effects'].update(contct=1.0)), 'effects.contct: unknown key'),
    (broken(lambda raw: raw.update(single=-1.0)), 'single: must be'),
    (broken(lambda raw: raw.update(particles_per_thread='many')), 'thread.grid: must be a number'),
    (broken(lambda raw: raw.update(particles_per_thread={'contact': 0})),
     'particles_per_thread.contact: must be a number of at least 1'),
    (broken(lambda raw: raw.update(particles_per_thread={'contct': 9.0})),
     'particles_per_thread.contct: unknown key')])
def test_what_is_no_table_is_refused_in_one_line(text, why, tmp_path):
    file = tmp_path / 'table.yaml'
    file.write_text(text)
    with pytest.raises(InputError, match=why) as refused:
        compile_scene(load_scene('swing', {'solver.cost_table': str(file)}))
    assert '\n' not in str(refused.value)
    assert str(file) in str(refused.value)


def test_a_missing_file_is_refused_with_the_way_out():
    with pytest.raises(InputError, match='/nowhere.yaml: No such file or directory; write it with '
                                         'xpbd_ros cost --calibrate'):
        compile_scene(load_scene('swing', {'solver.cost_table': '/nowhere.yaml'}))


def test_the_shipped_table_has_all_methods():
    assert set(SHIPPED.methods) == set(METHODS)
