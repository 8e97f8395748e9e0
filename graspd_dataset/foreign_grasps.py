"""Read grasp files of other projects. Convert joint values to the hand's order, and poses to the hand's base link.

DexGraspBench (.npy): one pickled dictionary per grasp. It holds three postures, each as position, quaternion wxyz and
unnamed joint values. `runtime/inert_pickle` reads the pickle without running code from it.

isaac_grasp 1.0 (.yaml): the gripper's pose, and named joint values at grasp and pregrasp. There is no squeeze. The
gripper's frame is a link name, or a USD stage path that ends with a link name. Any other name means the base link.

GraspGen (.json): poses of the gripper's base and whether each grasp held. There are no joint values.
`complete_grasps` closes the open hand until it touches the object.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.config.mapping import parse_yaml
from graspd_core.errors import ConfigError, FormatError, short_repr
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import AT_ORIGIN, HandModel, all_joint_names, all_joint_positions
from graspd_core.runtime.inert_pickle import NUMPY_NAMES, Inert, array_of, load_inert, read_bounded
from graspd_core.types import Posture

# Tolerances: of a coupled joint's value, which its leading joint sets [rad] or [m], and of a quaternion's length.
_COUPLED, _UNIT = 1e-3, 0.01
# The greatest magnitude of a position, angle or scale. With this limit, results stay finite.
_LARGEST = 1e6


@dataclass(frozen=True)
class ImportedGrasp:
    """One grasp read from a file.

    Attributes:
        name: the file, and the grasp's number or name in it. For messages.
        mesh: mesh file of the object, or shape:NAME. Poses are in the frame of the scaled mesh.
        scale: factor on the mesh's coordinates.
        grasp: the touching posture. If the format has no joint values, this is the open hand, still to be closed.
        pregrasp, squeeze: None if the format has no such posture.
        closed: whether the file gives the joint values of `grasp`.
        squeeze_moved: distance by which the file moves the base from grasp to squeeze [m]. graspd ignores this motion.
        refused: reason to refuse the grasp if its file marks it as failed. Otherwise empty.
    """

    name: str
    mesh: str
    scale: float
    grasp: Posture
    pregrasp: Posture | None = None
    squeeze: Posture | None = None
    closed: bool = True
    squeeze_moved: float = 0.0
    refused: str = ""


def numbers_of(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Return a value as an array. Raises FormatError: not numbers of this shape, a NaN, or a magnitude over 1e6."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = None
    # A comparison with NaN is false.
    if numbers is None or numbers.shape != shape or not (np.abs(numbers) <= _LARGEST).all():
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
        wanted += f" of at most {_LARGEST:.0e}"
        raise FormatError(f"{where}: {' '.join(short_repr(value).split())}; expected {wanted}")
    return numbers


def entry(values: Any, key: str, where: str) -> Any:
    """Return the value of a key. Raises FormatError: the key is missing, or `values` is not a mapping."""
    if not isinstance(values, Mapping):
        raise FormatError(f"{where}: {short_repr(values)}; expected a mapping with the key {key!r}")
    if key not in values:
        known = ", ".join(sorted(str(name)[:40] for name in values)[:20])
        raise FormatError(f"{where}: the key {key!r} is missing; present keys: {known or 'none'}")
    return values[key]


def quaternion_of(value: Any, where: str) -> Float[np.ndarray, "4"]:
    """Return a unit quaternion, wxyz. Raises FormatError: not four numbers, or the length is not 1 within 0.01."""
    quaternion = numbers_of(value, (4,), where)
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _UNIT:
        raise FormatError(f"{where}: the quaternion has length {length:.3g}; valid: 1")
    return quaternion / length


def joints_by_name(values: Any, hand: HandModel, where: str) -> Float[np.ndarray, "joints"]:
    """Return the values of the actuated joints [rad] or [m] from a mapping, which may also contain coupled joints.

    Raises FormatError: a name is unknown, an actuated joint is missing, or a coupled joint's value does not fit.
    """
    if not isinstance(values, Mapping):
        raise FormatError(f"{where}: {short_repr(values)}; expected joint values by name")
    names = all_joint_names(hand)
    if strange := [name for name in values if name not in names]:
        raise FormatError(f"{where}: {short_repr(strange[0])} is not a joint of {hand.name}; valid: {', '.join(names)}")
    if missing := [name for name in hand.joint_names if name not in values]:
        raise FormatError(f"{where}: joint {missing[0]!r} of {hand.name} is missing")
    joints = np.array([float(numbers_of(values[name], (), f"{where}: {name}")) for name in hand.joint_names])
    for name, follows in zip(names, all_joint_positions(hand, joints), strict=True):
        given = float(numbers_of(values.get(name, follows), (), f"{where}: {name}"))
        if abs(given - follows) > _COUPLED:
            raise FormatError(f"{where}: joint {name!r} is {given:.4g}; valid: {follows:.4g}, because it is coupled")
    return joints


def checked_order(order: Sequence[str], hand: HandModel) -> tuple[str, ...]:
    """Return the joint order as a tuple. Raises ConfigError: a joint is unknown, missing, or occurs twice."""
    names = all_joint_names(hand)
    for name in order:
        if name not in names or list(order).count(name) > 1:
            fault = "occurs twice" if name in names else f"is not a joint of {hand.name}"
            raise ConfigError(f"joint order: {name!r} {fault}; valid: {', '.join(names)}")
    if missing := [name for name in hand.joint_names if name not in order]:
        raise ConfigError(f"joint order: {missing[0]!r} of {hand.name} is missing")
    return tuple(order)


def find_beside(named: Any, file: Path, where: str) -> str:
    """Search `named` in the folders above `file`, nearest first, and return its path. Raises FormatError: not found."""
    if isinstance(named, str) and named:
        for folder in file.resolve().parents:
            # Path.is_file raises an error for a name that is too long.
            if isfile(folder / named):
                return str(folder / named)
    raise FormatError(f"{where}: object {short_repr(named)} is in no folder above the file; give --object MESH")


# Hands that DexGraspBench models with our joint order but another root frame, and our palm's orientation (wxyz) in
# that frame. A qpos has the pose of this frame. For other hands, it is the root frame of our hand file.
PALMS = {"allegro_right": (0.0, 1.0, 0.0, 1.0)}
STAGES = ("pregrasp", "grasp", "squeeze")
_WHAT = "file of DexGraspBench"


def order_of(hand: HandModel, order: Sequence[str]) -> tuple[str, ...]:
    """Return the joint order of a qpos (pose and joint values): `order`, or if it is empty the hand's known order.

    Raises ConfigError: the order is not known, or does not fit the hand.
    """
    if not order and hand.name not in PALMS:
        names = ",".join(all_joint_names(hand))
        raise ConfigError(f"joint order: not known for {hand.name}; give all joints in the file's order, e.g. {names}")
    return checked_order(order or all_joint_names(hand), hand)


def read_dexgraspbench(
    path: Path, content: bytes, hand: HandModel, mesh: str | None, order: Sequence[str]
) -> list[ImportedGrasp]:
    """Read the single grasp of an npy file, in the object frame. `mesh`, if given, replaces the mesh named in the file.

    Raises:
        ConfigError: the joint order is not known or does not fit the hand.
        FormatError: the file is not an npy file that holds one dictionary, the pickle calls code, or an entry is bad.
    """
    order = order_of(hand, order)
    values = npy_dictionary(path, content)
    named = plain_entry(values, "obj_path", path)
    mesh = mesh or find_beside(f"{named}/mesh/simplified.obj", path, f"{path}: obj_path")
    scale = float(numbers_of(plain_entry(values, "obj_scale", path), (), f"{path}: obj_scale"))
    target = _pose(plain_entry(values, "obj_pose", path), 0, f"{path}: obj_pose")
    pregrasp, grasp, squeeze = (_posture(values, stage, target, hand, order, path) for stage in STAGES)
    moved = float(np.linalg.norm(squeeze.position - grasp.position))
    return [ImportedGrasp(f"{path}", mesh, scale, grasp, pregrasp, squeeze, squeeze_moved=moved)]


def npy_dictionary(path: Path, content: bytes) -> dict[Any, Any]:
    """Return the dictionary of an npy file. Arrays in it are `Inert` objects, because no code of the pickle is run.

    Raises FormatError: the file is not an npy file with one pickled dictionary.
    """
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
        raise FormatError(f"{path}: the pickle holds no dictionary; expected one dictionary")
    return items[0]


def plain_entry(values: dict[Any, Any], key: str, path: Path) -> Any:
    """Return the text, number or array of numbers of a key. Raises FormatError: no such key, or another type."""
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
    size = len(values) if isinstance(values, np.ndarray) and values.ndim == 1 else 0
    if joints and size > 7 and size != 7 + joints:
        raise FormatError(f"{where}: {size - 7} joints; the joint order has {joints}")
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
    """Return the hand's posture at `stage`, for example the pregrasp. The pose is that of the base link, object frame.

    `target` is the object's pose in the file's world frame: position, quaternion wxyz, no joint values.
    """
    from scipy.spatial.transform import Rotation

    where = f"{path}: {stage}_qpos"
    position, quaternion, joints = _pose(plain_entry(values, f"{stage}_qpos", path), len(order), where)
    into = Rotation.from_quat(np.roll(target[1], -1)).inv()
    frame = Rotation.from_quat(np.roll(quaternion, -1))
    place, turn = hand.base_place
    if (place, turn) == AT_ORIGIN:
        turn = PALMS.get(hand.name, turn)
    base = into * frame * Rotation.from_quat(np.roll(turn, -1))
    named = joints_by_name(dict(zip(order, joints, strict=True)), hand, where)
    return Posture(into.apply(position + frame.apply(place) - target[0]), np.roll(base.as_quat(), 1), named)


# Greatest error of a rigid transform: of the entries of R Rᵀ from the identity, and of the last row from 0 0 0 1.
_ROTATION = 1e-3


def read_isaac(path: Path, text: bytes, hand: HandModel, mesh: str | None) -> list[ImportedGrasp]:
    """Read the grasps of an isaac_grasp file. `mesh` replaces the mesh in it. Raises FormatError: malformed file."""
    try:
        _, document = parse_yaml(text.decode())
    except ValueError as error:
        raise FormatError(f"{path}: not YAML: {error}") from None
    if entry(document, "format", f"{path}") != "isaac_grasp" or document.get("format_version") != 1.0:
        given = f"{short_repr(document['format'])} {short_repr(document.get('format_version'))}"
        raise FormatError(f"{path}: format {given}; valid: isaac_grasp 1.0")
    # Isaac Sim writes keys that end with `_frame_link`, Isaac ROS documents keys that end with `_frame`.
    target, frame = (document.get(f"{of}_frame_link", document.get(f"{of}_frame")) for of in ("object", "gripper"))
    mesh = mesh or find_beside(target, path, f"{path}: object_frame_link")
    frame = str(frame).rpartition("/")[2]
    grasps = entry(document, "grasps", f"{path}")
    if not isinstance(grasps, dict):
        raise FormatError(f"{path}: grasps: {short_repr(grasps)}; expected a mapping of names to grasps")
    return [_grasp_of(values, hand, frame, mesh, f"{path}: {short_repr(name)}") for name, values in grasps.items()]


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
    """Return the pose of the base link. `position` and `quaternion` (wxyz) are the pose of `link`."""
    from scipy.spatial.transform import Rotation

    rotations, translations = link_poses(hand, joints)
    index = hand.link_index[link]
    base = Rotation.from_quat(np.roll(quaternion, -1)) * Rotation.from_matrix(rotations[index]).inv()
    return position - base.apply(translations[index]), np.roll(base.as_quat(), 1)


def read_graspgen(path: Path, text: bytes, hand: HandModel, mesh: str | None) -> list[ImportedGrasp]:
    """Read the grasps of a GraspGen file. `mesh` replaces the mesh in the file. Raises FormatError: malformed file."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not JSON: {error}") from None
    target, grasps = (entry(document, key, f"{path}") for key in ("object", "grasps"))
    mesh = mesh or find_beside(entry(target, "file", f"{path}: object"), path, f"{path}: object")
    scale = float(numbers_of(entry(target, "scale", f"{path}: object"), (), f"{path}: object: scale"))
    poses, held = (entry(grasps, key, f"{path}: grasps") for key in ("transforms", "object_in_gripper"))
    if not isinstance(poses, list) or not isinstance(held, list) or len(poses) != len(held):
        raise FormatError(f"{path}: grasps: transforms and object_in_gripper must be two lists of equal length")
    found = []
    for number, (pose, good) in enumerate(zip(poses, held, strict=True)):
        where = f"{path}: grasp {number}"
        if not isinstance(good, bool):
            raise FormatError(f"{where}: object_in_gripper: {short_repr(good)}; expected true or false")
        refused = "" if good else "its file says that the grasp did not hold"
        found.append(ImportedGrasp(where, mesh, scale, _open_at(pose, hand, where), closed=False, refused=refused))
    return found


def _open_at(pose: object, hand: HandModel, where: str) -> Posture:
    """Return the open hand at a 4 x 4 pose `T_object_hand`. Raises FormatError: the pose is not a rigid transform."""
    from scipy.spatial.transform import Rotation

    matrix = numbers_of(pose, (4, 4), f"{where}: transform")
    rotation = matrix[:3, :3]
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION and np.linalg.det(rotation) > 0
    if not rigid or np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION:
        raise FormatError(f"{where}: transform: {short_repr(pose)}; expected a rotation and a translation")
    quaternion = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
    return Posture(matrix[:3, 3], quaternion, np.clip(hand.open_posture, hand.lower, hand.upper))


# Formats by file ending, in search order. JSON is last: folders of npy files may also have JSON files of objects.
FORMATS = {".npy": "dexgraspbench", ".yaml": "isaac", ".yml": "isaac", ".json": "graspgen"}


def read_foreign(
    place: Path, hand: HandModel, *, mesh: str | None = None, order: Sequence[str] = ()
) -> tuple[ImportedGrasp, ...]:
    """Read all grasps of a file, or of all files of one format below a folder, sorted by file name.

    Args:
        hand: the hand that the grasps were made for.
        mesh: mesh of the object. If None, each file names its mesh.
        order: joint names in the order of an npy file's joint values. If empty, the hand's known order is used.

    Raises:
        ConfigError: the joint order is not known, or does not fit the hand.
        FormatError: there is no such file, or a file is malformed.
    """
    found: list[ImportedGrasp] = []
    for path in foreign_files(place):
        try:
            content = read_bounded(path, "file of grasps")
        except ValueError as error:
            raise FormatError(f"{path}: {error}") from None
        if path.suffix == ".npy":
            found += read_dexgraspbench(path, content, hand, mesh, order)
        else:
            found += (read_graspgen if path.suffix == ".json" else read_isaac)(path, content, hand, mesh)
    return tuple(found)


def foreign_files(place: Path) -> tuple[Path, ...]:
    """Return the grasp file `place`, or all files of one format below this folder. Raises FormatError: none found."""
    endings = ", ".join(FORMATS)
    if place.is_file():
        if place.suffix not in FORMATS:
            raise FormatError(f"{place}: unknown ending {place.suffix!r}; valid: {endings}")
        return (place,)
    if not place.is_dir():
        raise FormatError(f"{place}: no such file or folder")
    for kind in dict.fromkeys(FORMATS.values()):
        files = [path for path in place.rglob("*") if FORMATS.get(path.suffix) == kind and path.is_file()]
        if files:
            return tuple(sorted(files, key=_natural))
    raise FormatError(f"{place}: no file of grasps in this folder; valid endings: {endings}")


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if odd % 2 else (0, part) for odd, part in enumerate(re.split(r"([0-9]+)", str(path)))]
