"""Load arms by name, or from an arm description: a YAML file beside a URDF (docs/arms.md).

An arm is a chain of links from its base to the tip link that carries the hand. graspd's URDF reader reads the chain.
Forward kinematics and Jacobians come from pytorch-kinematics, which is imported when an arm is used.

Each collision shape becomes a capsule: all points within a radius of a segment. Spheres and capsules do not change. Any
other shape is replaced by a larger enclosing capsule. Distances from a capsule to a capsule or to a plane are exact.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.config.mapping import from_mapping, yaml_values
from graspd_core.errors import ConfigError, choices, short_repr
from graspd_core.hands.model import HandModel, Mount, Primitive
from graspd_core.hands.readers.description import is_number
from graspd_core.hands.readers.urdf import joint_end, keep_links, read_urdf
from graspd_core.hands.readers.xml_io import parse_xml, read_xml
from graspd_core.paths import config_dir
from graspd_core.se3 import SE3, rotation_from_quaternion

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain

# A segment with a squared length up to this counts as a point [m²].
_POINT = 1e-12


@dataclass(frozen=True)
class Capsules:
    """Capsules that are fixed to links.

    Attributes:
        link: index of each capsule's link.
        start, end: end points of the segments, link frame [m].
        radius: radius of each capsule [m].
    """

    link: Int[np.ndarray, "n"]
    start: Float[np.ndarray, "n 3"]
    end: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]


# Primitives are hashed by identity.
@lru_cache(maxsize=8)
def capsules_about(primitives: tuple[Primitive, ...]) -> Capsules:
    """Return an enclosing capsule of each primitive. Spheres and capsules are not enlarged."""
    rows = [(solid, *_about(solid)) for solid in primitives]
    turned = [[solid.rotation @ point + solid.translation for point in (start, end)] for solid, start, end, _ in rows]
    ends = np.array(turned, dtype=float).reshape(-1, 2, 3)
    link = np.array([solid.link for solid in primitives], dtype=np.int64)
    return Capsules(link, ends[:, 0], ends[:, 1], np.array([radius for *_, radius in rows], dtype=float))


def _about(primitive: Primitive) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Return the end points and the radius of a capsule around a primitive, in the primitive's frame [m]."""
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
    """Return end points and radius of a capsule around points. The capsule lies along the direction of most spread."""
    center = 0.5 * (corners.min(0) + corners.max(0))
    local = corners - center
    axis = np.linalg.svd(local, full_matrices=False)[2][0]
    along = local @ axis
    away = np.linalg.norm(local - np.outer(along, axis), axis=1)
    radius = float(away.max())
    # Make the capsule as short as possible: a point may lie beyond the end of the segment by `slack`.
    slack = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    low, high = float((along + slack).min()), float((along - slack).max())
    if low > high:
        low = high = 0.5 * (low + high)
    return center + low * axis, center + high * axis, radius


def placed(
    capsules: Capsules, links: SE3
) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n 3"], Float[Tensor, "n"]]:
    """Return end points [m] and radii [m] of capsules at link poses, in the frame of the poses."""
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
    """Return the distance [m] between the segments from a to b and from c to d.

    A segment may be a point. The nearest points of the two lines are clamped to the segments. Source: C. Ericson,
    Real-Time Collision Detection, 5.1.9.
    """
    along, other, between = b - a, d - c, a - c
    aa, ee = (along * along).sum(-1), (other * other).sum(-1)
    f, cc, bb = (other * between).sum(-1), (along * between).sum(-1), (along * other).sum(-1)
    safe_a, safe_e = aa.clamp_min(_POINT), ee.clamp_min(_POINT)
    denominator = aa * ee - bb * bb
    # If the segments are parallel, any value of s gives the correct distance, so begin with s = 0.
    apart = denominator > 1e-9 * aa * ee
    s = torch.where(apart, (bb * f - cc * ee) / torch.where(apart, denominator, 1.0), 0.0).clamp(0.0, 1.0)
    t = torch.where(ee > _POINT, ((bb * s + f) / safe_e), 0.0).clamp(0.0, 1.0)
    s = torch.where(aa > _POINT, ((bb * t - cc) / safe_a), 0.0).clamp(0.0, 1.0)
    return (between + s[..., None] * along - t[..., None] * other).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class Arm:
    """A loaded arm, hashed by identity. Its joints lie between base and tip. Their order starts at the base.

    Attributes:
        name: name of the arm.
        chain: links and joints of the arm. Link 0 is the base, whose frame is the arm's base frame.
        tip: index of the link that carries the hand.
        lower, upper: joint limits of the URDF, or narrower limits of the arm description [rad] or [m].
        seed: collision-free joint values [rad] or [m]. The planner prefers arm postures near the seed.
        capsules: capsules that enclose the collision shapes of the links.
        mounts: poses of hands on the tip, by hand name. A hand that is not listed uses the mount of its description.
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
        """Names of the joints, starting at the base."""
        return self.chain.joint_names

    @cached_property
    def moved_link(self) -> Int[np.ndarray, "joints"]:
        """Index of the child link of each joint."""
        return np.flatnonzero(self.chain.link_joint >= 0)


def tip_hand(arm: Arm, hand: HandModel) -> SE3:
    """Return `T_tip_hand`, the hand's pose on the tip. Raises ConfigError: neither arm nor hand has a mount."""
    mount = arm.mounts.get(hand.name, hand.mount)
    if mount is None:
        known = ", ".join(arm.mounts) or "none"
        raise ConfigError(
            f"arm {arm.name}: no mount for hand {hand.name}; mounts of the arm: {known}; "
            "add `mounts` to the arm's description, or `mount` to the hand's (docs/arms.md)"
        )
    rotation = rotation_from_quaternion(torch.tensor(mount.quaternion_wxyz, dtype=torch.float64))
    return SE3(rotation, torch.tensor(mount.position, dtype=torch.float64))


# Arms are hashed by identity.
@lru_cache(maxsize=8)
def kinematic_chain(arm: Arm) -> Chain:
    """Build an arm's pytorch-kinematics chain in float64. The library's own URDF reader would round to float32."""
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
    """Return `T_base_link` of every link at joint values `q` [rad] or [m]. The batch shape is (batch, links)."""
    chain = kinematic_chain(arm)
    poses = chain.forward_kinematics_tensor(q.double())[chain.get_frame_indices(*arm.chain.link_names)]
    poses = poses.transpose(0, 1).to(q)
    return SE3(poses[..., :3, :3], poses[..., :3, 3])


ROBOT_DESCRIPTION = "robot_description"


@dataclass(frozen=True)
class _MountEntry:
    """The pose of a hand's base link on the tip: position [m] and unit quaternion, w first."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ArmFile:
    """The keys of an arm description.

    Attributes:
        urdf: path of the URDF, relative to the description's folder. If it is `robot_description`, the caller
            passes the URDF's text. The URDF may contain more than the arm.
        tip: name of the link that carries the hand.
        base: name of the first link of the arm. Empty for the root of the URDF.
        name: name of the arm. Empty for the stem of the file name.
        seed: joint values of `Arm.seed` by joint name [rad] or [m]. The default is the middle of the limits.
        limits: lower and upper limit by joint name [rad] or [m], within the limits of the URDF.
        mounts: pose on the tip (`_MountEntry`) by hand name. Other hands use the mount of their own description.
    """

    urdf: str = ""
    tip: str = ""
    base: str = ""
    name: str = ""
    seed: dict = field(default_factory=dict)
    limits: dict = field(default_factory=dict)
    mounts: dict = field(default_factory=dict)


def arm_names() -> tuple[str, ...]:
    """Return the names of the arms that are part of graspd."""
    return tuple(sorted(path.stem for path in (config_dir() / "arms").glob("*.yaml")))


def load_arm(name_or_path: str | Path, robot_description: str = "") -> Arm:
    """Load an arm by its name, or by the path of its description (.yaml).

    Args:
        name_or_path: name of the arm, or path of its description.
        robot_description: text of a robot's URDF, for descriptions whose `urdf` is `robot_description`.

    Raises:
        ConfigError: the arm or file does not exist, or the description is invalid. The message names file and key.
        HandError: the URDF cannot be used.
    """
    path, entries = read_arm_file(name_or_path)
    urdf, given = path.parent / entries.urdf, from_robot_description(entries)
    if given and not robot_description:
        hint = "known only to a node with the parameter arm; without a node, give the path of a URDF"
        raise ConfigError(f"{path}.urdf: {ROBOT_DESCRIPTION} is {hint}")
    return _make_arm(entries, urdf, parse_xml(urdf, robot_description) if given else read_xml(urdf), str(path))


def from_robot_description(entries: ArmFile) -> bool:
    """Return True if the caller must pass the text of the URDF, as `robot_description`."""
    return entries.urdf == ROBOT_DESCRIPTION


def read_arm_file(name_or_path: str | Path) -> tuple[Path, ArmFile]:
    """Read an arm description and return its path and entries. Raises ConfigError: see `load_arm`."""
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
    """Build an arm from its description and URDF. `root` is modified. Raises the errors of `load_arm`."""
    _keep_chain(root, entries.base, entries.tip, where)
    # The pose of the arm's base is that of the first link, so a `world` link with a fixed offset must stay.
    chain = read_urdf(urdf, root, keep_world=True)
    if entries.base and chain.base_link != entries.base:
        above = f"{entries.base!r} is above a floating or planar joint"
        raise ConfigError(f"{where}.base: {above}; valid: {chain.base_link}, or a link between it and the tip")
    if chain.mimics:
        raise ConfigError(
            f"{where}: joint {chain.mimics[0].name!r} is coupled by <mimic>; valid: independent joints of the arm"
        )
    if all(chain.link_group[primitive.link] == 0 for primitive in chain.primitives):
        raise ConfigError(f"{urdf}: no moving link has a <collision> or <visual> shape; valid: at least one shape")
    lower, upper = _limits(chain, entries.limits, where)
    seed = 0.5 * (lower + upper)
    for joint, value in _by_joint(chain, entries.seed, f"{where}.seed").items():
        index = chain.joint_names.index(joint)
        if not is_number(value) or not lower[index] <= value <= upper[index]:
            limits = f"[{lower[index]:g}, {upper[index]:g}]"
            raise ConfigError(f"{where}.seed.{joint}: {short_repr(value)}; valid: a number within the limits {limits}")
        seed[index] = value
    name = entries.name or Path(where).stem
    mounts = {str(hand): _mount(given, entries.tip, f"{where}.mounts.{hand}") for hand, given in entries.mounts.items()}
    capsules = capsules_about(chain.primitives)
    return Arm(name, chain, chain.link_index[entries.tip], lower, upper, seed, capsules, mounts)


def _keep_chain(root: ET.Element, base: str, tip: str, where: str) -> None:
    """Keep the chain from base to tip and all links that are fixed to it, but not those fixed to the tip."""
    links = [str(link.get("name")) for link in root.findall("link")]
    for key, link in (("tip", tip), ("base", base)):
        if link and link not in links:
            raise ConfigError(f"{where}.{key}: no link {link!r} in the URDF; links: {', '.join(links) or 'none'}")
    joints = {joint_end(joint, "child"): joint for joint in root.findall("joint")}
    above = {child: joint_end(joint, "parent") for child, joint in joints.items()}
    chain = [tip]
    while chain[-1] != base and chain[-1] in above and above[chain[-1]] not in chain:
        chain.append(above[chain[-1]])
    if base and chain[-1] != base:
        raise ConfigError(f"{where}.base: {base!r} is not above the tip {tip!r}; valid: {', '.join(chain[1:])}")
    kept, waiting = set(chain), chain[1:]
    while waiting:
        parent = waiting.pop()
        welded = [c for c, j in joints.items() if above[c] == parent and j.get("type") == "fixed" and c not in kept]
        kept.update(welded)
        waiting += welded
    if chain[-1] in joints:
        root.remove(joints[chain[-1]])
    keep_links(root, kept)


def _limits(
    chain: HandModel, narrower: Mapping[str, Any], where: str
) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "joints"]]:
    """Return lower and upper joint limits: the description's limits if given, else the URDF's limits."""
    lower, upper = chain.lower.copy(), chain.upper.copy()
    for joint, given in _by_joint(chain, narrower, f"{where}.limits").items():
        index = chain.joint_names.index(joint)
        if not isinstance(given, list) or len(given) != 2 or not all(map(is_number, given)):
            raise ConfigError(f"{where}.limits.{joint}: expected a lower and an upper number, got {short_repr(given)}")
        low, high = given
        if not chain.lower[index] <= low < high <= chain.upper[index]:
            limits = f"[{chain.lower[index]:g}, {chain.upper[index]:g}]"
            raise ConfigError(f"{where}.limits.{joint}: [{low:g}, {high:g}]; valid: a range within the URDF's {limits}")
        lower[index], upper[index] = low, high
    return lower, upper


def _by_joint(chain: HandModel, values: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    for joint in values:
        if joint not in chain.joint_names:
            raise ConfigError(f"{where}: no joint {short_repr(joint)}; joints: {', '.join(chain.joint_names)}")
    return values


def _mount(given: Any, tip: str, where: str) -> Mount:
    entry = from_mapping(_MountEntry, given, where)
    length = float(np.linalg.norm(entry.quaternion_wxyz))
    if abs(length - 1.0) > 1e-2:
        raise ConfigError(f"{where}.quaternion_wxyz: length {length:.3g}; valid: a unit quaternion")
    w, x, y, z = (value / length for value in entry.quaternion_wxyz)
    return Mount(tip, entry.position, (w, x, y, z))
