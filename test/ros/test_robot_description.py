"""An arm that is part of the robot on /robot_description: heard at the start, or one line that says what is missing."""

from __future__ import annotations

from pathlib import Path

import pytest
from geometry_msgs.msg import Point, Pose
from graspd_msgs.msg import GraspArray, GraspRequest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header, String

from graspd_core.paths import config_dir

pytestmark = pytest.mark.timeout(300)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def description(folder: Path, **keys: str) -> Path:
    """The shipped arm of seven axes, its URDF left to the topic."""
    text = (config_dir() / "arms" / "panda_like.yaml").read_text().replace("urdf: panda_like.urdf", "")
    path = folder / "arm.yaml"
    for key, value in keys.items():
        text = "\n".join(line for line in text.splitlines() if not line.startswith(f"{key}:")) + f"\n{key}: {value}\n"
    path.write_text(f"{text}\nurdf: robot_description\n")
    return path


@pytest.fixture
def robot(client):
    """What robot_state_publisher sends, once, before the node starts."""
    publisher = client.node.create_publisher(String, "/robot_description", LATCHED)
    publisher.publish(String(data=(config_dir() / "arms" / "panda_like.urdf").read_text()))
    yield publisher
    client.node.destroy_publisher(publisher)


def told_at_the_start(start_node, arm: Path) -> list[str]:
    node = start_node(ready=False, arm=arm)
    node.process.wait(100)
    status, log = node.stop()
    assert status == 2
    return [line for line in log.splitlines() if line.startswith("graspd_node:")]


def test_grasps_come_with_the_joints_of_an_arm_that_was_heard(client, robot, start_node, tmp_path):
    start_node(arm=description(tmp_path), hand="barrett_like", num_grasps=1, preset="fast", deadline=100.0)
    place = Pose(position=Point(x=0.5, z=0.2))
    header = Header(frame_id="base_link")
    client.send_request(
        id="r", source=GraspRequest.MESH, mesh_uri="sphere.obj", header=header, object_pose=place, time_budget=100.0
    )
    answer = client.answer("r")
    assert answer.status == GraspArray.SUCCEEDED, answer.message
    assert list(answer.grasps[0].arm_trajectory.joint_names) == [f"joint_{number}" for number in range(1, 8)]


def test_a_link_that_the_robot_does_not_have_ends_the_start_with_the_choices(robot, start_node, tmp_path):
    (told,) = told_at_the_start(start_node, description(tmp_path, tip="tool"))
    assert "arm.yaml.tip: no link 'tool' in the URDF; links: base_link, " in told
    (told,) = told_at_the_start(start_node, description(tmp_path, base="torso"))
    assert "arm.yaml.base: no link 'torso' in the URDF; links: base_link, " in told


def test_a_robot_that_never_comes_is_waited_for_so_long(start_node, tmp_path):
    arm = description(tmp_path)
    (told,) = told_at_the_start(start_node, arm)
    assert told == (
        f"graspd_node: parameter arm: {arm} is part of the robot on /robot_description, where nothing came within 10 s"
        "; start robot_state_publisher first, or name a file in urdf"
    )
