"""Attributes of an MJCF file: default classes, units, orientations. Reference: MuJoCo's XML reference, 3.x."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.readers.xml_io import Element, wrong
from graspd_core.hands.readers.xml_values import read_numbers, read_position
from graspd_core.se3 import axis_rotation, quaternion_between, rotation_from_quaternion

_Attributes = Mapping[str, Mapping[str, str]]
# Each class holds all that the classes above it say.
_MOST_CLASSES, _MOST_KINDS = 300, 64
_ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
# All write to the same attributes: a class's defaults for one are those for the others.
_ACTUATORS = (
    "general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class MjcfSettings:
    """What the whole file says about its elements.

    Attributes:
        path: of the file.
        degrees: whether angles are in degrees, as they are unless the file says otherwise.
        euler: the axes of Euler angles in their order, lower case where they turn with the body.
        limits_by_range: whether a joint with a range is limited by it.
        mesh_folder: where mesh files lie.
        corners: the most that the hull of a mesh may have.
        classes: default attributes by class and element; each class holds those of the classes above it.
    """

    path: Path
    degrees: bool = True
    euler: str = "xyz"
    limits_by_range: bool = True
    mesh_folder: str = ""
    corners: int = 200
    classes: Mapping[str, _Attributes] = field(default_factory=lambda: MappingProxyType({"main": {}}))

    @property
    def angle(self) -> float:
        """One unit of angle of the file [rad]."""
        return float(np.pi / 180.0) if self.degrees else 1.0


def read_settings(path: Path, root: ET.Element) -> MjcfSettings:
    """Compiler settings and default classes of a file.

    Raises:
        HandError: an Euler sequence or a coordinate system that does not exist.
    """
    compiler: dict[str, str] = {}
    for element in root.findall("compiler"):
        compiler |= element.attrib
        euler = element.get("eulerseq", "xyz")
        if len(euler) != 3 or set(euler) - set("xyzXYZ"):
            raise wrong(path, element, f"<compiler eulerseq={euler!r}>: expected three of x, y, z")
        if element.get("coordinate", "local") != "local":
            raise wrong(path, element, f"<compiler coordinate={element.get('coordinate')!r}>: only 'local' is read")
    classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
    for element in root.findall("default"):
        _collect_classes(path, element, classes, "main", {})
    return MjcfSettings(
        path=path,
        degrees=compiler.get("angle", "degree") != "radian",
        euler=compiler.get("eulerseq", "xyz"),
        limits_by_range=compiler.get("autolimits", "true") != "false",
        mesh_folder=compiler.get("meshdir", compiler.get("assetdir", "")),
        classes=classes,
    )


def _collect_classes(
    path: Path,
    element: ET.Element,
    classes: dict[str, dict[str, dict[str, str]]],
    name: str,
    above: Mapping[str, Mapping[str, str]],
) -> None:
    # Only the first class can be written in several pieces.
    own = {tag: dict(values) for tag, values in (classes.get(name) or above).items()}
    for child in element:
        if child.tag != "default":
            own[_kin(child.tag)] = {**own.get(_kin(child.tag), {}), **child.attrib}
    classes[name] = own
    if len(classes) > _MOST_CLASSES or len(own) > _MOST_KINDS:
        limits = f"{_MOST_CLASSES} default classes, nor one more than {_MOST_KINDS} kinds of elements"
        raise wrong(path, element, f"no hand has more than {limits}")
    for child in element.findall("default"):
        if not child.get("class"):
            raise wrong(path, child, "a nested <default> has no class")
        _collect_classes(path, child, classes, str(child.get("class")), own)


def _kin(tag: str) -> str:
    return "general" if tag in _ACTUATORS else tag


def with_defaults(settings: MjcfSettings, element: ET.Element, child_class: str) -> ET.Element:
    """The element with the attributes that its class gives it.

    Raises:
        HandError: the class is not defined.
    """
    name = element.get("class", child_class)
    if name not in settings.classes:
        raise wrong(settings.path, element, f"class {name!r} is not defined; known: {', '.join(settings.classes)}")
    merged = dict(settings.classes[name].get(_kin(element.tag), {}))
    if any(key in element.attrib for key in _ORIENTATIONS):
        merged = {key: value for key, value in merged.items() if key not in _ORIENTATIONS}
    whole = Element(element.tag, {**merged, **element.attrib})
    whole.line, whole.owner = getattr(element, "line", 0), getattr(element, "owner", "")
    return whole


def read_pose(settings: MjcfSettings, element: ET.Element) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Rotation and position [m] of a body, geom or inertial in its parent."""
    return read_rotation(settings, element), read_position(settings.path, element, "pos")


def read_rotation(settings: MjcfSettings, element: ET.Element) -> Float[np.ndarray, "3 3"]:
    """The one orientation that an element gives, identity where it gives none.

    Raises:
        HandError: it gives several, or one without length.
    """
    path = settings.path
    given = [key for key in _ORIENTATIONS if key in element.attrib]
    if len(given) > 1:
        raise wrong(path, element, f"<{element.tag}> has several orientations: {', '.join(given)}")
    if not given:
        return np.eye(3)
    if given[0] == "quat":
        return rotation_from_quaternion(torch.as_tensor(_direction(settings, element, "quat", 4))).numpy()
    if given[0] == "axisangle":
        values = read_numbers(path, element, "axisangle", 4, "")
        return axis_rotation(_unit(settings, element, "axisangle", values[:3]), values[3] * settings.angle)
    if given[0] == "euler":
        rotation = np.eye(3)
        for axis, angle in zip(settings.euler, read_numbers(path, element, "euler", 3, ""), strict=True):
            step = axis_rotation(np.eye(3)["xyz".index(axis.lower())], angle * settings.angle)
            rotation = rotation @ step if axis.islower() else step @ rotation
        return rotation
    if given[0] == "xyaxes":
        values = read_numbers(path, element, "xyaxes", 6, "")
        x = _unit(settings, element, "xyaxes", values[:3])
        y = _unit(settings, element, "xyaxes", values[3:] - (values[3:] @ x) * x)
        return np.column_stack([x, y, np.cross(x, y)])
    return turn_z_to(_direction(settings, element, "zaxis", 3))


def read_range(settings: MjcfSettings, element: ET.Element, key: str, flag: str) -> Float[np.ndarray, "2"] | None:
    """The two ends of a range, None where it does not hold: `flag` says so, or leaves it to the compiler's settings."""
    ends = read_numbers(settings.path, element, key, 2, "0 0")
    limited = element.get(flag, "auto")
    by_itself = limited == "auto" and settings.limits_by_range and ends[0] != ends[1]
    return ends if limited == "true" or by_itself else None


def read_axis(settings: MjcfSettings, joint: ET.Element) -> Float[np.ndarray, "3"]:
    """A joint's unit axis in its body's frame."""
    return _direction(settings, joint, "axis", 3) if "axis" in joint.attrib else np.array([0.0, 0.0, 1.0])


def turn_z_to(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The shortest rotation of z onto a unit vector; like MuJoCo, about x where it is half a turn."""
    x, _, z = np.eye(3)
    return rotation_from_quaternion(torch.as_tensor(quaternion_between(z, direction, around=x))).numpy()


def _direction(settings: MjcfSettings, element: ET.Element, key: str, count: int) -> Float[np.ndarray, "n"]:
    return _unit(settings, element, key, read_numbers(settings.path, element, key, count, ""))


def _unit(
    settings: MjcfSettings, element: ET.Element, key: str, values: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    length = float(np.linalg.norm(values.clip(-1e10, 1e10)))
    if not 1e-10 < length < 1e10:
        raise wrong(settings.path, element, f"<{element.tag} {key}={element.get(key)!r}>: has no direction")
    return values / length
