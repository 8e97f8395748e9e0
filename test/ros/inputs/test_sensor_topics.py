"""Topics of sensors over DDS, from processes of their own: large clouds, what is offered, what is lost or missing."""

import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from rclpy.exceptions import InvalidParameterValueException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from graspd_ros.inputs import sensor_topics
from graspd_ros.inputs.sensor_topics import SensorTopic
from graspd_ros.parameters import LiveSettings

pytestmark = pytest.mark.timeout(300)
LARGE = 1_200_000  # bytes of a cloud that Fast DDS' shared memory of 512 KB does not hold

# Publishes so many messages of so many bytes, when somebody asks with the reliability that it is told to wait for.
PUBLISHER = """
import sys, time, rclpy
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs import msg

kind, topic, reliability, durability, asked, count, size = sys.argv[1:8]
rclpy.init(args=[])
node = rclpy.create_node("camera")
qos = QoSProfile(depth=20, reliability=ReliabilityPolicy[reliability], durability=DurabilityPolicy[durability])
publisher = node.create_publisher(getattr(msg, kind), topic, qos)
heard = lambda: {info.qos_profile.reliability.name for info in node.get_subscriptions_info_by_topic(topic)}
while asked != "NOBODY" and asked not in heard():
    time.sleep(0.02)
time.sleep(0.5)  # the match follows the news of it
message = getattr(msg, kind)()
for number in range(int(count)):
    if "paced" in sys.argv and number:
        sys.stdin.readline()  # a slow machine's queues are not what is tested
    message.header.stamp.sec, message.header.stamp.nanosec = number, 1
    if kind != "CameraInfo":
        message.data = bytes(int(size))
    publisher.publish(message)
    time.sleep(0.05)
publisher.wait_for_all_acked(Duration(seconds=100))
print("sent", flush=True)
sys.stdin.read()
"""

EXECUTORS: list[Executor] = []  # a node holds its own by a weak reference only
Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture(scope="module")
def domain(claim_domain: Callable[[], int]) -> int:
    """A domain without the node that other tests share: it hears the same topics."""
    return claim_domain()


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch, domain: int, make_node) -> Iterator[Node]:
    """A node with the shared memory that Fast DDS has by itself."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    yield make_node(domain=domain)
    for executor in set(EXECUTORS):
        executor.shutdown()
    EXECUTORS.clear()


@pytest.fixture
def publish(node: Node, start_python: Start) -> Start:
    def start(kind: str, topic: str, reliability: str, **more: Any) -> subprocess.Popen[str]:
        options = {"durability": "VOLATILE", "asked": reliability, "count": 1, "size": 100} | more
        return start_python("-c", PUBLISHER, kind, topic, reliability, *options.values())

    return start


def watch(node: Node, topics: list[SensorTopic], until: Callable[[list[str]], Any]) -> list[str]:
    """Spin and check, as the node does, until what the topics say is as wanted."""
    # One for all of a test: an executor that ends may take what it was about to hand out with it.
    executor = node.executor or SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    EXECUTORS.append(executor)
    while not until(told := [topic.check() for topic in topics]):
        executor.spin_once(timeout_sec=0.05)
    return told


def test_large_clouds_of_a_reliable_publisher_all_come(node: Node, publish: Start):
    heard: list[PointCloud2] = []
    topic = SensorTopic(node, PointCloud2, "points", heard.append)
    camera = publish("PointCloud2", "/points", "RELIABLE", count=20, size=LARGE, paced="paced")
    assert camera.stdin is not None
    for number in range(20):
        watch(node, [topic], lambda told: any(cloud.header.stamp.sec == number for cloud in heard))  # noqa: B023
        camera.stdin.write("\n")
        camera.stdin.flush()
    assert {cloud.header.stamp.sec for cloud in heard} == set(range(20))
    assert all(len(cloud.data) == LARGE for cloud in heard)


def test_what_comes_once_while_the_choice_is_made_is_heard(node: Node):
    publisher = node.create_publisher(CameraInfo, "/depth/camera_info", 10)
    heard: list[CameraInfo] = []
    topic = SensorTopic(node, CameraInfo, "depth/camera_info", heard.append)
    watch(node, [topic], lambda told: topic._before is not None)
    # Matched with the one before, not yet perhaps with the new one.
    publisher.publish(CameraInfo(width=1))
    watch(node, [topic], lambda told: heard)
    while topic._before is not None:
        publisher.publish(CameraInfo(width=2))
        count = len(heard)
        watch(node, [topic], lambda told: len(heard) > count)  # noqa: B023
    assert heard[0].width == 1
    publisher.publish(CameraInfo(width=3))
    watch(node, [topic], lambda told: heard[-1].width == 3)
    assert len([info for info in heard if info.width == 3]) == 1


def test_a_stamp_that_comes_again_later_is_heard(node: Node):
    publisher = node.create_publisher(CameraInfo, "/depth/camera_info", 10)
    heard: list[CameraInfo] = []
    topic = SensorTopic(node, CameraInfo, "depth/camera_info", heard.append)

    def send(width: int) -> None:
        message = CameraInfo(width=width)
        message.header.stamp.sec = 1
        publisher.publish(message)
        spins = iter(range(5))
        watch(node, [topic], lambda told: next(spins, None) is None)

    watch(node, [topic], lambda told: topic._before is not None)
    while topic._before is not None:
        send(1)
    while heard[-1].width != 2:  # until the test's limit, where the stamp counts as heard for ever
        send(2)


def test_a_camera_that_offers_less_is_heard_too_and_its_losses_are_told(node, publish, capfd):
    heard: list[PointCloud2] = []
    topic = SensorTopic(node, PointCloud2, "points", heard.append)
    publish("PointCloud2", "/points", "BEST_EFFORT", count=3)
    watch(node, [topic], lambda told: heard)
    publish("PointCloud2", "/points", "BEST_EFFORT", count=40, size=8 * LARGE)
    watch(node, [topic], lambda told: topic._lost)
    written = "".join(capfd.readouterr())
    assert "/points: " in written
    assert "were lost on the way: Fast DDS loses messages" in written
    assert "config/fastdds.xml" in written


def test_what_was_published_before_is_heard_where_it_is_kept(node: Node, publish: Start):
    camera = publish("CameraInfo", "/depth/camera_info", "RELIABLE", durability="TRANSIENT_LOCAL", asked="NOBODY")
    assert camera.stdout is not None
    assert camera.stdout.readline() == "sent\n"
    heard: list[CameraInfo] = []
    topic = SensorTopic(node, CameraInfo, "depth/camera_info", heard.append)
    watch(node, [topic], lambda told: heard)
    assert topic._qos.durability is DurabilityPolicy.TRANSIENT_LOCAL


def test_what_somebody_asks_for_by_a_parameter_stays(make_node, domain: int, publish: Start):
    node = make_node("-p", "qos_overrides./points.subscription.reliability:=best_effort", domain=domain)
    heard: list[PointCloud2] = []
    topic = SensorTopic(node, PointCloud2, "points", heard.append)
    publish("PointCloud2", "/points", "RELIABLE", asked="BEST_EFFORT", count=5)
    watch(node, [topic], lambda told: heard)
    assert topic._qos.reliability is ReliabilityPolicy.BEST_EFFORT


@pytest.mark.parametrize(("policy", "value"), [("reliability", "certain"), ("history", "unknown"), ("depth", "-3")])
def test_an_invalid_qos_override_is_named_with_the_valid_values(make_node, domain: int, policy: str, value: str):
    name = f"qos_overrides./points.subscription.{policy}"
    node = make_node("-p", f"{name}:={value}", domain=domain)
    LiveSettings(node)
    with pytest.raises(InvalidParameterValueException, match=f"{name}: '?{value}'?; valid: "):
        SensorTopic(node, PointCloud2, "points", print)


def test_packed_images_are_heard_where_nobody_sends_plain_ones(node: Node, publish: Start):
    heard: list[Any] = []
    plain = SensorTopic(node, Image, "depth/image_rect", heard.append)
    name, ending = "depth/image_rect/compressedDepth", "/compressedDepth"
    packed = SensorTopic(node, CompressedImage, name, heard.append, instead_of=plain, ending=ending)
    publish("CompressedImage", "/depth/image_rect/compressedDepth", "RELIABLE", count=3)
    watch(node, [plain, packed], lambda told: len(heard) == 3)
    assert all(isinstance(message, CompressedImage) for message in heard)
    heard.clear()
    publish("Image", "/depth/image_rect", "RELIABLE", count=3)
    watch(node, [plain, packed], lambda told: len(heard) == 3)
    publish("CompressedImage", "/depth/image_rect/compressedDepth", "RELIABLE", asked="NOBODY", count=3)
    assert all(isinstance(message, Image) for message in heard)
    assert packed._subscription is None


def test_a_publisher_that_sends_nothing_or_another_type_is_told(node, publish, monkeypatch):
    monkeypatch.setattr(sensor_topics, "SILENCE", 0.3)
    clouds, images = (
        SensorTopic(node, kind, name, lambda message: None)
        for kind, name in ((PointCloud2, "points"), (Image, "depth/image_rect"))
    )
    assert [clouds.check(), images.check()] == ["", ""]
    publish("PointCloud2", "/points", "BEST_EFFORT", count=0)
    publish("CompressedImage", "/depth/image_rect", "BEST_EFFORT", count=0, asked="NOBODY")
    silent, other = watch(node, [clouds, images], all)
    assert silent.startswith("/points: a publisher has existed for ")
    assert silent.endswith("but no message has arrived")
    assert other == "/depth/image_rect: its publishers have type sensor_msgs/msg/CompressedImage; this node needs Image"
