"""Arms by name, from an arm description: the YAML file beside a URDF (docs/arms.md).

An arm is a frozen chain of links from its base to the tip that carries the hand. graspd's URDF reader reads it. Forward
kinematics and Jacobians are those of pytorch-kinematics, which is imported when an arm is used.

Solids become capsules: all points nearer to a segment than a radius. Distances between capsules and to a plane are
exact. Any other solid gets an enclosing capsule, which is larger.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.config.mapping import from_mapping, yaml_values
from graspd_core.errors import ConfigError, choices, shown
from graspd_core.hands.model import HandModel, Mount, Primitive
from graspd_core.hands.readers.urdf import read_urdf
from graspd_core.hands.readers.xml_io import parse_xml, read_xml
from graspd_core.paths import config_dir
from graspd_core.se3 import SE3, rotation_from_quaternion

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain

# A squared length below this is a point's [m²].
_POINT = 1e-12


@dataclass(frozen=True)
class Capsules:
    """Some capsules, each fixed in a link.

    Attributes:
        link: number of the link of each.
        start, end: the ends of their segments, link frame [m].
        radius: [m].
    """

    link: Int[np.ndarray, "n"]
    start: Float[np.ndarray, "n 3"]
    end: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]


def capsules_about(primitives: Sequence[Primitive]) -> Capsules:
    """Return an enclosing capsule of each solid, spheres and capsules as they are."""
    rows = [_about(primitive) for primitive in primitives]
    turned = [
        [primitive.rotation @ point + primitive.translation for point in row[:2]]
        for primitive, row in zip(primitives, rows, strict=True)
    ]
    ends = np.array(turned, dtype=float).reshape(-1, 2, 3)
    link = np.array([primitive.link for primitive in primitives], dtype=np.int64)
    return Capsules(link, ends[:, 0], ends[:, 1], np.array([row[2] for row in rows], dtype=float))


def _about(primitive: Primitive) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Return ends and radius of a capsule about a solid, in the solid's frame."""
    size, up = primitive.size, np.array([0.0, 0.0, 1.0])
    if primitive.kind == "sphere":
        return np.zeros(3), np.zeros(3), size[0]
    if primitive.kind in ("capsule", "cylinder"):
        return -size[1] * up, size[1] * up, size[0]
    corners = primitive.vertices
    if primitive.kind == "box":
        corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3) * np.asarray(size)
    return _about_points(corners)


def _about_points(corners: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Return a capsule about points, along their direction of greatest spread, as thin, then as short as possible."""
    center = 0.5 * (corners.min(0) + corners.max(0))
    local = corners - center
    axis = np.linalg.svd(local, full_matrices=False)[2][0]
    along = local @ axis
    away = np.linalg.norm(local - np.outer(along, axis), axis=1)
    radius = float(away.max())
    # The caps reach past the ends. A point beside the axis needs them to reach less far than one on it.
    slack = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    low, high = float((along + slack).min()), float((along - slack).max())
    if low > high:
        low = high = 0.5 * (low + high)
    return center + low * axis, center + high * axis, radius


def placed(
    capsules: Capsules, links: SE3
) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n 3"], Float[Tensor, "n"]]:
    """Return ends [m] and radii of capsules at link poses, in the frame of the poses."""
    poses = links[:, torch.as_tensor(capsules.link)]
    ends = [torch.as_tensor(points).to(poses.translation) for points in (capsules.start, capsules.end)]
    start, end = ((poses.rotation @ points[..., None]).squeeze(-1) + poses.translation for points in ends)
    return start, end, torch.as_tensor(capsules.radius).to(poses.translation)


def segment_distance(
    a: Float[Tensor, "*#batch 3"],
    b: Float[Tensor, "*#batch 3"],
    c: Float[Tensor, "*#batch 3"],
    d: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch"]:
    """Return the distance [m] of the segments from a to b and from c to d.

    Each may be a point. C. Ericson, Real-Time Collision Detection, 5.1.9: the nearest points of the lines are clamped
    to their segments.
    """
    along, other, between = b - a, d - c, a - c
    aa, ee = (along * along).sum(-1), (other * other).sum(-1)
    f, cc, bb = (other * between).sum(-1), (along * between).sum(-1), (along * other).sum(-1)
    safe_a, safe_e = aa.clamp_min(_POINT), ee.clamp_min(_POINT)
    denominator = aa * ee - bb * bb
    # Of parallel segments any point will do for a start.
    apart = denominator > 1e-9 * aa * ee
    s = torch.where(apart, (bb * f - cc * ee) / torch.where(apart, denominator, 1.0), 0.0).clamp(0.0, 1.0)
    t = torch.where(ee > _POINT, ((bb * s + f) / safe_e), 0.0).clamp(0.0, 1.0)
    s = torch.where(aa > _POINT, ((bb * t - cc) / safe_a), 0.0).clamp(0.0, 1.0)
    return (between + s[..., None] * along - t[..., None] * other).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm as loaded, hashed by identity. Joints are those between base and tip, base first.

    Attributes:
        name: the arm's name.
        chain: its links and joints, link 0 the base, whose frame is the arm's base frame.
        tip: number of the link that carries the hand.
        lower, upper: joint limits, the URDF's or narrower [rad] or [m].
        seed: joint values clear of everything, which joints stay near if they can.
        capsules: its links' solids, a little larger than they are.
        mounts: where hands' base links sit on the tip, by the hand's name. Others sit as they say themselves.
    """

    name: str
    chain: HandModel
    tip: int
    lower: Float[np.ndarray, "joints"]
    upper: Float[np.ndarray, "joints"]
    seed: Float[np.ndarray, "joints"]
    capsules: Capsules
    mounts: Mapping[str, Mount] = field(default_factory=dict)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, base first."""
        return self.chain.joint_names

    @cached_property
    def moved_link(self) -> Int[np.ndarray, "joints"]:
        """The link that each joint moves against its parent."""
        return np.flatnonzero(self.chain.link_joint >= 0)


def tip_hand(arm: Arm, hand: HandModel) -> SE3:
    """Return `T_tip_hand`, the hand's pose on the tip. Raises ConfigError: neither arm nor hand says it."""
    mount = arm.mounts.get(hand.name, hand.mount)
    if mount is None:
        known = ", ".join(arm.mounts) or "none"
        raise ConfigError(
            f"arm {arm.name}: nobody says how hand {hand.name} is mounted; mounts of the arm: {known}; "
            "or give the hand's description a mount (docs/arms.md)"
        )
    rotation = rotation_from_quaternion(torch.tensor(mount.quaternion_wxyz, dtype=torch.float64))
    return SE3(rotation, torch.tensor(mount.position, dtype=torch.float64))


# Arms are hashed by identity.
@lru_cache(maxsize=8)
def kinematic_chain(arm: Arm) -> Chain:
    """Build pytorch-kinematics' chain of all links of an arm, in float64. Its own URDF reader keeps float32."""
    from pytorch_kinematics.chain import Chain
    from pytorch_kinematics.frame import Frame, Joint, Link
    from pytorch_kinematics.transforms import Transform3d

    model = arm.chain
    frames: list[Frame] = []
    for link, name in enumerate(model.link_names):
        offset = Transform3d(
            rot=torch.as_tensor(model.link_offset_rotation[link]).double(),
            pos=torch.as_tensor(model.link_offset_translation[link]).double(),
            dtype=torch.float64,
        )
        joint = Joint(offset=offset, dtype=torch.float64)
        if model.link_joint[link] >= 0:
            joint_name, axis = model.joint_names[model.link_joint[link]], torch.as_tensor(model.joint_axis[link])
            joint = Joint(joint_name, offset, model.joint_kind[link], axis, dtype=torch.float64)
        frames.append(Frame(name, Link(name), joint))
        if model.link_parent[link] >= 0:
            frames[model.link_parent[link]].add_child(frames[link])
    return Chain(frames[0], dtype=torch.float64)


def arm_links(arm: Arm, q: Float[Tensor, "batch joints"]) -> SE3:
    """Return `T_base_link` of every link at joint values q [rad] or [m]: a batch of arms by links."""
    chain = kinematic_chain(arm)
    poses = chain.forward_kinematics_tensor(q.double())[chain.get_frame_indices(*arm.chain.link_names)]
    poses = poses.transpose(0, 1).to(q)
    return SE3(poses[..., :3, :3], poses[..., :3, 3])


ROBOT_DESCRIPTION = "robot_description"


@dataclass(frozen=True)
class _MountEntry:
    """Where a hand's base link sits on the tip: position [m] and unit quaternion, w first."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ArmFile:
    """The keys of an arm description.

    Attributes:
        urdf: path of the URDF, from the description's folder, or `robot_description`: the robot that a caller brings
            along. It may hold more than the arm.
        tip: the link that carries the hand.
        base: the link that the arm begins at. Empty: the URDF's root.
        name: of the arm. Empty: the file's.
        seed: joint values by name, others in the middle of their limits [rad] or [m].
        limits: narrower limits by joint name, lower and upper [rad] or [m].
        mounts: `_MountEntry`s by the hand's name. Other hands sit as their own description says.
    """

    urdf: str = ""
    tip: str = ""
    base: str = ""
    name: str = ""
    seed: dict = field(default_factory=dict)
    limits: dict = field(default_factory=dict)
    mounts: dict = field(default_factory=dict)


def arm_names() -> tuple[str, ...]:
    """Return the names of the arms that graspd ships with."""
    return tuple(sorted(path.stem for path in (config_dir() / "arms").glob("*.yaml")))


def load_arm(name_or_path: str | Path, robot_description: str = "") -> Arm:
    """Load an arm by its name, or by the path of its description (.yaml).

    Args:
        name_or_path: of the arm.
        robot_description: a robot's URDF, for descriptions whose `urdf` is `robot_description`.

    Raises:
        ConfigError: no such arm or file, or the description is wrong. Names file, key and valid choices.
        HandError: the URDF cannot be used.
    """
    path, entries = read_arm_file(name_or_path)
    urdf = path.parent / entries.urdf
    if not from_robot_description(entries):
        return _make_arm(entries, urdf, read_xml(urdf), str(path))
    if not robot_description:
        told = "is what the node hears at its start, where its parameter arm names this file; else name a file"
        raise ConfigError(f"{path}.urdf: {ROBOT_DESCRIPTION} {told}")
    return _make_arm(entries, urdf, parse_xml(urdf, robot_description), str(path))


def from_robot_description(entries: ArmFile) -> bool:
    """Tell whether the arm is part of a robot whose URDF the caller brings."""
    return entries.urdf == ROBOT_DESCRIPTION


def read_arm_file(name_or_path: str | Path) -> tuple[Path, ArmFile]:
    """Read an arm's description. Return its path and entries. Raises ConfigError: see `load_arm`."""
    text = str(name_or_path)
    if not text.endswith((".yaml", ".yml")):
        if text not in arm_names():
            raise ConfigError(f"unknown arm {text!r}; {choices(text, arm_names(), ', or the path of a .yaml file')}")
        text = str(config_dir() / "arms" / f"{text}.yaml")
    path = Path(text)
    with yaml_values(path) as values:
        entries = from_mapping(ArmFile, values, path.name)
    for key in ("urdf", "tip"):
        if not getattr(entries, key):
            raise ConfigError(f"{path}: {key} is missing; keys: {', '.join(ArmFile.__dataclass_fields__)}")
    return path, entries


def _make_arm(entries: ArmFile, urdf: Path, root: ET.Element, where: str) -> Arm:
    """Make the arm of a description and its URDF. The elements of `root` are changed. Raises: see `load_arm`."""
    _keep_chain(root, entries.base, entries.tip, where)
    chain = read_urdf(urdf, root)
    if chain.mimics:
        raise ConfigError(
            f"{where}: joint {chain.mimics[0].name!r} follows another; an arm's joints move by themselves"
        )
    if all(chain.link_group[primitive.link] == 0 for primitive in chain.primitives):
        raise ConfigError(f"{urdf}: no link that moves has a <collision> or <visual> shape: give the arm capsules")
    lower, upper = _limits(chain, entries.limits, where)
    seed = 0.5 * (lower + upper)
    for joint, value in _by_joint(chain, entries.seed, f"{where}.seed").items():
        index = chain.joint_names.index(joint)
        if not _number(value) or not lower[index] <= value <= upper[index]:
            limits = f"[{lower[index]:g}, {upper[index]:g}]"
            raise ConfigError(f"{where}.seed.{joint}: {shown(value)} is no number within the limits {limits}")
        seed[index] = value
    name = entries.name or Path(where).stem
    mounts = {str(hand): _mount(given, entries.tip, f"{where}.mounts.{hand}") for hand, given in entries.mounts.items()}
    capsules = capsules_about(chain.primitives)
    return Arm(name, chain, chain.link_index[entries.tip], lower, upper, seed, capsules, mounts)


def _keep_chain(root: ET.Element, base: str, tip: str, where: str) -> None:
    """Drop all links and joints except those from base to tip and what is welded to them before the tip."""
    links = [str(link.get("name")) for link in root.findall("link")]
    for key, link in (("tip", tip), ("base", base)):
        if link and link not in links:
            raise ConfigError(f"{where}.{key}: no link {link!r} in the URDF; links: {', '.join(links) or 'none'}")
    joints = {_end(joint, "child"): joint for joint in root.findall("joint")}
    above = {child: _end(joint, "parent") for child, joint in joints.items()}
    chain = [tip]
    while chain[-1] != base and chain[-1] in above and above[chain[-1]] not in chain:
        chain.append(above[chain[-1]])
    if base and chain[-1] != base:
        raise ConfigError(f"{where}.base: {base!r} is not above the tip {tip!r}; above it: {', '.join(chain[1:])}")
    kept, waiting = set(chain), chain[1:]
    while waiting:
        parent = waiting.pop()
        welded = [c for c, j in joints.items() if above[c] == parent and j.get("type") == "fixed" and c not in kept]
        kept.update(welded)
        waiting += welded
    for element in root.findall("link"):
        if element.get("name") not in kept:
            root.remove(element)
    for child, element in joints.items():
        if child not in kept or child == chain[-1]:
            root.remove(element)


def _end(joint: ET.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else str(element.get("link"))


def _limits(
    chain: HandModel, narrower: Mapping[str, Any], where: str
) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "joints"]]:
    """Return the URDF's limits, narrowed as the description says."""
    lower, upper = chain.lower.copy(), chain.upper.copy()
    for joint, given in _by_joint(chain, narrower, f"{where}.limits").items():
        index = chain.joint_names.index(joint)
        if not isinstance(given, list) or len(given) != 2 or not all(map(_number, given)):
            raise ConfigError(f"{where}.limits.{joint}: expected a lower and an upper number, got {shown(given)}")
        low, high = given
        if not chain.lower[index] <= low < high <= chain.upper[index]:
            limits = f"[{chain.lower[index]:g}, {chain.upper[index]:g}]"
            raise ConfigError(f"{where}.limits.{joint}: [{low:g}, {high:g}] is no range within the URDF's {limits}")
        lower[index], upper[index] = low, high
    return lower, upper


def _by_joint(chain: HandModel, values: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    for joint in values:
        if joint not in chain.joint_names:
            raise ConfigError(f"{where}: no joint {shown(joint)}; joints: {', '.join(chain.joint_names)}")
    return values


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9


def _mount(given: Any, tip: str, where: str) -> Mount:
    entry = from_mapping(_MountEntry, given, where)
    length = float(np.linalg.norm(entry.quaternion_wxyz))
    if abs(length - 1.0) > 1e-2:
        raise ConfigError(f"{where}.quaternion_wxyz: a unit quaternion has length 1, not {length:.3g}")
    w, x, y, z = (value / length for value in entry.quaternion_wxyz)
    return Mount(tip, entry.position, (w, x, y, z))
