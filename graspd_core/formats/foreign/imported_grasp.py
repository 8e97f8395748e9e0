"""A grasp from somebody else's file, in graspd's terms: joints by the hand's own order, poses of its base link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import ConfigError, FormatError, shown
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.types import Posture

# A coupled joint may be so far from where it follows to [rad] or [m], and a quaternion's length from one.
_COUPLED, _UNIT = 1e-3, 0.01
# No position, angle or scale is larger; what is computed of such numbers stays finite.
_LARGEST = 1e6


@dataclass(frozen=True)
class ImportedGrasp:
    """One grasp as a file has it.

    Attributes:
        name: the file and the place in it.
        mesh: file of the object or shape:NAME; in its frame, once it is scaled, the poses are.
        scale: factor on the mesh's coordinates.
        grasp: the touching posture; of a format without joints the open hand, which is to be closed.
        pregrasp, squeeze: None where the format has none.
        closed: whether the joints of `grasp` are those of the file.
        squeeze_moved: how far the squeeze's base is from the grasp's [m]: graspd keeps it at the grasp's.
        refused: why its own file calls it no grasp; empty where it does not.
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
    """A value as numbers of a shape, none of them huge. Raises FormatError: it is something else."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = None
    # Of NaN this is false.
    if numbers is None or numbers.shape != shape or not (np.abs(numbers) <= _LARGEST).all():
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
        wanted += f" of at most {_LARGEST:.0e}"
        raise FormatError(f"{where}: {' '.join(shown(value).split())}; expected {wanted}")
    return numbers


def entry(values: Any, key: str, where: str) -> Any:
    """What a mapping has under a key. Raises FormatError: it has no such key, or is no mapping."""
    if not isinstance(values, Mapping):
        raise FormatError(f"{where}: {shown(values)}; expected a mapping with the key {key!r}")
    if key not in values:
        known = ", ".join(sorted(str(name)[:40] for name in values)[:20])
        raise FormatError(f"{where}: the key {key!r} is missing; it has {known or 'none'}")
    return values[key]


def quaternion_of(value: Any, where: str) -> Float[np.ndarray, "4"]:
    """A unit quaternion, wxyz. Raises FormatError: it is none."""
    quaternion = numbers_of(value, (4,), where)
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _UNIT:
        raise FormatError(f"{where}: the quaternion has length {length:.3g}; valid: 1")
    return quaternion / length


def joints_by_name(values: Any, hand: HandModel, where: str) -> Float[np.ndarray, "joints"]:
    """Actuated joint values from named ones; coupled joints may be among them.

    Raises:
        FormatError: a name is not of the hand, one of its joints is missing, or a coupled one is not where it follows.
    """
    if not isinstance(values, Mapping):
        raise FormatError(f"{where}: {shown(values)}; expected joint values by name")
    names = all_joint_names(hand)
    if strange := [name for name in values if name not in names]:
        raise FormatError(f"{where}: joint {shown(strange[0])} is not of {hand.name}; valid: {', '.join(names)}")
    if missing := [name for name in hand.joint_names if name not in values]:
        raise FormatError(f"{where}: joint {missing[0]!r} of {hand.name} is missing")
    joints = np.array([float(numbers_of(values[name], (), f"{where}: {name}")) for name in hand.joint_names])
    for name, follows in zip(names, all_joint_positions(hand, joints), strict=True):
        given = float(numbers_of(values.get(name, follows), (), f"{where}: {name}"))
        if abs(given - follows) > _COUPLED:
            raise FormatError(f"{where}: joint {name!r} is {given:.4g}; by the joint that it follows {follows:.4g}")
    return joints


def checked_order(order: Sequence[str], hand: HandModel) -> tuple[str, ...]:
    """A joint order that fits the hand. Raises ConfigError: it names a joint that is not there, or lacks one."""
    names = all_joint_names(hand)
    for name in order:
        if name not in names or list(order).count(name) > 1:
            fault = "occurs twice" if name in names else f"is not of {hand.name}"
            raise ConfigError(f"joint order: {name!r} {fault}; valid: {', '.join(names)}")
    if missing := [name for name in hand.joint_names if name not in order]:
        raise ConfigError(f"joint order: {missing[0]!r} of {hand.name} is missing")
    return tuple(order)


def find_beside(named: Any, file: Path, where: str) -> str:
    """A file that another one names, relative to any folder that it lies in. Raises FormatError: it is nowhere."""
    if isinstance(named, str) and named and "\0" not in named:
        for folder in file.resolve().parents:
            if (folder / named).is_file():
                return str(folder / named)
    raise FormatError(f"{where}: the object {shown(named)} is not beside the file; name its mesh: --object MESH")
