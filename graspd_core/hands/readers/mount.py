"""The `mount` entry of a hand description: where the hand's base link sits on the arm that carries it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.errors import HandError, shown
from graspd_core.hands.model import Mount

_DEFAULTS = {"position": [0.0, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}

# No length, angle or torque of a hand is larger, in any unit.
_LARGEST = 1e9


def is_number(value: object) -> bool:
    """Whether a value of YAML is a number that a hand can have."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -_LARGEST <= value <= _LARGEST


def read_mount(path: Path, lines: Mapping[str, int], value: Any) -> Mount:
    """The mount that a YAML value describes: `parent`, and the pose of the base link in it, zero unless given.

    Raises:
        HandError: a key is unknown or missing, or a value of the wrong kind; names file, line and key.
    """

    def error(key: str, message: str) -> HandError:
        return HandError(f"{path}:{lines.get(key, lines['mount'])}: {key}: {message}")

    def numbers(key: str) -> tuple[float, ...]:
        given, count = value.get(key, _DEFAULTS[key]), len(_DEFAULTS[key])
        fine = isinstance(given, list) and len(given) == count
        if not fine or not all(map(is_number, given)):
            raise error(f"mount.{key}", f"expected {count} numbers, got {shown(given)}")
        return tuple(float(x) for x in given)

    if not isinstance(value, dict):
        raise error("mount", f"expected a mapping of keys to values, got {shown(value)}")
    for key in map(str, value):
        if key not in ("parent", *_DEFAULTS):
            raise error(f"mount.{key}", f"unknown key; known: parent, {', '.join(_DEFAULTS)}")
    parent = value.get("parent")
    if not isinstance(parent, str) or not parent:
        raise error("mount.parent", f"expected the name of the arm's link, got {shown(parent)}")
    x, y, z = numbers("position")
    quaternion = np.array(numbers("quaternion_wxyz"))
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-2:
        raise error("mount.quaternion_wxyz", f"a unit quaternion, w first, has the length 1, not {length:.3g}")
    w, i, j, k = (float(v) for v in quaternion / length)
    return Mount(parent, (x, y, z), (w, i, j, k))
