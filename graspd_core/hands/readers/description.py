"""A hand description: the YAML file beside a URDF that says where the palm is and how the hand opens and closes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from graspd_core.config.yaml_text import YamlError, parse_yaml
from graspd_core.errors import HandError, shown
from graspd_core.hands.default_postures import default_palm, default_postures
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel, Mount
from graspd_core.hands.readers.mount import is_number, read_mount

_KEYS = ("name", "urdf", "root", "palm", "approach", "effort", "open", "closed", "mount")
_REQUIRED = ("urdf",)
_PALM_KEYS = ("link", "center", "normal")


@dataclass(frozen=True, eq=False)
class HandDescription:
    """A checked YAML file.

    Attributes:
        path: the file.
        name: the hand's name, the file's stem unless given.
        urdf: path of the URDF or MJCF file.
        palm_link: the link that palm_center and palm_normal are given in; None for the base link.
        palm_center: the point of the palm that grasps centre on [m]; None where the palm is to be guessed.
        palm_normal: direction out of the palm, unit; None likewise.
        approach: direction of approach in the base frame, unit; None for the palm's normal.
        effort: one greatest torque for all joints, some by name, or None for the URDF's [N·m].
        open, closed: joint values by joint name [rad] or [m]; None where they are to be guessed.
        lines: line of each key in the file, `palm.center` for a nested one.
        mount: where the base link sits on an arm; None where the file does not say.
        root: the link that the hand begins at, where the URDF holds a whole robot; None: all of it is the hand.
    """

    path: Path
    name: str
    urdf: Path
    palm_link: str | None
    palm_center: Float[np.ndarray, "3"] | None
    palm_normal: Float[np.ndarray, "3"] | None
    approach: Float[np.ndarray, "3"] | None
    effort: float | dict[str, float] | None
    open: dict[str, float] | None
    closed: dict[str, float] | None
    lines: dict[str, int]
    mount: Mount | None = None
    root: str | None = None

    def error(self, key: str, message: str) -> HandError:
        """The error to raise about a key: names file, line and key."""
        return HandError(f"{self.path}:{self.lines.get(key, 1)}: {key}: {message}")


def read_description(path: Path) -> HandDescription:
    """Read and check a hand description.

    Raises:
        HandError: not YAML, an unknown or missing key, or a value of the wrong type; names file, line and key.
    """
    try:
        text = path.read_text(encoding="utf-8")
        node, data = parse_yaml(text)
    except OSError as error:
        raise HandError(f"{path}: cannot be read: {error.strerror or error}") from error
    except YamlError as error:
        raise HandError(f"{path}:{error.line}: not well-formed YAML: {error.problem}") from error
    except UnicodeDecodeError as error:
        raise HandError(f"{path}:1: not well-formed YAML: {type(error).__name__}") from error
    # Keys that YAML reads as something else than what is written, or that it merges, are looked for in vain.
    lines: dict[str, int] = defaultdict(lambda: 1, _key_lines(node))
    root = _mapping(path, 1, "the file", data)
    _check_keys(path, lines, root, "", _KEYS, _REQUIRED)
    palm = _mapping(path, lines["palm"], "palm", root["palm"]) if "palm" in root else {}
    _check_keys(path, lines, palm, "palm.", _PALM_KEYS, ("center", "normal") if "palm" in root else ())

    for key, value in (
        ("name", root.get("name", "")),
        ("urdf", root["urdf"]),
        ("root", root.get("root", "")),
        ("palm.link", palm.get("link", "")),
    ):
        if not isinstance(value, str):
            raise HandError(f"{path}:{lines[key]}: {key}: expected text, got {shown(value)}")
    # In this order, which decides what is told of a file with several mistakes.
    effort = _effort(path, lines, root["effort"]) if root.get("effort") is not None else None
    return HandDescription(
        path=path,
        name=root.get("name", path.stem),
        urdf=path.parent / root["urdf"],
        palm_link=palm.get("link"),
        palm_center=_vector(path, lines, "palm.center", palm["center"]) if palm else None,
        palm_normal=_direction(path, lines, "palm.normal", palm["normal"]) if palm else None,
        approach=_direction(path, lines, "approach", root["approach"]) if "approach" in root else None,
        effort=effort,
        open=_numbers(path, lines, "open", root["open"]) if "open" in root else None,
        closed=_numbers(path, lines, "closed", root["closed"]) if "closed" in root else None,
        lines=lines,
        mount=read_mount(path, lines, root["mount"]) if "mount" in root else None,
        root=root.get("root"),
    )


def _vector(path: Path, lines: Mapping[str, int], key: str, value: Any) -> Float[np.ndarray, "3"]:
    if not isinstance(value, list) or len(value) != 3 or not all(is_number(x) for x in value):
        raise HandError(f"{path}:{lines[key]}: {key}: expected three numbers, got {shown(value)}")
    return np.array(value, dtype=np.float64)


def _direction(path: Path, lines: Mapping[str, int], key: str, value: Any) -> Float[np.ndarray, "3"]:
    vector = _vector(path, lines, key, value)
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise HandError(f"{path}:{lines[key]}: {key}: a direction cannot be zero")
    return vector / length


def _numbers(path: Path, lines: Mapping[str, int], key: str, value: Any) -> dict[str, float]:
    """Numbers by joint name."""
    values = _mapping(path, lines[key], key, value)
    for joint, number in values.items():
        if not is_number(number):
            line = lines[f"{key}.{joint}"]
            raise HandError(f"{path}:{line}: {key}.{joint}: expected a number, got {shown(number)}")
    return {joint: float(number) for joint, number in values.items()}


def _effort(path: Path, lines: Mapping[str, int], value: Any) -> float | dict[str, float]:
    """One greatest torque for all joints, or some by name."""
    efforts = _numbers(path, lines, "effort", value) if isinstance(value, dict) else value
    values = list(efforts.values()) if isinstance(efforts, dict) else [efforts]
    if not all(is_number(number) and number > 0 for number in values):
        raise HandError(f"{path}:{lines['effort']}: effort: expected positive numbers, got {shown(value)}")
    return efforts if isinstance(efforts, dict) else float(efforts)


def apply_description(hand: HandModel, description: HandDescription) -> HandModel:
    """The hand with the description's palm, postures and efforts; what it leaves out is guessed, with a warning.

    Raises:
        HandError: an unknown joint or link, a joint without a value, or a value outside the joint's limits.
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
        raise description.error("palm.link", f"{link!r} is not fixed to the base; choose from {', '.join(fixed)}")
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
        raise description.error(key, f"no value for {', '.join(missing)}")
    for name, lower, upper in zip(hand.joint_names, hand.lower, hand.upper, strict=True):
        if not lower <= values[name] <= upper:
            raise description.error(f"{key}.{name}", f"{values[name]:g} is outside the limits [{lower:g}, {upper:g}]")
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
            raise description.error(f"{key}.{name}", f"no such joint; joints: {', '.join(hand.joint_names)}")


def _key_lines(node: yaml.Node | None, prefix: str = "") -> dict[str, int]:
    """Line number of every key of the file and of the mappings in it, the two joined by a dot."""
    lines: dict[str, int] = {}
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            name = f"{prefix}{key.value}"
            lines[name] = key.start_mark.line + 1
            # No deeper: by its aliases a mapping may hold itself.
            lines |= {} if prefix else _key_lines(value, f"{name}.")
    return lines


def _mapping(path: Path, line: int, what: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise HandError(f"{path}:{line}: {what}: expected a mapping of keys to values, got {shown(value)}")
    # Some hands' joints have bare numbers for names.
    return {key if isinstance(key, str) else shown(key): entry for key, entry in value.items()}


def _check_keys(
    path: Path,
    lines: dict[str, int],
    data: dict[str, Any],
    prefix: str,
    known: tuple[str, ...],
    required: tuple[str, ...],
) -> None:
    for key in data:
        if key not in known:
            raise HandError(f"{path}:{lines.get(f'{prefix}{key}', 1)}: unknown key {key!r}; known: {', '.join(known)}")
    for key in required:
        if key not in data:
            raise HandError(f"{path}:{lines.get(prefix.rstrip('.'), 1)}: {prefix}{key} is missing")
