"""A mounted hand's grasps say where the arm has to be, and coupled joints are in every message."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel, Mount
from graspd_core.types import Grasp, Posture
from graspd_ros.inputs.frames import matrix_of_pose
from graspd_ros.outputs.messages import grasp_message
from graspd_ros.outputs.mount import matrix_of_mount
from graspd_ros.outputs.trajectory import Pace, stage_times

# The flange's z is the hand's, 3 cm before the mount; an eighth of a turn about it.
MOUNT = Mount("tool0", (0.0, 0.0, 0.03), (float(np.cos(np.pi / 8)), 0.0, 0.0, float(np.sin(np.pi / 8))))


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return replace(load_hand("barrett_like", candidates=8), mount=MOUNT)


def posture(hand: HandModel, share: float, height: float) -> Posture:
    joints = hand.lower + share * (hand.upper - hand.lower)
    return Posture(np.array([0.1, -0.2, height]), np.array([0.5, 0.5, -0.5, 0.5]), joints)


@pytest.fixture(scope="module")
def grasp(hand: HandModel) -> Grasp:
    return Grasp(posture(hand, 0.2, 0.3), posture(hand, 0.4, 0.25), posture(hand, 0.5, 0.25), (), 1.0)


def test_the_arms_link_is_where_the_mount_puts_it(hand: HandModel, grasp: Grasp) -> None:
    message = grasp_message(grasp, 0, "r", Header(frame_id="camera"), hand, Pace())
    assert message.mount_link == "tool0"
    for base, parent in (
        (message.pregrasp_pose, message.mount_pregrasp_pose),
        (message.grasp_pose, message.mount_grasp_pose),
    ):
        # T_frame_parent · T_parent_base is the base link's pose again.
        again = matrix_of_pose(parent) @ matrix_of_mount(MOUNT)
        np.testing.assert_allclose(again, matrix_of_pose(base), atol=1e-12)
    # By hand: the base's z is turned by the quaternion (0.5, 0.5, -0.5, 0.5) onto -y; 3 cm back along it.
    z = matrix_of_pose(message.grasp_pose)[:3, 2]
    at = message.mount_grasp_pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], np.array([0.1, -0.2, 0.25]) - 0.03 * z, atol=1e-12)


def test_a_floating_hand_names_no_link(hand: HandModel, grasp: Grasp) -> None:
    message = grasp_message(grasp, 0, "r", Header(frame_id="camera"), replace(hand, mount=None), Pace())
    assert message.mount_link == ""


def test_all_movable_joints_are_in_every_message(hand: HandModel, grasp: Grasp) -> None:
    message = grasp_message(grasp, 0, "r", Header(frame_id="camera", stamp=Time()), hand, Pace())
    names = [
        "f1_spread",
        "f1_proximal",
        "f1_distal",
        "f2_spread",
        "f2_proximal",
        "f2_distal",
        "f3_proximal",
        "f3_distal",
    ]
    assert list(message.grasp_joints.name) == names
    # Controllers refuse joints that have no command of their own.
    assert list(message.trajectory.joint_names) == list(hand.joint_names)
    assert set(hand.joint_names) < set(names)
    value = dict(zip(names, message.squeeze_joints.position, strict=True))
    assert value["f2_spread"] == pytest.approx(-value["f1_spread"])
    assert value["f3_distal"] == pytest.approx(value["f3_proximal"] / 3)
    for point, at in zip(message.trajectory.points, (grasp.pregrasp, grasp.grasp, grasp.squeeze), strict=True):
        np.testing.assert_allclose(point.positions, at.joint_positions)
        assert len(point.velocities) == hand.num_joints


def test_a_follower_is_no_faster_than_its_kind_may_be(hand: HandModel, grasp: Grasp) -> None:
    """A joint that follows three times as fast makes its leader three times as slow."""
    quick = replace(hand, mimics=tuple(replace(m, multiplier=3.0) for m in hand.mimics), velocity=np.full(4, np.inf))
    pace = Pace(joint_speed=0.1, shortest=0.01)
    travel = grasp.grasp.joint_positions - grasp.pregrasp.joint_positions
    first, closed, _ = stage_times(grasp, quick, pace)
    assert closed - first == pytest.approx(1.5 * 3 * np.abs(travel).max() / 0.1)
