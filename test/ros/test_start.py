"""What a start finds: another ROS, no place for logs, arguments, a robot's arm, two hands on one robot."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from expected import refused
from geometry_msgs.msg import Point, Pose
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import GraspArray, GraspRequest
from rclpy.action.client import ActionClient
from std_msgs.msg import Header, String

from graspd_core import load_hand
from graspd_core.errors import ConfigError, HandError
from graspd_core.paths import config_dir
from graspd_ros.inputs import tf_listener
from graspd_ros.node import foreign_ros, log_directory

LAUNCH = Path(__file__).parents[2] / "graspd_ros" / "launch" / "graspd.launch.py"
pytestmark = pytest.mark.timeout(300)
HANDS = {"left": "allegro_left", "right": "allegro_right"}
FEW = {"num_grasps": 1, "preset": "fast", "deadline": 600.0}  # the goals wait until the nodes are ready


@pytest.mark.parametrize(("program", "package"), [("graspd_ros.node", "rclpy"), ("graspd_ros.player", "sensor_msgs")])
def test_a_ros_before_the_environments_own_is_told_in_one_line(tmp_path, program: str, package: str):
    assert foreign_ros() == ""
    # As a sourced ROS of another Python stands there: it is found, and its compiled part cannot be loaded.
    other = tmp_path / "ros" / "lib" / "python3.12" / "site-packages"
    (other / package).mkdir(parents=True)
    (other / package / "__init__.py").write_text("raise ImportError('No module named rclpy._rclpy_pybind11')")
    environment = {**os.environ, "PYTHONPATH": f"{other}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run([sys.executable, "-m", program], env=environment, capture_output=True, text=True)
    name = {"graspd_ros.node": "graspd_node", "graspd_ros.player": "graspd_play"}[program]
    told = f"{name}: {package} comes from {other}, not from this environment; unset PYTHONPATH, or source no other ROS"
    assert (done.returncode, done.stderr.splitlines()) == (2, [told])


def test_logs_go_to_another_place_where_the_usual_one_cannot_be_written(tmp_path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").touch()
    for name, value in (("ROS_HOME", str(tmp_path)), ("ROS_LOG_DIR", "")):
        monkeypatch.setenv(name, value)
    assert log_directory() == ""
    assert os.environ["ROS_LOG_DIR"] == ""
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "file"))
    told = log_directory()
    assert "cannot be written" in told
    assert "\n" not in told
    assert Path(os.environ["ROS_LOG_DIR"]).is_dir()


def test_launch_arguments_that_are_not_given_leave_the_parameter_file_as_it_is():
    """The launch packages come with ROS: of the file, the function that decides is run alone."""
    body = ast.parse(LAUNCH.read_text()).body
    function = next(node for node in body if isinstance(node, ast.FunctionDef) and node.name == "given")
    names: dict = {}
    exec(compile(ast.Module([function], type_ignores=[]), str(LAUNCH), "exec"), names)
    assert names["given"]({"hand": "", "output_frame": "", "use_sim_time": ""}) == {}
    asked = {"hand": "leap_right", "output_frame": "", "use_sim_time": "True"}
    assert names["given"](asked) == {"hand": "leap_right", "use_sim_time": True}


def test_a_hand_is_taken_out_of_a_robots_description(tmp_path):
    hand = (config_dir() / "hands" / "parallel_gripper.urdf").read_text()
    plain = load_hand("parallel_gripper", candidates=50)
    head, _, body = hand.partition("<link")
    robot = f"""{head}<link name="world_base"/><link name="arm"/>
    <joint name="shoulder" type="revolute"><parent link="world_base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
    <joint name="flange" type="fixed"><parent link="arm"/><child link="{plain.base_link}"/></joint><link{body}"""
    (tmp_path / "robot.urdf").write_text(robot)
    (tmp_path / "hand.yaml").write_text(f"urdf: robot.urdf\nroot: {plain.base_link}\n")
    taken = load_hand(tmp_path / "hand.yaml", candidates=50)
    assert taken.link_names == plain.link_names
    assert taken.joint_names == plain.joint_names
    (tmp_path / "hand.yaml").write_text("urdf: robot.urdf\nroot: elbow\n")
    with pytest.raises(HandError, match="root: no link 'elbow'; links: world_base, arm"):
        load_hand(tmp_path / "hand.yaml")


def description(folder: Path) -> Path:
    """The shipped arm of seven axes, its URDF left to the topic."""
    text = (config_dir() / "arms" / "panda_like.yaml").read_text().replace("urdf: panda_like.urdf", "")
    path = folder / "arm.yaml"
    path.write_text(f"{text}\nurdf: robot_description\n")
    return path


@pytest.fixture
def robot(client):
    """What robot_state_publisher sends, once, before the node starts."""
    publisher = client.kept(String, "/robot_description")
    publisher.publish(String(data=(config_dir() / "arms" / "panda_like.urdf").read_text()))
    yield publisher
    client.node.destroy_publisher(publisher)


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


def test_a_robot_that_never_comes_is_waited_for_so_long(make_node, claim_domain, monkeypatch, tmp_path):
    arm = description(tmp_path)
    told = (
        f"parameter arm: {arm} needs a URDF from /robot_description, but none arrived within 0.2 s"
        "; start robot_state_publisher first, or give a URDF file as urdf"
    )
    assert tf_listener.ROBOT_PATIENCE == 10.0  # as docs/ros.md has it
    monkeypatch.setattr(tf_listener, "ROBOT_PATIENCE", 0.2)
    with refused(ConfigError, match=f"^{re.escape(told)}$"):
        tf_listener.heard_robot(make_node(domain=claim_domain()), str(arm))


def test_two_nodes_of_one_domain_answer_each_for_its_own_hand(client, start_node, tmp_path):
    started, mesh = [], str(tmp_path / "sphere.obj")
    for side, hand in HANDS.items():
        parameters = {"hand": hand, "hand_prefix": f"{side}_", "mesh_roots": f"[{tmp_path}]", **FEW}
        started.append(start_node(ready=False, namespace=f"/{side}", **parameters))
    actions = {side: ActionClient(client.node, SynthesizeGrasps, f"/{side}/graspd/synthesize") for side in HANDS}
    for action in actions.values():
        client.spin_until(action.server_is_ready, "action server")
    goal = SynthesizeGrasps.Goal(request=GraspRequest(id="same-id", source=GraspRequest.MESH, mesh_uri=mesh))
    sent = {side: action.send_goal_async(goal) for side, action in actions.items()}
    ends = {side: client.done(future, "answer to a goal").get_result_async() for side, future in sent.items()}
    for side, future in ends.items():
        answer = client.done(future, "result").result.result
        assert answer.status == GraspArray.SUCCEEDED
        grasp = answer.grasps[0]
        assert grasp.hand == HANDS[side]
        assert grasp.base_link.startswith(f"{side}_")
        assert all(name.startswith(f"{side}_") for name in grasp.trajectory.joint_names)
        assert all(contact.link.startswith(f"{side}_") for contact in grasp.contacts)
    for action in actions.values():
        action.destroy()
    assert [process.stop()[0] for process in started] == [0, 0]
