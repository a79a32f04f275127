"""A scene file at the door: what is understood, and what a user is told of the rest."""

import os
from pathlib import Path
import time

import pytest

from xpbd_ros.effects import EFFECTS
from xpbd_ros.errors import InputError
from xpbd_ros.scene.load import load_scene, scene_from_mapping, scene_from_text, settings_overrides

FLAG = """\
cloths:
  flag:
    grid: {size: [1.2, 0.8], resolution: [4, 3]}
    density: 0.15
    effects:
      stretch: {warp: 800.0, weft: 800.0}
"""
TOP = ('(known: gravity, frame_id, frame_rate, duration, solver, cloths, effects, inputs, robots, '
       'pins, colliders, seams)')


def read(text, **options):
    """Return a scene given as text."""
    return scene_from_text(text, where='flag.yaml', name='flag', **options)


def refusal(text, **options):
    """Return what a user is told about a scene."""
    with pytest.raises(InputError) as error:
        read(text, **options)
    assert '\n' not in str(error.value)
    assert len(str(error.value)) < 400
    return str(error.value)


@pytest.mark.smoke
@pytest.mark.parametrize('before, after, text', [
    ('stretch:', 'strech:', "cloths.flag.effects.strech: unknown effect; did you mean 'stretch'? "
     f'(known: {", ".join(name for name in EFFECTS if EFFECTS[name] == "cloth")})'),
    ('warp: 800.0', 'warp: -1', 'cloths.flag.effects.stretch.warp: must be > 0 N/m (got -1)'),
    ('warp: 800.0', 'warp: 0', 'cloths.flag.effects.stretch.warp: must be > 0 N/m (got 0)'),
    ('warp: 800.0', 'wrap: 800.0', "cloths.flag.effects.stretch.wrap: unknown key; did you mean "
     "'warp'? (known: warp, weft, compliance)"),
    ('warp: 800.0', 'warp: .nan',
     'cloths.flag.effects.stretch.warp: must be finite N/m (got nan)'),
    ('warp: 800.0', 'warp: soft',
     "cloths.flag.effects.stretch.warp: must be a number in N/m (got 'soft')"),
    ('warp: 800.0', 'warp: ', 'cloths.flag.effects.stretch.warp: has no value; give it one (N/m), '
     'or leave it out'),
    ('warp: 800.0', 'warp: [1]',
     'cloths.flag.effects.stretch.warp: must be a number in N/m (got [1])'),
    ('density: 0.15', 'density: -0.15', 'cloths.flag.density: must be > 0 kg/m² (got -0.15)'),
    ('density: 0.15', 'density: .inf', 'cloths.flag.density: must be finite kg/m² (got inf)'),
    ('density: 0.15', 'density: true',
     'cloths.flag.density: must be a number in kg/m² (got True)'),
    ('density: 0.15', 'density: 2001-01-01',
     'cloths.flag.density: must be a number in kg/m² (got datetime.date(2001, 1, 1))'),
    ('density: 0.15', 'density: 0x' + 'f' * 6000,
     'cloths.flag.density: must be finite kg/m² (got a number of 24000 bits)'),
    ('    density: 0.15\n', '', 'cloths.flag.density: missing (kg/m²); or name a material'),
    ('[1.2, 0.8]', '[1.2]', 'cloths.flag.grid.size: must be 2 numbers in m (got 1)'),
    ('[1.2, 0.8]', '1.2', 'cloths.flag.grid.size: must be a list of 2 numbers in m (got 1.2)'),
    ('[1.2, 0.8]', '[1.2, 0]', 'cloths.flag.grid.size[1]: must be > 0 m (got 0)'),
    ('[4, 3]', '[4.5, 3]',
     'cloths.flag.grid.resolution[0]: must be a whole number (got 4.5)'),
    ('[4, 3]', '[0, 3]', 'cloths.flag.grid.resolution[0]: must be at least 1 (got 0)'),
    ('[4, 3]', '[4, 100000]',
     'cloths.flag.grid.resolution[1]: must be at most 10000 (got 100000)'),
    ('[4, 3]', '[3000, 2000]', 'cloths.flag.grid: resolution: must be at most 4000000 particles '
                               'in all (got 3000 × 2000 = 6000000)'),
    ('{warp: 800.0, weft: 800.0}', '800',
     'cloths.flag.effects.stretch: must be a mapping (got 800)'),
    ('  flag:', '  my flag:',
     'cloths.my flag: a name must match [A-Za-z_][A-Za-z0-9_]*'),
    ('  flag:', '  2:', 'cloths.2: a name must match [A-Za-z_][A-Za-z0-9_]*'),
    ('cloths:', 'cloth:', f"cloth: unknown key; did you mean 'cloths'? {TOP}"),
    ('      stretch', '      contact: {thickness: 0.01}\n      stretch',
     'cloths.flag.effects.contact: belongs under effects')])
def test_a_mistake_in_a_cloth_names_key_value_unit_and_remedy(before, after, text):
    assert FLAG.count(before) == 1
    assert refusal(FLAG.replace(before, after)) == f'flag.yaml: {text}'


@pytest.mark.parametrize('added, text', [
    ('effects: {friction: {}}',
     'effects.friction: needs contact or self_collision, and the scene has neither'),
    ('effects: {stretch: {warp: 1, weft: 1}}',
     'effects.stretch: belongs under cloths.<name>.effects'),
    ('effects: {dampng: {rate: 1}}', "effects.dampng: unknown effect; did you mean 'damping'? "
     f'(known: {", ".join(name for name in EFFECTS if EFFECTS[name] == "scene")})'),
    ('effects: {damping: {}}', 'effects.damping.rate: missing (1/s)'),
    ('effects: {damping: {rate: -1}}', 'effects.damping.rate: must be at least 0 1/s (got -1)'),
    ('colliders: {floor: {plane: {}}}',
     'colliders: needs effects.contact, and the scene does not name it'),
    ('effects: {contact: {thickness: 0.01}}\ncolliders: {floor: {plane: }}',
     'colliders.floor.plane: has no value; give it {}, or leave it out'),
    ('pins: [left]', "pins: must be a mapping (got ['left'])"),
    ('pins: {left: {cloth: flag, at: 3}}', 'pins.left.at: must be text or a list (got 3)'),
    ('pins: {left: {at: corner_00}}', 'pins.left.cloth: missing'),
    ('pins: {left: {cloth: flag, at: [0, x]}}',
     "pins.left.at[1]: must be a number (got 'x')"),
    ('gravity: -9.81', 'gravity: must be a list of 3 numbers in m/s² (got -9.81)'),
    ('effects: {wind: 5}', 'effects.wind: must be a mapping {velocity: m/s} (got 5)'),
    ('gravity: [0, 0]', 'gravity: must be 3 numbers in m/s² (got 2)'),
    ('gravity: [0, 0, -.inf]', 'gravity[2]: must be finite m/s² (got -inf)'),
    ('frame_rate: 0.5', 'frame_rate: must be at least 1 Hz (got 0.5)'),
    ('frame_rate: 20000', 'frame_rate: must be at most 10000 Hz (got 20000)'),
    ('frame_id: ""', "frame_id: must be text (got '')"),
    ('frame_id: /map', "frame_id: TF frames have no leading '/'; take 'map'"),
    ('duration: 0', 'duration: must be > 0 s (got 0)'),
    ('solver: {substeps: 0}', 'solver.substeps: must be at least 1 (got 0)'),
    ('solver: {method: gauss_siedel}', "solver.method: unknown value; did you mean "
     "'gauss_seidel'? (known: auto, gauss_seidel, gauss_seidel_symmetric, line, jacobi, explicit; "
     "got 'gauss_siedel')"),
    ('solver: fast', "solver: must be a mapping (got 'fast')"),
    ('wind: {}', f'wind: unknown key {TOP}')])
def test_a_mistake_in_the_rest_is_told_too(added, text):
    assert refusal(f'{FLAG}{added}\n') == f'flag.yaml: {text}'


@pytest.mark.parametrize('scene, text', [
    ('', 'cloths: missing; a scene needs at least one cloth'),
    ('cloths: {}', 'cloths: missing; a scene needs at least one cloth'),
    ('cloths: {flag: }', "cloths.flag: needs either 'grid' or 'mesh', and only one of them"),
    ('3', 'the scene: must be a mapping (got 3)'),
    (FLAG + 'gravity: [0, 0, -1]\ngravity: [0, 0, -2]\n',
     "line 8, column 1: key 'gravity' is given twice"),
    (FLAG + '  flag: {}\n', "line 7, column 3: key 'flag' is given twice"),
    (FLAG + '? [a, b]\n: 1\n', 'line 7, column 3: a key must be a name'),
    (FLAG + '? !!set {a}\n: 1\n', 'line 7, column 3: a key must be a name'),
    (FLAG + '\tx: 1\n',
     "line 7, column 1: found character '\\t' that cannot start any token"),
    (FLAG + 'gravity: [0, 0\n', "line 8, column 1: expected ',' or ']', but got '<stream end>'"),
    (FLAG + '---\n' + FLAG, 'line 7, column 1: expected a single document in the stream, but '
     'found another document'),
    (FLAG.replace('grid:', '<<: {density: 1}\n    grid:'),
     "line 3, column 5: merge keys ('<<') are not supported; write their keys out"),
    (FLAG + 'duration: 010\n',
     'line 7, column 11: 010 is 8 in YAML 1.1 (base 8); write 8, or 10'),
    (FLAG + 'gravity: [0, 0, -0_12]\n',
     'line 7, column 17: -0_12 is -10 in YAML 1.1 (base 8); write -10, or -12'),
    (FLAG + 'duration: 1:30\n',
     "line 7, column 11: 1:30 is 90 in YAML 1.1 (base 60); write 90, or '1:30' for text"),
    (FLAG + 'duration: 1:30.5\n',
     "line 7, column 11: 1:30.5 is 90.5 in YAML 1.1 (base 60); write 90.5, or '1:30.5' for text"),
    (FLAG.replace('0.15', '!!python/object/apply:os.getcwd []'),
     'line 4, column 14: could not determine a constructor for the tag '
     "'tag:yaml.org,2002:python/object/apply:os.getcwd'")])
def test_what_is_no_scene_at_all_is_told_with_its_place(scene, text):
    assert refusal(scene) == f'flag.yaml: {text}'


def test_numbers_that_mean_the_same_to_any_base_are_taken():
    scene = read(FLAG + 'duration: 007\ngravity: [00, -0.0, -01.5]\nframe_rate: 0x40\n')
    assert (scene.top.duration, scene.top.gravity, scene.top.frame_rate) == (
        7.0, (0.0, 0.0, -1.5), 64.0)


def bomb(levels=9):
    """Return aliases of aliases: a few hundred bytes that spell out as 10 ** levels words."""
    lines = ['&a0 [' + ', '.join('x' * 10) + ']']
    lines += [f'&a{k} [' + ', '.join([f'*a{k - 1}'] * 10) + ']' for k in range(1, levels)]
    return '[' + ', '.join(lines) + ']'


@pytest.fixture(scope='module')
def plain():
    """Return what a list of 5000 numbers takes to be read and refused here [s]."""
    start = time.process_time()
    with pytest.raises(InputError):
        read(FLAG + f'gravity: {list(range(5000))}\n')
    return time.process_time() - start


@pytest.mark.parametrize('scene', [
    FLAG.replace('0.15', bomb()), FLAG + f'duration: {bomb()}\n', FLAG + f'? {bomb()}\n: 1\n',
    FLAG + f'gravity: {bomb()}\n', FLAG + f'effects: {bomb()}\n', bomb(),
    FLAG + f'frame_id: {bomb()}\n', FLAG + f'pins: {{a: {bomb()}}}\n',
    'cloths: &c {a: *c}', 'gravity: &g [*g, *g, *g]', '&s {cloths: *s}',
    FLAG + 'duration: &d [*d]',
    '[' * 2000, '{a: ' * 2000, FLAG + 'x' * 300_000 + ': 1\n'])
def test_aliases_and_nesting_are_refused_at_once(scene, plain):
    """Nothing is spelt out: at most as long as 100 000 numbers, not 10 ** 9 words."""
    start = time.process_time()
    with pytest.raises(InputError) as error:
        read(scene)
    assert time.process_time() - start < 20.0 * plain
    assert len(str(error.value)) < 300 + scene.count('xxx')


def test_numbers_may_be_written_without_a_dot():
    """YAML 1.1 takes 1e-5 for text."""
    scene = read(FLAG.replace('warp: 800.0', 'warp: 1e-5').replace('0.15', '2E+1'))
    assert scene.cloth_effects['flag']['stretch'].warp == 1e-5
    assert scene.cloths['flag'].density == 20.0
    assert read(FLAG + 'solver: {substeps: 1e1}').top.solver.substeps == 10


@pytest.mark.smoke
def test_what_is_left_out_takes_its_default():
    scene = read(FLAG)
    assert scene.top.gravity == (0.0, 0.0, -9.80665)
    assert scene.top.frame_id == 'world'
    assert scene.top.frame_rate == 60.0
    assert scene.top.solver.method == 'auto'
    assert scene.cloths['flag'].pose.orientation == (0.0, 0.0, 0.0, 1.0)
    assert scene.sections == {}
    assert scene.effect_names == ('stretch',)
    assert read(FLAG + 'pins: {}').effect_names == ('pin', 'stretch')


def test_both_forms_of_stretch_are_read():
    assert read(FLAG).cloth_effects['flag']['stretch'].compliance is None
    form = read(FLAG.replace('warp: 800.0, weft: 800.0', 'compliance: 0'))
    assert form.cloth_effects['flag']['stretch'].compliance == 0.0
    assert refusal(FLAG.replace('weft', 'compliance')) == (
        'flag.yaml: cloths.flag.effects.stretch: needs either warp and weft (N/m) or compliance '
        '(m/N), not both')


def test_an_orientation_is_normalised_and_nonsense_refused():
    pose = '    pose: {orientation: [0, 0, 0.70710678, 0.70710678]}\n    density'
    q = read(FLAG.replace('    density', pose)).cloths['flag'].pose.orientation
    assert sum(c * c for c in q) == pytest.approx(1.0, abs=1e-15)
    assert refusal(FLAG.replace('    density', pose.replace('0.70710678', '1'))) == (
        'flag.yaml: cloths.flag.pose.orientation: must be a unit quaternion x y z w '
        '(got length 1.41)')


def test_overrides_stand_in_for_what_the_file_says():
    scene = read(FLAG, overrides={'solver.substeps': 32, 'gravity': [0.0, 0.0, -1.0],
                                  'cloths.flag.effects.stretch.warp': '1e3',
                                  'effects.damping.rate': 2})
    assert scene.top.solver.substeps == 32
    assert scene.top.gravity == (0.0, 0.0, -1.0)
    assert scene.cloth_effects['flag']['stretch'].warp == 1000.0
    assert scene.effects['damping'].rate == 2.0
    assert scene.raw['solver'] == {'substeps': 32}


@pytest.mark.parametrize('key, value, text', [
    ('cloths.flag.density.x', 1, "'density' holds a value, so it has no key 'x'"),
    ('cloths.flag.densty', 1, "cloths.flag.densty: unknown key; did you mean 'density'? "
     '(known: grid, mesh, density, material, pose, friction, static_friction, effects)'),
    ('', 1, "'' is not a key"),
    ('cloths..density', 1, "'.density' is not a key"),
    ('solver.substeps', 3.5, 'solver.substeps: must be a whole number (got 3.5)'),
    ('solver', None, 'ok')])
def test_an_override_is_checked_like_the_file(key, value, text):
    if text == 'ok':
        assert read(FLAG, overrides={key: value}).top.solver.method == 'auto'
    else:
        assert refusal(FLAG, overrides={key: value}) == f'flag.yaml: {text}'


@pytest.mark.parametrize(('key', 'value', 'text'), [
    ('cloths.flg.grid', {'size': [1, 1], 'resolution': [4, 4]},
     "cloths.flg: unknown cloth; did you mean 'flag'? (known: flag)"),
    ('cloths.flg.density', 0.3, "cloths.flg: unknown cloth; did you mean 'flag'? (known: flag)"),
    ('pins.lefft.slip', 3.0, "pins.lefft: unknown pin; did you mean 'left'? (known: left)"),
    ('pins.lefft', {'cloth': 'flag', 'at': 'corner_00'},
     "pins.lefft: unknown pin; did you mean 'left'? (known: left)"),
    ('colliders.bal.sphere.radius', 0.3,
     "colliders.bal: unknown collider; did you mean 'ball'? (known: ball)"),
    ('colliders.bal', {'sphere': {'radius': 0.1}},
     "colliders.bal: unknown collider; did you mean 'ball'? (known: ball)"),
    ('robots.rm.description', 'other.urdf',
     "robots.rm: unknown robot; did you mean 'arm'? (known: arm)"),
    ('seams.side.compliance', 0.1, 'seams.side: the scene has none')])
def test_an_override_never_makes_a_new_member(key, value, text):
    scene = FLAG + """
pins: {left: {cloth: flag, at: corner_00}}
colliders: {ball: {sphere: {radius: 0.1}}}
robots: {arm: {description: arm.urdf}}
effects: {contact: {thickness: 0.004}}
"""
    assert refusal(scene, overrides={key: value}) == f'flag.yaml: {text}'


def test_an_override_may_give_a_whole_section():
    scene = read(FLAG, overrides={'pins': {'new': {'cloth': 'flag', 'at': 'corner_00'}},
                                  'pins.new.slip': 2.0})
    assert scene.sections['pins']['new'].slip == 2.0


def test_a_mapping_given_is_not_written_to():
    raw = {'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [2, 2]}, 'density': 1}}}
    scene_from_mapping(raw, where='x', name='x', overrides={'cloths.c.density': 2})
    assert raw['cloths']['c']['density'] == 1


def write(folder: Path, content: bytes, name: str = 'flag.yaml') -> str:
    """Write a file and return its name."""
    (folder / name).write_bytes(content)
    return str(folder / name)


@pytest.mark.smoke
def test_a_file_is_found_by_path_and_a_shipped_scene_by_name(tmp_path):
    scene = load_scene(write(tmp_path, FLAG.encode()))
    assert scene.name == 'flag'
    assert scene.where == str(tmp_path / 'flag.yaml')
    assert load_scene(write(tmp_path, b'\xef\xbb\xbf' + FLAG.encode())).cloths.keys() == {'flag'}
    assert load_scene('swing').name == 'swing'


def test_a_folder_of_equal_name_does_not_hide_a_shipped_scene(tmp_path, monkeypatch):
    """Runs are written to folders, and one may well be called after its scene."""
    (tmp_path / 'swing').mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_scene('swing').where.endswith('scenes/swing.yaml')


def test_a_file_that_cannot_be_read_is_told_in_one_line(tmp_path):
    def told(name):
        with pytest.raises(InputError) as error:
            load_scene(name)
        assert '\n' not in str(error.value)
        return str(error.value)

    assert told('no/such.yaml') == 'no/such.yaml: no such file'
    (tmp_path / 'folder.yaml').mkdir()
    assert told(str(tmp_path / 'folder.yaml')) == f'{tmp_path}/folder.yaml: is a folder'
    assert told('swng').startswith("swng: unknown scene; did you mean 'swing'? (known: ")
    assert told('swng').endswith('; or give a .yaml file')
    name = write(tmp_path, b'cloths: \xff\n')
    assert told(name) == f'{name}: not UTF-8 text (invalid start byte at byte 8)'
    name = write(tmp_path, b'cloths: \x00\n')
    assert told(name) == (f'{name}: unacceptable character #x0000: special characters are not '
                          'allowed')
    name = write(tmp_path, b'#' * (17 * 2**20))
    assert told(name) == f'{name}: larger than 16 MiB'
    assert told(str(tmp_path)).startswith(f'{tmp_path}: is a folder; give a .yaml file, or one '
                                          'of arch, bag, ')
    (tmp_path / 'run_0.mcap').touch()
    assert told(str(tmp_path)).startswith(f'{tmp_path}: is a folder of a log, which xpbd_ros '
                                          'resim solves again; give a .yaml file, or one of ')
    assert told('').startswith("'': is a folder; give a .yaml file, or one of arch, bag, ")
    assert told('a\0b').startswith('a\0b: unknown scene (known: ')
    name = write(tmp_path, b'{}', os.fsdecode(b'a\xff.yaml'))
    assert told(name).startswith(f'{name}: its name is no text in the encoding of file names, ')


def test_a_settings_file_gives_overrides(tmp_path):
    name = write(tmp_path, b'solver: {substeps: 7, iterations: 2}\n', 'settings.yaml')
    assert settings_overrides(name) == {'solver.substeps': 7, 'solver.iterations': 2}
    for content, text in ((b'substeps: 7', "must hold one section, 'solver:'"),
                          (b'solver: 3', 'solver: must be a mapping (got 3)'),
                          (b'solver: {substep: 3}', "solver.substep: unknown key; did you mean "
                                                    "'substeps'?"),
                          (b'solver: {substeps: 0}', 'solver.substeps: '),
                          (b'\xff', 'cannot be read (')):
        name = write(tmp_path, content, 'settings.yaml')
        with pytest.raises(InputError) as error:
            settings_overrides(name)
        assert str(error.value).startswith(f'{name}: {text}')
    with pytest.raises(InputError, match='no such file'):
        settings_overrides(str(tmp_path / 'none.yaml'))


def test_what_is_quoted_is_kept_short_and_on_one_line():
    name = 'x\n' * 5000
    with pytest.raises(InputError) as refused:
        scene_from_mapping({'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [2, 2]},
                                             'density': name}}}, where='a.yaml', name='a')
    assert '\n' not in str(refused.value)
    with pytest.raises(InputError, match='at least 1e-300 kg/m² in size'):
        scene_from_mapping({'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [2, 2]},
                                             'density': 5e-324}}}, where='a.yaml', name='a')
