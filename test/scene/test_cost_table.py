"""Cost tables: read from files, and taken only where a scene says so."""

import pytest
import yaml

from xpbd_ros.effects.contact import PER_SUBSTEP
from xpbd_ros.effects.strain_limit import MOST, PER_LOAD
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene, HAND_SPEED, Retune
from xpbd_ros.scene.cost_table import CostTable, read_table, SHIPPED, table_text
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.scene.save import explicit
from xpbd_ros.sim.self_collision.expected_work import OVERLAP, SEARCH
from xpbd_ros.sim.self_collision.neighbour_list import spacing_of
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
    contact = simulation.effects['contact']
    particles = contact.particles_worth(simulation.effects, simulation.state, 1)
    assert particles == len(simulation.slot) + PER_SUBSTEP
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


def towel(*, poses=({},), **keys):
    """Return a scene of sheets that may touch."""
    return scene_from_mapping({
        'frame_rate': 50, 'duration': 2.0, 'cloths': {'cd'[k]: {
            'grid': {'size': [1, 1], 'resolution': [21, 21]}, 'density': 0.2, 'pose': pose,
            'effects': {'stretch': {'warp': 100.0, 'weft': 100.0}}}
            for k, pose in enumerate(poses)},
        'effects': {'self_collision': {'thickness': 0.01}, 'contact': {'thickness': 0.01}},
        **keys}, where='x', name='x')


def work_of(effect, simulation, substeps=1):
    """Return the work of an effect in a substep, over that of one for each particle."""
    return simulation.effects[effect].particles_worth(
        simulation.effects, simulation.state, substeps) / len(simulation.slot)


def hand(**keys):
    """Return a pin that a scene moves back and forth."""
    return {'hand': {'cloth': 'c', 'at': 'corner_00', **keys}}


@pytest.mark.parametrize('keys, speed', [
    ({}, 0.0), ({'pins': hand()}, HAND_SPEED), ({'pins': {}}, HAND_SPEED),
    ({'effects': {'self_collision': {'thickness': 0.01}, 'pin': {}}}, HAND_SPEED),
    ({'pins': hand(motion=[[0, 0, 0, 0], [0.5, 0, 0.3, 0.4], [1, 0, 0, 0]])}, 0.5),
    ({'pins': hand(motion=[[0, 0, 0, 0], [4, 0, 0.6, 0.8]])}, 0.25),
    ({'colliders': {'ball': {'sphere': {'radius': 0.1}, 'motion': [
        [0, 0, 0, 1], [2, 0, 0, 3]]}}, 'pins': hand(motion=[[0, 0, 0, 0], [1, 0, 0, 1]])}, 1.0),
    ({'colliders': {'ball': {'sphere': {'radius': 0.1}, 'frame': 'gripper'}}}, HAND_SPEED)])
def test_searches_take_time_as_far_as_a_scene_moves_the_cloth_in_a_frame(keys, speed):
    """By the mean speed of its fastest pin or collider, in spacings of the particles."""
    simulation = compile_scene(towel(**keys))
    for substeps in 1, 7:
        extra = work_of('self_collision', simulation, substeps) - 1.0
        assert substeps * extra == pytest.approx(
            SEARCH * speed / 50 / spacing_of(simulation.cloths))
    assert simulation.effects['self_collision'].fewest_substeps == (6 if speed else 4)


UPRIGHT = {'orientation': [0.7071067811865476, 0.0, 0.0, 0.7071067811865476]}


@pytest.mark.parametrize('keys, share', [
    ({}, 0.0), ({'poses': [{}, {'position': [0.0, 0.0, 0.1]}]}, 0.5),
    ({'poses': [{}, {'position': [2.0, 0.0, 0.0]}]}, 0.0),
    ({'poses': [{}, {'position': [0.5, 0.0, 0.1]}]}, 0.25), ({'poses': [UPRIGHT]}, 0.95),
    ({'poses': [UPRIGHT], 'pins': hand()}, 0.0),
    ({'poses': [UPRIGHT], 'gravity': [0.0, 0.0, 0.0]}, 0.0),
    ({'poses': [UPRIGHT], 'gravity': [0.0, 9.0, 0.0]}, 0.0),
    ({'gravity': [0.0, 9.0, 0.0]}, 0.95)])
def test_cloth_that_covers_other_cloth_takes_more_time(keys, share):
    """As seen along gravity."""
    simulation = compile_scene(towel(**keys))
    effect = simulation.effects['self_collision']
    assert effect.overlap == pytest.approx(share, abs=0.1)
    assert work_of('self_collision', simulation, 10**9) == pytest.approx(
        1.0 + OVERLAP * effect.overlap)


def test_a_budget_has_room_for_searches():
    """With them, one more substep would exceed it; without motion, there are more."""
    at_rest, moved = (compile_scene(towel(solver={'budget_ms': 3.0, 'compliance_scale': 1e-6},
                                          **keys)) for keys in (
        {}, {'pins': hand(motion=[[0, 0, 0, 0], [1, 1, 0, 0]])}))
    cost = [n * SHIPPED.substep_ns('line', 1, moved.effects, moved.state, 0.02 / n, n)
            for n in (moved.solver.substeps, moved.solver.substeps + 1)]
    assert cost[0] <= 3e6 < cost[1]
    assert moved.solver.substeps < at_rest.solver.substeps


def curtain(*, weft=50.0, limit=0.1, rigid=False, pins=True, **rod):
    """Return a scene of a sheet with a limit that hangs from an edge."""
    return scene_from_mapping({
        'gravity': [0.0, 0.0, -10.0], 'cloths': {'c': {
            'grid': {'size': [1, 2], 'resolution': [11, 21]}, 'density': 0.3,
            'effects': {'stretch': {'compliance': 0.0} if rigid else {'warp': 100.0, 'weft': weft},
                        'strain_limit': {'max': limit}}}},
        'pins': {'rod': {'cloth': 'c', **(rod or {'at': 'edge_1x'})}} if pins else {}},
        where='x', name='x')


def test_a_limit_takes_time_as_far_as_the_weight_loads_the_edges_at_its_pins():
    """They bear weft · limit for each metre of the edge."""
    for weft, limit in (50.0, 0.1), (50.0, 0.2), (400.0, 0.1):
        assert work_of('strain_limit', compile_scene(curtain(weft=weft, limit=limit))) == (
            pytest.approx(1.0 + PER_LOAD * (0.3 * 2 * 10.0) / (weft * limit)))
    for keys in {'pins': False}, {'rigid': True}, {'rigid': True, 'limit': 0.0}:
        assert work_of('strain_limit', compile_scene(curtain(**keys))) == 1.0
    for keys in {'limit': 0.0}, {'weft': 1e-3}:
        assert work_of('strain_limit', compile_scene(curtain(**keys))) == 1.0 + PER_LOAD * MOST


@pytest.mark.parametrize('scene, effect, key, value, factor', [
    (towel(poses=[UPRIGHT]), 'self_collision', 'effects.self_collision.thickness', 0.02, 1.0),
    (curtain(near=(0.0, 0.0, 0.0), radius=0.15), 'strain_limit',
     'cloths.c.effects.strain_limit.max', 0.2, 0.5)])
def test_live_keys_leave_the_places_that_auto_counts_with(scene, effect, key, value, factor):
    """Those at the start: where the cloth is later does not change the number of substeps."""
    simulation = compile_scene(scene)
    before = work_of(effect, simulation) - 1.0
    simulation.state.x[:] = simulation.state.x[[0, 2, 1]] + 5.0
    simulation.effects = Retune(scene, simulation.cloths, simulation.state, simulation.effects)(
        key, value).effects
    assert 0.0 < factor * before == pytest.approx(work_of(effect, simulation) - 1.0)


def broken(change):
    """Return the text of a table after a change of its mapping."""
    raw = yaml.safe_load(table_text(scaled(1.0), 'some CPU'))
    change(raw)
    return yaml.safe_dump(raw)


@pytest.mark.parametrize('text, why', [
    (broken(lambda raw: raw.update(version=7)), 'has version 7, and this release reads 2; write '
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
