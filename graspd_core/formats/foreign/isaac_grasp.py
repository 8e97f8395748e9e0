"""isaac_grasp 1.0 (YAML): a pose of the gripper, joints at the grasp and at the pregrasp by name; no squeeze.

The gripper's frame is a link of the hand by its name, the last word of a path in a stage; other words mean its base
link. Both postures have the same pose.
"""

from __future__ import annotations

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
