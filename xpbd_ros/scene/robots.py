"""
The section ``robots``: colliders made of a URDF's links, and a grasp made of its gripper.

The colliders become entries of ``colliders`` that follow the TF frames of their links, so all that
holds for colliders holds for them. Their names are those of the robot and the link.
"""

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
from pathlib import Path
import re
from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.frames import Follower, TIMEOUT
from xpbd_ros.scene.inputs import TOPIC
from xpbd_ros.scene.read import mapping, names, read, unknown
from xpbd_ros.scene.urdf import Description
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.contact.collider_entries import Pad
from xpbd_ros.sim.geometry.pose import compose
from xpbd_ros.sim.parameters import check_frame_name, quantity

TopicText = Callable[[str], str]
"""topic -> text on it; raises InputError if there is none"""
HYSTERESIS = 0.2
"""a gripper opens this share of ``closed_below`` above it, unless ``open_above`` is given"""


@dataclass(frozen=True)
class Gripper:
    """The key ``gripper`` of a robot."""

    joint: str = quantity(doc='joint whose position closes it')
    closed_below: float = quantity(unit='m or rad', doc='position below which it grasps')
    frame: str = quantity(doc='TF frame, or link, where it grasps')
    radius: float = quantity(unit='m', above=0.0, doc='radius of the grasp')
    open_above: float | None = quantity(None, unit='m or rad', doc=(
        'position above which it releases; closed_below and a fifth of it unless given'))

    def __post_init__(self):
        """Require hysteresis."""
        if self.open_above is not None and self.open_above < self.closed_below:
            raise InputError(f'open_above: must be at least closed_below ({self.closed_below:g}) '
                             f'(got {self.open_above:g})')

    @property
    def opens(self) -> float:
        """Position above which it releases."""
        return (self.closed_below + HYSTERESIS * abs(self.closed_below)
                if self.open_above is None else self.open_above)


@dataclass(frozen=True)
class RobotKeys:
    """One entry of ``robots``."""

    description: str = quantity(doc=(
        'URDF file, beside the scene file, or an absolute path; or a topic, such as '
        '/robot_description, that the node reads'))
    links: tuple[str, ...] | None = quantity(None, doc=(
        'links that are colliders; all with collision geometry unless given'))
    friction: float = quantity(0.5, minimum=0.0, doc='coefficient μ')
    pad: Pad | None = quantity(None, doc='a soft surface of all these links')
    position: tuple[float, float, float] = quantity(
        (0.0, 0.0, 0.0), unit='m', doc='of its root link, where joint_states move it')
    orientation: tuple[float, float, float, float] = quantity(
        (0.0, 0.0, 0.0, 1.0), doc='of its root link, a quaternion x y z w')
    follow: str = quantity('auto', choices=('auto', 'tf', 'joint_states'), doc=(
        'TF, or joint_states and kinematics; auto: TF where tf2_ros is installed'))
    joint_states: str = quantity('/joint_states', doc='topic')
    frame_prefix: str | None = quantity(None, doc='of its TF frames')
    frame_timeout: float = quantity(TIMEOUT, unit='s', above=0.0, doc='as of a collider')
    max_speed: float = quantity(5.0, unit='m/s', above=0.0, doc='of its colliders')
    gripper: Gripper | None = quantity(None)


@dataclass(frozen=True)
class Robot:
    """A robot whose colliders are in the scene."""

    name: str
    keys: RobotKeys
    file: str
    """path, or topic, of its description"""
    text: bytes = dataclasses.field(repr=False)
    """its description"""
    colliders: tuple[str, ...]
    """names of its colliders"""

    @property
    def pose(self) -> Pose:
        """Pose of its root link in the scene, where joint_states move it."""
        return Pose(self.keys.position, self.keys.orientation)

    @property
    def pin(self) -> str:
        """Name of the pin of its gripper."""
        return f'{self.name}_gripper'

    @property
    def grasp(self) -> Follower | None:
        """Follower of the gripper's pin; None without a gripper."""
        gripper = self.keys.gripper
        if gripper is None:
            return None
        return Follower('pins', self.pin, f'{self.keys.frame_prefix or ""}{gripper.frame}', Pose(),
                        self.keys.frame_timeout, gripper.radius)


def with_robots(raw: dict, folder: Path, topic_text: TopicText | None) -> tuple[
        dict, dict[str, Robot]]:
    """
    Return a scene's mapping with its robots as colliders, and the robots by name.

    Parameters
    ----------
    raw : the scene's mapping
    folder : of the scene file
    topic_text : returns the text on a topic; None where topics cannot be read

    """
    robots, colliders = {}, dict(mapping(raw.get('colliders'), 'colliders'))
    effects = dict(mapping(raw.get('effects'), 'effects'))
    for name, value in names(raw['robots'], 'robots').items():
        path = f'robots.{name}'
        keys = read(RobotKeys, value, path)
        if not TOPIC.fullmatch(keys.joint_states.removeprefix('~/')):
            raise InputError(f'{path}.joint_states: is not the name of a topic, such as '
                             f"/joint_states (got '{keys.joint_states}')")
        if keys.frame_prefix is not None:
            check_frame_name(f'{path}.frame_prefix', keys.frame_prefix)
        try:
            description = _description(keys.description, folder, topic_text)
        except InputError as error:
            raise InputError(f'{path}.description: {error}') from None
        made = _colliders(name, keys, description)
        for collider in made:
            if collider in colliders:
                raise InputError(f"colliders.{collider}: is the name of a link's collider of "
                                 f'{path}; take another name')
        colliders.update(made)
        robots[name] = robot = Robot(name, keys, str(description.file), description.text,
                                     tuple(made))
        if keys.gripper is not None:
            _check_gripper(robot, description)
            effects.setdefault('pin', {})
    raw = {key: value for key, value in raw.items() if key != 'robots'}
    return {**raw, 'colliders': colliders, 'effects': effects}, robots


def _description(name: str, folder: Path, topic_text: TopicText | None) -> Description:
    """Return the description of a file, or of a topic: an absolute name without a suffix."""
    file = (folder / name).absolute()
    if file.is_file() or not name.startswith('/') or Path(name).suffix:
        return Description(file)
    if topic_text is None:
        raise InputError(f'no such file: {name}; only the node reads a topic, so save it: '
                         f'ros2 topic echo --once --field data {name} > robot.urdf')
    return Description(Path(name), topic_text(name).encode())


def _colliders(name: str, keys: RobotKeys, description: Description) -> dict[str, dict]:
    """Return the entries of ``colliders`` that a robot's links become."""
    path = f'robots.{name}'
    for k, link in enumerate(keys.links or ()):
        if link not in description.links:
            raise InputError(f'{path}.links[{k}]: {unknown(link, description.links, "link")}')
        if link not in description.solid_links:
            raise InputError(f"{path}.links[{k}]: '{link}' has no collision geometry (these have: "
                             f'{", ".join(description.solid_links) or "none"})')
    chosen = description.solid_links if keys.links is None else dict.fromkeys(keys.links)
    if not chosen and keys.gripper is None:
        raise InputError(f'{path}.description: {description.file}: no link has collision geometry')
    description.move({})
    found = {}
    for link in chosen:
        try:
            shapes = description.collisions(link)
        except InputError as error:
            raise InputError(f'{path}.description: {error}') from None
        for k, (shape, offset) in enumerate(shapes):
            start = compose(Pose(keys.position, keys.orientation),
                            compose(description.pose(link), offset))
            entry: dict[str, Any] = {
                **shape, **_plain(offset), 'frame': f'{keys.frame_prefix or ""}{link}',
                'frame_timeout': keys.frame_timeout, 'start': _plain(start),
                'friction': keys.friction, 'max_speed': keys.max_speed}
            if keys.pad is not None:
                entry['pad'] = {'stiffness': keys.pad.stiffness}
            plain = re.sub(r'\W', '_', f'{name}_{link}', flags=re.ASCII)
            plain = plain if len(shapes) == 1 else f'{plain}_{k}'
            while plain in found:    # of another link, such as jaw-1 and jaw_1
                plain += '_'
            found[plain] = entry
    return found


def _plain(pose: Pose) -> dict[str, list[float]]:
    return {'position': list(pose.position), 'orientation': list(pose.orientation)}


def _check_gripper(robot: Robot, description: Description) -> None:
    gripper, path = robot.keys.gripper, f'robots.{robot.name}.gripper'
    assert gripper is not None
    if gripper.joint not in description.joints:
        other = description.mimics.get(gripper.joint)
        raise InputError(f'{path}.joint: ' + (
            f"'{gripper.joint}' mimics '{other}'; take that one" if other else
            unknown(gripper.joint, description.joints, 'joint')))
    if robot.keys.follow != 'tf' and gripper.frame not in description.links:
        raise InputError(f'{path}.frame: {unknown(gripper.frame, description.links, "link")}; '
                         'any TF frame will do with follow: tf')
