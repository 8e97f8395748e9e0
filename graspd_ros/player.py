"""`graspd_play BAG`: publish a recording's topics at the recorded times. Use it where `ros2 bag play` is missing.

graspd_play BAG [--rate R] [--loop] [--topics NAME ...] [--now] [--wait SEC] [--ros-args -r /recorded:=/wanted]
"""

from __future__ import annotations

import argparse
import importlib
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graspd_core.errors import BagError, ConfigError, Parser
from graspd_core.io.bags import BagTopic, bag_topics, read_raw
from graspd_core.transforms import SECOND
from graspd_ros.node import run_command

DEPTH = 10
SETTLE = 0.3  # wait after discovery [s], because the first messages could still be lost
DELIVERY = 5.0  # longest wait at the end until reliable subscribers have confirmed the last messages [s]


def main(args: list[str] | None = None) -> int:
    """Play a recording to its end or until a signal. Return 0 when done or stopped, 2 for bad input."""
    return run_command("graspd_play", args, _parse, _play)


def _play(options: argparse.Namespace, stop: threading.Event) -> None:
    import rclpy

    node = rclpy.create_node("graspd_play")
    play(node, **vars(options), stop=stop)
    node.destroy_node()


def play(
    node: Any,
    bag: Path,
    *,
    topics: Sequence[str] = (),
    rate: float = 1.0,
    loop: bool = False,
    now: bool = False,
    wait: float = 0.0,
    stop: threading.Event | None = None,
) -> int:
    """Publish a recording's messages at their recorded times until `stop` is set. Return the number of messages.

    `_parse` explains the options. Raises BagError if the bag cannot be read, lacks a topic, or has no topic of an
    installed type.
    """
    stop = stop or threading.Event()
    publishers = _publishers(node, bag, topics)
    _wait_for_subscriber(publishers, wait, stop)
    published = 0
    while True:
        begun, began_at, start = time.monotonic(), time.time_ns(), None
        for topic, recorded, data in read_raw(bag, tuple(publishers)):
            if start is None:
                start = recorded
            due = begun + (recorded - start) / SECOND / rate
            if stop.wait(max(0.0, due - time.monotonic())):
                return published
            publisher, kind = publishers[topic.name]
            publisher.publish(_shifted(data, kind, start, began_at, rate) if now else data)
            published += 1
        if not loop or stop.is_set():
            _wait_for_delivery(publishers)
            return published


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = Parser(prog="graspd_play", description="Publish the topics of a rosbag2 recording.")
    parser.add_argument("bag", metavar="BAG", type=Path, help="a directory, or a .mcap or .db3 file")
    parser.add_argument("--rate", type=float, default=1.0, metavar="R", help="factor on the recorded speed (default 1)")
    parser.add_argument("--loop", action="store_true", help="restart the recording at its end")
    parser.add_argument("--topics", nargs="+", default=[], metavar="NAME", help="play only these topics")
    parser.add_argument("--now", action="store_true", help="shift all stamps to the present time")
    parser.add_argument("--wait", type=float, default=0.0, metavar="SEC", help="wait this long for a subscriber")
    options = parser.parse_args(arguments)
    if not options.rate > 0:
        raise ConfigError(f"--rate: {options.rate}; valid: above 0")
    return options


def _publishers(node: Any, bag: Path, wanted: Sequence[str]) -> dict[str, tuple[Any, type]]:
    """Return publisher and message type of each topic whose type is installed. Log a warning about other topics."""
    from rclpy.qos import DurabilityPolicy, QoSProfile

    recorded = bag_topics(bag)
    for name in wanted:
        if name not in {topic.name for topic in recorded}:
            raise BagError(f"{bag}: no topic {name!r}; the bag has: {', '.join(t.name for t in recorded) or 'none'}")
    publishers = {}
    for topic in recorded:
        if wanted and topic.name not in wanted:
            continue
        kind = _message_type(topic)
        if kind is None:
            node.get_logger().warning(f"{topic.name} is not played: no Python package for {topic.type} is installed")
            continue
        latched = topic.name.endswith("tf_static")
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=100 if latched else DEPTH, durability=durability)
        publishers[topic.name] = node.create_publisher(kind, topic.name, qos), kind
    if not publishers:
        types = ", ".join(f"{topic.name} ({topic.type})" for topic in recorded) or "none"
        raise BagError(f"{bag}: no topic has a type that is installed here; the bag has: {types}")
    return publishers


def _message_type(topic: BagTopic) -> type | None:
    package, _, name = topic.type.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None


def _wait_for_subscriber(publishers: dict[str, tuple[Any, type]], timeout: float, stop: threading.Event) -> None:
    end = time.monotonic() + timeout
    while time.monotonic() < end and not stop.is_set():
        if any(publisher.get_subscription_count() for publisher, _ in publishers.values()):
            stop.wait(SETTLE)
            return
        stop.wait(0.02)


def _wait_for_delivery(publishers: dict[str, tuple[Any, type]]) -> None:
    from rclpy.duration import Duration

    end = time.monotonic() + DELIVERY
    for publisher, _ in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


def _shifted(data: bytes, kind: type, start: int, began: int, rate: float) -> Any:
    """Return the message with the stamps of its headers moved to the time of publication.

    The stamp `start` [ns] becomes `began` [ns]. Time since `start` is divided by `rate`. Messages without headers and
    zero stamps do not change, because a zero stamp means that there is none.
    """
    from rclpy.serialization import deserialize_message

    from graspd_ros.convert import nanoseconds, set_nanoseconds

    message = deserialize_message(data, kind)
    for stamped in (message, *getattr(message, "transforms", ())):
        if hasattr(stamped, "header") and (stamp := nanoseconds(stamped.header.stamp)):
            set_nanoseconds(stamped.header.stamp, max(0, began + round((stamp - start) / rate)))
    return message


if __name__ == "__main__":
    sys.exit(main())
