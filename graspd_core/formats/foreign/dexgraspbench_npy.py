"""DexGraspBench's npy: a pickled dictionary a grasp, three postures as position, quaternion wxyz and joints by order.

A pickle is a program: it is read by `runtime/inert_pickle`, which runs none of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.errors import ConfigError, FormatError
from graspd_core.formats.foreign.imported_grasp import (
    ImportedGrasp,
    checked_order,
    entry,
    find_beside,
    joints_by_name,
    numbers_of,
    quaternion_of,
)
from graspd_core.hands.model import HandModel, all_joint_names
from graspd_core.runtime.inert_arrays import array_of
from graspd_core.runtime.inert_pickle import NUMPY_NAMES, Inert, load_inert
from graspd_core.types import Posture

# The palm, our base link, in the frame of the qpos, wxyz, of hands whose model there is another than ours. Their joints
# are in the order of ours; of other hands the frame is that of the base link.
PALMS = {"allegro_right": (0.0, 1.0, 0.0, 1.0)}
STAGES = ("pregrasp", "grasp", "squeeze")
_WHAT = "file of DexGraspBench"


def order_of(hand: HandModel, order: Sequence[str]) -> tuple[str, ...]:
    """The order of the joints of a qpos: as given, else known. Raises ConfigError: neither, or it fits no hand."""
    if not order and hand.name not in PALMS:
        names = ",".join(all_joint_names(hand))
        raise ConfigError(f"joint order: npy files name no joints, that of {hand.name} is not known; such as: {names}")
    return checked_order(order or all_joint_names(hand), hand)


def read_dexgraspbench(
    path: Path, content: bytes, hand: HandModel, mesh: str | None, order: Sequence[str]
) -> list[ImportedGrasp]:
    """The one grasp of a file, in the frame of the object; `mesh` stands for the one that it names.

    Raises:
        ConfigError: the joint order is not known or does not fit the hand.
        FormatError: no npy of a dictionary, asks for code to be run, or an entry is missing or malformed, by its key.
    """
    order = order_of(hand, order)
    values = npy_dictionary(path, content)
    named = _plain(values, "obj_path", path)
    mesh = mesh or find_beside(f"{named}/mesh/simplified.obj", path, f"{path}: obj_path")
    scale = float(numbers_of(_plain(values, "obj_scale", path), (), f"{path}: obj_scale"))
    target = _pose(_plain(values, "obj_pose", path), 0, f"{path}: obj_pose")
    pregrasp, grasp, squeeze = (_posture(values, stage, target, hand, order, path) for stage in STAGES)
    moved = float(np.linalg.norm(squeeze.position - grasp.position))
    return [ImportedGrasp(f"{path}", mesh, scale, grasp, pregrasp, squeeze, squeeze_moved=moved)]


def npy_dictionary(path: Path, content: bytes) -> dict[Any, Any]:
    """The dictionary of an npy file: plain values, and `Inert` arrays of numbers. Raises FormatError: it holds none."""
    file = BytesIO(content)
    try:
        major = np.lib.format.read_magic(file)[0]
        read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    except Exception as error:
        raise FormatError(f"{path}: not an npy file: {' '.join(str(error).split())[:200]}") from None
    if dtype != np.dtype(object) or shape not in ((), (1,)):
        raise FormatError(f"{path}: holds an array of {dtype} of shape {shape}; expected one pickled dictionary")
    try:
        held = load_inert(content[file.tell() :], NUMPY_NAMES, _WHAT)
    except ValueError as error:
        raise FormatError(f"{path}: {error}") from error
    state = held.state if isinstance(held, Inert) else None
    items = state[4] if isinstance(state, tuple) and len(state) == 5 else None
    if not isinstance(items, list) or len(items) != 1 or not isinstance(items[0], dict):
        raise FormatError(f"{path}: holds no dictionary")
    return items[0]


def _plain(values: dict[Any, Any], key: str, path: Path) -> Any:
    """Text, a number, or an array of numbers under a key."""
    value = entry(values, key, f"{path}")
    if not isinstance(value, Inert):
        return value
    try:
        if value.kind == "scalar" and len(value.arguments) == 2:
            dtype, raw = value.arguments
            return array_of(Inert("array", state=(1, (), dtype, False, raw)))
        if value.kind != "array":
            raise ValueError(f"holds a {value.kind} where numbers are expected")
        return array_of(value)
    except ValueError as error:
        raise FormatError(f"{path}: {key}: {error}") from error


def _pose(values: Any, joints: int, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, quaternion wxyz and joints of a qpos."""
    size = np.shape(values)
    if joints and len(size) == 1 and size[0] != 7 + joints:
        raise FormatError(f"{where}: {size[0] - 7} joints; the joint order has {joints}")
    row = numbers_of(values, (7 + joints,), where)
    return row[:3], quaternion_of(row[3:7], where), row[7:]


def _posture(
    values: dict[Any, Any],
    stage: str,
    target: tuple[np.ndarray, ...],
    hand: HandModel,
    order: Sequence[str],
    path: Path,
) -> Posture:
    """A posture of the hand's base link in the frame of the object."""
    from scipy.spatial.transform import Rotation

    where = f"{path}: {stage}_qpos"
    position, quaternion, joints = _pose(_plain(values, f"{stage}_qpos", path), len(order), where)
    into = Rotation.from_quat(np.roll(target[1], -1)).inv()
    palm = Rotation.from_quat(np.roll(PALMS.get(hand.name, (1.0, 0.0, 0.0, 0.0)), -1))
    base = into * Rotation.from_quat(np.roll(quaternion, -1)) * palm
    named = joints_by_name(dict(zip(order, joints, strict=True)), hand, where)
    return Posture(into.apply(position - target[0]), np.roll(base.as_quat(), 1), named)
