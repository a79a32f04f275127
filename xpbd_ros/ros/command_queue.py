"""
A queue of commands for the next frame: checked on arrival, grouped by message.

Callbacks fill it from the executor's thread; the stepper's thread drains it between frames. The
commands of a message act together or not at all. A newer message about the same names replaces an
older one; of messages with stamps the latest MAX_STAMPED stay, because motion is interpolated
between them. A refused message is counted and changes nothing. The first refusal on a topic is
reported at once, the number of further ones after WARN_PERIOD.
"""

from collections import Counter
from collections.abc import Callable
import threading
import time

from xpbd_ros.errors import brief, InputError
from xpbd_ros.ros.inputs import count_in, unpacked
from xpbd_ros.sim.commands import Command, MoveCollider, MovePin, PlaceCollider, SetState, SetWind

MAX_WAITING = 4096
"""commands from messages that may wait for the next frame, at most"""
MAX_STAMPED = 64
"""messages with stamps about the same names that wait for the next frame, at most"""
WARN_PERIOD = 1.0
"""time between two warnings about a topic [s]"""
TARGETS = MovePin, MoveCollider, PlaceCollider, SetState, SetWind
"""commands of which a newer one replaces an older one"""

Group = tuple[Command, ...]


class CommandQueue:
    """
    Commands that wait for the next frame; all methods are thread-safe.

    Parameters
    ----------
    warn : is given each warning
    max_message_bytes : larger messages are refused before they are unpacked
    max_names : messages with more entries are refused before they are unpacked

    """

    def __init__(self, warn: Callable[[str], None], *, max_message_bytes: int, max_names: int):
        self.max_message_bytes = max_message_bytes
        self.max_names = max_names
        self.accepted: Counter = Counter()
        """messages accepted, by topic"""
        self.refused: Counter = Counter()
        """messages refused, by topic"""
        self.arrived: dict[str, float] = {}
        """arrival of the last accepted message, by topic [s, monotonic]"""
        self._warn = warn
        self._collecting: dict[str, tuple[threading.Timer, int, str]] = {}
        """topics warned about within WARN_PERIOD: timer, refusals since, and the last reason"""
        self._waiting: list[Group] = []
        self._sources: dict[int, tuple[Command, str]] = {}
        self._drained: dict[int, tuple[Command, str]] = {}
        self._lock = threading.Lock()

    def take(self, topic: str, raw: bytes, kind: type, read: Callable) -> None:
        """Unpack, check and queue one serialized message, or refuse all of it."""
        try:
            self._check_size(raw)
            count = count_in(raw, kind) if hasattr(kind, 'markers') or hasattr(
                kind, 'joint_names') else 0
            if count > self.max_names:
                raise InputError(f'{count} entries, and there is room for {self.max_names}')
            commands = read(unpacked(raw, kind))
            if sum(map(len, self._waiting)) + len(commands) > MAX_WAITING:
                raise InputError(f'more than {MAX_WAITING} commands wait for the next frame')
            self.put(topic, tuple(commands))
        except InputError as error:
            self.refuse(topic, str(error))

    def take_state(self, topic: str, raw: bytes, kind: type, take: Callable) -> None:
        """Give ``take`` an unpacked message that followers look at, or refuse it."""
        try:
            self._check_size(raw)
            take(unpacked(raw, kind))
            self.put(topic)
        except InputError as error:
            self.refuse(topic, str(error))

    def _check_size(self, raw: bytes) -> None:
        if len(raw) > self.max_message_bytes:
            raise InputError(f'{len(raw)} bytes are more than max_message_bytes '
                             f'({self.max_message_bytes})')

    def put(self, topic: str, *groups: Group) -> None:
        """Queue commands for the next frame; those of a group act together."""
        with self._lock:
            for group in filter(None, groups):
                self._keep(group)
                self._sources[id(group[0])] = group[0], topic
            self.accepted[topic] += 1
            self.arrived[topic] = time.monotonic()

    def _keep(self, group: Group) -> None:
        """Append a group; targets replace older ones of the same names that still wait."""
        if all(isinstance(command, TARGETS) for command in group):
            names, same = set(map(_name, group)), []
            for k in range(len(self._waiting) - 1, -1, -1):
                others = set(map(_name, self._waiting[k]))
                if type(self._waiting[k][0]) is type(group[0]) and others <= names:
                    same.append(k)
                elif None in others or not others.isdisjoint(names):
                    break
            stamped = all(getattr(command, 'stamp_ns', 0) for command in group)
            for k in same[MAX_STAMPED - 1 if stamped else 0:]:
                self._sources.pop(id(self._waiting.pop(k)[0]), None)
        self._waiting.append(group)

    def drain(self) -> list[Group]:
        """Return and remove all waiting groups."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
            self._drained, self._sources = self._sources, {}
        return waiting

    def topic_of(self, command: Command) -> str | None:
        """Return the topic of the group last drained that begins with a command; None if none."""
        return self._drained.get(id(command), (command, None))[1]

    def refuse(self, topic: str, reason: str) -> None:
        """Count a refusal and warn, at most once in WARN_PERIOD per topic."""
        with self._lock:
            self.refused[topic] += 1
            if topic in self._collecting:
                timer, count, _ = self._collecting[topic]
                self._collecting[topic] = timer, count + 1, reason
                return
            self._collect_refusals(topic)
        self._warn(f'{topic}: refused: {brief(reason)}')

    def _collect_refusals(self, topic: str) -> None:
        """Collect further refusals of a topic for WARN_PERIOD."""
        timer = threading.Timer(WARN_PERIOD, self._report_collected, (topic,))
        timer.daemon = True
        self._collecting[topic] = timer, 0, ''
        timer.start()

    def _report_collected(self, topic: str) -> None:
        """Warn of the refusals collected since the last warning about a topic."""
        with self._lock:
            _, count, reason = self._collecting.pop(topic, (None, 0, ''))
            if count:
                self._collect_refusals(topic)
        if count:
            self._warn(f'{topic}: refused: … and {count} more, the last one: {brief(reason)}')

    def close(self) -> None:
        """Give all pending warnings and stop the timers; no message may follow."""
        with self._lock:
            for timer, _, _ in self._collecting.values():
                timer.cancel()
        for topic in list(self._collecting):
            self._report_collected(topic)
        with self._lock:
            for timer, _, _ in self._collecting.values():
                timer.cancel()
            self._collecting.clear()


def _name(command: Command):
    """Return (kind, name) of the object that a command is about; None if it is about all."""
    if isinstance(command, SetWind):
        return 'wind', ''
    if isinstance(command, SetState):
        return 'cloth', command.cloth
    pin, collider = getattr(command, 'pin', None), getattr(command, 'collider', None)
    if pin is not None:
        return 'pin', pin
    return ('collider', collider) if collider is not None else None
