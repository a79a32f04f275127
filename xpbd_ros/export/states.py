"""The states of a log, read one frame at a time."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Float64

from xpbd_ros.errors import InputError
from xpbd_ros.export.body import Body
from xpbd_ros.log.reader import LogReader, Message
from xpbd_ros.ros.clouds import positions_of
from xpbd_ros.ros.inputs import unpacked
from xpbd_ros.ros.logged_commands import last_part
from xpbd_ros.ros.recorder import type_name
from xpbd_ros.scene.load import parse_yaml
from xpbd_ros.scene.model import TopKeys
from xpbd_ros.scene.read import mapping, read


class State(NamedTuple):
    """One frame."""

    frame: int
    time_s: float
    """simulation time since the start of the log [s]"""
    positions: dict[str, np.ndarray]
    """by cloth [m], float32, shape (particles, 3)"""
    pins: list[Body]
    colliders: list[Body]


class States:
    """
    The states of a recorded run.

    Parameters
    ----------
    run : path of the log
    every : take only frames whose index is a multiple of this

    Attributes
    ----------
    triangles : dict of array
        By cloth, shape (triangles, 3).
    particles : dict of int
        Number of particles by cloth.
    frames : list of int
        Frames that have a cloud of every cloth.
    frame_rate : float
        [Hz]

    Raises
    ------
    InputError : the file holds no readable cloud

    """

    def __init__(self, run: str, *, every: int = 1,
                 tell: Callable[[str], None] = lambda text: None):
        self._reader = reader = LogReader(run)
        self.path = reader.path
        for text in reader.damage:
            tell(text)
        alone = _only_cloth(reader)
        self._clouds = {topic: _cloth_of(topic, alone) for topic, about in reader.topics.items()
                        if last_part(topic) == 'particles'
                        and about.type == type_name(PointCloud2)}
        self._bodies = [topic for topic, about in reader.topics.items()
                        if last_part(topic) in ('pin_states', 'collider_wrenches')
                        and about.type == type_name(MultiDOFJointState)]
        if not self._clouds:
            raise InputError(f'{self.path}: holds no ~/particles' + (
                ' in its readable part' if reader.damage else
                ', so it is no log of xpbd_ros'))
        self.frame_rate = frame_rate(reader)
        self.triangles, self.particles = self._meshes()
        self.frames = [frame for frame in self._whole() if frame % every == 0]
        if not self.frames:
            raise InputError(f'{self.path}: holds no frame to export' + (
                f'; take a smaller --every (got {every})' if every > 1 else ''))

    def errors(self) -> dict[int, float]:
        """Return the estimated errors of frames, RMS [m], by frame; NaN if under-resolved."""
        found: dict[str, list[float]] = {'frame': [], 'rms': []}
        for message in self._reader.messages({
                topic for topic, about in self._reader.topics.items()
                if topic.endswith(('/error_estimate/frame', '/error_estimate/rms'))
                and about.type == type_name(Float64)}):
            found[last_part(message.topic)].append(unpacked(message.data, Float64).data)
        return {int(frame): rms for frame, rms in zip(found['frame'], found['rms'])}

    def _meshes(self) -> tuple[dict[str, np.ndarray], dict[str, int]]:
        triangles, particles = {}, {}
        topics = {topic.removesuffix('particles') + 'mesh': cloth
                  for topic, cloth in self._clouds.items()}
        for message in self._reader.messages(topics):
            mesh = unpacked(message.data, Mesh)
            triangles[topics[message.topic]] = np.array(
                [each.vertex_indices for each in mesh.triangles], np.int32).reshape(-1, 3)
            particles[topics[message.topic]] = len(mesh.vertices)
        for cloth in set(self._clouds.values()) - set(triangles):
            raise InputError(f'{self.path}: the mesh of the cloth {cloth} is lost')
        return triangles, particles

    def _whole(self) -> Iterator[int]:
        """Yield the frames that have a cloud of every cloth."""
        for frame, messages in self._by_frame(self._clouds):
            if len({message.topic for message in messages}) == len(self._clouds):
                yield frame

    def _by_frame(self, topics) -> Iterator[tuple[int, list[Message]]]:
        """Yield the messages of each frame; a frame's messages follow each other in a log."""
        found: list[Message] = []
        for message in self._reader.messages(topics):
            if found and message.frame != found[0].frame:
                yield found[0].frame, found
                found = []
            found.append(message)
        if found:
            yield found[0].frame, found

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)

    def __iter__(self) -> Iterator[State]:
        """Yield the states of ``frames``."""
        wanted, start_ns = set(self.frames), self._reader.start_ns or 0
        for frame, messages in self._by_frame([*self._clouds, *self._bodies]):
            if frame not in wanted:
                continue
            positions: dict[str, np.ndarray] = {}
            bodies: dict[str, list[Body]] = {}
            for message in messages:
                if message.topic in self._clouds:
                    positions[self._clouds[message.topic]] = positions_of(
                        unpacked(message.data, PointCloud2))
                else:
                    bodies[last_part(message.topic)] = bodies_of(
                        unpacked(message.data, MultiDOFJointState))
            yield State(frame, 1e-9 * (messages[0].time_ns - start_ns), positions,
                        bodies.get('pin_states', []), bodies.get('collider_wrenches', []))


def frame_rate(reader: LogReader) -> float:
    """Return the frame rate of a log's scene [Hz]."""
    scene = _scene(reader)
    return read(TopKeys, {key: scene[key] for key in ('frame_rate',) if key in scene},
                f'{reader.path}: scene').frame_rate


def _scene(reader: LogReader) -> dict:
    """Return the mapping of a log's scene, unchecked; empty if the log has none."""
    where = f'{reader.path}: scene'
    return mapping(parse_yaml(reader.scene or '', where), where)


def _only_cloth(reader: LogReader) -> str:
    """Return the name of the cloth of a log's scene; ``cloth`` for a log without a scene."""
    cloths = _scene(reader).get('cloths')
    return str(*cloths) if isinstance(cloths, dict) and len(cloths) == 1 else 'cloth'


def _cloth_of(topic: str, alone: str) -> str:
    """Return the name of the cloth whose cloud a topic is: ``alone`` where there is only one."""
    parts = topic.split('/')
    return parts[-2] if len(parts) > 3 and parts[-3] == 'cloth' else alone


def bodies_of(message: MultiDOFJointState) -> list[Body]:
    """Return the bodies in a message of ~/pin_states or ~/collider_wrenches."""
    found = []
    for name, pose, wrench in zip(message.joint_names, message.transforms, message.wrench):
        at, turn = pose.translation, pose.rotation
        force, torque = wrench.force, wrench.torque
        found.append(Body(name, (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w),
                          (force.x, force.y, force.z), (torque.x, torque.y, torque.z)))
    return found
