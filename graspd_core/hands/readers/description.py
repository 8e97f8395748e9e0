"""Read hand descriptions: YAML files with the palm, the postures and the efforts of a hand in a URDF or MJCF file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from graspd_core.config.mapping import YamlError, line_of, parse_yaml
from graspd_core.errors import HandError, choices, short_repr
from graspd_core.hands.default_postures import default_palm, default_postures
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel, Mount

_KEYS = ("name", "urdf", "root", "palm", "approach", "effort", "open", "closed", "mount")
_PALM_KEYS, _MOUNT_KEYS = ("link", "center", "normal"), ("parent", "position", "quaternion_wxyz")
# Greatest magnitude of a number in a description.
_LARGEST = 1e9


@dataclass(frozen=True, eq=False)
class Source:
    """A file and its YAML nodes. Nested keys are written like `palm.center`. The methods check values."""

    path: Path
    node: yaml.Node | None

    def error(self, key: str, message: str) -> HandError:
        """Return an error about a key. The message names the file, the line and the key."""
        # Only the first dot separates two keys, because names of joints may contain dots.
        return HandError(f"{self.path}:{line_of(self.node, key.split('.', 1))}: {key}: {message}")

    def mapping(self, key: str, value: Any) -> dict[str, Any]:
        """Check a mapping, and convert its keys to text, because some joints have numbers as names."""
        if not isinstance(value, dict):
            raise self.error(key, f"expected a mapping of keys to values, got {short_repr(value)}")
        return {name if isinstance(name, str) else short_repr(name): entry for name, entry in value.items()}

    def section(self, key: str, value: Any, known: tuple[str, ...], required: tuple[str, ...]) -> dict[str, Any]:
        """Check a mapping for unknown and missing keys. An empty `key` means the whole file."""
        data, above = self.mapping(key or "the file", value), [key] if key else []
        for name in data:
            if name not in known:
                line = line_of(self.node, [*above, name])
                raise HandError(f"{self.path}:{line}: unknown key {name!r}; {choices(name, known)}")
        for name in required:
            if name not in data:
                raise HandError(f"{self.path}:{line_of(self.node, above)}: {'.'.join([*above, name])} is missing")
        return data

    def text(self, key: str, value: Any) -> str:
        """Check that a value is text."""
        if not isinstance(value, str):
            raise self.error(key, f"expected text, got {short_repr(value)}")
        return value

    def numbers(self, key: str, value: Any, count: int) -> Float[np.ndarray, "count"]:
        """Check a list of `count` numbers."""
        if not isinstance(value, list) or len(value) != count or not all(map(is_number, value)):
            raise self.error(key, f"expected {count} numbers, got {short_repr(value)}")
        return np.array(value, dtype=np.float64)

    def direction(self, key: str, value: Any) -> Float[np.ndarray, "3"]:
        """Return three numbers as a unit vector."""
        vector = self.numbers(key, value, 3)
        length = float(np.linalg.norm(vector))
        if length < 1e-9:
            raise self.error(key, "a direction cannot be zero")
        return vector / length

    def by_joint(self, key: str, value: Any) -> dict[str, float]:
        """Check a mapping of joint names to numbers."""
        values = self.mapping(key, value)
        for joint, number in values.items():
            if not is_number(number):
                raise self.error(f"{key}.{joint}", f"expected a number, got {short_repr(number)}")
        return {joint: float(number) for joint, number in values.items()}

    def effort(self, value: Any) -> float | dict[str, float]:
        """Check the effort: one positive number for all joints, or a mapping of joint names to positive numbers."""
        efforts = self.by_joint("effort", value) if isinstance(value, dict) else value
        values = list(efforts.values()) if isinstance(efforts, dict) else [efforts]
        if not all(is_number(number) and number > 0 for number in values):
            raise self.error("effort", f"expected positive numbers, got {short_repr(value)}")
        return efforts if isinstance(efforts, dict) else float(efforts)

    def mount(self, value: Any) -> Mount:
        """Read the `mount` entry: a link of the arm, and the base link's pose in that link (default: identity)."""
        given = self.section("mount", value, _MOUNT_KEYS, ("parent",))
        parent = self.text("mount.parent", given["parent"])
        x, y, z = self.numbers("mount.position", given.get("position", [0, 0, 0]), 3).tolist()
        quaternion = self.numbers("mount.quaternion_wxyz", given.get("quaternion_wxyz", [1, 0, 0, 0]), 4)
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > 1e-2:
            raise self.error("mount.quaternion_wxyz", f"length {length:.3g}; valid: a unit quaternion, w first")
        w, i, j, k = (quaternion / length).tolist()
        return Mount(parent, (x, y, z), (w, i, j, k))


@dataclass(frozen=True, eq=False)
class HandDescription:
    """The checked content of a description.

    Attributes:
        source: the file and its YAML nodes.
        name: name of the hand. The default is the stem of the file name.
        urdf: path of the URDF or MJCF file.
        palm_link: link in whose frame palm_center and palm_normal are given. None for the base link.
        palm_center: centre of the palm's surface [m]. None to guess the palm.
        palm_normal: unit direction out of the palm. None to guess the palm.
        approach: unit direction of approach in the base frame. None for the palm normal.
        effort: greatest effort [N·m] or [N], of all joints or by joint name. None to keep the efforts of the URDF.
        open, closed: joint values by joint name [rad] or [m]. None to guess the posture.
        mount: pose of the base link on an arm. None if the file has no `mount`.
        root: first link of the hand in a URDF of a whole robot. None if the whole URDF is the hand.
    """

    source: Source
    name: str
    urdf: Path
    palm_link: str | None
    palm_center: Float[np.ndarray, "3"] | None
    palm_normal: Float[np.ndarray, "3"] | None
    approach: Float[np.ndarray, "3"] | None
    effort: float | dict[str, float] | None
    open: dict[str, float] | None
    closed: dict[str, float] | None
    mount: Mount | None = None
    root: str | None = None


def is_number(value: object) -> bool:
    """Return True for a number between -1e9 and 1e9. Booleans do not count as numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -_LARGEST <= value <= _LARGEST


def read_description(path: Path) -> HandDescription:
    """Read and check a hand description.

    Raises HandError if the file is not YAML, lacks a key, or has an unknown key or a wrong value.
    """
    try:
        node, data = parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise HandError(f"{path}: cannot be read: {error.strerror or error}") from error
    except YamlError as error:
        raise HandError(f"{path}:{error.line}: not well-formed YAML: {error.problem}") from error
    except UnicodeDecodeError as error:
        raise HandError(f"{path}:1: not well-formed YAML: {type(error).__name__}") from error
    source = Source(path, node)
    root = source.section("", data, _KEYS, ("urdf",))
    palm = source.section("palm", root["palm"], _PALM_KEYS, _PALM_KEYS[1:]) if "palm" in root else {}

    def checked(key: str, check: Callable[[str, Any], Any], values: dict[str, Any] = root) -> Any:
        return check(key, values[key.rpartition(".")[2]]) if key.rpartition(".")[2] in values else None

    # If a file has several mistakes, the order of these checks decides which of them is reported.
    return HandDescription(
        source=source,
        name=checked("name", source.text) or path.stem,
        urdf=path.parent / source.text("urdf", root["urdf"]),
        palm_link=checked("palm.link", source.text, palm),
        effort=source.effort(root["effort"]) if root.get("effort") is not None else None,
        palm_center=checked("palm.center", lambda key, value: source.numbers(key, value, 3), palm),
        palm_normal=checked("palm.normal", source.direction, palm),
        approach=checked("approach", source.direction),
        open=checked("open", source.by_joint),
        closed=checked("closed", source.by_joint),
        mount=source.mount(root["mount"]) if "mount" in root else None,
        root=checked("root", source.text),
    )


def apply_description(hand: HandModel, description: HandDescription) -> HandModel:
    """Return the hand with the description's palm, postures and efforts.

    A missing palm or posture is guessed, with a warning. Raises HandError: a joint or link is unknown, a joint has no
    value, or a value is outside the joint limits.
    """
    known_at_once = {"name": description.name, "effort": _efforts(hand, description), "mount": description.mount}
    hand = _with_palm(replace(hand, **known_at_once), description)
    given = {"open": description.open, "closed": description.closed}
    known = {key: _posture(hand, description, key, values) for key, values in given.items() if values is not None}
    if len(known) < len(given):
        hand = default_postures(hand, tuple(key for key in given if key not in known))
    return replace(hand, **{f"{key}_posture": values for key, values in known.items()})


def _with_palm(hand: HandModel, description: HandDescription) -> HandModel:
    center, normal = description.palm_center, description.palm_normal
    if center is None or normal is None:
        hand = default_palm(hand)
        return hand if description.approach is None else replace(hand, approach=description.approach)
    link = description.palm_link or hand.base_link
    fixed = [name for name, group in zip(hand.link_names, hand.link_group, strict=True) if group == 0]
    if link not in fixed:
        raise description.source.error(
            "palm.link", f"{link!r} is not fixed to the base; choose from {', '.join(fixed)}"
        )
    rotations, translations = link_poses(hand, hand.open_posture)
    number = hand.link_index[link]
    normal = rotations[number] @ normal
    return replace(
        hand,
        palm_center=rotations[number] @ center + translations[number],
        palm_normal=normal,
        approach=normal if description.approach is None else description.approach,
    )


def _posture(
    hand: HandModel, description: HandDescription, key: str, values: Mapping[str, float]
) -> Float[np.ndarray, "joints"]:
    _check_joints(hand, description, key, values)
    missing = [name for name in hand.joint_names if name not in values]
    if missing:
        raise description.source.error(key, f"no value for {', '.join(missing)}")
    for name, lower, upper in zip(hand.joint_names, hand.lower, hand.upper, strict=True):
        if not lower <= values[name] <= upper:
            raise description.source.error(
                f"{key}.{name}", f"{values[name]:g} is outside the limits [{lower:g}, {upper:g}]"
            )
    return np.array([values[name] for name in hand.joint_names])


def _efforts(hand: HandModel, description: HandDescription) -> Float[np.ndarray, "joints"]:
    effort = description.effort
    if effort is None:
        return hand.effort
    if not isinstance(effort, dict):
        return np.full(hand.num_joints, float(effort))
    _check_joints(hand, description, "effort", effort)
    return np.array([effort.get(name, old) for name, old in zip(hand.joint_names, hand.effort.tolist(), strict=True)])


def _check_joints(hand: HandModel, description: HandDescription, key: str, values: Mapping[str, float]) -> None:
    for name in values:
        if name not in hand.joint_names:
            raise description.source.error(f"{key}.{name}", f"no such joint; joints: {', '.join(hand.joint_names)}")
