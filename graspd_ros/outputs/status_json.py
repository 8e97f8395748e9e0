"""Grasps to ROS messages and to the JSON events of `~/status`.

Quaternions turn from wxyz (core) to xyzw (ROS) in `pose_of`. No message carries a NaN.
"""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.io.grasps_json import grasp_figures
from graspd_core.types import Grasp, GraspResult, Posture, Progress, Verdict


def pose_of(posture: Posture) -> Pose:
    """Pose of the hand's base link in the object's frame."""
    x, y, z = map(float, posture.position)
    qw, qx, qy, qz = map(float, posture.quaternion_wxyz)
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_message(grasp: Grasp, frame: str, stamp: Time) -> PoseStamped:
    """Where the hand's base link is at the grasp, in the frame that the object came in."""
    return PoseStamped(header=Header(frame_id=frame, stamp=stamp), pose=pose_of(grasp.grasp))


def joint_message(posture: Posture, hand: HandModel, stamp: Time) -> JointState:
    """Values of all movable joints, coupled ones too [rad] or [m]; no velocities and no efforts."""
    return JointState(
        header=Header(frame_id=hand.base_link, stamp=stamp),
        name=list(all_joint_names(hand)),
        position=all_joint_positions(hand, posture.joint_positions).tolist(),
    )


def presentable(result: GraspResult) -> Grasp | None:
    """The best grasp, if it is as sure as was asked for: one known to be bad or less sure is never published as one."""
    best = result.grasps[0] if result.grasps else None
    return best if best is not None and best.usable else None


def progress_event(progress: Progress) -> dict[str, Any]:
    """A progress report; `fraction` is that of its stage."""
    told = {name: value for name, value in vars(progress).items() if name != "found"}
    return {**told, "fraction": fraction_of(progress)}


def fraction_of(progress: Progress) -> float:
    """How much of its stage is done, 0 to 1; 0 where nobody knows."""
    return min(progress.step / progress.of, 1.0) if progress.of > 0 else 0.0


def result_event(result: GraspResult) -> dict[str, Any]:
    """Outcome, counts, timing and the best grasp's figures; `best` is null when no grasp is worth publishing."""
    best = presentable(result)
    return {
        "outcome": result.outcome.name.lower(),
        "message": result.message or result.outcome.value,
        "warnings": list(result.warnings),
        "grasps": len(result.grasps),
        "verified": sum(grasp.verdict is Verdict.VERIFIED for grasp in result.grasps),
        "timing": dataclasses.asdict(result.timing),
        "audits": dataclasses.asdict(result.audits),
        "best": None if best is None else _summary(best),
    }


def _summary(grasp: Grasp) -> dict[str, Any]:
    pose = grasp.grasp
    return {
        "verdict": grasp.verdict,
        "score": grasp.score,
        "probability": grasp.probability,
        "position": [float(value) for value in pose.position],
        "quaternion_wxyz": [float(value) for value in pose.quaternion_wxyz],
        "links": [contact.link for contact in grasp.contacts],
        **grasp_figures(grasp),
    }


def status_line(event: dict[str, Any]) -> str:
    """One JSON object on one line; numbers that JSON does not know become null."""
    return json.dumps(_finite(event), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
