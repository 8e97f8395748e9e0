"""Where the arm stands that carries the hand: the restriction by its reach, from parameters and /tf."""

from __future__ import annotations

import time
from functools import lru_cache

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from graspd_core import Arm, Reach, load_arm
from graspd_core.arms.arm import ROBOT_DESCRIPTION, from_robot_description, read_arm_file
from graspd_core.errors import ConfigError
from graspd_ros.convert import wxyz_of_matrix
from graspd_ros.request import FrameLookup, Request

ROBOT_PATIENCE = 10.0  # seconds that the start waits for the robot


def reach_of(request: Request, lookup: FrameLookup, robot_description: str = "") -> Reach:
    """Return the restriction, in the frame of the request's object, whose settings name the arm and its base's frame.

    `lookup` is of two frames when the object was seen, `robot_description` the URDF of a robot that has the arm.
    """
    settings = request.settings
    arm = _arm(settings.arm, robot_description)
    T = request.to_object(settings.arm_base_frame or arm.chain.base_link, np.eye(4), lookup)
    x, y, z = map(float, T[:3, 3])
    qw, qx, qy, qz = map(float, wxyz_of_matrix(T))
    return Reach(arm, (x, y, z), (qw, qx, qy, qz))


# What is known of an arm takes a tenth of a second to make, and is kept with it.
@lru_cache(maxsize=2)
def _arm(name: str, robot_description: str) -> Arm:
    return load_arm(name, robot_description)


def heard_robot(node: Node, arm: str) -> str:
    """Return the URDF on the topic robot_description if an arm is part of that robot; else nothing is waited for.

    To be called at the start, before the node is spun. Raises GraspdError: nothing came in time, or not with the arm.
    """
    if not from_robot_description(read_arm_file(arm)[1]):
        return ""
    heard: list[String] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    topic = node.create_subscription(String, ROBOT_DESCRIPTION, heard.append, latched)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end = time.monotonic() + ROBOT_PATIENCE
    while not heard and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)  # in short turns, between which signals are handled
    name = topic.topic_name
    executor.remove_node(node)
    executor.shutdown()
    node.destroy_subscription(topic)
    if not heard:
        raise ConfigError(
            f"parameter arm: {arm} is part of the robot on {name}, where nothing came within {ROBOT_PATIENCE:g} s; "
            "start robot_state_publisher first, or name a file in urdf"
        )
    robot = str(heard[-1].data)
    _arm(arm, robot)
    return robot
