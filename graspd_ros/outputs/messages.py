"""Progress and answers as messages of graspd_msgs. No message carries a NaN.

Metrics that were not measured are left out; other figures that are not finite are -1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, Vector3
from graspd_msgs.msg import Contact as ContactMessage
from graspd_msgs.msg import Grasp as GraspMessage
from graspd_msgs.msg import GraspArray, GraspProgress, Metric
from graspd_msgs.msg import TrialResult as TrialMessage
from std_msgs.msg import Header

from graspd_core import HandModel
from graspd_core.types import Contact, Grasp, GraspResult, Outcome, Progress, Stage, TrialResult, Verdict
from graspd_ros.inputs.frames import pose_of_matrix
from graspd_ros.outputs import status_json as convert
from graspd_ros.outputs.arm_trajectory import arm_trajectory
from graspd_ros.outputs.error_codes import ErrorCode
from graspd_ros.outputs.mount import parent_pose
from graspd_ros.outputs.trajectory import Pace, base_poses, trajectory_of

UNMEASURED = -1.0
VERDICTS = {
    Verdict.UNVERIFIED: GraspMessage.UNVERIFIED,
    Verdict.VERIFIED: GraspMessage.VERIFIED,
    Verdict.FAILED: GraspMessage.FAILED,
}
# Outcomes that fall short of what was asked for, as codes.
_SHORT = {
    Outcome.TOO_FEW: ErrorCode.NO_GRASP,
    Outcome.NO_CANDIDATES: ErrorCode.NO_GRASP,
    Outcome.DEADLINE: ErrorCode.DEADLINE,
    Outcome.CANCELLED: ErrorCode.CANCELLED,
}


@dataclass(frozen=True)
class AnswerEnding:
    """How a request ended, in the words of a GraspArray.

    Attributes:
        status: one of the constants of GraspArray.
        code: kind of trouble, `NONE` where there was none.
        message: one line for people.
        result: the run, None where there was none; its grasps are in the answer's frame.
    """

    status: int
    code: ErrorCode
    message: str
    result: GraspResult | None = None


def ending_of(result: GraspResult) -> AnswerEnding:
    """The ending of a run that nobody stopped."""
    message = result.message or result.outcome.value
    if result.outcome is Outcome.SUCCEEDED:
        return AnswerEnding(GraspArray.SUCCEEDED, ErrorCode.NONE, message, result)
    if result.outcome is Outcome.CANCELLED:
        return AnswerEnding(GraspArray.CANCELLED, ErrorCode.CANCELLED, message, result)
    some = any(grasp.verdict is not Verdict.FAILED for grasp in result.grasps)
    return AnswerEnding(GraspArray.PARTIAL if some else GraspArray.FAILED, _SHORT[result.outcome], message, result)


def array_message(
    ending: AnswerEnding, request_id: str, header: Header, elapsed: float, hand: HandModel, pace: Pace
) -> GraspArray:
    """The one answer to a request; `elapsed` seconds after it came. Raises FloatingPointError: a grasp holds a NaN."""
    message = GraspArray(
        header=header,
        request_id=request_id,
        status=ending.status,
        error_code=str(ending.code),
        message=ending.message,
        elapsed=elapsed,
    )
    if ending.result is not None:
        message.outcome = ending.result.outcome.name.lower()
        message.warnings = list(ending.result.warnings)
        if ending.result.next_view is not None:
            message.next_view = PoseStamped(header=header, pose=pose_of_matrix(ending.result.next_view))
        message.grasps = [
            grasp_message(grasp, rank, request_id, header, hand, pace)
            for rank, grasp in enumerate(ending.result.grasps)
        ]
    return message


def grasp_message(
    grasp: Grasp, rank: int, request_id: str, header: Header, hand: HandModel, pace: Pace
) -> GraspMessage:
    """One grasp, in the frame that the header names. Raises FloatingPointError: it holds a NaN."""
    _check_finite(grasp, rank)
    joints = [
        convert.joint_message(posture, hand, header.stamp) for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze)
    ]
    message = GraspMessage(
        header=header,
        id=f"{request_id}/{rank}",
        rank=rank,
        verdict=VERDICTS[grasp.verdict],
        reason=grasp.reason,
        hand=hand.name,
        base_link=hand.base_link,
        pregrasp_pose=convert.pose_of(grasp.pregrasp),
        grasp_pose=convert.pose_of(grasp.grasp),
        pregrasp_joints=joints[0],
        grasp_joints=joints[1],
        squeeze_joints=joints[2],
        score=_number(grasp.score),
        probability=-1.0 if grasp.probability is None else grasp.probability,
        metrics=[
            Metric(name=name, value=value)
            for name, value in (grasp.metrics or {}).items()
            if value is not None and math.isfinite(value)
        ],
        trials=[_trial(trial) for trial in grasp.trials],
        contacts=[_contact(contact) for contact in grasp.contacts],
        trajectory=trajectory_of(grasp, hand, pace),
        trajectory_base_poses=base_poses(grasp, header.frame_id, header.stamp),
    )
    if grasp.arm is not None:
        message.arm_trajectory = arm_trajectory(grasp, grasp.arm, pace)
        message.arm_stages = list(grasp.arm.stages)
    if hand.mount is not None:
        message.mount_link = hand.mount.parent
        message.mount_pregrasp_pose = parent_pose(message.pregrasp_pose, hand.mount)
        message.mount_grasp_pose = parent_pose(message.grasp_pose, hand.mount)
    return message


def progress_message(progress: Progress, request_id: str, frame: str, stamp: Time, elapsed: float) -> GraspProgress:
    """How far a request is, `elapsed` seconds after it came."""
    return GraspProgress(
        header=Header(frame_id=frame, stamp=stamp),
        request_id=request_id,
        stage=str(progress.stage),
        step=max(progress.step, 0),
        of=max(progress.of, 0),
        fraction=convert.fraction_of(progress),
        best=_number(progress.best, 0.0),
        verified=progress.verified,
        elapsed=elapsed,
        message=sentence(progress),
    )


def queued_message(request_id: str, frame: str, stamp: Time, ahead: int) -> GraspProgress:
    """What a request hears that must wait its turn."""
    header = Header(frame_id=frame, stamp=stamp)
    return GraspProgress(header=header, request_id=request_id, stage="queued", message=f"queued: {ahead} ahead")


def sentence(progress: Progress) -> str:
    """A progress report for people."""
    steps = f"{progress.step} of {progress.of}"
    match progress.stage:
        case Stage.LOAD:
            return "reading the object"
        case Stage.OPTIMISE:
            return f"optimising: step {steps}, lowest loss {progress.best:.3g}"
        case Stage.VERIFY:
            return f"trying grasps: {steps}, {progress.verified} hold"
        case _:
            return f"done: {progress.verified} hold"


def _check_finite(grasp: Grasp, rank: int) -> None:
    postures = {"pregrasp": grasp.pregrasp, "grasp": grasp.grasp, "squeeze": grasp.squeeze}
    parts = {
        f"{name}'s {part}": getattr(posture, part)
        for name, posture in postures.items()
        for part in ("position", "quaternion_wxyz", "joint_positions")
    }
    parts |= {f"contact of {c.link}": [*c.position, *c.normal] for c in grasp.contacts}
    wrong = [name for name, values in parts.items() if not np.isfinite(values).all()]
    if wrong:
        raise FloatingPointError(f"grasp {rank}: not finite: {', '.join(wrong)}")


def _contact(contact: Contact) -> ContactMessage:
    x, y, z = map(float, contact.position)
    nx, ny, nz = map(float, contact.normal)
    return ContactMessage(link=contact.link, position=Point(x=x, y=y, z=z), normal=Vector3(x=nx, y=ny, z=nz))


def _trial(trial: TrialResult) -> TrialMessage:
    return TrialMessage(
        name=trial.name,
        passed=trial.passed,
        displacement=_number(trial.displacement),
        rotation=_number(trial.rotation),
        reason=trial.reason,
    )


def _number(value: float, otherwise: float = UNMEASURED) -> float:
    return float(value) if math.isfinite(value) else otherwise
