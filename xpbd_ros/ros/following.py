"""All that a node does with TF: parts that follow it, and inputs in other TF frames."""

from collections.abc import Callable, Sequence

from xpbd_ros.errors import InputError
from xpbd_ros.ros.frame_follower import FrameFollower
from xpbd_ros.ros.frame_inputs import FrameInputs
from xpbd_ros.scene.frames import followers
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Reset
from xpbd_ros.sim.simulation import Simulation


class Following:
    """
    TF frames of a configured node.

    Parameters
    ----------
    node : the ``ClothNode``
    scene, simulation : of the node
    take : is given (topic, serialized message, type, reader) of each message to read now

    Raises
    ------
    InputError : the scene names a TF frame, and tf2_ros is not installed

    """

    def __init__(self, node, scene: Scene, simulation: Simulation, take: Callable):
        self.inputs = FrameInputs(node, scene.top.frame_id, take, node.command_queue.refuse)
        sources = []
        for each in followers(scene):
            try:
                sources.append((each, self.inputs.transforms()))
            except InputError as error:
                raise InputError(f'{scene.where}: {each.path}: {error}') from None
        self._follower = FrameFollower(
            simulation, scene.top.frame_id, sources, now_ns=lambda: node.pace()[0](),
            warn=node.get_logger().warning)

    def commands(self, groups: Sequence[tuple]) -> list[tuple]:
        """Return the commands of followers before a frame, to act after the ``groups``."""
        reset = any(isinstance(command, Reset) for group in groups for command in group)
        return self._follower.commands(reset=reset)

    @property
    def finding(self) -> str:
        """Present warning for ``/diagnostics``; empty without one."""
        return self._follower.finding

    def diagnostics(self) -> dict[str, float]:
        """Return the values for ``/diagnostics``."""
        return self._follower.diagnostics()

    def clear(self) -> None:
        """Forget transforms, after the clock went back."""
        self.inputs.clear()

    def close(self) -> None:
        """Destroy the subscriptions."""
        self.inputs.close()
