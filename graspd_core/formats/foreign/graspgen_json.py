"""GraspGen's JSON: poses of the gripper's base, and whether each held there; no joints.

What is made of a pose: the hand stands open there, closes until it touches, and presses as graspd's grasps do.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from graspd_core.errors import FormatError, shown
from graspd_core.formats.foreign.imported_grasp import ImportedGrasp, entry, find_beside, numbers_of
from graspd_core.hands.model import HandModel
from graspd_core.types import Posture

# Entries of a rotation matrix may be so far from orthonormal.
_ROTATION = 1e-3


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
