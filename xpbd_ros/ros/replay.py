"""
The node that publishes a log.

It works as ``ros2 bag play`` does: each message is published as the recorded bytes, with the
recorded quality of service, at its log time. The inputs in a log are published only on request,
because they would act on a running node. All runs in one thread, so services answer between two
messages.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
import importlib
import math
import re
import time
from types import MappingProxyType

from builtin_interfaces.msg import Time
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from xpbd_ros.errors import InputError
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.reader import LogReader, Message
from xpbd_ros.log.replay_clock import Playhead
from xpbd_ros.ros.keyboard import pressed_keys
from xpbd_ros.ros.logged_commands import is_input
from xpbd_ros.ros.signals import collected_signals, ignore_signals

NODE = 'xpbd_ros_replay'
CLOCK = '/clock'
TYPE = re.compile(r'(\w+)/msg/(\w+)')
SERVE_PERIOD = 0.02    # longest time that a burst of messages delays a service [s]
STOP_PERIOD = 0.1      # longest time that a signal waits [s]
LOOK_PERIOD = 0.2      # period of checks for subscribers to inputs [s]
KEY_PERIOD = 0.05      # period at which the keyboard is read [s]
RATE_STEP = 1.1        # factor of the rate by a key
SLOWEST, FASTEST = 0.01, 100.0
UNKNOWN = '_UNKNOWN_'  # rmw's placeholder in a node name that discovery has not delivered yet
ACK_TIMEOUT = 2.0      # longest wait at the end for acknowledgements by subscribers [s]
ANSWER_TIME = 1.0      # time for a service's answer to arrive, which is not acknowledged [s]


def replay(log: LogReader, *, remap: Collection[str] = (), keyboard: bool = False,
           log_level: str = 'info', **options) -> tuple[Counter[str], bool]:
    """
    Publish a log until its end or until SIGINT or SIGTERM.

    Parameters
    ----------
    log
        The log to publish.
    remap
        Rules FROM:=TO for topics and services.
    keyboard
        Whether keys of the terminal control the replay.
    log_level
        Least severity of messages that are printed.
    options
        Options of Replay.

    Returns
    -------
    published : Counter
        Number of published messages by topic.
    stopped : bool
        Whether a signal ended the replay.

    Raises
    ------
    InputError : none of the topics can be published

    """
    rules = [word for rule in remap for word in ('--remap', rule)]
    with stop_flag() as stopped, pressed_keys(keyboard) as keys:
        rclpy.init(args=['--ros-args', *rules, '--log-level', log_level],
                   signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = Replay(log, keys=keys, **options)
            try:
                node.run(stopped)
            finally:
                node.close()
        finally:
            rclpy.try_shutdown()
        return node.published, stopped()


@contextmanager
def stop_flag() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether SIGINT or SIGTERM came; they interrupt nothing."""
    received: list[int] = []
    try:
        with collected_signals() as received:
            yield lambda: bool(received)
    finally:
        if received:
            ignore_signals()


class Replay:
    """
    A node that publishes a log.

    Parameters
    ----------
    log
        The log to publish.
    topics
        Recorded names of the topics to publish; all if None.
    rate
        Log time per wall time.
    loop
        Whether to start again at the end.
    start_offset
        Log time to skip [s]; the last messages of latched topics in it are published first.
    duration
        Log time to publish from ``start_offset`` on [s]; None for all of it.
    until_ns
        Log time after which nothing is published [ns]; with ``duration`` the later one holds.
    delay
        Wall time to wait before each round [s].
    paused
        Whether to wait for ~/resume, ~/play_next or ~/stop.
    clock_hz
        Rate of /clock [Hz], which replaces a recorded one; None for no clock.
    clock_topics
        Topics whose messages are preceded by their log time on /clock, in place of ``clock_hz``;
        all if empty, none if None.
    qos
        Quality of service in place of the recorded one, by topic.
    ack_timeout
        Longest wait at the end for acknowledgements by subscribers [s]; None for no limit.
    keys
        Function that returns the keys pressed since its last call; None without a keyboard.

    """

    def __init__(self, log: LogReader, *, topics: Collection[str] | None = None,
                 rate: float = 1.0, loop: bool = False, start_offset: float = 0.0,
                 duration: float | None = None, until_ns: int | None = None, delay: float = 0.0,
                 paused: bool = False, clock_hz: float | None = None,
                 clock_topics: Collection[str] | None = None,
                 qos: Mapping[str, QoSProfile] = MappingProxyType({}),
                 ack_timeout: float | None = ACK_TIMEOUT,
                 keys: Callable[[], list[str]] | None = None):
        self.published: Counter[str] = Counter()
        self._log = log
        self._loop = loop
        self._start_ns = (log.start_ns or 0) + round(start_offset * 1e9)
        ends = [*([] if duration is None else [self._start_ns + round(duration * 1e9)]),
                *([] if until_ns is None else [until_ns])]
        self._end_ns: float = max(ends, default=math.inf)
        self._delay, self._ack_timeout, self._qos = delay, ack_timeout, qos
        self._timed = frozenset(log.topics if clock_topics is not None and not clock_topics
                                else clock_topics or ())
        self._node = rclpy.create_node(NODE)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._publishers: dict[str, Publisher] = {}
        self._inputs: list[str] = []
        self._listeners: Counter[str] = Counter()
        for topic in log.topics:
            if (topics is None or topic in topics) and not (
                    topic == CLOCK and (clock_hz or self._timed)):
                self._add_publisher(topic)
        if not (self._publishers or clock_hz or self._timed):
            self.close()
            raise InputError(f'{log.path}: has no topic that can be published here')
        for name, answer in (('pause', self._pause), ('resume', self._resume),
                             ('toggle_paused', self._toggle), ('is_paused', self._tell_paused),
                             ('play_next', self._play_next), ('stop', self._stop)):
            self._node.create_service(Trigger, f'~/{name}', answer)
        self._stopped = False
        self._playhead = Playhead(self._start_ns, rate=rate, paused=paused)
        self._declare(rate, start_offset)
        if clock_hz or self._timed:
            self._clock = self._node.create_publisher(ClockMessage, CLOCK, 10)
        if clock_hz:
            self._node.create_timer(1.0 / clock_hz, self._publish_clock,
                                    clock=Clock(clock_type=ClockType.STEADY_TIME))
        if keys is not None:
            self._node.create_timer(KEY_PERIOD, lambda: self._obey(keys()),
                                    clock=Clock(clock_type=ClockType.STEADY_TIME))
        if self._inputs:
            self._node.create_timer(LOOK_PERIOD, self._look_for_listeners,
                                    clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._answered = -ANSWER_TIME
        self._go(self._start_ns)

    def _declare(self, rate: float, start_offset: float) -> None:
        """Declare parameters for the requests of rosbag2 that have no type in std_srvs."""
        for name, value, what in (
                ('rate', rate, 'log time per wall time; > 0'),
                ('seek', start_offset, 'goes to this time of the log when it is set [s]'),
                ('burst', 0, 'publishes so many messages at once when it is set, while paused')):
            self._node.declare_parameter(name, value, ParameterDescriptor(description=what))
        self._node.add_on_set_parameters_callback(self._check_parameters)
        self._node.add_post_set_parameters_callback(self._apply_parameters)

    def run(self, stopped: Callable[[], bool]) -> None:
        """Publish until the end of the log (never, if it loops), ~/stop, or ``stopped()``."""
        self._wait_before_round(stopped)
        served = time.monotonic()
        while not stopped() and not self._stopped:
            if self._next is None and not self._playhead.paused:
                if self._loop:
                    self._wait_before_round(stopped)
                    self._go(self._start_ns)
                if self._next is None:
                    break
            wait = self._playhead.wait(self._next.time_ns) if self._next else STOP_PERIOD
            if wait == 0.0:
                self._publish_next()
                if time.monotonic() - served < SERVE_PERIOD:
                    continue
            self._executor.spin_once(timeout_sec=min(wait, STOP_PERIOD))
            served = time.monotonic()
        self._look_for_listeners(last=True)
        if not stopped():
            self._settle()

    def _wait_before_round(self, stopped: Callable[[], bool]) -> None:
        """Wait for the delay; services are served."""
        if self._delay:
            end = time.monotonic() + self._delay
            while (left := end - time.monotonic()) > 0 and not stopped() and not self._stopped:
                self._executor.spin_once(timeout_sec=min(left, STOP_PERIOD))
            self._playhead.jump(self._next.time_ns if self._next else self._start_ns)

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self._node.destroy_node()

    def _add_publisher(self, topic: str) -> None:
        """Create the publisher of a recorded topic; warn if its type is not installed."""
        about = self._log.topics[topic]
        try:
            if about.encoding != 'cdr':
                raise ValueError(f'its messages are encoded as {about.encoding}, not cdr')
            found = TYPE.fullmatch(about.type)
            if not found:
                raise ValueError('not the name of a message type')
            message_type = getattr(importlib.import_module(f'{found[1]}.msg'), found[2])
            self._publishers[topic] = self._node.create_publisher(
                message_type, topic, self._qos.get(topic) or profile(about.qos))
            if is_input(topic, about.type):
                self._inputs.append(topic)
        except (ImportError, AttributeError, ValueError, NameValidationException) as error:
            self._node.get_logger().warning(
                f'{topic}: left out, its {about.type or "data"} cannot be published here: {error}')

    def _look_for_listeners(self, *, last: bool = False) -> None:
        """Warn which nodes subscribe to inputs; their names may arrive after the subscriptions."""
        for topic in self._inputs:
            publisher = self._publishers[topic]
            count = publisher.get_subscription_count()
            if count > self._listeners[topic]:
                names = {f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in
                         self._node.get_subscriptions_info_by_topic(publisher.topic_name)}
                known = sorted(name for name in names if UNKNOWN not in name)
                if len(known) < len(names) and not last:
                    continue
                self._node.get_logger().warning(
                    f'{publisher.topic_name}: {", ".join(known) or "a node"} listens: it takes '
                    'the inputs of this log')
            self._listeners[topic] = count

    def _go(self, time_ns: int) -> None:
        """Go to a log time [ns], and publish the latched messages before it."""
        self._messages = self._log.messages(self._publishers.keys())
        before: dict[str, deque[Message]] = {
            topic: deque(maxlen=self._log.topics[topic].qos.depth) for topic in self._publishers
            if self._log.topics[topic].qos.latched}
        self._advance()
        while self._next and self._next.time_ns < time_ns:
            if self._next.topic in before:
                before[self._next.topic].append(self._next)
            self._advance()
        for messages in before.values():
            for message in messages:
                self._publish(message)
        self._playhead.jump(time_ns)

    def _advance(self) -> None:
        """Read the next message of the log, up to the end of the replay."""
        message = next(self._messages, None)
        self._next = message if message and message.time_ns <= self._end_ns else None

    def _publish(self, message: Message) -> None:
        """Publish a recorded message, after its time where it sets the clock, and count it."""
        if message.topic in self._timed:
            self._publish_time(message.time_ns)
        self._publishers[message.topic].publish(message.data)
        self.published[message.topic] += 1

    def _publish_next(self) -> None:
        """Publish the next message, and read the one after it."""
        assert self._next is not None
        self._publish(self._next)
        self._advance()

    def _publish_clock(self) -> None:
        """Publish the present log time on /clock."""
        self._publish_time(self._playhead.time_ns)

    def _publish_time(self, time_ns: int) -> None:
        """Publish a log time on /clock."""
        seconds, nanoseconds = divmod(time_ns, 10**9)
        self._clock.publish(ClockMessage(clock=Time(sec=seconds, nanosec=nanoseconds)))

    def _settle(self) -> None:
        """Wait until subscribers and service clients have received all that was sent."""
        begin = time.monotonic()
        for publisher in self._publishers.values():
            if self._ack_timeout is None:
                publisher.wait_for_all_acked()
                continue
            left = max(0.0, begin + self._ack_timeout - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))
        time.sleep(max(0.0, self._answered + ANSWER_TIME - time.monotonic()))

    def _pause(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Pause; the answer tells whether it was paused before."""
        was = self._playhead.paused
        self._playhead.pause()
        return self._told(answer, True, f'{"was" if was else "is"} paused at {self._where()}')

    def _resume(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Resume; the answer tells whether it was playing before."""
        was = self._playhead.paused
        self._playhead.resume()
        did = 'goes on' if was else 'was playing'
        return self._told(answer, True, f'{did} at {self._where()}')

    def _toggle(self, request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Resume if paused, else pause."""
        return (self._resume if self._playhead.paused else self._pause)(request, answer)

    def _tell_paused(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Succeed if it is paused."""
        paused = self._playhead.paused
        return self._told(answer, paused,
                          f'is {"paused" if paused else "playing"} at {self._where()}')

    def _stop(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """End the replay, also while paused."""
        self._stopped = True
        return self._told(answer, True, f'stops at {self._where()}')

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse a rate that is not positive, and a time outside the log."""
        duration = ((self._log.end_ns or 0) - (self._log.start_ns or 0)) * 1e-9
        for each in parameters:
            if each.name == 'rate' and not 0.0 < each.value < math.inf:
                return SetParametersResult(successful=False,
                                           reason=f'rate: must be > 0 (got {each.value})')
            if each.name == 'seek' and not 0.0 <= each.value <= duration:
                return SetParametersResult(successful=False, reason=(
                    f'seek: must be within the log, which is {duration:.3f} s long (got '
                    f'{each.value})'))
            if each.name == 'burst' and (each.value < 1 or not self._playhead.paused):
                return SetParametersResult(successful=False, reason=(
                    f'burst: must be >= 1 (got {each.value})' if each.value < 1 else
                    'burst: is playing; pause first'))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Play at a rate, or from a time, or publish a number of messages, that was set."""
        for each in parameters:
            if each.name == 'rate':
                self._playhead.set_rate(each.value)
            elif each.name == 'seek':
                self._go((self._log.start_ns or 0) + round(each.value * 1e9))
            elif each.name == 'burst':
                for _ in range(each.value):
                    if self._next is None:
                        break
                    self._playhead.jump(self._next.time_ns)
                    self._publish_next()

    def _play_next(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Publish the next message; refused unless paused."""
        if not self._playhead.paused:
            return self._told(answer, False, 'is playing; pause first')
        if self._next is None:
            return self._told(answer, False,
                              f'no message after {self._where()}: the end of the log')
        message = self._next
        self._playhead.jump(message.time_ns)
        self._publish_next()
        return self._told(answer, True,
                          f'{message.topic}, frame {message.frame}, at {self._where()}')

    def _obey(self, keys: list[str]) -> None:
        """Act on keys as ros2 bag play does: pause, next message, faster, slower."""
        for key in keys:
            if key == 'space':
                (self._playhead.resume if self._playhead.paused else self._playhead.pause)()
                text = f'{"paused" if self._playhead.paused else "playing"} at {self._where()}'
            elif key == 'right':
                text = self._play_next(Trigger.Request(), Trigger.Response()).message
            else:
                rate = self._playhead.rate * (RATE_STEP if key == 'up' else 1.0 / RATE_STEP)
                self._node.set_parameters([Parameter(
                    'rate', value=min(max(rate, SLOWEST), FASTEST))])
                text = f'rate {self._playhead.rate:.3g}'
            self._node.get_logger().info(text)

    def _told(self, answer: Trigger.Response, success: bool, message: str) -> Trigger.Response:
        """Fill in and return a service's answer."""
        self._answered = time.monotonic()
        answer.success, answer.message = success, message
        return answer

    def _where(self) -> str:
        """Return the time since the start of the log, as text [s]."""
        return f'{(self._playhead.time_ns - (self._log.start_ns or 0)) * 1e-9:.3f} s'


def profile(qos: Qos) -> QoSProfile:
    """Return the recorded quality of service in rclpy's terms."""
    return QoSProfile(depth=qos.depth,
                      reliability=ReliabilityPolicy[qos.reliability.upper()],
                      durability=DurabilityPolicy[qos.durability.upper()])
