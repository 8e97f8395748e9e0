"""What a start finds around it: another ROS, no place for logs, launch arguments, two hands on one robot."""

from __future__ import annotations

import ast
import os
from pathlib import Path

import pytest
import rclpy

from graspd_core import load_hand
from graspd_core.errors import HandError
from graspd_core.hands.model import all_joint_names
from graspd_core.paths import config_dir
from graspd_ros.node import log_directory
from graspd_ros.ros_command import foreign_rclpy

LAUNCH = Path(__file__).parents[2] / "graspd_ros" / "launch" / "graspd.launch.py"


def test_an_rclpy_before_the_environments_own_is_told_in_one_line():
    assert foreign_rclpy(str(rclpy.__file__)) == ""
    told = foreign_rclpy("/opt/ros/jazzy/lib/python3.12/site-packages/rclpy/__init__.py")
    assert told.startswith("rclpy is that of /opt/ros/jazzy/lib/python3.12/site-packages, not this environment's")
    assert "\n" not in told


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


def test_the_names_of_two_hands_differ_by_a_prefix():
    plain, left = load_hand("barrett_like", candidates=50), load_hand("barrett_like", candidates=50, prefix="left_")
    assert left.base_link == f"left_{plain.base_link}"
    assert all_joint_names(left) == tuple(f"left_{name}" for name in all_joint_names(plain))
    assert set(left.link_index) == {f"left_{name}" for name in plain.link_names}


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
