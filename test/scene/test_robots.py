"""Robots in scenes: links become colliders; errors name file, key and value."""

from importlib.util import find_spec
from math import pi
import os
from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import pytest
import yaml

from support.meshes import obj_text
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_text
from xpbd_ros.scene.save import scene_text
from xpbd_ros.scene.urdf import Description
from xpbd_ros.share import share_folder
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import compose, from_matrix

pytestmark = pytest.mark.skipif(find_spec('yourdfpy') is None,
                                reason="yourdfpy is missing: pip install '.[robot]'")
PAGE = Path(__file__).parents[2] / 'doc' / 'robots.md'
ROBOTS = share_folder() / 'robots'
URDF = """<robot name="r">
  <link name="base"/>
  <joint name="turn" type="revolute">
    <origin xyz="0 0 1" rpy="0 0 0"/><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/>
  </joint>
  <link name="arm">
    <collision><origin xyz="0.5 0 0" rpy="0 1.5707963267948966 0"/>
      <geometry><cylinder radius="0.05" length="1.0"/></geometry></collision>
    <collision><origin xyz="1 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic">
    <origin xyz="1 0 0"/><parent link="arm"/><child link="jaw-1"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="1" velocity="1" effort="1"/>
  </joint>
  <link name="jaw-1"><collision>
    <geometry><mesh filename="MESH" scale="0.1 0.1 0.1"/></geometry></collision></link>
</robot>
"""
TOWEL = """
cloths:
  towel:
    grid: {size: [0.4, 0.4], resolution: [9, 9]}
    density: 0.25
    effects: {stretch: {warp: 500.0, weft: 500.0}}
colliders:
  table: {plane: {}}
  ball: {sphere: {radius: 0.1}, position: [0.0, 1.0, 0.15]}
effects:
  contact: {thickness: 0.004}
solver: {method: gauss_seidel, substeps: 20}
"""
GRIPPER = 'gripper: {joint: slide, closed_below: 0.1, frame: jaw-1, radius: 0.05}'


@pytest.fixture
def folder(tmp_path) -> Path:
    """Return a folder with a description and its mesh."""
    (tmp_path / 'jaw.obj').write_text(obj_text(*closed_box()))
    (tmp_path / 'r.urdf').write_text(URDF.replace('MESH', 'jaw.obj'))
    return tmp_path


def closed_box():
    """Return the surface of a box, as triangles."""
    vertices = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def scene(folder: Path, keys: str = 'description: r.urdf', effects: str = ''):
    """Return the towel's scene with a robot."""
    text = TOWEL.replace('thickness: 0.004', f'thickness: 0.004{effects}')
    return scene_from_text(f'{text}\nrobots:\n  arm: {{{keys}}}\n', where='scene.yaml',
                           name='scene', folder=folder)


def test_links_are_colliders_that_follow_their_frames(folder):
    found = scene(folder, 'description: r.urdf, friction: 0.9, position: [0, 0, 2], '
                  'frame_prefix: left/, frame_timeout: 0.3')
    colliders = found.sections['colliders']
    assert list(colliders) == ['table', 'ball', 'arm_arm_0', 'arm_arm_1', 'arm_jaw_1']
    tube, ball, jaw = (colliders[f'arm_{name}'] for name in ('arm_0', 'arm_1', 'jaw_1'))
    assert (tube.cylinder.radius, tube.cylinder.length) == (0.05, 1.0)
    assert tube.offset.position == (0.5, 0.0, 0.0)
    assert tube.offset.orientation == pytest.approx((0.0, 0.5**0.5, 0.0, 0.5**0.5))
    assert (tube.frame, tube.frame_timeout, tube.friction) == ('left/arm', 0.3, 0.9)
    assert ball.pose.position == pytest.approx((1.0, 0.0, 3.0)), 'where it stands without TF'
    assert jaw.mesh.file == str(folder / 'jaw.obj')
    assert jaw.mesh.scale == 0.1
    simulation = compile_scene(found)
    again = scene_from_text(scene_text(found, simulation.solver), where='log', name='scene')
    assert again.sections == found.sections, 'a log repeats without the description'
    assert 'pin' not in found.effects
    assert 'pin' in scene(folder, f'description: r.urdf, {GRIPPER}').effects


def test_kinematics_are_those_of_the_joints(folder):
    description = Description(folder / 'r.urdf')
    assert description.joints == ('turn', 'slide')
    description.move({'turn': pi / 2, 'slide': 0.3, 'other': 1.0})
    found = description.pose('jaw-1')
    assert found.position == pytest.approx((-0.3, 1.0, 1.0))
    assert found.orientation == pytest.approx((0.0, 0.0, 0.5**0.5, 0.5**0.5))
    description.move({})
    assert description.pose('jaw-1').position == pytest.approx((1.0, 0.0, 1.0))


def test_mimicked_joints_follow():
    description = Description(ROBOTS / 'two_finger.urdf')
    description.move({'finger': 0.02})
    assert description.pose('left_finger').position[1] == pytest.approx(0.02)
    assert description.pose('right_finger').position[1] == pytest.approx(-0.02)


def test_axes_count_by_their_direction_and_mimics_of_mimics_follow(folder):
    """And joints that no joint state has, such as floating ones, are none and stay."""
    more = """
  <joint name="drift" type="floating"><origin xyz="0 0 1"/>
    <parent link="base"/><child link="cart"/></joint><link name="cart"/>
  <joint name="turn" """
    tips = """
  <joint name="half" type="prismatic"><axis xyz="0 0 0.5"/><parent link="arm"/>
    <child link="a"/><mimic joint="slide" multiplier="0.5" offset="0.1"/></joint>
  <joint name="back" type="prismatic"><axis xyz="0 0 3"/><parent link="arm"/>
    <child link="b"/><mimic joint="half" multiplier="-2" offset="0.3"/></joint>
  <link name="a"/><link name="b"/></robot>"""
    text = (folder / 'r.urdf').read_text().replace('\n  <joint name="turn" ', more).replace(
        'xyz="0 1 0"', 'xyz="0 2 0"').replace('</robot>', tips)
    (folder / 'r.urdf').write_text(text)
    description = Description(folder / 'r.urdf')
    assert description.joints == ('turn', 'slide')
    assert description.mimics == {'half': 'slide', 'back': 'slide'}
    description.move({'turn': 0.0, 'slide': 0.4})
    assert description.pose('jaw-1').position == pytest.approx((1.0, 0.4, 1.0))
    assert description.pose('a').position == pytest.approx((0.0, 0.0, 1.0 + 0.5 * 0.4 + 0.1))
    assert description.pose('b').position == pytest.approx((0.0, 0.0, 1.0 - 2 * 0.3 + 0.3))
    assert description.pose('cart').position == pytest.approx((0.0, 0.0, 1.0))


def test_links_whose_names_differ_by_a_sign_are_two_colliders(folder):
    """So are a link's second shape and a link of that name; one named twice is one."""
    text = (folder / 'r.urdf').read_text()
    (folder / 'r.urdf').write_text(text.replace('</robot>', ''.join(f"""
  <joint name="{link}" type="fixed"><parent link="base"/><child link="{link}"/></joint>
  <link name="{link}"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  """ for link in ('jaw_1', 'arm_1')) + '</robot>'))
    frames = {name: each.frame for name, each in scene(folder).sections['colliders'].items()}
    assert frames == {'table': None, 'ball': None, 'arm_arm_0': 'arm', 'arm_arm_1': 'arm',
                      'arm_jaw_1': 'jaw-1', 'arm_jaw_1_': 'jaw_1', 'arm_arm_1_': 'arm_1'}
    found = scene(folder, 'description: r.urdf, links: [jaw_1, jaw_1]').robots['arm']
    assert found.colliders == ('arm_jaw_1',)


def test_matrices_become_poses_for_any_turn():
    rng = np.random.default_rng(1)
    for q in [*np.eye(4), *rng.normal(size=(100, 4)), *(np.eye(4)[[0, 1, 2]] + 1e-9)]:
        pose = Pose((1.0, 2.0, 3.0), tuple((q / np.linalg.norm(q)).tolist()))
        columns = [compose(Pose((0.0,) * 3, pose.orientation), Pose(tuple(e))).position
                   for e in np.eye(3)]
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.transpose(columns), pose.position
        found = np.array(from_matrix(matrix).orientation)
        assert abs(found @ pose.orientation) == pytest.approx(1.0, abs=1e-12)
        assert from_matrix(matrix).position == pose.position


@pytest.mark.parametrize(('keys', 'reason'), [
    ('description: no.urdf', 'scene.yaml: robots.arm.description: no such file: '),
    ('description: /robot_description', 'only the node reads a topic, so save it: '
     'ros2 topic echo --once --field data /robot_description > robot.urdf'),
    ('description: r.urdf, links: [amr]', "robots.arm.links[0]: unknown link; did you mean 'arm'? "
     '(known: base, arm, jaw-1)'),
    ('description: r.urdf, links: [arm, base]', "robots.arm.links[1]: 'base' has no collision "
     'geometry (these have: arm, jaw-1)'),
    ('description: r.urdf, frction: 1',
     "robots.arm.frction: unknown key; did you mean 'friction'"),
    ('description: r.urdf, follow: tff', "robots.arm.follow: unknown value; did you mean 'tf'?"),
    (f'description: r.urdf, {GRIPPER.replace("slide", "silde")}',
     "robots.arm.gripper.joint: unknown joint; did you mean 'slide'? (known: turn, slide)"),
    (f'description: r.urdf, {GRIPPER.replace("jaw-1", "jaw1")}',
     "robots.arm.gripper.frame: unknown link; did you mean 'jaw-1'?"),
    (f'description: r.urdf, {GRIPPER.replace("radius: 0.05", "radius: 0")}',
     'robots.arm.gripper.radius: must be > 0 m (got 0)'),
    ('description: r.urdf, joint_states: joint states',
     'robots.arm.joint_states: is not the name of a topic, such as /joint_states (got '
     "'joint states')"),
    ('description: r.urdf, frame_prefix: /left/',
     "robots.arm.frame_prefix: TF frames have no leading '/'; take 'left/'"),
    (f'description: r.urdf, {GRIPPER.replace("0.1", "0.1, open_above: 0.05")}',
     'robots.arm.gripper: open_above: must be at least closed_below (0.1) (got 0.05)'),
])
def test_what_a_robot_cannot_be(folder, keys, reason):
    with pytest.raises(InputError) as error:
        scene(folder, keys)
    assert reason in str(error.value)


def test_a_gripper_is_read_from_the_joint_that_moves():
    with pytest.raises(InputError, match="robots.arm.gripper.joint: 'finger_mirror' mimics "
                                         "'finger'; take that one"):
        load_scene(str(ROBOTS / 'robot.yaml'), {'robots.arm.gripper.joint': 'finger_mirror'})


@pytest.mark.parametrize(('old', 'new', 'reason'), [
    ('<robot name="r">', '<robot name="r"', 'r.urdf: is no URDF: '),
    ('<robot name="r">', '<robot>', "its root is <robot>, and should be <robot name='…'>"),
    ('<link name="base"/>', '<link name="base"/><xacro:x xmlns:xacro="xacro"/>',
     'holds xacro macros; expand it first: xacro r.urdf > r_expanded.urdf'),
    ('radius="0.05"', 'radius="wide"', 'cannot be read as URDF (ValueError: '),
    ('jaw.obj', 'gone.obj', "r.urdf: link 'jaw-1': no such mesh file: "),
    ('jaw.obj', 'package://nowhere/jaw.obj', "ROS has no package 'nowhere'"),
    ('<parent link="arm"/>', '<parent link="amr"/>', "r.urdf: joint 'slide': its parent 'amr': "
     "unknown link; did you mean 'arm'? (known: base, arm, jaw-1)"),
    ('<child link="jaw-1"/>', '', "joint 'slide': its child '': unknown link"),
    ('<child link="arm"/>', '<child link="jaw-1"/>',
     "link 'jaw-1' is the child of more than one joint"),
    ('<parent link="base"/>', '<parent link="jaw-1"/>',
     "link 'arm' is in or below a loop of joints"),
    ('<link name="base"/>', '<link name="base"/><link name="other"/>',
     'only one link can be without a parent, and base, other are; connect them by joints'),
    ('<link name="base"/>', '<link name="base"/><link name="base"/>',
     "link 'base' is there 2 times"),
    ('name="slide"', 'name="turn"', "joint 'turn' is there 2 times"),
    ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "joint 'slide': its axis has length 0"),
    ('<axis xyz="0 1 0"/>', '<mimic joint="trun"/>', "joint 'slide': mimics 'trun': unknown "
     "joint; did you mean 'turn'? (known: turn, slide)"),
    ('<axis xyz="0 1 0"/>', '<mimic joint="slide"/>',
     "joint 'slide': mimics itself (slide → slide)"),
    ('0.1 0.1 0.1', '0.1 0.1 0.2', "link 'jaw-1': a mesh is scaled by [0.1, 0.1, 0.2]"),
    ('0.1 0.1 0.1', '0 0 0', "link 'jaw-1': a mesh is scaled by [0.0, 0.0, 0.0]"),
])
def test_a_description_that_cannot_be_read(folder, old, new, reason):
    if 'package' in new:
        pytest.importorskip('ament_index_python', reason='needs ROS')
    text = (folder / 'r.urdf').read_text()
    assert old in text
    (folder / 'r.urdf').write_text(text.replace(old, new))
    with pytest.raises(InputError) as error:
        scene(folder)
    assert reason in str(error.value)
    assert str(error.value).startswith('scene.yaml: robots.arm.description: ')
    assert '\n' not in str(error.value)


def test_a_package_is_found_where_ros_has_it(folder, tmp_path, monkeypatch):
    pytest.importorskip('ament_index_python', reason='needs ROS')
    prefix = tmp_path / 'install'
    (prefix / 'share' / 'jaws').mkdir(parents=True)
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'jaws').touch()
    (folder / 'jaw.obj').rename(prefix / 'share' / 'jaws' / 'jaw.obj')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(prefix))
    text = (folder / 'r.urdf').read_text()
    (folder / 'r.urdf').write_text(text.replace('jaw.obj', 'package://jaws/jaw.obj'))
    found = scene(folder).sections['colliders']['arm_jaw_1'].mesh.file
    assert found == str(prefix / 'share' / 'jaws' / 'jaw.obj')


def test_capacity_counts_links(folder):
    with pytest.raises(InputError, match='5 colliders, but effects.contact.max_colliders is 4'):
        compile_scene(scene(folder, effects=', max_colliders: 4'))


def test_a_name_that_is_taken(folder):
    text = TOWEL.replace('  ball: {', '  arm_jaw_1: {')
    with pytest.raises(InputError, match='colliders.arm_jaw_1: is the name of a link'):
        scene_from_text(text + '\nrobots:\n  arm: {description: r.urdf}\n', where='scene.yaml',
                        name='scene', folder=folder)


def test_the_shipped_robot_stands_over_the_cloth():
    found = load_scene(str(ROBOTS / 'robot.yaml'))
    assert set(found.robots['arm'].colliders) == {'arm_palm', 'arm_left_finger',
                                                  'arm_right_finger'}
    frame = compile_scene(found).frame()
    assert frame.colliders['arm_palm'].pose.position == pytest.approx((0.0, 0.0, 0.13))


def test_the_example_of_the_page_of_robots():
    (block,) = re.findall(r'```yaml\n(.*?)```', PAGE.read_text(), re.DOTALL)
    found = scene_from_text(f'cloths: {yaml.safe_load(TOWEL)["cloths"]}\n{block}',
                            where='robots.md', name='robots', folder=ROBOTS)
    compile_scene(found)
    assert found.robots['arm'].keys.gripper.opens == pytest.approx(0.0072)


def test_a_scene_without_robots_does_not_import_the_library():
    done = subprocess.run(
        [sys.executable, '-c', "import sys; from xpbd_ros.scene.load import load_scene; "
         "load_scene('towel'); print('yourdfpy' in sys.modules)"],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))},
        capture_output=True, text=True, check=False)
    assert done.stdout.strip() == 'False', done.stderr
