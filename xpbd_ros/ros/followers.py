"""The pins and colliders of a scene that follow TF frames, robots, or topics of other programs."""

from collections.abc import Callable, Sequence
from typing import Protocol

from xpbd_ros.errors import InputError
from xpbd_ros.ros.frame_follower import FrameFollower, PoseSource
from xpbd_ros.scene.frames import Follower, followers, topic_of_frame
from xpbd_ros.scene.model import Scene
from xpbd_ros.scene.robots import Robot
from xpbd_ros.sim.commands import Command, Grasp, Reset
from xpbd_ros.sim.simulation import Simulation


class Sources(Protocol):
    """Sources of poses: the topics of a node, or those of a log."""

    def way(self, robot: Robot) -> str:
        """Return how a robot is followed: 'tf' or 'joint_states'."""

    def transforms(self) -> PoseSource:
        """Return the poses of TF frames."""

    def states(self, robot: Robot):
        """Return the ``JointStates`` of a robot."""

    def topic(self, name: str) -> PoseSource:
        """Return the poses on a topic of another program."""


class Followers:
    """
    All followers of a scene, with the grippers of its robots.

    Parameters
    ----------
    simulation, scene : have the pins and colliders
    sources : of their poses
    now_ns : clock that silence is measured with [ns]
    warn, tell : are given each warning, and each return of what was silent

    Raises
    ------
    InputError : a source does not exist; the text begins with the key in the scene

    """

    def __init__(self, simulation: Simulation, scene: Scene, sources: Sources, *,
                 now_ns: Callable[[], int], warn: Callable[[str], None],
                 tell: Callable[[str], None]):
        self._simulation = simulation
        self._topics, self._now_ns, self._warn = sources, now_ns, warn
        self._frame_id = scene.top.frame_id
        self._grippers: list = []
        self.sources = self._all(scene)
        """each follower with the source of its poses"""
        self._follower = FrameFollower(simulation, self._frame_id, self.sources, now_ns=now_ns,
                                       warn=warn, tell=tell)

    def _all(self, scene: Scene) -> list[tuple[Follower, PoseSource]]:
        """Return each follower with the source of its poses."""
        of_collider: dict[str, PoseSource] = {}
        grasps = []
        for robot in scene.robots.values():
            source = self._robot(robot)
            of_collider.update(dict.fromkeys(robot.colliders, source))
            if robot.grasp is not None:
                from xpbd_ros.ros.robots import GripperFollower
                grasps.append((robot.grasp, source))
                self._grippers.append((robot.pin, GripperFollower(
                    robot, self._topics.states(robot), source, self._frame_id,
                    now_ns=self._now_ns, warn=self._warn)))
        found: list[tuple] = []
        for each in followers(scene):
            source = of_collider.get(each.name) if each.section == 'colliders' else None
            found.append((each, self._source(each) if source is None else source))
        return found + grasps

    def _robot(self, robot: Robot) -> PoseSource:
        """Return the source of a robot's link poses."""
        if self._topics.way(robot) == 'tf':
            return self._transforms(f'robots.{robot.name}.follow')
        from xpbd_ros.ros.robots import Kinematics
        return Kinematics(robot, self._topics.states(robot))

    def _source(self, follower: Follower) -> PoseSource:
        topic = topic_of_frame(follower.frame)
        if topic is None:
            return self._transforms(follower.path)
        return self._topics.topic(topic[0])

    def _transforms(self, path: str) -> PoseSource:
        try:
            return self._topics.transforms()
        except InputError as error:
            raise InputError(f'{path}: {error}') from None

    def commands(self, groups: Sequence[tuple] = ()) -> list[tuple]:
        """
        Return the commands before a frame, to act after the ``groups``.

        Commands that services have applied since the last frame count like those of the groups.
        """
        before = [*self._simulation.pending, *(each for group in groups for each in group)]
        reset = any(isinstance(command, Reset) for command in before)
        grasped = {command.pin for command in before if isinstance(command, Grasp)}
        found: list[tuple] = []
        acting: list[str] = []
        for pin, gripper in self._grippers:
            command = gripper.command(holds=self._follower.holds(pin), reset=reset)
            if command is not None:
                found.append((command,))
                acting.append(pin)
            if gripper.open:
                self._follower.let_go(pin)
        return found + self._follower.commands(reset=reset, without=acting, grasped=grasped)

    def source_of(self, command: Command) -> str | None:
        """Return the name of the source that a command's pin or collider follows, if any."""
        return next((source.name for each, source in self.sources if each.name == getattr(
            command, each.section.removesuffix('s'), None)), None)

    @property
    def finding(self) -> str:
        """Present warning for ``/diagnostics``; empty without one."""
        return self._follower.finding

    def diagnostics(self) -> dict[str, float]:
        """Return the values for ``/diagnostics``."""
        return self._follower.diagnostics()
