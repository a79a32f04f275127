"""
One input topic, subscribed so that reliable and best-effort publishers both match.

A reliable subscription does not match best-effort publishers, and a best-effort one receives the
messages of reliable publishers without retransmission. An inlet therefore has a reliable
subscription, and adds a best-effort one once a publisher needs it. That one receives the messages
of reliable publishers too; a message received twice is taken once. If ``qos_overrides`` sets the
reliability, there is only the subscription that it asks for.
"""

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import qos_policy_name_from_kind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

DEPTH = 1000
"""depth of the subscriptions [messages]: half a second of two publishers at 1 kHz"""


class Inlet:
    """
    The subscriptions of one topic.

    Parameters
    ----------
    node : creates the subscriptions
    topic : full name
    kind : message type
    take : is given each serialized message

    """

    def __init__(self, node: LifecycleNode, topic: str, kind: type,
                 take: Callable[[bytes], None]):
        self._node, self._topic, self._kind, self._take = node, topic, kind, take
        self._qos = QoSProfile(depth=DEPTH)
        self._seen: dict[tuple, None] = {}    # latest messages: source time, sequence number
        self._reliable: Any = None
        self._best_effort: Any = None
        self._reliable = self._subscribe(
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible_qos,
                                                       use_default_callbacks=False))

    def _subscribe(self, **options):
        def take(raw, info):
            self._drain(subscription, raw, info)
        callback: Callable[..., None] = take    # rclpy's type lacks the message info
        subscription = self._node.create_subscription(self._kind, self._topic, callback, self._qos,
                                                      raw=True, **options)
        return subscription

    def _on_incompatible_qos(self, event) -> None:
        """Subscribe to best-effort publishers, or report why one is incompatible."""
        given = f'qos_overrides.{self._topic}.subscription.reliability'
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        if policy != 'RELIABILITY' or given in self._node._parameter_overrides:
            self._node.get_logger().warning(
                f'{self._topic}: a publisher is not received: its {policy.lower()} is '
                f'incompatible with qos_overrides.{self._topic}.subscription')
        elif self._best_effort is None:
            self._qos.reliability = ReliabilityPolicy.BEST_EFFORT
            self._best_effort = self._subscribe()

    def _drain(self, subscription, raw: bytes, info: dict) -> None:
        """Take a message and all that wait behind it; one wake-up for each takes far longer."""
        if subscription is self._best_effort:
            self._drain_more(self._reliable)
        self._take_once(raw, info)
        self._drain_more(subscription)

    def _drain_more(self, subscription) -> None:
        with subscription.handle:
            for _ in range(DEPTH):
                found = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if found is None:
                    return
                self._take_once(*found)

    def _take_once(self, raw: bytes, info: dict) -> None:
        if self._best_effort is not None:
            mark = info['source_timestamp'], info['publication_sequence_number']
            if mark in self._seen:
                return
            self._seen[mark] = None
            if len(self._seen) > 4 * DEPTH:
                del self._seen[next(iter(self._seen))]
        self._take(raw)

    def close(self) -> None:
        """Destroy the subscriptions."""
        for subscription in filter(None, (self._reliable, self._best_effort)):
            self._node.destroy_subscription(subscription)
