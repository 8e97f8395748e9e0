"""Progress, answers and trajectories as messages. No message carries a NaN.

Metrics that were not measured are left out; other figures that are not finite are -1.

A trajectory has three points in time for the fingers, and the base's pose at each of them. Velocities are zero at every
point. A controller that interpolates by cubics (ros2_control's, where positions and velocities are given) then moves
all joints along straight lines in step with each other, which is the way that the trial tried, and its greatest speed
is 1.5 times the mean one of each stage; the times here account for that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped
from graspd_msgs.msg import Contact as ContactMessage
from graspd_msgs.msg import Grasp as GraspMessage
from graspd_msgs.msg import GraspArray, GraspProgress, Metric
from graspd_msgs.msg import TrialResult as TrialMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from graspd_core import HandModel
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import RETREAT
from graspd_core.hands.model import Mount, all_joint_names, all_joint_positions
from graspd_core.types import (
    ArmPath,
    Contact,
    Grasp,
    GraspResult,
    Outcome,
    Posture,
    Progress,
    Stage,
    TrialResult,
    Verdict,
)
from graspd_ros.convert import (
    Matrix,
    duration_of,
    matrix_of,
    matrix_of_posture,
    point_of,
    pose_of_matrix,
    pose_of_posture,
    vector_of,
)
from graspd_ros.error_codes import ErrorCode

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
    joints = [joint_message(posture, hand, header.stamp) for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze)]
    message = GraspMessage(
        header=header,
        id=f"{request_id}/{rank}",
        rank=rank,
        verdict=VERDICTS[grasp.verdict],
        reason=grasp.reason,
        hand=hand.name,
        base_link=hand.base_link,
        pregrasp_pose=pose_of_posture(grasp.pregrasp),
        grasp_pose=pose_of_posture(grasp.grasp),
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
        message.mount_pregrasp_pose = mount_pose(grasp.pregrasp, hand.mount)
        message.mount_grasp_pose = mount_pose(grasp.grasp, hand.mount)
    return message


def progress_message(progress: Progress, request_id: str, frame: str, stamp: Time, elapsed: float) -> GraspProgress:
    """How far a request is, `elapsed` seconds after it came."""
    return GraspProgress(
        header=Header(frame_id=frame, stamp=stamp),
        request_id=request_id,
        stage=str(progress.stage),
        step=max(progress.step, 0),
        of=max(progress.of, 0),
        fraction=fraction_of(progress),
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


def fraction_of(progress: Progress) -> float:
    """How much of its stage is done, 0 to 1; 0 where nobody knows."""
    return min(progress.step / progress.of, 1.0) if progress.of > 0 else 0.0


def joint_message(posture: Posture, hand: HandModel, stamp: Time) -> JointState:
    """Values of all movable joints, coupled ones too [rad] or [m]; no velocities and no efforts."""
    return JointState(
        header=Header(frame_id=hand.base_link, stamp=stamp),
        name=list(all_joint_names(hand)),
        position=all_joint_positions(hand, posture.joint_positions).tolist(),
    )


def pose_message(grasp: Grasp, frame: str, stamp: Time) -> PoseStamped:
    """Where the hand's base link is at the grasp, in the frame that the object came in."""
    return PoseStamped(header=Header(frame_id=frame, stamp=stamp), pose=pose_of_posture(grasp.grasp))


def matrix_of_mount(mount: Mount) -> Matrix:
    """Return `T_parent_base` [m]: the hand's base link in the arm's link that carries it."""
    return matrix_of(mount.position, mount.quaternion_wxyz)


def mount_pose(base: Posture, mount: Mount) -> Pose:
    """Return the pose of the arm's link when the hand's base link is at `base`, in the same frame."""
    return pose_of_matrix(matrix_of_posture(base) @ np.linalg.inv(matrix_of_mount(mount)))


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
    return ContactMessage(link=contact.link, position=point_of(contact.position), normal=vector_of(contact.normal))


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
    return [PoseStamped(header=Header(frame_id=frame, stamp=stamp), pose=pose_of_posture(p)) for p in _postures(grasp)]


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
    return JointTrajectoryPoint(
        positions=positions.tolist(), velocities=[0.0] * len(positions), time_from_start=duration_of(at)
    )


def arm_trajectory(grasp: Grasp, path: ArmPath, pace: Pace) -> JointTrajectory:
    """All waypoints of an arm; no velocities, so that controllers go through them without a stop.

    The arm is taken to stand at the retreat when it begins: the first point comes after `pace.shortest`.
    Between two stages time is shared out evenly, enough for joints below `pace.joint_speed` and the hand below
    `pace.base_speed`.
    """
    from graspd_core.arms.arm_paths import LIFT
    from graspd_core.hands.kinematics import RETREAT

    way = float(np.linalg.norm(grasp.grasp.position - grasp.pregrasp.position))
    times = [pace.shortest]
    for first, last, travel in zip(path.stages, path.stages[1:], (RETREAT, way, LIFT), strict=False):
        fastest = float(np.abs(np.diff(path.positions[first : last + 1], axis=0)).max()) * (last - first)
        seconds = max(pace.shortest, _PEAK * fastest / pace.joint_speed, _PEAK * travel / pace.base_speed)
        times += (times[-1] + seconds * np.arange(1, last - first + 1) / (last - first)).tolist()
    points = [
        JointTrajectoryPoint(positions=positions.tolist(), time_from_start=duration_of(at))
        for positions, at in zip(path.positions, times, strict=True)
    ]
    return JointTrajectory(joint_names=list(path.joint_names), points=points)
