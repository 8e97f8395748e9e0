"""A recording goes out over DDS as it was recorded, and comes in by a subscription."""

import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from bag_writer import Record, camera_info_message, cloud_message, depth_message, transforms_message, write_bag
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from tf2_msgs.msg import TFMessage

from graspd_core.errors import BagError
from graspd_core.io.messages import cloud_from_depth_message, points_from_message
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.transforms import SECOND
from graspd_ros.player import _shifted, main, play

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5, (0.1, -0.05))
DEPTH = np.linspace(0.4, 0.8, 24 * 32).reshape(24, 32)
POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype("f4").astype(float)
START = 1_700_000_000 * SECOND
TIMEOUT = 100.0


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two clouds 0.2 s apart, a depth image with its camera, and transforms."""
    frame, path = "camera_optical_frame", tmp_path / "bag"
    records = [
        Record("/play/points", START, cloud_message(POINTS, frame, START)),
        Record("/play/tf_static", START, transforms_message([("world", frame, np.eye(4))], START)),
        Record("/play/camera_info", START, camera_info_message(CAMERA, frame, START)),
        Record("/play/image", START, depth_message(DEPTH, frame, START, encoding="32FC1")),
        Record("/play/points", START + SECOND // 5, cloud_message(2 * POINTS, frame, START + SECOND // 5)),
    ]
    write_bag(path, records, storage="mcap")
    return path


@pytest.fixture
def heard(client):
    """What is received of each type on the recording's topics."""
    messages: dict[type, list] = {PointCloud2: [], Image: [], CameraInfo: []}
    names = {PointCloud2: "points", Image: "image", CameraInfo: "camera_info"}
    qos = QoSProfile(depth=10, durability=DurabilityPolicy.VOLATILE)
    subscriptions = [
        client.node.create_subscription(kind, f"/play/{names[kind]}", received.append, qos)
        for kind, received in messages.items()
    ]
    yield messages
    for subscription in subscriptions:
        client.node.destroy_subscription(subscription)


def test_a_recording_comes_in_as_it_was_recorded(client, bag, heard):
    played: list[int] = []
    topics = ("/play/points", "/play/image", "/play/camera_info")
    player = threading.Thread(target=lambda: played.append(play(client.node, bag, topics=topics, wait=TIMEOUT)))
    player.start()
    client.spin_until(lambda: len(heard[PointCloud2]) == 2 and heard[Image] and heard[CameraInfo], "messages")
    player.join(TIMEOUT)
    assert played == [4]
    first, second = heard[PointCloud2]
    np.testing.assert_array_equal(points_from_message(first), POINTS)
    np.testing.assert_array_equal(points_from_message(second), 2 * POINTS)
    assert first.header.stamp.sec * SECOND == START
    # The same functions serve messages of a bag and of DDS.
    seen = cloud_from_depth_message(heard[Image][0], heard[CameraInfo][0])
    assert seen.points[:, 2] == pytest.approx(DEPTH.reshape(-1), abs=1e-6)


def test_the_pace_is_the_recorded_one_times_the_rate(client, tmp_path):
    frame, stamps = "camera_optical_frame", (START, START + 3600 * SECOND)
    records = [Record("/play/points", stamp, cloud_message(POINTS, frame, stamp)) for stamp in stamps]
    write_bag(tmp_path / "hour", records, storage="mcap")
    begun = time.monotonic()
    # At the recorded pace it would take an hour, and the test's time would be over.
    assert play(client.node, tmp_path / "hour", rate=18_000.0) == 2
    assert time.monotonic() - begun >= 3600 / 18_000


def test_stamps_can_be_those_of_now_at_the_rate_that_they_are_played(client, bag, heard):
    given = {"topics": ("/play/points",), "now": True, "rate": 4, "wait": TIMEOUT}
    player = threading.Thread(target=play, args=(client.node, bag), kwargs=given)
    player.start()
    client.spin_until(lambda: len(heard[PointCloud2]) == 2, "clouds")
    player.join(TIMEOUT)
    first, second = (m.header.stamp.sec * SECOND + m.header.stamp.nanosec for m in heard[PointCloud2])
    assert second - first == SECOND // 5 // 4
    assert abs(time.time_ns() - second) < TIMEOUT * SECOND


def test_a_message_without_a_stamp_gets_none():
    for message in (PointCloud2(), TFMessage(transforms=[TransformStamped()])):
        shifted = _shifted(serialize_message(message), type(message), START, time.time_ns(), 1.0)
        assert shifted == message


def test_the_command_loops_under_other_names_until_a_signal(client, start_python, bag, heard):
    options = ("--wait", TIMEOUT, "--rate", 20, "--loop", "--ros-args", "-r", "/play/image:=/play/other")
    process = start_python("-m", "graspd_ros.player", bag, *options)
    client.spin_until(lambda: len(heard[PointCloud2]) >= 5, "clouds of a third round")
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert "left out" not in errors  # /tf_static is played as well
    assert not heard[Image]


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (["missing"], "missing: no such bag"),
        (["BAG", "--rate", "0"], "--rate: 0.0; valid: above 0"),
        (["BAG", "--topics", "/nothing"], "no topic '/nothing'; the bag has: /play/camera_info"),
        (["BAG", "--backwards"], "unrecognized arguments: --backwards"),
        (["BAG", "--ros-args", "--foo"], "unknown ROS arguments: '--foo'; valid: -p NAME:=VALUE"),
    ],
)
def test_bad_input_is_named_in_one_line(bag, capsys, arguments, culprit):
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        status = main([str(bag) if argument == "BAG" else argument for argument in arguments])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert status == 2
    line = capsys.readouterr().err
    assert line.startswith("graspd_play: ")
    assert line.count("\n") == 1
    assert culprit in line


def test_a_bag_without_any_known_type_is_refused(client, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", None)  # as where the package is not installed
    message = transforms_message([("world", "camera", np.eye(4))], START)
    write_bag(tmp_path / "only_tf", [Record("/tf", START, message)])
    with pytest.raises(BagError, match=r"no topic has a type that is installed here; the bag has: /tf \(tf2_msgs"):
        play(client.node, tmp_path / "only_tf")
