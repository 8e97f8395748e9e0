"""Progress, answers, trajectories and markers as messages. No message contains a NaN.

Metrics that were not measured are omitted. Other non-finite numbers become -1.

A finger trajectory has three points: pregrasp, grasp and squeeze. Each point has a pose of the hand's base link and
zero velocities. So a controller with cubic interpolation (ros2_control) moves straight in joint space, as in the trial.
Between two points, the greatest speed is 1.5 times the mean speed. The durations keep the speeds within their limits.

RViz markers show the hand at its grasp, the contacts, the axes of the base link, and a text. Each name of `PARTS`
is a marker namespace that can be switched off. Marker ids of a grasp start at `IDS_OF_A_GRASP` times its rank. Markers
stay until the next result deletes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped
from graspd_msgs.msg import Contact as ContactMessage
from graspd_msgs.msg import Grasp as GraspMessage
from graspd_msgs.msg import GraspArray, GraspExecution, GraspProgress, Metric
from graspd_msgs.msg import TrialResult as TrialMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from graspd_core import ArmPath, Grasp, HandModel, Outcome, Posture, Progress, Verdict
from graspd_core.hands.kinematics import RETREAT, link_poses
from graspd_core.hands.model import Mount, Primitive, all_joint_names, all_joint_positions
from graspd_core.types import Contact, Stage, TrialResult
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

if TYPE_CHECKING:
    from graspd_ros.parameters import Settings
    from graspd_ros.request_planner import Planned

UNMEASURED = -1.0
_CODES = {
    Outcome.SUCCEEDED: ErrorCode.NONE,
    Outcome.TOO_FEW: ErrorCode.NO_GRASP,
    Outcome.NO_CANDIDATES: ErrorCode.NO_GRASP,
    Outcome.DEADLINE: ErrorCode.DEADLINE,
    Outcome.CANCELLED: ErrorCode.CANCELLED,
}

# Ratio of greatest to mean speed of a cubic that starts and ends at rest.
_PEAK = 1.5
IDS_OF_A_GRASP = 1000
GEOMETRIES = ("visual", "collision")
# Parts that markers can show. For the best grasps: the hand at grasp, pregrasp and squeeze (the last two faint),
# contacts, axes of the base link, and a text. `rejected` shows position and reason of grasps that failed a trial.
PARTS = ("hand", "pregrasp", "squeeze", "contacts", "axes", "text", "rejected")
USUAL_PARTS = ("hand", "contacts", "axes", "text")
_FAINT = 0.25
COLOURS = {
    Verdict.VERIFIED: (0.20, 0.70, 0.30),
    Verdict.UNVERIFIED: (0.95, 0.70, 0.15),
    Verdict.FAILED: (0.85, 0.20, 0.20),
}
_AXIS_LENGTH = 0.05
_ARROW_LENGTH = 0.03
_TEXT_HEIGHT = 0.015
_TEXT_ABOVE = 0.12


@dataclass(frozen=True)
class AnswerEnding:
    """Outcome of a request, for a GraspArray. `planned` is None if the request was not processed."""

    status: int
    code: ErrorCode
    message: str
    planned: Planned | None = None


def ending_of(planned: Planned) -> AnswerEnding:
    """Return status, error code and message for the GraspArray of a planning result."""
    result = planned.result
    some = any(grasp.verdict is not Verdict.FAILED for grasp in result.tried)
    ends = {Outcome.SUCCEEDED: GraspArray.SUCCEEDED, Outcome.CANCELLED: GraspArray.CANCELLED}
    status = ends.get(result.outcome, GraspArray.PARTIAL if some else GraspArray.FAILED)
    return AnswerEnding(status, _CODES[result.outcome], result.message or result.outcome.value, planned)


def array_message(
    ending: AnswerEnding, request_id: str, header: Header, elapsed: float, hand: HandModel, settings: Settings
) -> GraspArray:
    """Return the answer to a request that came `elapsed` seconds ago. Raises FloatingPointError: a grasp has a NaN."""
    message = GraspArray(
        header=header,
        request_id=request_id,
        status=ending.status,
        error_code=str(ending.code),
        message=ending.message,
        elapsed=elapsed,
    )
    if ending.planned is not None:
        planned, result = ending.planned, ending.planned.result
        message.mass, message.mass_assumed = _number(planned.mass, 0.0), planned.mass_assumed
        message.objects = [point_of(place) for place, _ in planned.objects]
        message.object_reasons = [reason for _, reason in planned.objects]
        message.outcome, message.warnings = result.outcome.name.lower(), list(result.warnings)
        if result.next_view is not None:
            message.next_view = PoseStamped(header=header, pose=pose_of_matrix(result.next_view))
        # If the object may weigh more than in the trials, the lift is gentle.
        mass = result.tried_mass if result.mass is None else None
        message.grasps = [
            grasp_message(grasp, rank, request_id, header, hand, settings, mass=mass)
            for rank, grasp in enumerate(result.tried)
        ]
    return message


def grasp_message(
    grasp: Grasp,
    rank: int,
    request_id: str,
    header: Header,
    hand: HandModel,
    settings: Settings,
    *,
    mass: float | None = None,
) -> GraspMessage:
    """Return one grasp in the header's frame. Raises FloatingPointError if the grasp contains a NaN.

    `mass` is the object's mass [kg], or None if unknown. The lift acceleration depends on the mass.
    """
    _check_finite(grasp, rank)
    pregrasp, closed, squeeze = (joint_message(posture, hand, header.stamp) for posture in _postures(grasp))
    message = GraspMessage(
        header=header,
        id=f"{request_id}/{rank}",
        rank=rank,
        verdict=getattr(GraspMessage, grasp.verdict.name),
        reason=grasp.reason,
        hand=hand.name,
        base_link=hand.base_link,
        pregrasp_pose=pose_of_posture(grasp.pregrasp),
        grasp_pose=pose_of_posture(grasp.grasp),
        pregrasp_joints=pregrasp,
        grasp_joints=closed,
        squeeze_joints=squeeze,
        score=_number(grasp.score),
        probability=UNMEASURED if grasp.probability is None else grasp.probability,
        metrics=[
            Metric(name=name, value=value)
            for name, value in (grasp.metrics or {}).items()
            if value is not None and math.isfinite(value)
        ],
        trials=[_trial_message(trial) for trial in grasp.trials],
        contacts=[_contact_message(contact) for contact in grasp.contacts],
        trajectory=trajectory_of(grasp, hand, settings),
        trajectory_base_poses=base_poses(grasp, header.frame_id, header.stamp),
    )
    if grasp.arrival is not None:
        message.arrival_pose = pose_of_posture(grasp.arrival)
        message.arrival_joints = joint_message(grasp.arrival, hand, header.stamp)
    if grasp.arm is not None:
        message.arm_trajectory = arm_trajectory(grasp, grasp.arm, settings)
        message.arm_stages = list(grasp.arm.stages)
        message.execution = execution_message(grasp, grasp.arm, hand, settings, mass)
    if hand.mount is not None:
        message.mount_link = hand.mount.parent
        message.mount_pregrasp_pose = mount_pose(grasp.pregrasp, hand.mount)
        message.mount_grasp_pose = mount_pose(grasp.grasp, hand.mount)
    return message


def _trial_message(trial: TrialResult) -> TrialMessage:
    moved, turned = _number(trial.displacement), _number(trial.rotation)
    return TrialMessage(name=trial.name, passed=trial.passed, displacement=moved, rotation=turned, reason=trial.reason)


def _contact_message(contact: Contact) -> ContactMessage:
    normal, force = vector_of(contact.normal), vector_of(contact.force or (0.0, 0.0, 0.0))
    return ContactMessage(link=contact.link, position=point_of(contact.position), normal=normal, force=force)


def progress_message(progress: Progress, request_id: str, frame: str, stamp: Time, elapsed: float) -> GraspProgress:
    """Return the progress of a request that arrived `elapsed` seconds ago."""
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


def sentence(progress: Progress) -> str:
    """Return a progress report as one line for people."""
    steps = f"{progress.step} of {progress.of}"
    said = {
        Stage.LOAD: "reading the object",
        Stage.OPTIMISE: f"optimising: step {steps}, lowest loss {progress.best:.3g}",
        Stage.VERIFY: f"trying grasps: {steps}, {progress.verified} hold",
    }
    return said.get(progress.stage, f"done: {progress.verified} hold")


def fraction_of(progress: Progress) -> float:
    """Return the fraction of the current stage that is done, 0 to 1, or 0 if unknown."""
    return min(progress.step / progress.of, 1.0) if progress.of > 0 else 0.0


def joint_message(posture: Posture, hand: HandModel, stamp: Time) -> JointState:
    """Return the positions of all movable joints, including coupled ones [rad] or [m]."""
    return JointState(
        header=Header(frame_id=hand.base_link, stamp=stamp),
        name=list(all_joint_names(hand)),
        position=all_joint_positions(hand, posture.joint_positions).tolist(),
    )


def mount_pose(base: Posture, mount: Mount) -> Pose:
    """Return the pose of the arm's mount link when the hand's base link is at `base`, in the same frame."""
    return pose_of_matrix(matrix_of_posture(base) @ np.linalg.inv(matrix_of(mount.position, mount.quaternion_wxyz)))


def _check_finite(grasp: Grasp, rank: int) -> None:
    parts = {
        f"{name}'s {part}": getattr(posture, part)
        for name, posture in zip(("pregrasp", "grasp", "squeeze"), _postures(grasp), strict=True)
        for part in ("position", "quaternion_wxyz", "joint_positions")
    }
    parts |= {f"contact of {c.link}": [*c.position, *c.normal] for c in grasp.contacts}
    wrong = [name for name, values in parts.items() if not np.isfinite(values).all()]
    if wrong:
        raise FloatingPointError(f"grasp {rank}: not finite: {', '.join(wrong)}")


def _number(value: float, otherwise: float = UNMEASURED) -> float:
    return float(value) if math.isfinite(value) else otherwise


def trajectory_of(grasp: Grasp, hand: HandModel, settings: Settings) -> JointTrajectory:
    """Return the trajectory through pregrasp, grasp and squeeze. Its stamp is zero, so it starts on receipt.

    The trajectory has only the driven joints, because controllers refuse others. The hand may start in any posture.
    Positions are within the joint limits. The last point is a target inside the object. The object stops the joints.
    """
    times = posture_times(grasp, hand, settings)
    return JointTrajectory(
        header=Header(frame_id=hand.base_link),
        joint_names=list(hand.joint_names),
        points=[_point(posture, hand, at) for posture, at in zip(_postures(grasp), times, strict=True)],
    )


def base_poses(grasp: Grasp, frame: str, stamp: Time) -> list[PoseStamped]:
    """Return the base link's pose at each trajectory point. Between points, the base must move and rotate uniformly."""
    return [PoseStamped(header=Header(frame_id=frame, stamp=stamp), pose=pose_of_posture(p)) for p in _postures(grasp)]


def posture_times(grasp: Grasp, hand: HandModel, settings: Settings) -> tuple[float, float, float]:
    """Return the times of pregrasp, grasp and squeeze from the start of the trajectory [s].

    The first time is enough for every joint to cross its whole range. At this time, the base must be at the pregrasp.
    """
    speed = hand.joint_speeds(settings.joint_speed, settings.base_speed)
    first = max(settings.shortest_stage, _PEAK * float(np.max((hand.upper - hand.lower) / speed, initial=0.0)))
    closing = _move_time(grasp.pregrasp, grasp.grasp, speed, settings)
    return first, first + closing, first + closing + _move_time(grasp.grasp, grasp.squeeze, speed, settings)


def _move_time(start: Posture, end: Posture, speed: np.ndarray, settings: Settings) -> float:
    joints = float(np.max(np.abs(end.joint_positions - start.joint_positions) / speed, initial=0.0))
    travel = float(np.linalg.norm(end.position - start.position)) / settings.base_speed
    # q and -q are the same rotation. Take the smaller angle.
    cosine = min(abs(float(start.quaternion_wxyz @ end.quaternion_wxyz)), 1.0)
    turn = 2 * math.acos(cosine) / settings.base_turn
    return max(settings.shortest_stage, _PEAK * max(joints, travel, turn))


def _postures(grasp: Grasp) -> tuple[Posture, Posture, Posture]:
    return grasp.pregrasp, grasp.grasp, grasp.squeeze


def _point(posture: Posture, hand: HandModel, at: float) -> JointTrajectoryPoint:
    # Rounding may put a joint slightly beyond its limit, which controllers refuse.
    positions = np.clip(posture.joint_positions, hand.lower, hand.upper)
    still = [0.0] * len(positions)
    return JointTrajectoryPoint(positions=positions.tolist(), velocities=still, time_from_start=duration_of(at))


def arm_trajectory(grasp: Grasp, path: ArmPath, settings: Settings) -> JointTrajectory:
    """Return all waypoints of the arm without velocities, so that controllers pass them without stopping.

    The first point is the retreat posture, at the time `settings.shortest_stage` [s]. The arm must start in this
    posture. Points of a stage are evenly spaced in time. No joint exceeds its own speed limit. Revolute joints stay
    below `settings.joint_speed`. Prismatic joints and the hand's base stay below `settings.base_speed`.
    """
    from graspd_core.arms.arm_paths import LIFT

    approach = float(np.linalg.norm(grasp.grasp.position - grasp.pregrasp.position))
    times, speeds = [settings.shortest_stage], _arm_speeds(path, settings)
    for first, last, travel in zip(path.stages, path.stages[1:], (RETREAT, approach, LIFT), strict=False):
        longest = float((np.abs(np.diff(path.positions[first : last + 1], axis=0)) / speeds).max()) * (last - first)
        seconds = max(settings.shortest_stage, _PEAK * longest, _PEAK * travel / settings.base_speed)
        times += (times[-1] + seconds * np.arange(1, last - first + 1) / (last - first)).tolist()
    points = [
        JointTrajectoryPoint(positions=positions.tolist(), time_from_start=duration_of(at))
        for positions, at in zip(path.positions, times, strict=True)
    ]
    return JointTrajectory(joint_names=list(path.joint_names), points=points)


def _arm_speeds(path: ArmPath, settings: Settings) -> np.ndarray:
    """Return the greatest speed of each arm joint [rad/s] or [m/s]."""
    own = np.inf if path.velocity is None else path.velocity
    slides = np.zeros(len(path.joint_names), dtype=bool) if path.slides is None else path.slides
    return np.minimum(np.where(slides, settings.base_speed, settings.joint_speed), own)


def execution_message(
    grasp: Grasp, path: ArmPath, hand: HandModel, settings: Settings, mass: float | None = None
) -> GraspExecution:
    """Return the motion from retreat to the end of the lift, with the index of each gate (named point of rest)."""
    from graspd_core.arms.execution import GATES, ExecutionPace, execution_of

    own = ExecutionPace(settings.joint_speed, settings.base_speed, settings.base_speed, settings.shortest_stage)
    made = execution_of(grasp, hand, arm_speeds=_arm_speeds(path, settings), mass=mass, pace=own)
    times = [duration_of(at) for at in made.times.tolist()]
    arm = [
        JointTrajectoryPoint(positions=q, velocities=v, time_from_start=at)
        for q, v, at in zip(made.arm.tolist(), made.arm_speed.tolist(), times, strict=True)
    ]
    rows = zip(made.hand.tolist(), made.hand_speed.tolist(), made.efforts.tolist(), times, strict=True)
    fingers = [JointTrajectoryPoint(positions=q, velocities=v, effort=e, time_from_start=at) for q, v, e, at in rows]
    return GraspExecution(
        gates=list(GATES),
        gate_points=list(made.gates),
        arm=JointTrajectory(joint_names=list(made.arm_joints), points=arm),
        hand=JointTrajectory(joint_names=list(made.hand_joints), points=fingers),
        mass=UNMEASURED if mass is None else mass,
    )


def result_markers(
    grasps: Sequence[Grasp],
    hand: HandModel,
    frame: str,
    stamp: Time,
    *,
    most: int = 1,
    parts: Sequence[str] = USUAL_PARTS,
    solids: Sequence[Primitive] | None = None,
) -> MarkerArray:
    """Return markers of the best `most` grasps. `parts` are names of `PARTS`. Part `rejected` shows all failed grasps.

    The first marker deletes all earlier markers. The hand is drawn as `solids`, or as its collision shapes if None.
    """
    header = Header(frame_id=frame, stamp=stamp)
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    for rank, grasp in enumerate(grasps):
        made = _parts_of(grasp, rank, hand, hand.primitives if solids is None else solids) if rank < most else {}
        if grasp.verdict is Verdict.FAILED:
            made["rejected"] = lambda grasp=grasp, rank=rank: _rejected(grasp, rank)
        for namespace in parts:
            for number, marker in enumerate(made[namespace]() if namespace in made else ()):
                marker.header, marker.action, marker.ns = header, Marker.ADD, namespace
                marker.id = rank * IDS_OF_A_GRASP + number
                markers.append(marker)
    return MarkerArray(markers=markers)


def _parts_of(
    grasp: Grasp, rank: int, hand: HandModel, solids: Sequence[Primitive]
) -> dict[str, Callable[[], Iterable[Marker]]]:
    clear, faint = _colour(COLOURS[grasp.verdict], 0.8), _colour(COLOURS[grasp.verdict], _FAINT)
    return {
        "hand": lambda: _hand(hand, solids, grasp.grasp, clear),
        "pregrasp": lambda: _hand(hand, solids, grasp.pregrasp, faint),
        "squeeze": lambda: _hand(hand, solids, grasp.squeeze, faint),
        "contacts": lambda: map(_contact, grasp.contacts),
        "axes": lambda: _axes(matrix_of_posture(grasp.grasp)),
        "text": lambda: [_text(grasp, rank, (1.0, 1.0, 1.0))],
    }


def _rejected(grasp: Grasp, rank: int) -> list[Marker]:
    colour = COLOURS[Verdict.FAILED]
    return [_arrow(grasp.pregrasp.position, grasp.grasp.position, colour), _text(grasp, rank, colour)]


def _hand(hand: HandModel, solids: Sequence[Primitive], posture: Posture, colour: ColorRGBA) -> Iterator[Marker]:
    """Yield the markers of the hand's shapes `solids`. A capsule is drawn as a cylinder and two spheres."""
    T_frame_base = matrix_of_posture(posture)
    rotations, translations = link_poses(hand, posture.joint_positions)
    for solid in solids:
        T_base_link = _matrix(rotations[solid.link], translations[solid.link])
        T = T_frame_base @ T_base_link @ _matrix(solid.rotation, solid.translation)
        pose, size = pose_of_matrix(T), solid.size
        if solid.kind == "hull":
            yield _solid(Marker.TRIANGLE_LIST, pose, (1, 1, 1), colour, points=_corners(solid))
        elif solid.kind == "box":
            yield _solid(Marker.CUBE, pose, 2 * np.array(size), colour)
        elif solid.kind == "sphere":
            yield _solid(Marker.SPHERE, pose, np.full(3, 2 * size[0]), colour)
        else:
            yield _solid(Marker.CYLINDER, pose, 2 * np.array([size[0], size[0], size[1]]), colour)
            for end in (-size[1], size[1]) if solid.kind == "capsule" else ():
                ball = Pose(position=point_of(T[:3, 3] + end * T[:3, 2]))
                yield _solid(Marker.SPHERE, ball, np.full(3, 2 * size[0]), colour)


# The lists are cached, because thousands of points take tens of milliseconds. Nothing modifies the lists.
@lru_cache(maxsize=256)
def _corners(mesh: Primitive) -> list[Point]:
    return [point_of(corner) for corner in mesh.vertices[mesh.faces.reshape(-1)]]


def _contact(contact: Contact) -> Marker:
    """Return an arrow that ends at the contact and points in the direction in which the link presses."""
    tip = np.array(contact.position)
    tail = tip + _ARROW_LENGTH * np.array(contact.normal)
    return _arrow(tail, tip, (0.1, 0.3, 0.9))


def _axes(T_frame_base: Matrix) -> Iterator[Marker]:
    origin = T_frame_base[:3, 3]
    for axis, colour in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
        yield _arrow(origin, origin + _AXIS_LENGTH * T_frame_base[:3, axis], colour)


def _text(grasp: Grasp, rank: int, colour: tuple[float, float, float]) -> Marker:
    lines = [f"#{rank} {grasp.verdict}"]
    payload = (grasp.metrics or {}).get("payload")
    if payload is not None:
        lines.append(f"holds {payload:.2g} kg")
    if grasp.reason:
        lines.append(grasp.reason)
    above = Pose(position=point_of(grasp.grasp.position + np.array([0.0, 0.0, _TEXT_ABOVE])))
    size, text = (0, 0, _TEXT_HEIGHT), "\n".join(lines)
    return _solid(Marker.TEXT_VIEW_FACING, above, size, _colour(colour), text=text)


def _arrow(tail: np.ndarray, tip: np.ndarray, colour: tuple[float, float, float]) -> Marker:
    points = [point_of(tail), point_of(tip)]  # in the header's frame
    return _solid(Marker.ARROW, Pose(), (0.004, 0.008, 0.01), _colour(colour), points=points)


def _solid(kind: int, pose: Pose, size: Sequence[float] | np.ndarray, colour: ColorRGBA, **fields: Any) -> Marker:
    return Marker(type=kind, pose=pose, scale=vector_of(size), color=colour, **fields)


def _matrix(rotation: np.ndarray, translation: np.ndarray) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def _colour(rgb: tuple[float, float, float], alpha: float = 1.0) -> ColorRGBA:
    r, g, b = rgb
    return ColorRGBA(r=r, g=g, b=b, a=alpha)
