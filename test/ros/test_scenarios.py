"""Whole stories between processes: a recording played in, its answer recorded, simulated time, a client that dies."""

import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writer import Record, camera_info_message, depth_message, packed_depth, transforms_message, write_bag
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import Grasp, GraspArray, GraspRequest
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_srvs.srv import Trigger

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import TabletopScene, depth_views, ring_poses, tabletop
from graspd_core.io.grasps_json import grasps_of, load_document
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.transforms import SECOND
from graspd_ros.convert import array_of, matrix_of_pose

SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
ONE = {"num_grasps": 1, "preset": "fast"}
REACH = 0.2  # metres from the hand's base to what it holds
START = 1_700_000_000 * SECOND  # of the recording; long before now
SEEN = START + SECOND + SECOND // 100  # when the image was taken: between two samples of /tf
CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)

# An action client whose end nobody but the system decides on.
DOOMED = """
import rclpy
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import GraspRequest
from rclpy.action import ActionClient

rclpy.init()
node = rclpy.create_node("doomed")
client = ActionClient(node, SynthesizeGrasps, "/graspd/synthesize")
client.wait_for_server()
request = GraspRequest(id="orphan", source=GraspRequest.MESH, mesh_uri="sphere.obj", num_grasps=64)
request.preset, request.time_budget = "accurate", 600.0
tell = lambda told: print(told.feedback.progress.stage, flush=True)
goal = client.send_goal_async(SynthesizeGrasps.Goal(request=request), feedback_callback=tell)
rclpy.spin_until_future_complete(node, goal)
answer = goal.result().get_result_async()
print("asked for the result", flush=True)
rclpy.spin_until_future_complete(node, answer)
"""

pytestmark = pytest.mark.timeout(300)


def rigid(rotation: Rotation, place: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), place
    return T


@pytest.fixture
def publish(client) -> Iterator[Callable[[Any, str], None]]:
    """Publishes a message on a topic that the node listens to."""
    publishers: dict[str, Any] = {}

    def publish(message: Any, topic: str) -> None:
        if topic not in publishers:
            publishers[topic] = client.node.create_publisher(type(message), topic, 10)
            client.spin_until(publishers[topic].get_subscription_count, f"subscriber of {topic}")
        publishers[topic].publish(message)

    yield publish
    for publisher in publishers.values():
        client.node.destroy_publisher(publisher)


def record_scene(path: Path, scene: TabletopScene) -> np.ndarray:
    """A recording of 1.5 s: one noisy depth image by a camera on a mount that moves. `T_world_camera` at the image."""
    (T_world_camera,) = ring_poses(1, elevation=0.8, azimuth=0.5)
    T_mount_camera = rigid(Rotation.from_euler("xyz", [0.3, -0.2, 1.0]), [0.05, 0.0, 0.1])
    T_world_mount = T_world_camera @ np.linalg.inv(T_mount_camera)
    records = [Record("/tf_static", START, transforms_message([("mount", "optical", T_mount_camera)], START))]
    for stamp in range(START, START + 3 * SECOND // 2, SECOND // 50):
        seconds = (stamp - SEEN) / SECOND
        pose = T_world_mount @ rigid(Rotation.from_rotvec([0, 0, seconds]), [0.0, 0.0, 0.0])
        pose[:3, 3] += [0.5 * seconds, 0.0, 0.0]
        records.append(Record("/tf", stamp, transforms_message([("world", "mount", pose)], stamp)))
    ((depth, _),) = depth_views(scene, CAMERA, (T_world_camera,), DEFAULT)
    records.append(Record("/camera/camera_info", SEEN, camera_info_message(CAMERA, "optical", SEEN)))
    records.append(Record("/camera/image_rect", SEEN, depth_message(depth, "optical", SEEN)))
    write_bag(path, records, storage="mcap")
    return T_world_camera


def record_answer(path: Path, data: bytes, typestore: Any) -> None:
    """One GraspArray as `ros2 bag record` writes it: the bytes of DDS, and the definitions of the types."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/recorded/grasps", "graspd_msgs/msg/GraspArray", typestore=typestore)
        writer.write(topic, START, data)


def test_a_played_recording_is_grasped_in_the_world_and_the_recorded_answer_reads_back(
    client, node, start_python, tmp_path, typestore, agree
):
    scene = tabletop("cylinder", yaw=0.3)
    T_world_camera = record_scene(tmp_path / "scene", scene)
    play = partial(start_python, "-m", "graspd_ros.player", "--wait", 100)
    raw: list[bytes] = []
    recorder = client.node.create_subscription(GraspArray, "/graspd/grasps", raw.append, 10, raw=True)
    client.set_parameters(output_frame="world", **ONE)
    remaps = ("-r", "/camera/image_rect:=/depth/image_rect", "-r", "/camera/camera_info:=/depth/camera_info")
    player = play(tmp_path / "scene", "--now", "--ros-args", *remaps)
    result = client.event(event="result")
    answer = client.answer(result["request"])
    assert player.wait() == 0, player.stderr.read()

    assert (answer.status, answer.header.frame_id) == (GraspArray.SUCCEEDED, "world"), answer.message
    best = answer.grasps[0]
    assert (best.verdict, best.header.frame_id) == (Grasp.VERIFIED, "world")
    T_world_base = matrix_of_pose(best.grasp_pose)
    low, high = scene.truth.vertices.min(0), scene.truth.vertices.max(0)
    assert np.linalg.norm(T_world_base[:3, 3] - (low + high) / 2) < REACH
    contacts = np.array([array_of(contact.position) for contact in best.contacts])
    assert (contacts > low - 0.015).all()
    assert (contacts < high + 0.015).all()
    # The file holds the same grasp as the camera saw it; the camera's true pose then, not the newest, leads here.
    seen = grasps_of(load_document(node.directory / result["file"]))[0].grasp
    T_camera_base = rigid(Rotation.from_quat(seen.quaternion_wxyz, scalar_first=True), list(seen.position))
    np.testing.assert_allclose(T_world_base, T_world_camera @ T_camera_base, atol=1e-6)

    client.spin_until(lambda: raw, "the answer as bytes")
    client.node.destroy_subscription(recorder)
    record_answer(tmp_path / "answer", raw[0], typestore)
    with AnyReader([tmp_path / "answer"]) as reader:
        ((connection, _, data),) = reader.messages()
        assert agree(reader.deserialize(data, connection.msgtype), answer)
    assert deserialize_message(bytes(data), GraspArray) == answer
    replayed: list[GraspArray] = []
    subscription = client.node.create_subscription(GraspArray, "/recorded/grasps", replayed.append, 10)
    play(tmp_path / "answer")
    client.spin_until(lambda: replayed, "the answer once more")
    client.node.destroy_subscription(subscription)
    assert replayed == [answer]


def test_a_client_killed_amid_its_goal_leaves_the_node_serving(client, node, start_python):
    doomed, awaited = start_python("-c", DOOMED), {"asked for the result", "optimise"}
    while awaited and (line := doomed.stdout.readline()):
        awaited.discard(line.strip())
    assert not awaited
    assert not client.answers
    doomed.send_signal(signal.SIGKILL)
    assert doomed.wait() == -signal.SIGKILL
    # Nobody waits for it any more; it can be cancelled still, and a goal that waits behind it is served.
    actions = client.actions(SynthesizeGrasps, "synthesize")
    goal = SynthesizeGrasps.Goal(request=GraspRequest(id="heir", **SPHERE, **ONE))
    asked = client.send_goal(actions, goal).get_result_async()
    client.send_cancel("orphan")
    assert client.answer("orphan").status == GraspArray.CANCELLED
    ended = client.done(asked, "result")
    assert ended.result.result.status == GraspArray.SUCCEEDED
    assert node.alive()
    actions.destroy()


def test_under_sim_time_a_clouds_age_is_told_by_the_clock_topic(client, start_node, publish, make_cloud, seen_ball):
    process = start_node(use_sim_time=True, **ONE)
    health: list[DiagnosticArray] = []
    subscription = client.node.create_subscription(DiagnosticArray, "/diagnostics", health.append, 10)

    def set_time(stamp: int) -> None:
        def told() -> bool:
            publish(Clock(clock=Time(sec=stamp // SECOND)), "/clock")
            return bool(health) and health[-1].header.stamp.sec == stamp // SECOND

        client.spin_until(told, "the node's time")

    cloud = make_cloud(seen_ball)
    cloud.header.stamp = Time(sec=START // SECOND)
    set_time(START + SECOND)
    client.send_cloud(cloud)
    result = client.event(event="result")  # though the clock stands still meanwhile
    answer = client.answer(result["request"])
    assert (answer.status, answer.header) == (GraspArray.SUCCEEDED, cloud.header), answer.message
    set_time(START + 10 * SECOND)
    client.send_request(id="late", source=GraspRequest.LATEST_CLOUD)
    late = client.answer("late")
    assert (late.status, late.error_code) == (GraspArray.REFUSED, "STALE_CLOUD")
    assert "is 10.0 s old" in late.message
    client.node.destroy_subscription(subscription)
    assert process.alive()


def test_packed_depth_whose_calibration_comes_once_is_grasped_and_what_does_not_pair_is_told(
    client, node, claim_domain, tmp_path
):
    """In a domain of its own: other tests publish plain images, and the node hears those alone."""
    own = type(client)(claim_domain())
    process = type(node)(own.domain, tmp_path, {}, None)
    try:
        own.event(event="ready")
        own.wait_for_match()
        own.forget()
        packed_images_are_grasped(own)
    finally:
        process.stop()
        own.close()


def packed_images_are_grasped(client) -> None:
    ((depth, _),) = depth_views(tabletop("cylinder", yaw=0.3), CAMERA, ring_poses(1, elevation=0.8), DEFAULT)
    client.set_parameters(cloud_policy="off", **ONE)
    message = CompressedImage(format="16UC1; compressedDepth png", data=packed_depth(depth))
    publisher = client.node.create_publisher(CompressedImage, "/depth/image_rect/compressedDepth", 10)

    def latest(name: str) -> GraspArray:
        asked: list[str] = []

        def sent() -> bool:
            message.header.frame_id, message.header.stamp = "camera_depth_optical_frame", client.now()
            publisher.publish(message)
            client.spin_for(0.2)
            asked.append(f"{name}-{len(asked)}")
            client.send_request(id=asked[-1], source=GraspRequest.LATEST_CLOUD)
            answer = client.answer(asked[-1])
            return answer.error_code != "NO_CLOUD" or "but no pair matches" in answer.message

        client.spin_until(sent, "an answer about the image")
        return client.answer(asked[-1])

    missing = latest("alone")
    assert (missing.status, missing.error_code) == (GraspArray.REFUSED, "NO_CLOUD")
    assert missing.message.startswith("no cloud or depth image has arrived yet; ")
    assert "; depth images: " in missing.message
    assert "and 0 CameraInfos received, but no pair matches; last image: 320 x 240" in missing.message
    assert client.event(event="refused", source="sensors")["code"] == "NO_CLOUD"
    # Once, and without a stamp.
    calibration = CameraInfo(height=240, width=320, k=[308.0, 0, 159.5, 0, 308.0, 119.5, 0, 0, 1])
    infos = client.node.create_publisher(CameraInfo, "/depth/camera_info", 10)
    client.spin_until(infos.get_subscription_count, "match of the calibration")
    calibration.header.frame_id = "camera_depth_optical_frame"
    infos.publish(calibration)
    client.call(Trigger, "reset")
    answer = latest("paired")
    if "0 CameraInfos received" in answer.message:
        # The node may match the publisher after it is matched. Then the one message was lost.
        infos.publish(calibration)
        answer = latest("again")
    assert answer.status == GraspArray.SUCCEEDED, answer.message
    assert answer.header.frame_id == "camera_depth_optical_frame"
