"""Subscriptions to sensor topics with the QoS that their publishers offer, and detection of lost messages.

rmw's BEST_AVAILABLE chooses the QoS once, when the subscription is created. A camera that starts later may need another
QoS, and its messages would not arrive. This module chooses the QoS again when publishers appear or disappear.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from graspd_core.io.messages import stamp_of

DEPTH = 5
MOST_TWICE = 100  # stamps remembered to drop duplicates while two subscriptions exist
SILENCE = 5.0  # seconds that a publisher may be silent without a warning
REPEAT = 10.0  # seconds between two warnings about lost messages
REMEDY = (
    "Fast DDS loses messages above its shared memory of 512 KB; start sensor and node with "
    "FASTRTPS_DEFAULT_PROFILES_FILE=config/fastdds.xml, or let the sensor publish reliably (docs/ros.md, Large clouds)"
)


class SensorTopic:
    """Subscription to one sensor topic. Only the executor's thread uses it.

    Args:
        node: node that subscribes and logs lost messages.
        kind: message type.
        name: name of the topic before remapping.
        callback: called with each message.
        instead_of: preferred topic. While that topic has publishers, this object does not subscribe.
        ending: suffix of the topic's name. If `name` is not remapped, the topic is `instead_of.name + ending`.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        callback: Callable[[Any], None],
        *,
        instead_of: SensorTopic | None = None,
        ending: str = "",
    ) -> None:
        self._node, self._kind, self._callback, self._instead_of = node, kind, callback, instead_of
        self.name = node.resolve_topic_name(name)
        if instead_of is not None and self.name == node.resolve_topic_name(name, only_expand=True):
            self.name = instead_of.name + ending
        self._received = self._lost = 0
        self._silent_since = self._reported = -float("inf")
        self._subscription: Subscription | None = None
        self._before: Subscription | None = None
        self._twice: set[int] = set()  # stamps received by the old subscription while both existed
        self._qos = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        # The user's QoS override is kept. rclpy has no public function that reads overrides.
        self._fixed = f"qos_overrides.{self.name}.subscription.reliability" in getattr(node, "_parameter_overrides", {})
        if instead_of is None:
            self._listen(QoSOverridingOptions.with_default_policies())

    def publishers(self) -> list[Any]:
        """Return information about the publishers that send messages of type `kind`."""
        kind = f"{self._kind.__module__.partition('.')[0]}/msg/{self._kind.__name__}"
        return [info for info in self._node.get_publishers_info_by_topic(self.name) if info.topic_type == kind]

    def check(self) -> str:
        """Adapt the QoS to the publishers. Return a line about missing messages, or "". Call this once a second."""
        publishers = self.publishers()
        if self._instead_of is not None and (not publishers or self._instead_of.publishers()):
            self._stop()
            return ""
        self._follow(publishers)
        if not publishers:
            self._silent_since = -float("inf")
            return self._other_types()
        if self._received:
            return ""
        if self._silent_since < 0:
            self._silent_since = time.monotonic()
        silent = time.monotonic() - self._silent_since
        lost = f"{self._lost} messages were lost: {REMEDY}" if self._lost else "no message has arrived"
        return f"{self.name}: a publisher has existed for {silent:.0f} s, but {lost}" if silent >= SILENCE else ""

    def _other_types(self) -> str:
        types = {info.topic_type for info in self._node.get_publishers_info_by_topic(self.name)}
        heard = f"this node needs {self._kind.__name__}"
        return f"{self.name}: its publishers have type {', '.join(sorted(types))}; {heard}" if types else ""

    def _follow(self, publishers: list[Any]) -> None:
        offers = [info.qos_profile for info in publishers]
        reliable = bool(offers) and all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        kept = reliable and all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
        wanted = QoSProfile(
            depth=self._qos.depth,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
        )
        same = (wanted.reliability, wanted.durability) == (self._qos.reliability, self._qos.durability)
        if self._subscription is None or (offers and not same and not self._fixed):
            # The old subscription stays until the new one has received a message, so that no message is lost.
            self._destroy(self._before)
            self._before, self._qos, self._twice = self._subscription, wanted, set()
            self._listen()

    def _listen(self, overrides: QoSOverridingOptions | None = None) -> None:
        qos = self._qos

        def take(message: Any) -> None:
            stamp = stamp_of(message)
            if qos is not self._qos:
                self._twice = {stamp, *self._twice} if len(self._twice) < MOST_TWICE else {stamp}
            elif self._before is not None:
                self._destroy(self._before)
                self._before = None
            if qos is self._qos and stamp and stamp in self._twice:
                self._twice.remove(stamp)  # A later message with this stamp is another one, as in a bag that loops.
                return
            self._received += 1
            self._callback(message)

        lost = SubscriptionEventCallbacks(message_lost=lambda status: self._on_lost(status.total_count_change))
        self._subscription = self._node.create_subscription(
            self._kind, self.name, take, qos, event_callbacks=lost, qos_overriding_options=overrides
        )

    def _stop(self) -> None:
        self._destroy(self._before)
        self._destroy(self._subscription)
        self._before = self._subscription = None

    def _destroy(self, subscription: Subscription | None) -> None:
        if subscription is not None:
            self._node.destroy_subscription(subscription)

    def _on_lost(self, count: int) -> None:
        self._lost += count
        if time.monotonic() - self._reported >= REPEAT:
            self._reported = time.monotonic()
            of = self._lost + self._received
            self._node.get_logger().warning(
                f"{self.name}: {self._lost} of {of} messages were lost on the way: {REMEDY}"
            )
