"""
Motion from a log of another program: commands for each frame of a run, as a node would give them.

The messages of the log arrive in simulation time, which begins at its first message or later. So
pins and colliders follow TF frames, joint states and topics of poses exactly as they do in a node
that receives the same messages, delay and interpolation included.
"""

from collections.abc import Callable, Iterator
from difflib import get_close_matches
from functools import partial
from typing import Any

from sensor_msgs.msg import JointState

from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.foreign import ForeignLog, Record
from xpbd_ros.ros.followers import Followers
from xpbd_ros.ros.foreign_topic import message_class
from xpbd_ros.ros.frame_follower import PoseSource
from xpbd_ros.ros.inputs import unpacked
from xpbd_ros.ros.logged_tf import LoggedTransforms
from xpbd_ros.ros.pose_messages import JOINT_STATE, read_transforms, TF_MESSAGE, TYPES
from xpbd_ros.ros.topic_poses import TopicPoses
from xpbd_ros.scene.model import Scene
from xpbd_ros.scene.robots import Robot
from xpbd_ros.sim.simulation import Simulation

TF = '/tf', '/tf_static'
STATIC = '_static'
"""end of the names of topics with static transforms"""
LOOK_NS = 10**9
"""period at which the log is checked for the poses that the scene needs [ns]"""


class ForeignMotion:
    """
    The motion of a scene's pins and colliders in a log of another program.

    Parameters
    ----------
    log : the log
    scene, simulation : of the run
    frames : number of frames of the run
    offset : time of the log at which the run begins [s]

    Raises
    ------
    InputError : the log lacks a topic, a TF frame or messages in the time of the run, or has
        another type on a topic

    """

    def __init__(self, log: ForeignLog, scene: Scene, simulation: Simulation, *, frames: int,
                 offset: float = 0.0):
        self._log, self._scene, self._simulation = log, scene, simulation
        self._begin_ns = self._now_ns = log.start_ns + round(1e9 * offset)
        self._end_ns = self._begin_ns + simulation.time_ns(frames)
        self._frame_id = scene.top.frame_id
        self._notes: list[str] = []
        self._refused: dict[str, list[str]] = {}    # reasons by topic
        self._takers: dict[str, Callable[[bytes], None]] = {}    # by topic
        self._states: dict[str, Any] = {}
        self._topics: dict[str, TopicPoses] = {}
        self._tf_topics = self._topics_of_tf()
        self._transforms = LoggedTransforms()
        for topic, entries in scene.inputs.items():
            if any(entry.frame is not None for entry in entries):
                self._need(topic, (TF_MESSAGE,), f'inputs.{topic}')
        self._followers = Followers(simulation, scene, self, now_ns=lambda: self._now_ns,
                                    warn=self._notes.append, tell=self._notes.append)
        if not self._takers:
            raise InputError(f'{log.path}: is not a log of xpbd_ros, and the scene maps none of '
                             f"its topics to a pin or collider under 'inputs' ({self._usable()})")
        self._check()
        self._left = self._messages()
        self._next = next(self._left, None)

    def _topics_of_tf(self) -> list[str]:
        """Return the topics of TF: those that inputs name, else /tf, else all."""
        named = [topic for topic, entries in self._scene.inputs.items()
                 if any(entry.frame is not None for entry in entries)]
        found = [topic for topic, type_name in self._log.topics.items()
                 if type_name == TF_MESSAGE]
        wanted = {*named, *(topic + STATIC for topic in named)} or (
            set(TF) if set(TF).intersection(found) else set(found))
        return [topic for topic in found if topic in wanted]

    # as ``followers.Sources``

    def way(self, robot: Robot) -> str:
        """Return how a robot is followed: 'tf' or 'joint_states'; auto: TF if the log has it."""
        if robot.keys.follow == 'auto':
            return 'tf' if self._tf_topics else 'joint_states'
        return robot.keys.follow

    def transforms(self) -> PoseSource:
        """Return the transforms of the log."""
        if not self._tf_topics:
            raise InputError(f'needs TF, and {self._log.path} has no topic of {TF_MESSAGE}')
        def take(static: bool, raw: bytes) -> None:
            self._transforms.take(read_transforms(raw), static=static)
        for topic in self._tf_topics:
            self._takers[topic] = partial(take, topic.endswith(STATIC))
        return self._transforms

    def states(self, robot: Robot):
        """Return the joint states of a robot."""
        from xpbd_ros.ros.robots import JointStates
        topic = robot.keys.joint_states
        if topic not in self._states:
            self._need(topic, (JOINT_STATE,), f'robots.{robot.name}.joint_states')
            states = self._states[topic] = JointStates(topic, lambda: self._now_ns)
            self._takers[topic] = lambda raw: states.take(unpacked(raw, JointState))
        return self._states[topic]

    def topic(self, name: str) -> PoseSource:
        """Return the poses on a topic."""
        if name not in self._topics:
            self._need(name, TYPES, f'inputs.{name}')
            type_name = self._log.topics[name]
            kind = message_class(type_name)
            poses = self._topics[name] = TopicPoses(name, self._frame_id, self.transforms,
                                                    lambda: self._now_ns)
            self._takers[name] = lambda raw: poses.take(type_name, unpacked(raw, kind))
        return self._topics[name]

    def _need(self, topic: str, types: tuple[str, ...], path: str) -> None:
        """Raise InputError unless the log has a topic, with one of these types."""
        log = self._log
        if topic in log.encodings:
            raise InputError(f'{path}: {log.path} has it in the encoding '
                             f"'{log.encodings[topic]}', and only cdr can be read")
        if topic not in log.topics:
            near = get_close_matches(topic, log.topics, 1)
            meant = f'; did you mean {near[0]}?' if near else ''
            raise InputError(f'{path}: {log.path} has no such topic{meant} '
                             f'({self._usable(types)})')
        found = log.topics[topic]
        if not found:
            raise InputError(f'{path}: {log.path} does not say of which type it is: its messages '
                             'have no definition there')
        if found not in types:
            other = ("; a robot follows joint states by its key 'joint_states'"
                     if found == JOINT_STATE else
                     "; name the TF frame with 'frame'" if found == TF_MESSAGE else '')
            raise InputError(f'{path}: is {found}, and must be {" or ".join(types)}{other}')

    def _usable(self, types: tuple[str, ...] = (*TYPES, JOINT_STATE, TF_MESSAGE)) -> str:
        found = [f'{topic} ({type_name})' for topic, type_name in self._log.topics.items()
                 if type_name in types]
        return f'it has {", ".join(found)}' if found else (
            f'it has no topic of {" or ".join(types)}')

    # messages

    def _refuse(self, topic: str, reason: str) -> None:
        self._refused.setdefault(topic, []).append(reason)

    def _take(self, record: Record) -> None:
        try:
            self._takers[record.topic](record.data)
        except InputError as error:
            self._refuse(record.topic, str(error))

    def _messages(self) -> Iterator[Record]:
        """Yield the messages of the run: static transforms of the whole log first."""
        static = {topic for topic in self._tf_topics if topic.endswith(STATIC)}
        yield from self._log.messages(static.intersection(self._takers))
        for record in self._log.messages(self._takers.keys() - static):
            if record.time_ns > self._end_ns:
                return
            if record.time_ns >= self._begin_ns:
                yield record

    def _clear(self) -> None:
        """Forget all poses and refusals."""
        for each in (self._transforms, *self._states.values(), *self._topics.values()):
            each.clear()
        self._refused = {}

    def _check(self) -> None:
        """Raise InputError if a follower has no pose in the time of the run."""
        known: set[str] = set()
        while known != self._takers.keys():    # a pose in another TF frame adds those of TF
            known = set(self._takers)
            heard = self._look_ahead(known)
        for path, reason in self._missing():
            for topic in self._takers.keys() - heard:
                self._check_times(topic, path)
            raise InputError(f'{path}: {"; ".join([reason, *self._refusals()])} '
                             f'({self._log.path})')
        self._clear()
        self._now_ns = self._begin_ns

    def _look_ahead(self, topics: set[str]) -> set[str]:
        """
        Take messages until each follower has a pose, or other topics are needed too.

        Returns
        -------
        heard : topics that had messages

        """
        self._clear()
        heard: set[str] = set()
        look_ns = 0
        for record in self._messages():
            heard.add(record.topic)
            self._now_ns = max(self._begin_ns, record.time_ns)
            self._take(record)
            if self._takers.keys() != topics:
                break
            if record.time_ns >= look_ns:
                look_ns = record.time_ns + LOOK_NS
                if not self._missing():
                    break
        return heard

    def _missing(self) -> list[tuple[str, str]]:
        """Return the followers without a pose, each as (key of the scene, reason)."""
        found = []
        for each, source in self._followers.sources:
            try:
                source.pose(self._frame_id, each.frame,
                            source.latest_ns(self._frame_id, each.frame))
            except InputError as error:
                found.append((each.path, str(error)))
        return found

    def _check_times(self, topic: str, path: str) -> None:
        """Raise InputError if a topic has messages at other times than the run."""
        times = [record.time_ns for record in self._log.messages({topic})]
        if topic.endswith(STATIC) or not times:
            return
        first, last, begin, end = (1e-9 * (ns - self._log.start_ns) for ns in (
            times[0], times[-1], self._begin_ns, self._end_ns))
        raise InputError(
            f'{path}: {topic} has messages from {first:.3f} s to {last:.3f} s of '
            f'{self._log.path}, and the run takes {begin:.3f} s to {end:.3f} s of it; change '
            '--start-offset or --duration')

    def commands(self, index: int) -> list[tuple]:
        """Return the commands before a frame."""
        self._now_ns = self._begin_ns + self._simulation.time_ns(index - 1)
        while self._next is not None and self._next.time_ns <= self._now_ns:
            self._take(self._next)
            self._next = next(self._left, None)
        return self._followers.commands()

    def texts(self) -> list[str]:
        """Return notes on silent TF frames and refused messages."""
        return [*self._notes, *self._refusals()]

    def _refusals(self) -> list[str]:
        return [f'{topic}: {counted(len(reasons), "message")} refused: {reasons[0]}'
                for topic, reasons in self._refused.items()]
