"""An effect that the scene does not name is absent: from imports, memory and machine code."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from support.kinds import kinds_of
from support.scenes import EXAMPLES, run, SHAPES, simulate, with_effects
from xpbd_ros.effects import EFFECTS
from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend import jit
from xpbd_ros.sim.stepping import stages

ROOT = Path(__file__).resolve().parents[2]
CHILD = """
import json, sys, warnings
from support.scenes import run, simulate
scene, kernels = json.loads(sys.argv[1])
simulation = simulate(**scene)
simulation.compile()
run(simulation, 3)
with warnings.catch_warnings():
    warnings.simplefilter('ignore')    # of a cached step there is no text to look at
    text = ''.join(simulation._step.kernel.inspect_asm().values())
print(json.dumps({
    'imported': [name for name in sys.modules if name.startswith('xpbd_ros.effects.')],
    'kernels': [name for name in kernels if f'{len(name)}{name}B' in text],    # as mangled
    'data': [type(data).__name__ for data in simulation._tuple],
    'reaction': simulation.state.reaction is not None,
    'cached': bool(simulation._step.kernel.stats.cache_hits)}))
"""
SCENES = {
    ('contact',): {'colliders': {'s': {'plane': {}}},
                   'scene_effects': {'contact': {'thickness': 0.01}}},
    ('stretch',): {'effects': {'stretch': {'compliance': 1e-3}}},
}


def kernels(names=EFFECTS, *, kinds=None, without=()):
    """Return the names of the kernels of some effects, of these types, but for some stages."""
    theirs = set().union(*map(kinds_of, names))
    return sorted({kernel.__name__ for (stage, kind), kernel in stages.KERNELS.items()
                   if kind in theirs and stage not in without
                   and (kinds is None or kind.__name__ in kinds)})


OF_SHAPES = ['grid_distance', 'ground_distance']
OF_PADS = ['become_rigid', 'calm_particle']
GROUND = {'g': {'heights': {'size': [1.0, 1.0], 'values': [[0.0, 0.0], [0.0, 0.0]]}}}


def look(names, cache, **more):
    """Run a scene with these effects in a process of its own; say what was there."""
    path = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    arguments = json.dumps([{**SCENES[names], **more}, [*kernels(), *OF_SHAPES, *OF_PADS]])
    child = subprocess.run(
        [sys.executable, '-c', CHILD, arguments], check=True, capture_output=True, text=True,
        env={**os.environ, 'PYTHONPATH': path, 'NUMBA_CACHE_DIR': str(cache)}, timeout=300)
    return json.loads(child.stdout)


@pytest.mark.parametrize('module', ['cli.run', 'ros.cloth_node', 'view.live'])
def test_a_program_imports_no_effect_before_it_has_a_scene(module):
    found = subprocess.run(
        [sys.executable, '-c', f'import sys, xpbd_ros.{module}; print(*sys.modules)'],
        check=True, capture_output=True, text=True, cwd=ROOT, timeout=300).stdout.split()
    assert not [name for name in found if name.startswith('xpbd_ros.effects.')]
    assert 'xpbd_ros.sim.contact.broad_phase' not in found


def test_every_effect_has_kernels_of_its_own_name():
    assert all(kernels([name]) for name in EFFECTS)
    assert sum(len(kernels([name])) for name in EFFECTS) == len(kernels())


@pytest.mark.parametrize('scenes', [
    pytest.param([('stretch',)], id='one scene'),
    pytest.param(list(SCENES), id='one after the other', marks=pytest.mark.slow)])
def test_machine_code_holds_the_kernels_of_the_scene_only(scenes, tmp_path):
    """
    The scene with contact runs first, so that the other meets what it left in the cache.

    No effect asks for forces; the method neither sweeps back nor solves lines nor leaps.
    """
    for names in scenes:
        seen = look(names, tmp_path)
        assert not seen['cached']
        assert seen['kernels'] == kernels(names, kinds=seen['data'], without=(
            stages.accumulate_reactions, stages.project_back, stages.solve_lines,
            stages.add_explicit_forces, stages.damp_half_kick, stages.react_to_half_kick))
        assert seen['imported'] == [f'xpbd_ros.effects.{name}' for name in names]
        assert [name.lower() for name in seen['data']] == list(names)
        assert not seen['reaction']


@pytest.mark.slow
def test_machine_code_holds_the_shapes_of_the_colliders_only(tmp_path):
    """Ground is, once there is some; the test above has seen that a scene without has neither."""
    assert OF_SHAPES[1:] == [name for name in look(
        ('contact',), tmp_path, colliders=GROUND)['kernels'] if name in OF_SHAPES]


@pytest.mark.slow
def test_machine_code_holds_pads_only_where_a_collider_has_one(tmp_path):
    """The quick test above has seen that contact without pads has none of their kernels."""
    seen = look(('contact',), tmp_path, colliders={'s': {'plane': {}, 'pad': {'stiffness': 1e8}}})
    assert [name for name in seen['kernels'] if name in OF_PADS] == OF_PADS


def test_a_step_from_the_cache_imports_nothing_more():
    """Numba's cache holds the types of all scenes that it has seen; each has a folder here."""
    root = jit.CACHE_FOLDER.parents[1]    # of this process, with all that it has compiled
    simulate(**SCENES['stretch',]).compile()
    seen = look(('stretch',), root)
    assert seen['cached']
    assert seen['imported'] == ['xpbd_ros.effects.stretch']


def test_loading_a_scene_imports_only_the_effects_it_names():
    code = ('import sys; from xpbd_ros.scene.load import load_scene; '
            "from xpbd_ros.scene.compile import compile_scene; load_scene('swing'); "
            "print(sorted(name for name in sys.modules if name.startswith('xpbd_ros.effects.')))")
    child = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                           check=True, env={**os.environ, 'PYTHONPATH': str(ROOT)}, timeout=60)
    assert child.stdout.strip() == str([f'xpbd_ros.effects.{name}'
                                        for name in ('pin', 'shear', 'stretch')])


def test_a_scene_has_its_effects_only_in_projection_order():
    assert tuple(with_effects(names=EFFECTS).effects) == tuple(
        name for name in EFFECTS if name not in SHAPES)
    simulation = simulate((3, 1), effects={'stretch': EXAMPLES['stretch'],
                                           'bend': EXAMPLES['bend']})
    assert tuple(simulation.effects) == ('bend', 'stretch')
    assert len(simulation._tuple) == 2


def test_what_is_turned_off_makes_no_difference():
    """A contact that nothing can reach gives the bits of a scene without one."""
    hashes = []
    for extra in ({}, {'contact': {'thickness': 0.01}, 'friction': {}}):
        simulation = simulate((5, 4), effects={'stretch': {'compliance': 1e-3}}, substeps=3,
                              scene_effects={'damping': {'rate': 0.5}, 'pin': {}, **extra})
        for _ in range(20):
            simulation.step()
        hashes.append(simulation.hash())
    assert hashes[0] == hashes[1]


WITHOUT = """
import json, sys
from pathlib import Path
from support.scenes import run, simulate
scene, kernels, absent = json.loads(sys.argv[1])
import xpbd_ros
assert not (Path(xpbd_ros.__file__).parent / 'effects' / f'{absent}.py').exists()
simulation = simulate(**scene)
simulation.compile()
run(simulation, 10)
text = ''.join(simulation._step.kernel.inspect_asm().values())
print(json.dumps({
    'cached': bool(simulation._step.kernel.stats.cache_hits),
    'kernels': [name for name in kernels if f'{len(name)}{name}B' in text],
    'hash': simulation.hash()}))
"""
CLOTH = {'shear': {'stiffness': 15.0}, 'stretch': {'warp': 60.0, 'weft': 40.0}}
AROUND = {'damping': {'rate': 1.0}, 'force': {'per_mass': [0.1, 0.0, 0.0]}}
BESIDE = {name: {'contact': {'thickness': 0.01}} for name in ('friction', 'self_collision')}
"""what the scene has as well, since the absent effect works with it"""


def scene_without(absent):
    """Return a scene of four effects, less the one that is absent."""
    named = {'effects': CLOTH, 'scene_effects': {**AROUND, **BESIDE.get(absent, {})}}
    return {'grid': [5, 4], 'substeps': 3, **{key: {
        name: value for name, value in effects.items() if name != absent}
        for key, effects in named.items()}}


@pytest.mark.slow
@pytest.mark.parametrize('absent', EFFECTS)
def test_deleting_the_file_of_an_unused_effect_keeps_all_bits(absent, tmp_path):
    """The file deleted, the cache empty: the same state, and its kernels in no machine code."""
    for source in ('xpbd_ros', 'config', 'test'):
        shutil.copytree(ROOT / source, tmp_path / source,
                        ignore=shutil.ignore_patterns('__pycache__'))
    (tmp_path / 'xpbd_ros' / 'effects' / f'{absent}.py').unlink()
    own, scene = kernels([absent]), scene_without(absent)
    child = subprocess.run(
        [sys.executable, '-c', WITHOUT, json.dumps([scene, kernels(), absent])],
        check=True, capture_output=True, text=True, cwd=tmp_path, timeout=300,
        env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path / 'cache'),
             'PYTHONPATH': os.pathsep.join([str(tmp_path), str(tmp_path / 'test')])})
    seen = json.loads(child.stdout)
    simulation = simulate(**{**scene, 'grid': tuple(scene['grid'])})
    run(simulation, 10)
    assert not seen['cached']
    assert seen['hash'] == simulation.hash()
    assert seen['kernels']
    assert not set(seen['kernels']) & set(own)


def test_an_effect_whose_file_is_gone_is_missed_by_name(monkeypatch):
    """Only a scene that names it meets the gap."""
    monkeypatch.setitem(sys.modules, 'xpbd_ros.effects.wind', None)
    with pytest.raises(InputError, match='effects.wind: this installation has no such effect'):
        simulate((2, 1), scene_effects={'wind': {}})
