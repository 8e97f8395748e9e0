"""Numbers and origins of URDF elements, with errors that name the file, the element and the value."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.hands.readers.xml_io import wrong

# Nothing in a hand is farther than this from the frame that it is given in [m].
FARTHEST = 10.0


def read_origin(path: Path, element: ET.Element) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Rotation and translation [m] of an element's `<origin>`; identity where it has none."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    rpy = read_numbers(path, origin, "rpy", 3, "0 0 0")
    return rotation_from_rpy(rpy), read_position(path, origin, "xyz")


def read_position(path: Path, element: ET.Element, key: str) -> Float[np.ndarray, "3"]:
    """Three coordinates [m], zero where absent.

    Raises:
        HandError: they are not numbers, or farther away than anything in a hand is.
    """
    position = read_numbers(path, element, key, 3, "0 0 0")
    if np.abs(position).max() > FARTHEST:
        text = f"<{element.tag} {key}={element.get(key)!r}>"
        raise wrong(path, element, f"{text}: more than {FARTHEST:g} m away; lengths are in metres")
    return position


def read_numbers(path: Path, element: ET.Element, key: str, count: int, default: str) -> Float[np.ndarray, "n"]:
    """An attribute of `count` finite numbers.

    Raises:
        HandError: it holds something else.
    """
    text = element.get(key) or default
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise wrong(path, element, f"<{element.tag} {key}={text!r}>: expected {count} finite number(s)")
    return values


def rotation_from_rpy(rpy: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """`Rz(yaw) Ry(pitch) Rx(roll)`: URDF's fixed-axis convention [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
