"""isaac_grasp 1.0 (YAML): a pose of the gripper, joints at the grasp and at the pregrasp by name; no squeeze.

The gripper's frame is a link of the hand by its name, the last word of a path in a stage; other words mean its base
link. Both postures have the same pose.

GraspGen's JSON: poses of the gripper's base, and whether each held there; no joints. The hand stands open there, closes
until it touches, and presses as graspd's grasps do.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.config.yaml_text import parse_yaml
from graspd_core.errors import FormatError, shown
from graspd_core.formats.foreign.imported_grasp import (
    ImportedGrasp,
    entry,
    find_beside,
    joints_by_name,
    numbers_of,
    quaternion_of,
)
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel
from graspd_core.types import Posture

# Entries of a rotation matrix may be so far from orthonormal.
_ROTATION = 1e-3


def read_isaac(path: Path, text: bytes, hand: HandModel, mesh: str | None) -> list[ImportedGrasp]:
    """The grasps of one file; `mesh` stands for the one that it names. Raises FormatError: malformed, by key."""
    try:
        _, document = parse_yaml(text.decode())
    except ValueError as error:
        raise FormatError(f"{path}: not YAML: {error}") from None
    if entry(document, "format", f"{path}") != "isaac_grasp" or document.get("format_version") != 1.0:
        told = f"{shown(document['format'])} {shown(document.get('format_version'))}"
        raise FormatError(f"{path}: format {told}; valid: isaac_grasp 1.0")
    # Isaac Sim writes the former names, Isaac ROS describes the latter.
    target, frame = (document.get(f"{of}_frame_link", document.get(f"{of}_frame")) for of in ("object", "gripper"))
    mesh = mesh or find_beside(target, path, f"{path}: object_frame_link")
    frame = str(frame).rpartition("/")[2]
    grasps = entry(document, "grasps", f"{path}")
    if not isinstance(grasps, dict):
        raise FormatError(f"{path}: grasps: {shown(grasps)}; expected grasps by name")
    return [_grasp_of(values, hand, frame, mesh, f"{path}: {shown(name)}") for name, values in grasps.items()]


def _grasp_of(values: Any, hand: HandModel, frame: str, mesh: str, where: str) -> ImportedGrasp:
    joints, opened = (
        joints_by_name(entry(values, key, where), hand, f"{where}: {key}")
        for key in ("cspace_position", "pregrasp_cspace_position")
    )
    position = numbers_of(entry(values, "position", where), (3,), f"{where}: position")
    turn, place = entry(values, "orientation", where), f"{where}: orientation"
    xyz = numbers_of(entry(turn, "xyz", place), (3,), place)
    quaternion = quaternion_of([entry(turn, "w", place), *xyz], place)
    if frame in hand.link_names and frame != hand.base_link:
        position, quaternion = _base_of(hand, frame, joints, position, quaternion)
    grasp, pregrasp = (Posture(position, quaternion, values) for values in (joints, opened))
    return ImportedGrasp(where, mesh, 1.0, grasp, pregrasp)


def _base_of(
    hand: HandModel, link: str, joints: np.ndarray, position: np.ndarray, quaternion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion of the base link where those of another link are given."""
    from scipy.spatial.transform import Rotation

    rotations, translations = link_poses(hand, joints)
    index = hand.link_index[link]
    base = Rotation.from_quat(np.roll(quaternion, -1)) * Rotation.from_matrix(rotations[index]).inv()
    return position - base.apply(translations[index]), np.roll(base.as_quat(), 1)


def read_graspgen(path: Path, text: bytes, hand: HandModel, mesh: str | None) -> list[ImportedGrasp]:
    """The grasps of one file; `mesh` stands for the one that it names. Raises FormatError: malformed, by key."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not JSON: {error}") from None
    target, grasps = (entry(document, key, f"{path}") for key in ("object", "grasps"))
    mesh = mesh or find_beside(entry(target, "file", f"{path}: object"), path, f"{path}: object")
    scale = float(numbers_of(entry(target, "scale", f"{path}: object"), (), f"{path}: object: scale"))
    poses, held = (entry(grasps, key, f"{path}: grasps") for key in ("transforms", "object_in_gripper"))
    if not isinstance(poses, list) or not isinstance(held, list) or len(poses) != len(held):
        raise FormatError(f"{path}: grasps: transforms and object_in_gripper are not lists of one length")
    found = []
    for number, (pose, good) in enumerate(zip(poses, held, strict=True)):
        where = f"{path}: grasp {number}"
        if not isinstance(good, bool):
            raise FormatError(f"{where}: object_in_gripper: {shown(good)}; expected true or false")
        refused = "" if good else "its own file says that it did not hold"
        found.append(ImportedGrasp(where, mesh, scale, _open_at(pose, hand, where), closed=False, refused=refused))
    return found


def _open_at(pose: object, hand: HandModel, where: str) -> Posture:
    """The open hand at a pose `T_object_hand`."""
    from scipy.spatial.transform import Rotation

    matrix = numbers_of(pose, (4, 4), f"{where}: transform")
    rotation = matrix[:3, :3]
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION and np.linalg.det(rotation) > 0
    if not rigid or np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION:
        raise FormatError(f"{where}: transform: {shown(pose)}; expected a rotation and a translation")
    quaternion = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
    return Posture(matrix[:3, 3], quaternion, np.clip(hand.open_posture, hand.lower, hand.upper))
