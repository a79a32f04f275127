"""``threads: 0``: as many as pay, by cloths, effects and the cores there are."""

import os

import pytest
import yaml

from xpbd_ros.effects.contact import BuiltContact
from xpbd_ros.scene import threads
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import GRID, SHIPPED, table_text
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.save import explicit
from xpbd_ros.scene.threads import free_cores, paying
from xpbd_ros.sim.commands import SetKey


@pytest.mark.parametrize('particles, cores, expected', [
    (0, 8, 1), (9_999, 8, 1), (10_000, 8, 2), (16_384, 8, 3), (16_384, 2, 2), (10**6, 1, 1),
    (10**6, 500, 64)])
def test_each_thread_has_enough_particles_and_a_core(particles, cores, expected):
    assert paying(particles, 5000.0, cores) == expected


def swing(side: int, **keys):
    """Return the swing of some particles along each side, with ``threads: 0``."""
    return load_scene('swing', {'cloths.sheet.grid.resolution': [side, side],
                                'solver.threads': 0, 'solver.method': 'line',
                                'solver.substeps': 4, **keys})


def test_a_scene_takes_them_and_its_log_has_their_number(monkeypatch):
    monkeypatch.setattr(threads, 'free_cores', lambda: 3)
    scene = swing(130)
    simulation = compile_scene(scene)
    assert simulation.solver.threads == 3
    assert explicit(scene, simulation.solver)['solver']['threads'] == 3
    assert compile_scene(swing(60)).solver.threads == 1


def test_a_live_key_keeps_their_number(monkeypatch):
    monkeypatch.setattr(threads, 'free_cores', lambda: 2)
    simulation = compile_scene(swing(101))
    monkeypatch.setattr(threads, 'free_cores', lambda: 1)
    simulation.step([SetKey('cloths.sheet.effects.stretch.warp', 100.0)])
    assert simulation.solver.threads == 2


def test_meshes_take_one_unless_they_collide_with_themselves(monkeypatch):
    """Threads share no constraints of a mesh, but the search for its pairs."""
    monkeypatch.setattr(threads, 'free_cores', lambda: 2)
    monkeypatch.setattr(BuiltContact, 'particles_per_thread', 10.0)
    monkeypatch.setitem(SHIPPED.particles_per_thread, GRID, 10.0)
    assert compile_scene(load_scene('balloon', {'solver.threads': 0})).solver.threads == 1
    assert compile_scene(load_scene('shirt', {'solver.threads': 0})).solver.threads == 2


@pytest.mark.parametrize('name, cloth, effects', [
    ('drape', 'cover', ['contact']), ('fold', 'napkin', ['self_collision', 'contact'])])
def test_contact_takes_more_than_a_grid(name, cloth, effects, monkeypatch):
    monkeypatch.setattr(threads, 'free_cores', lambda: 8)
    for side in (12, 40, 60):
        found = compile_scene(load_scene(name, {
            f'cloths.{cloth}.grid.resolution': [side, side], 'solver.threads': 0}))
        least = max(SHIPPED.for_thread(effect) for effect in effects)
        assert found.solver.threads == paying(side**2, least, 8)


def test_the_table_of_a_machine_has_its_own_number(tmp_path, monkeypatch):
    monkeypatch.setattr(threads, 'free_cores', lambda: 8)
    raw = yaml.safe_load(table_text(SHIPPED, 'some CPU'))
    for given in ({'grid': 900.0}, 900.0):    # one number is that of grids
        raw['particles_per_thread'] = given
        file = tmp_path / f'{type(given).__name__}.yaml'
        file.write_text(yaml.safe_dump(raw))
        scene = swing(60, **{'solver.cost_table': str(file)})
        assert compile_scene(scene).solver.threads == 4
    raw['particles_per_thread'] = {'contact': 50.0, 'self_collision': 200.0}
    (tmp_path / 'contact.yaml').write_text(yaml.safe_dump(raw))
    for name, cloth, expected in (('drape', 'cover', 8), ('fold', 'napkin', 2)):
        scene = load_scene(name, {f'cloths.{cloth}.grid.resolution': [20, 20],
                                  'solver.threads': 0,
                                  'solver.cost_table': str(tmp_path / 'contact.yaml')})
        assert compile_scene(scene).solver.threads == expected, 'the largest number decides'


def test_cores_are_those_that_the_process_may_use():
    assert free_cores() == len(os.sched_getaffinity(0))
