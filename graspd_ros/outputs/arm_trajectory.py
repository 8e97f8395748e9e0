"""The arm's way through a grasp as a trajectory."""

from __future__ import annotations

import math

import numpy as np
from builtin_interfaces.msg import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from graspd_core.arms.arm_paths import LIFT
from graspd_core.hands.kinematics import RETREAT
from graspd_core.types import ArmPath, Grasp
from graspd_ros.outputs.trajectory import Pace

# Greatest over mean speed between two stages, as of fingers.
_PEAK = 1.5


def arm_trajectory(grasp: Grasp, path: ArmPath, pace: Pace) -> JointTrajectory:
    """All waypoints; no velocities, so that controllers go through them without a stop.

    The arm is taken to stand at the retreat when it begins: the first point comes after `pace.shortest`.
    Between two stages time is shared out evenly, enough for joints below `pace.joint_speed` and the hand below
    `pace.base_speed`.
    """
    way = float(np.linalg.norm(grasp.grasp.position - grasp.pregrasp.position))
    times = [pace.shortest]
    for first, last, travel in zip(path.stages, path.stages[1:], (RETREAT, way, LIFT), strict=False):
        fastest = float(np.abs(np.diff(path.positions[first : last + 1], axis=0)).max()) * (last - first)
        seconds = max(pace.shortest, _PEAK * fastest / pace.joint_speed, _PEAK * travel / pace.base_speed)
        times += (times[-1] + seconds * np.arange(1, last - first + 1) / (last - first)).tolist()
    points = [
        JointTrajectoryPoint(positions=positions.tolist(), time_from_start=_duration(at))
        for positions, at in zip(path.positions, times, strict=True)
    ]
    return JointTrajectory(joint_names=list(path.joint_names), points=points)


def _duration(seconds: float) -> Duration:
    # Whole nanoseconds, rounded up: never faster than allowed.
    whole, nanoseconds = divmod(math.ceil(seconds * 1e9), 1_000_000_000)
    return Duration(sec=whole, nanosec=nanoseconds)
