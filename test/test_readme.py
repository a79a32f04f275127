"""Everything that the README and the pages of doc/ show is run."""

from dataclasses import fields
import importlib
from pathlib import Path
import re
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

from support.keys import tables
from support.meshes import disc, obj_text
from support.tiers import slow
from xpbd_ros.demo.domain import private_environment
from xpbd_ros.effects import EFFECTS, load
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.frames import followers
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.scene.materials import MATERIALS, pulled
from xpbd_ros.share import share_folder

README = Path(__file__).parents[1] / 'README.md'
pytestmark = pytest.mark.skipif(not README.is_file(), reason='the README is not installed')


def text(page: str = 'README') -> str:
    """Return the README, or a page of doc/."""
    file = README if page == 'README' else README.parent / 'doc' / f'{page}.md'
    return file.read_text(encoding='utf-8')


def block(language: str, page: str = 'README') -> str:
    """Return the only block of code of a page in a language."""
    found = re.findall(rf'```{language}\n(.*?)```', text(page), re.S)
    assert len(found) == 1
    return found[0]


def effects_table() -> str:
    """Return the rows of the table of effects in doc/effects.md."""
    rows = []
    for name, scope in EFFECTS.items():
        effect = load(name)
        units = [(field.name, field.metadata['unit']) for field in fields(effect.parameters)]
        parameters = ', '.join(f'`{key}` ({unit})' if unit else f'`{key}`' for key, unit in units)
        about = importlib.import_module(f'xpbd_ros.effects.{name}').__doc__.strip()
        about = about.split('\n\n')[0].replace('\n', ' ').split(': ', 1)[1].rstrip('.')
        home = 'a cloth' if scope == 'cloth' else 'the scene'
        rows.append(f'| `{name}` | {home} | {parameters} | {about} |')
    return '\n'.join(rows)


def test_table_of_effects_is_what_their_files_say():
    assert effects_table() in text('effects'), f'doc/effects.md should hold\n{effects_table()}'


def test_table_of_keys_is_what_their_declarations_say():
    assert tables() in text('keys'), f'doc/keys.md should hold\n{tables()}'


def test_table_of_places_is_where_pins_hold():
    cloth = yaml.safe_load(block('yaml', 'scenes'))['cloths']['towel']
    rows = '\n'.join(re.findall(r'^\| `(?:corner|edge)_.*$', text('scenes'), re.M))
    points = re.findall(r'\((.*?)\)|([xy]) = ([0-9.]+)', rows)
    for at, (corner, axis, value) in zip(re.findall(r'`(\w+)`', rows), points, strict=True):
        frame = compile_scene(scene_from_text(yaml.safe_dump(
            {'cloths': {'towel': cloth}, 'pins': {'a': {'cloth': 'towel', 'at': at}}}),
            where='README', name='readme')).frame()
        held = frame.x[frame.inv_mass == 0.0]
        if corner:
            np.testing.assert_allclose(held, [[*map(float, corner.split(',')), 0.0]])
        else:
            np.testing.assert_allclose(held[:, 'xy'.index(axis)], float(value))


def test_shipped_scenes_are_named_and_have_a_picture():
    for file in (share_folder() / 'scenes').glob('*.yaml'):
        assert f'`{file.stem}`' in text('scenes')
        if file.stem != 'demo':    # which has a larger one of its own
            size = (README.parent / f'resource/images/{file.stem}.png').stat().st_size
            assert 3_000 < size < 60_000


def test_table_of_hard_cases_names_each_and_its_guards():
    from xpbd_ros.study.stress import all_hard
    from xpbd_ros.study.stress.guards import GUARDS
    from xpbd_ros.study.stress.run import NODE_CASES
    rows = {}
    for line in re.findall(r'^\| H\d+ \|.*$', text('robustness'), re.M):
        id_, *cells = (cell.strip() for cell in line.split('|')[1:-1])
        rows[id_] = cells
    for id_, title in [*((one.id, one.title) for one in all_hard()), *NODE_CASES.items()]:
        assert rows[id_][0] == title
        passed, tried = map(int, rows[id_][1].split(' of '))
        assert 0 < passed <= tried
    for guard in GUARDS:
        assert guard.what in rows[guard.case][3]


def test_figures_of_the_readme_are_those_of_the_pages():
    numbers = sum(map(int, re.findall(r'^\| V\d+ \|[^|]*\| (\d+) \|', text('verification'),
                                      re.M)))
    assert f'| {numbers} of {numbers} hold ([verification]' in text()
    ours, theirs = ([sum(map(int, column)) for column in zip(*re.findall(
        rf'^\| H\d+ \|[^|]*\|{skipped} (\d+) of (\d+) \|', text('robustness'), re.M))]
        for skipped in ('', r'[^|]*\|'))
    assert (f'| {ours[0]} of {ours[1]}; of a textbook solver {theirs[0]} of the {theirs[1]} that '
            'it can run') in text()


def test_table_of_guards_names_each():
    from xpbd_ros.ros.guards import GUARDS
    rows = '\n'.join(re.findall(r'^\| `.*$', text('robustness'), re.M))
    assert all(f'`{name}`' in rows for name in GUARDS)


@pytest.mark.parametrize('page', ['README', slow('scenes')])
def test_example_scene_runs(page):
    simulation = compile_scene(scene_from_text(block('yaml', page), where=page, name='readme'))
    for _ in range(5):
        frame = simulation.step()
    assert np.isfinite(frame.x).all()


def indented(heading: str) -> str:
    """Return the only indented block of a section of doc/scenes.md."""
    section = text('scenes').split(f'## {heading}\n')[1].split('\n#')[0]
    (found,) = re.findall(r'\n\n((?:    .*\n)+)', section)
    return re.sub('^    ', '', found, flags=re.M)


def test_pin_example_says_what_pins_hold():
    scene, more = yaml.safe_load(block('yaml', 'scenes')), yaml.safe_load(indented('Pins'))
    effects = {**scene['effects'], **more['effects']}
    simulation = compile_scene(scene_from_text(yaml.safe_dump(
        {**scene, **more, 'effects': effects}), where='README', name='readme'))
    assert simulation.effects['pin'].held['left'].slip == 3.0
    assert simulation.effects['pin'].held['left'].compliance == 0.002


def test_example_of_inputs_follows_topics():
    scene = scene_from_text(indented('Topics of other programs'), where='README', name='readme')
    assert {each.name: each.frame for each in followers(scene)} == {
        'left': 'topic:/left_hand', 'right': 'topic:/trackers:right_hand',
        'ball': 'topic:/trackers:ball'}
    assert compile_scene(scene).frame().pins['left'].pose.position == pytest.approx(
        (-0.2, -0.2, 0.004))


def test_seam_example_sews():
    cloth = yaml.safe_load(block('yaml', 'scenes'))['cloths']['towel']
    simulation = compile_scene(scene_from_text(yaml.safe_dump(
        {'cloths': {'front': cloth, 'back': cloth}, **yaml.safe_load(indented('Seams'))}),
        where='README', name='readme'))
    assert len(simulation.effects['seam'].data.first) == 43 + 3


def test_mesh_example_runs(tmp_path):
    vertices, triangles = disc()
    (tmp_path / 'shirt.obj').write_text(obj_text(100.0 * vertices, triangles))
    simulation = compile_scene(scene_from_text(indented('Meshes'), where='README', name='readme',
                                               folder=tmp_path))
    assert simulation.cloths[0].mesh.warp == (0.0, 1.0, 0.0)
    assert simulation.frame().inv_mass.min() == 0.0


def test_collider_example_runs(tmp_path):
    corners = [(x, y, z) for x in (0, 90) for y in (0, 90) for z in (0, 90)]
    faces = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
    (tmp_path / 'bust.obj').write_text('\n'.join(
        [f'v {x} {y} {z}' for x, y, z in corners] + ['f ' + ' '.join(map(str, f)) for f in faces]))
    scene, more = yaml.safe_load(block('yaml', 'scenes')), yaml.safe_load(indented('Colliders'))
    simulation = compile_scene(scene_from_text(
        yaml.safe_dump({**scene, **more}), where='README', name='readme', folder=tmp_path))
    assert set(simulation.effects['contact'].placed) == {'floor', 'bust', 'ground'}
    assert simulation.effects['friction'].data.static is not None


def test_pad_example_has_two_pads():
    scene, more = yaml.safe_load(block('yaml', 'scenes')), yaml.safe_load(indented('Pads'))
    simulation = compile_scene(scene_from_text(yaml.safe_dump({**scene, **more}), where='README',
                                               name='readme'))
    np.testing.assert_array_equal(simulation.effects['contact'].colliders.stiffness[:2], 2e8)
    assert {key for key in simulation.stats() if key.startswith('pad_force_')} == {
        'pad_force_finger_a_n', 'pad_force_finger_b_n'}


def test_material_example_means_denim():
    (cloth,) = scene_from_text(indented('Materials'), where='README',
                               name='readme').cloth_effects.values()
    assert cloth['bend'].stiffness == MATERIALS['denim'].bend
    assert set(cloth) == {'stretch', 'shear', 'bend'}
    (solid,) = re.findall(r'or (\{young.*\}):', text('scenes'))
    assert scene_from_text(indented('Materials'), where='README', name='readme', overrides={
        'cloths.jeans.material': yaml.safe_load(solid)}).cloths['jeans'].density == 0.9


def test_table_of_materials_is_what_their_file_says():
    for name, sheet in MATERIALS.items():
        warp, weft = pulled(sheet)
        assert (f'| `{name}` | {sheet.density:g} | {warp:.0f} | {weft:.0f} | {sheet.shear:.0f} | '
                f'{1e6 * sheet.bend:.0f} |\n') in text('scenes')


PAGES = [README, README.parent / 'CONTRIBUTING.md', *sorted((README.parent / 'doc').glob('*.md'))]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_every_picture_and_page_that_is_named_is_there(page):
    for mark, name in re.findall(r'(!?)\[[^]]*\]\(([^)#]+)\)', page.read_text(encoding='utf-8')):
        assert (page.parent / name).stat().st_size > (10_000 if mark else 500), name


def slug(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r'[^\w -]', '', heading.lower()).replace(' ', '-')


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_every_heading_that_is_linked_to_is_there(page):
    for name, anchor in re.findall(r'\]\(([^)#]*)#([^)]+)\)', page.read_text(encoding='utf-8')):
        there = (page.parent / name if name else page).read_text(encoding='utf-8')
        assert anchor in map(slug, re.findall(r'^#+ (.*)$', there, re.M)), f'{name}#{anchor}'


def test_the_readme_is_short_and_names_every_page():
    assert len(text().splitlines()) <= 150
    for page in (README.parent / 'doc').glob('*.md'):
        assert f'(doc/{page.name})' in text()


CITATION = r'doc/numerics\.md\s+(\d+(?:\.\d+)?)\b'
CODE = sorted(file for folder in ('xpbd_ros', 'test') for file in (
    README.parent / folder).rglob('*.py') if file != Path(__file__))


def test_every_section_of_numerics_that_is_cited_exists():
    """A citation without a number, which the pattern would not see, is an error as well."""
    there = set(re.findall(r'^##+ (\d+(?:\.\d+)?)[. ]', text('numerics'), re.M))
    cited = {}
    for file in CODE:
        source = file.read_text(encoding='utf-8')
        found = re.findall(CITATION, source)
        assert len(found) == source.count('numerics.md'), file
        cited.update(dict.fromkeys(found, file))
    assert len(cited) > 20
    assert not {number: file for number, file in cited.items() if number not in there}


def test_sections_of_numerics_are_in_order_and_refer_to_others():
    there = re.findall(r'^##+ (\d+(?:\.\d+)?)[. ]', text('numerics'), re.M)
    assert there == sorted(there, key=lambda number: [int(part) for part in number.split('.')])
    assert len(set(there)) == len(there)
    named = re.findall(r'\((\d+(?:\.\d+)?(?:, \d+(?:\.\d+)?)*)\)', text('numerics'))
    assert len(named) > 10
    for number in ', '.join(named).split(', '):
        assert number in there, number


def test_the_page_of_the_node_has_its_topics_and_parameters():
    pytest.importorskip('rclpy', reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    from xpbd_ros.ros.inputs import INPUTS
    from xpbd_ros.ros.outputs import Outputs
    from xpbd_ros.ros.parameters import TABLE
    from xpbd_ros.ros.recorder import type_name
    simulation = compile_scene(scene_from_text(block('yaml'), where='README', name='readme'))
    topics = [*((topic, about.kind) for topic, about in INPUTS.items() if about.effect),
              *((topic, about.kind) for topic, about in Outputs(simulation, '', '').topics.items()
                if not about.log_only)]
    for topic, kind in topics:
        topic = re.sub(r'^pin/\w+/', 'pin/<name>/', topic)
        assert f'`~/{topic}` | {type_name(kind).replace("/msg/", "/")}' in text('node')
    for row in TABLE:
        live = 'yes' if row.live else 'no'
        assert (f'| `{row.name}` | `{row.default!r}` | {row.description} | {live} |\n'
                in text('node'))


@pytest.fixture(scope='module')
def node():
    """Return the environment of a node that runs the demo's scene."""
    pytest.importorskip('rclpy', reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    environment = private_environment()
    process = subprocess.Popen(
        [sys.executable, '-m', 'xpbd_ros', 'node', '--ros-args', '-p', 'scene:=demo'],
        env=environment, stderr=subprocess.PIPE, text=True)
    yield environment
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 0
    assert 'refused' not in said, said


def python(program: str, environment: dict) -> str:
    done = subprocess.run([sys.executable, '-c', program], env=environment, timeout=240,
                          capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_client_grasps_lifts_and_lets_go(node):
    said = python(block('python'), node)
    forces = [float(f) for f in re.findall(r'hand: (-?[0-9.]+) N', said)]
    assert min(forces) < -0.1, said


PUBLISH = """
import sys, time, yaml, rclpy
from rclpy.qos import QoSProfile
from importlib import import_module
from sensor_msgs.msg import MultiDOFJointState, PointCloud2

def fill(message, values):
    for key, value in values.items():
        now = getattr(message, key)
        kind = message.get_fields_and_field_types()[key]
        if isinstance(value, dict):
            fill(now, value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            package, name = kind[len('sequence<'):-1].split('/')
            setattr(message, key, [fill(getattr(import_module(package + '.msg'), name)(), v)
                                   for v in value])
        else:
            setattr(message, key, type(now)(value) if isinstance(now, float) else value)
    return message

rclpy.init()
node = rclpy.create_node('hand')
pins = []
node.create_subscription(MultiDOFJointState, '/cloth/pin_states',
                         lambda m: pins.append({n: t.translation.z for n, t in
                                                zip(m.joint_names, m.transforms)}), 5)
for times, topic, kind, values in yaml.safe_load(sys.stdin.read()):
    package, _, name = kind.split('/')
    kind = getattr(import_module(package + '.msg'), name)
    publisher = node.create_publisher(kind, topic, 1)
    while not publisher.get_subscription_count():
        time.sleep(0.1)
    for _ in range(times):
        publisher.publish(fill(kind(), yaml.safe_load(values)))
        end = time.monotonic() + 1
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
    print(pins[-1], flush=True)
"""


def test_lines_for_the_shell_grasp_move_and_release(node):
    lines = [shlex.split(line.replace('--once', '-t 1')) for line in text().splitlines()
             if line.strip().startswith('ros2 topic pub')]
    assert len(lines) == 3
    time.sleep(0.5)
    done = subprocess.run([sys.executable, '-c', PUBLISH], env=node, text=True, timeout=240,
                          input=yaml.safe_dump([[int(line[4]), *line[5:]] for line in lines]),
                          capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    held, moved, released = (eval(line) for line in done.stdout.splitlines())
    assert held['hand'] == pytest.approx(0.0, abs=0.01)
    assert moved['hand'] == pytest.approx(0.4)
    assert released == {}
