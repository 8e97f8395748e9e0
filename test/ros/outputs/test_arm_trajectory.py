"""The arm's way as a trajectory: its points, its pace, and that it is in the message of its grasp."""

from __future__ import annotations

import numpy as np
import pytest
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectoryPoint

from graspd_core import load_hand
from graspd_core.arms.arm_paths import STAGE_ROWS
from graspd_core.types import ArmPath, Grasp, Posture
from graspd_ros.outputs.arm_trajectory import arm_trajectory
from graspd_ros.outputs.messages import grasp_message
from graspd_ros.outputs.trajectory import Pace

NAMES = ("shoulder", "elbow")


def grasp_with(step: float) -> Grasp:
    """A grasp 4 cm from its pregrasp, whose arm moves one joint by `step` [rad] between waypoints."""
    hand = load_hand("barrett_like", candidates=50)
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    before, there = (Posture(np.array([0.0, 0.0, z]), turn, hand.open_posture) for z in (0.24, 0.2))
    positions = np.column_stack([step * np.arange(STAGE_ROWS[-1] + 1), np.zeros(STAGE_ROWS[-1] + 1)])
    return Grasp(before, there, there, arm=ArmPath(NAMES, positions, STAGE_ROWS))


def seconds(point: JointTrajectoryPoint) -> float:
    return point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec


@pytest.mark.parametrize("step", [0.0, 0.02, 0.2])
def test_no_joint_and_no_hand_is_faster_than_asked(step: float):
    grasp, pace = grasp_with(step), Pace(joint_speed=0.5, base_speed=0.1, shortest=0.2)
    assert grasp.arm is not None
    trajectory = arm_trajectory(grasp, grasp.arm, pace)
    assert list(trajectory.joint_names) == list(NAMES)
    assert np.allclose([point.positions for point in trajectory.points], grasp.arm.positions)
    times = np.array([seconds(point) for point in trajectory.points])
    assert times[0] == pytest.approx(pace.shortest)
    assert step / np.diff(times).min() <= 0.5
    stages = np.diff(times[list(STAGE_ROWS)])
    assert (stages >= np.maximum(0.2, np.array([0.1, 0.04, 0.1]) / 0.1) - 1e-6).all()


def test_the_message_of_a_grasp_has_it_only_where_there_is_an_arm():
    hand, grasp = load_hand("barrett_like", candidates=50), grasp_with(0.02)
    told = grasp_message(grasp, 0, "id", Header(frame_id="world"), hand, Pace())
    assert list(told.arm_stages) == list(STAGE_ROWS)
    assert len(told.arm_trajectory.points) == STAGE_ROWS[-1] + 1
    bare = grasp_message(Grasp(grasp.pregrasp, grasp.grasp, grasp.squeeze), 0, "id", Header(), hand, Pace())
    assert list(bare.arm_stages) == []
    assert bare.arm_trajectory.points == []
