"""Grasps as moveit_msgs/Grasp for MoveIt's pick pipelines. ROS or `make setup` installs moveit_msgs.

MoveIt's `grasp_pose` is the pose of the end effector's parent link, the last link of the arm. `T_parent_base` is the
pose of the hand's base link in the parent link's frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped
from graspd_msgs.msg import Grasp
from shape_msgs.msg import Mesh, MeshTriangle
from trajectory_msgs.msg import JointTrajectory

from graspd_core import HandModel, TriangleMesh
from graspd_core.errors import ConfigError, GraspdError
from graspd_ros.convert import Matrix, matrix_of_pose, nanoseconds, point_of, pose_of_matrix, set_nanoseconds, vector_of

# MoveIt's `min_distance` as a fraction of `desired_distance`.
_LEAST_APPROACH = 0.5


class MoveItMissing(GraspdError):
    """moveit_msgs or one of its messages is not installed."""


def moveit_grasp(
    grasp: Grasp,
    *,
    retreat: tuple[float, float, float],
    retreat_frame: str,
    retreat_distance: float = 0.1,
    T_parent_base: Matrix | None = None,
    effort: Sequence[float] = (),
    touch: Sequence[str] = (),
) -> Any:
    """Return the moveit_msgs/Grasp of a graspd_msgs/Grasp.

    Args:
        grasp: a grasp from ~/grasps.
        retreat: lift direction in `retreat_frame`, of any length, usually up.
        retreat_frame: frame of `retreat`.
        retreat_distance: lift height [m].
        T_parent_base: pose of the hand's base link in the end effector's parent link. If None, the mount in the hand's
            description is used, or identity without a mount.
        touch: names of the collision objects that the hand may touch, usually the grasped object.
        effort: greatest effort per joint in the trajectory's order [N·m] or [N]. Empty leaves efforts out.

    Raises:
        MoveItMissing: moveit_msgs is not installed.
        ConfigError: the grasp failed its trial, or `retreat` is zero or not finite.
    """
    if grasp.verdict == Grasp.FAILED:
        raise ConfigError(f"grasp {grasp.id!r}: the grasp failed its trial ({grasp.reason}); execute a verified grasp")
    up = np.array(retreat, dtype=float)
    if not (np.isfinite(up).all() and up.any()):
        raise ConfigError(f"retreat: {retreat}; valid: a finite direction that is not zero")
    messages = _moveit_messages()
    first, *closing = deepcopy(grasp.trajectory.points)
    T_frame_grasp = T_frame_base = matrix_of_pose(grasp.grasp_pose)
    if waits := dict(zip(grasp.arrival_joints.name, grasp.arrival_joints.position, strict=True)):
        # At the end of MoveIt's approach the hand is still open.
        T_frame_base = matrix_of_pose(grasp.arrival_pose)
        first.positions = [waits[name] for name in grasp.trajectory.joint_names]
    approach = T_frame_base[:3, 3] - matrix_of_pose(grasp.pregrasp_pose)[:3, 3]
    T_base_parent = np.eye(4) if T_parent_base is None else np.linalg.inv(T_parent_base)
    if T_parent_base is None and grasp.mount_link:
        T_base_parent = np.linalg.inv(T_frame_grasp) @ matrix_of_pose(grasp.mount_grasp_pose)
    pose = pose_of_matrix(T_frame_base @ T_base_parent)
    for point in closing:
        point.effort = list(effort)
    quality = next((metric.value for metric in grasp.metrics if metric.name == "epsilon"), 0.0)
    return messages.Grasp(
        id=grasp.id,
        pre_grasp_posture=_posture(grasp, [first]),
        grasp_posture=_posture(grasp, closing, since=first),
        grasp_pose=PoseStamped(header=grasp.header, pose=pose),
        grasp_quality=quality,
        pre_grasp_approach=_translation(messages, approach, grasp.header.frame_id, float(np.linalg.norm(approach))),
        post_grasp_retreat=_translation(messages, up, retreat_frame, retreat_distance),
        allowed_touch_objects=list(touch),
    )


def attached_object(grasp: Grasp, hull: TriangleMesh, hand: HandModel, mass: float = 0.0) -> Any:
    """Return the object that the hand holds after the squeeze, as a moveit_msgs/AttachedCollisionObject.

    The object is attached to the hand's base link, and all links of the hand may touch it. Its id is the id of the
    request. The detach posture opens the hand to the pregrasp.

    Args:
        grasp: a grasp from ~/grasps.
        hull: hull of the object in the frame of the base link at the grasp [m].
        hand: the hand.
        mass: mass of the object [kg]. 0 if unknown.

    Raises MoveItMissing: moveit_msgs is not installed, or its version lacks this message.
    """
    kind = attached_kind()
    if kind is None:
        raise MoveItMissing("moveit_msgs/AttachedCollisionObject is not installed; install moveit_msgs of ROS 2 Jazzy")
    center = hull.vertices.mean(0)
    shape = Mesh(
        vertices=[point_of(vertex) for vertex in hull.vertices - center],
        triangles=[MeshTriangle(vertex_indices=face.astype(np.uint32)) for face in hull.faces],
    )
    message = kind(link_name=grasp.base_link, touch_links=list(hand.link_names), weight=mass)
    message.object.header.frame_id = grasp.base_link
    message.object.header.stamp = grasp.header.stamp
    message.object.id = grasp.id.rpartition("/")[0]
    message.object.pose = Pose(position=point_of(center))
    message.object.meshes, message.object.mesh_poses = [shape], [Pose()]
    message.object.operation = message.object.ADD
    message.detach_posture = _posture(grasp, [deepcopy(next(iter(grasp.trajectory.points)))])
    return message


def attached_kind() -> type | None:
    """Return the class moveit_msgs/AttachedCollisionObject. None if it is not installed."""
    try:
        return getattr(_moveit_messages(), "AttachedCollisionObject", None)
    except MoveItMissing:
        return None


def _posture(grasp: Grasp, points: list[Any], since: Any = None) -> JointTrajectory:
    began = nanoseconds(since.time_from_start) if since else 0
    for point in points:
        set_nanoseconds(point.time_from_start, nanoseconds(point.time_from_start) - began)
    trajectory = grasp.trajectory
    return JointTrajectory(header=trajectory.header, joint_names=list(trajectory.joint_names), points=points)


def _translation(messages: ModuleType, direction: np.ndarray, frame: str, distance: float) -> Any:
    length = math.hypot(*direction)
    translation = messages.GripperTranslation(desired_distance=distance, min_distance=_LEAST_APPROACH * distance)
    translation.direction.header.frame_id = frame
    translation.direction.vector = vector_of(direction / length if length else direction)
    return translation


def _moveit_messages() -> ModuleType:
    try:
        return import_module("moveit_msgs.msg")
    except ImportError:
        raise MoveItMissing("moveit_msgs is not installed; try: sudo apt install ros-jazzy-moveit-msgs") from None
