"""
Commands that answer: services and handles of pins, saved states, clouds for ``~/set_state``.

They act between two frames, after the messages that have arrived before them.
"""

from concurrent import futures

from xpbd_ros.errors import InputError
from xpbd_ros.ros.pin_handles import PinHandles
from xpbd_ros.ros.pin_services import PinServices
from xpbd_ros.ros.services import ANSWER_SECONDS, begin
from xpbd_ros.ros.set_state import CloudStates
from xpbd_ros.sim.commands import Command
from xpbd_ros.sim.simulation import SavedState


class Interaction:
    """
    The parts of a node whose commands answer.

    Parameters
    ----------
    node : the ``ClothNode``, with its scene and simulation

    """

    def __init__(self, node):
        self._node = node
        topic = node.resolve_topic_name('~/set_state')
        self.clouds = CloudStates(self._saved, lambda: node.value('set_state_radius'),
                                  lambda text: node.get_logger().info(f'{topic}: {text}'))
        """reader of ~/set_state"""
        self._handles: PinHandles | None = None
        self._parts: list[PinServices | PinHandles] = []
        if 'pin' in node.simulation.effects:
            self._parts.append(PinServices(node))
        if node.value('interactive_markers') and node.scene.sections.get('pins'):
            self._handles = PinHandles(node)
            self._parts.append(self._handles)

    def close(self) -> None:
        """Destroy the services and the topics of the handles."""
        for part in self._parts:
            part.close()

    def publish(self) -> None:
        """Publish the handles, if there are any; on the stepper's thread."""
        if self._handles is not None:
            self._handles.publish()

    def act(self, *commands: Command) -> None:
        """
        Apply commands between two frames, after those that wait; on the stepper's thread.

        Raises
        ------
        InputError : one is refused, or the node steps by /clock, which has not begun

        """
        node = self._node
        begin(node)
        for command, reason in node.simulation.apply(node.command_queue.drain()):
            node.refuse(command, reason)
        for _, reason in node.simulation.apply(commands):
            raise InputError(reason)

    def _saved(self) -> SavedState:
        """Return the state between two frames."""
        try:
            return self._node.stepper.ask(self._node.simulation.save).result(ANSWER_SECONDS)
        except (futures.TimeoutError, RuntimeError) as error:
            raise InputError(f'no state to start from: {error}') from error
