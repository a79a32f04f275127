"""
What came in since the last frame: checked at the door, kept by message, drained between frames.

Callbacks fill it from the executor's thread and the simulation's thread empties it. A message
waits as it came, and acts whole or not at all; one that says something newer about the same names
takes its place. Of streams with stamps some are kept, as they are rebuilt from all that was sent.
What is refused is counted and said, and nothing else happens: the first at once, and how many
more there were a second later.
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
KEPT = 64
"""messages of one stream with stamps that wait for the next frame; the latest"""
WARN_PERIOD = 1.0
"""[s]"""
TARGETS = MovePin, MoveCollider, PlaceCollider, SetWind

Group = tuple[Command, ...]


class CommandQueue:
    """Commands that wait for the next frame."""

    def __init__(self, warn: Callable[[str], None], *, max_message_bytes: int, max_names: int):
        self.max_message_bytes = max_message_bytes
        self.max_names = max_names
        self.accepted: Counter = Counter()
        """messages taken, by topic"""
        self.refused: Counter = Counter()
        """messages refused, by topic"""
        self.arrived: dict[str, float] = {}
        """when the last good message came, by topic [s, monotonic]"""
        self._warn = warn
        self._silent: dict[str, tuple[threading.Timer, int, str]] = {}
        """topics that were warned about: until when, refusals since, and the last reason"""
        self._waiting: list[Group] = []
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
            if sum(map(len, self._waiting)) + len(commands) > ROOM:
                raise InputError(f'more than {ROOM} commands wait for the next frame')
            self.put(topic, tuple(commands))
        except InputError as error:
            self.refuse(topic, str(error))

    def put(self, topic: str, *groups: Group) -> None:
        """Keep commands for the next frame; those of a group act together."""
        with self._lock:
            for group in filter(None, groups):
                self._keep(group)
            self.accepted[topic] += 1
            self.arrived[topic] = time.monotonic()

    def _keep(self, group: Group) -> None:
        """Let targets take the place of older ones of the same names that no frame has seen."""
        if all(isinstance(command, TARGETS) for command in group):
            names, same = set(map(_name, group)), []
            for k in range(len(self._waiting) - 1, -1, -1):
                others = set(map(_name, self._waiting[k]))
                if type(self._waiting[k][0]) is type(group[0]) and others <= names:
                    same.append(k)
                elif None in others or not others.isdisjoint(names):
                    break
            stamped = all(getattr(command, 'stamp_ns', 0) for command in group)
            for k in same[KEPT - 1 if stamped else 0:]:
                del self._waiting[k]
        self._waiting.append(group)

    def drain(self) -> list[Group]:
        """Return what waits, and forget it."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        return waiting

    def refuse(self, topic: str, reason: str) -> None:
        """Count a refusal and say so; more within a second are said at its end."""
        with self._lock:
            self.refused[topic] += 1
            if topic in self._silent:
                timer, count, _ = self._silent[topic]
                self._silent[topic] = timer, count + 1, reason
                return
            self._be_silent(topic)
        self._warn(f'{topic}: refused: {brief(reason)}')

    def _be_silent(self, topic: str) -> None:
        timer = threading.Timer(WARN_PERIOD, self._tell, (topic,))
        timer.daemon = True
        self._silent[topic] = timer, 0, ''
        timer.start()

    def _tell(self, topic: str) -> None:
        """Say how many were refused in silence."""
        with self._lock:
            _, count, reason = self._silent.pop(topic, (None, 0, ''))
            if count:
                self._be_silent(topic)
        if count:
            self._warn(f'{topic}: refused: … and {count} more, the last one: {brief(reason)}')

    def close(self) -> None:
        """Say what has not been said; nothing comes any more."""
        with self._lock:
            for timer, _, _ in self._silent.values():
                timer.cancel()
        for topic in list(self._silent):
            self._tell(topic)
        with self._lock:
            for timer, _, _ in self._silent.values():
                timer.cancel()
            self._silent.clear()


def _name(command: Command):
    """Return what a command is about; None: about everything."""
    if isinstance(command, SetWind):
        return 'wind', ''
    pin, collider = getattr(command, 'pin', None), getattr(command, 'collider', None)
    if pin is not None:
        return 'pin', pin
    return ('collider', collider) if collider is not None else None
