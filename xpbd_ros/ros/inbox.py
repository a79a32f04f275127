"""
What came in since the last frame: checked at the door, latest per name, drained between frames.

Callbacks fill it from the executor's thread and the simulation's thread empties it. What is
refused is counted and said at most once a second, and nothing else happens.
"""

from collections import Counter
from collections.abc import Callable
import threading
import time

from xpbd_ros.errors import brief, InputError
from xpbd_ros.ros.inputs import count_in, unpacked
from xpbd_ros.sim.commands import Command, MoveCollider, MovePin, PlaceCollider, SetWind

ROOM = 4096
"""commands from messages that may wait for the next frame"""
WARN_PERIOD = 1.0
"""[s]"""


class Inbox:
    """Commands that wait for the next frame."""

    def __init__(self, warn: Callable[[str], None], *, max_message_bytes: int, max_names: int):
        self.max_message_bytes = max_message_bytes
        self.max_names = max_names
        self.accepted: Counter = Counter()
        """messages taken, by topic"""
        self.refused: Counter = Counter()
        """messages and commands refused, by topic"""
        self.arrived: dict[str, float] = {}
        """when the last good message came, by topic [s, monotonic]"""
        self._warn = warn
        self._warned: dict[str, tuple[float, int]] = {}
        self._waiting: list[Command] = []
        self._lock = threading.Lock()

    def take(self, topic: str, raw: bytes, kind: type, read: Callable) -> None:
        """Unpack, check and keep one serialized message, or refuse it whole."""
        try:
            if len(raw) > self.max_message_bytes:
                raise InputError(f'{len(raw)} bytes are more than max_message_bytes '
                                 f'({self.max_message_bytes})')
            count = count_in(raw, kind) if hasattr(kind, 'markers') or hasattr(
                kind, 'joint_names') else 0
            if count > self.max_names:
                raise InputError(f'{count} entries, and there is room for {self.max_names}')
            commands = read(unpacked(raw, kind))
            if len(self._waiting) + len(commands) > ROOM:
                raise InputError(f'more than {ROOM} commands wait for the next frame')
            self.put(topic, commands)
        except InputError as error:
            self.refuse(topic, str(error))

    def put(self, topic: str, commands: list[Command]) -> None:
        """Keep commands for the next frame."""
        with self._lock:
            for command in commands:
                self._keep(command)
            self.accepted[topic] += 1
            self.arrived[topic] = time.monotonic()

    def _keep(self, command: Command) -> None:
        """Let a new target take the place of one that nobody has seen yet."""
        if isinstance(command, MovePin | MoveCollider | PlaceCollider | SetWind):
            name = _name(command)
            for k in range(len(self._waiting) - 1, -1, -1):
                if _name(self._waiting[k]) in (name, None):
                    if type(self._waiting[k]) is type(command):
                        self._waiting[k] = command
                        return
                    break
        self._waiting.append(command)

    def drain(self) -> list[Command]:
        """Return what waits, and forget it."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        return waiting

    def refuse(self, topic: str, reason: str) -> None:
        """Count a refusal and say so, at most once a second for each topic."""
        now = time.monotonic()
        with self._lock:
            self.refused[topic] += 1
            last, silent = self._warned.get(topic, (-WARN_PERIOD, 0))
            if now - last < WARN_PERIOD:
                self._warned[topic] = (last, silent + 1)
                return
            self._warned[topic] = (now, 0)
        more = f' ({silent} more refused since)' if silent else ''
        self._warn(f'{topic}: refused: {brief(reason)}{more}')


def _name(command: Command):
    """Return what a command is about; None: about everything."""
    if isinstance(command, SetWind):
        return 'wind', ''
    pin, collider = getattr(command, 'pin', None), getattr(command, 'collider', None)
    if pin is not None:
        return 'pin', pin
    return ('collider', collider) if collider is not None else None
