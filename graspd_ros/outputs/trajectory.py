"""A grasp as what controllers execute: three points in time for the fingers, and the base's pose at each of them.

Velocities are zero at every point. A controller that interpolates by cubics (ros2_control's, where positions and
velocities are given) then moves all joints along straight lines in step with each other, which is the way that the
trial tried, and its greatest speed is 1.5 times the mean one of each stage; the times here account for that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from graspd_core import HandModel
from graspd_core.errors import ConfigError
from graspd_core.types import Grasp, Posture
from graspd_ros.outputs.status_json import pose_of

# Greatest over mean speed of a cubic that starts and ends at rest.
_PEAK = 1.5


@dataclass(frozen=True)
class Pace:
    """How fast a real hand may be moved; a joint's own limit holds too.

    Attributes:
        joint_speed: greatest speed of a turning joint [rad/s].
        base_speed: greatest speed of the hand's base, and of sliding joints [m/s].
        base_turn: greatest turning speed of the base [rad/s].
        shortest: least time of a stage, twice and a half the trial's own [s].
    """

    joint_speed: float = 1.0
    base_speed: float = 0.05
    base_turn: float = 0.5
    shortest: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name}: {value}; it must be positive and finite")


def trajectory_of(grasp: Grasp, hand: HandModel, pace: Pace) -> JointTrajectory:
    """Pregrasp, grasp and squeeze, for a controller that starts on receipt (the stamp is zero) from any posture.

    It names the joints that a controller drives: one that follows another has no command of its own, and controllers
    refuse joints that they do not know. Positions are within the joint limits. The last point is a target that presses:
    joints stop short of it.
    """
    times = stage_times(grasp, hand, pace)
    return JointTrajectory(
        header=Header(frame_id=hand.base_link),
        joint_names=list(hand.joint_names),
        points=[_point(posture, hand, at) for posture, at in zip(_postures(grasp), times, strict=True)],
    )


def base_poses(grasp: Grasp, frame: str, stamp: Time) -> list[PoseStamped]:
    """Where the hand's base link is at each point of the trajectory; straight and evenly turning in between."""
    return [PoseStamped(header=Header(frame_id=frame, stamp=stamp), pose=pose_of(p)) for p in _postures(grasp)]


def stage_times(grasp: Grasp, hand: HandModel, pace: Pace) -> tuple[float, float, float]:
    """Seconds from the start until pregrasp, grasp and squeeze.

    The first is enough for any joint to come from anywhere within its limits; the base is taken to stand at the
    pregrasp by then.
    """
    speed = _greatest_speeds(hand, pace)
    first = max(pace.shortest, _PEAK * float(np.max((hand.upper - hand.lower) / speed, initial=0.0)))
    closing = _stage_time(grasp.pregrasp, grasp.grasp, speed, pace)
    return first, first + closing, first + closing + _stage_time(grasp.grasp, grasp.squeeze, speed, pace)


def _stage_time(start: Posture, end: Posture, speed: np.ndarray, pace: Pace) -> float:
    joints = float(np.max(np.abs(end.joint_positions - start.joint_positions) / speed, initial=0.0))
    travel = float(np.linalg.norm(end.position - start.position)) / pace.base_speed
    # A rotation is the same as its negative quaternion: the shorter way round.
    cosine = min(abs(float(start.quaternion_wxyz @ end.quaternion_wxyz)), 1.0)
    turn = 2 * math.acos(cosine) / pace.base_turn
    return max(pace.shortest, _PEAK * max(joints, travel, turn))


def _greatest_speeds(hand: HandModel, pace: Pace) -> np.ndarray:
    """Of the actuated joints [rad/s] or [m/s]; a joint that follows one may not be faster than its own kind either."""
    speed = np.minimum(np.where(hand.slides, pace.base_speed, pace.joint_speed), hand.velocity)
    for mimic in hand.mimics:
        own = pace.base_speed if hand.joint_kind[mimic.link] == "prismatic" else pace.joint_speed
        speed[mimic.joint] = min(speed[mimic.joint], own / max(abs(mimic.multiplier), 1e-9))
    return speed


def _postures(grasp: Grasp) -> tuple[Posture, Posture, Posture]:
    return grasp.pregrasp, grasp.grasp, grasp.squeeze


def _point(posture: Posture, hand: HandModel, at: float) -> JointTrajectoryPoint:
    # Rounding may put a joint that rests on its limit a hair beyond it, which controllers refuse.
    positions = np.clip(posture.joint_positions, hand.lower, hand.upper)
    # Whole nanoseconds, rounded up: never faster than allowed.
    seconds, nanoseconds = divmod(math.ceil(at * 1e9), 1_000_000_000)
    return JointTrajectoryPoint(
        positions=positions.tolist(),
        velocities=[0.0] * len(positions),
        time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
    )
