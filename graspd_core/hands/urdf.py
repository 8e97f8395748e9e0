"""URDF to `HandModel`: the tree and its joint order from pytorch-kinematics, numbers from the XML in float64.

pytorch-kinematics keeps offsets in float32 and stumbles over what it does not need (undeclared namespaces, a comment
before the XML header), so it is shown a bare tree of links and joints only.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from graspd_core.errors import HandError
from graspd_core.hands.collision import read_primitives
from graspd_core.hands.elements import read_numbers, read_origin
from graspd_core.hands.model import HandModel, JointKind

_KINDS: dict[str, JointKind] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
}


def read_urdf(path: Path) -> HandModel:
    """The hand that a URDF describes, without candidates; postures mid-range, palm at the base's origin.

    `continuous` joints are limited to ±π; an effort or velocity that is absent or zero becomes infinite.

    Raises:
        HandError: the file is missing, malformed, not a tree, has no actuated joint, or has one of an unknown type.
    """
    root = _parse(path)
    links = {str(link.get("name")): link for link in root.findall("link")}
    joints = {str(joint.find("child").get("link")): joint for joint in _checked_joints(path, root, links)}  # type: ignore[union-attr]
    link_names, joint_names = _depth_first(path, links, list(joints.values()))
    index = {name: i for i, name in enumerate(link_names)}
    count, moving = len(link_names), len(joint_names)

    parent = np.full(count, -1)
    link_joint = np.full(count, -1)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    axes = np.zeros((count, 3))
    kinds: list[JointKind] = ["fixed"] * count
    lower, upper, effort, velocity = (np.zeros(moving) for _ in range(4))
    for child, joint in joints.items():
        link, name = index[child], str(joint.get("name"))
        parent[link] = index[str(joint.find("parent").get("link"))]  # type: ignore[union-attr]
        rotations[link], translations[link] = read_origin(path, joint)
        kinds[link] = _KINDS[str(joint.get("type"))]
        if kinds[link] != "fixed":
            number = link_joint[link] = joint_names.index(name)
            axes[link] = _axis(path, joint)
            lower[number], upper[number], effort[number], velocity[number] = _limits(path, joint)
    masses, coms, inertias = _inertials(path, [links[name] for name in link_names])
    middle = 0.5 * (lower + upper)
    return HandModel(
        name=str(root.get("name") or path.stem),
        urdf=str(path),
        link_names=tuple(link_names),
        joint_names=tuple(joint_names),
        lower=lower,
        upper=upper,
        effort=effort,
        velocity=velocity,
        open_posture=middle,
        closed_posture=middle,
        palm_center=np.zeros(3),
        palm_normal=np.array([1.0, 0.0, 0.0]),
        approach=np.array([1.0, 0.0, 0.0]),
        link_parent=parent,
        link_joint=link_joint,
        link_offset_rotation=rotations,
        link_offset_translation=translations,
        joint_axis=axes,
        joint_kind=tuple(kinds),
        link_group=_groups(parent, link_joint),
        link_mass=masses,
        link_com=coms,
        link_inertia=inertias,
        primitives=tuple(p for i, name in enumerate(link_names) for p in read_primitives(path, i, links[name])),
        adjacent=np.eye(count, dtype=bool),
        candidate_points=np.zeros((0, 3)),
        candidate_normals=np.zeros((0, 3)),
        candidate_link=np.zeros(0, dtype=np.int64),
    )


def _parse(path: Path) -> ET.Element:
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise HandError(f"{path}: cannot be read: {error.strerror or error}") from error
    if "xmlns:xacro" in text and "<xacro:" in text:
        raise HandError(f"{path}: is a xacro file; expand it to a URDF first")
    header = re.search(r"<\?xml.*?\?>", text, re.DOTALL)
    text = text if header is None else text[: header.start()] + "\n" * header.group().count("\n") + text[header.end() :]
    undeclared = set(re.findall(r"</?([A-Za-z_][\w.-]*):", text)) - set(re.findall(r"xmlns:([\w.-]+)", text))
    declared = "".join(f' xmlns:{prefix}="urn:{prefix}"' for prefix in sorted(undeclared))
    text = re.sub(r"<robot\b", f"<robot{declared}", text, count=1)
    try:
        root = ET.fromstring(text.lstrip("\ufeff"))
    except ET.ParseError as error:
        raise HandError(f"{path}: not well-formed XML: {error}") from error
    if root.tag != "robot":
        raise HandError(f"{path}: the root element is <{root.tag}>, a URDF has <robot>")
    return root


def _checked_joints(path: Path, root: ET.Element, links: dict[str, ET.Element]) -> list[ET.Element]:
    """The joints, once they are known to make one tree over all links."""
    joints = root.findall("joint")
    children: set[str] = set()
    for joint in joints:
        name = joint.get("name")
        if joint.get("type") not in _KINDS:
            raise HandError(f"{path}: joint {name!r} is of type {joint.get('type')!r}; known: {', '.join(_KINDS)}")
        if joint.find("mimic") is not None:
            raise HandError(f"{path}: joint {name!r} mimics another joint, which this version cannot do")
        for end in ("parent", "child"):
            element = joint.find(end)
            link = None if element is None else element.get("link")
            if link not in links:
                raise HandError(f"{path}: joint {name!r} has the {end} link {link!r}, which the file does not define")
            if end == "child" and link in children:
                raise HandError(f"{path}: link {link!r} is the child of two joints; a hand is a tree")
            if end == "child":
                children.add(str(link))
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        raise HandError(f"{path}: a hand has one root link, this file has {len(roots)}: {', '.join(roots) or 'a loop'}")
    if all(joint.get("type") == "fixed" for joint in joints):
        raise HandError(f"{path}: no actuated joint")
    return joints


def _depth_first(path: Path, links: dict[str, ET.Element], joints: list[ET.Element]) -> tuple[list[str], list[str]]:
    """Names of links and actuated joints in pytorch-kinematics' order."""
    import pytorch_kinematics as pk

    bare = ET.Element("robot", name="hand")
    for name in links:
        ET.SubElement(bare, "link", name=name)
    for joint in joints:
        copy = ET.SubElement(bare, "joint", name=str(joint.get("name")), type=str(joint.get("type")))
        copy.extend(joint.find(end) for end in ("parent", "child"))  # type: ignore[misc]
        if joint.get("type") in ("revolute", "prismatic"):
            ET.SubElement(copy, "limit", lower="0", upper="0", effort="0", velocity="0")
    chain = pk.build_chain_from_urdf(ET.tostring(bare))
    frames = list(chain.get_frame_names(exclude_fixed=False))
    if len(frames) != len(links):
        lost = sorted(set(links) - set(frames))
        raise HandError(f"{path}: links in a loop, not reachable from the root: {', '.join(lost)}")
    return frames, list(chain.get_joint_parameter_names())


def _axis(path: Path, joint: ET.Element) -> Float[np.ndarray, "3"]:
    element = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if element is None else read_numbers(path, element, "xyz", 3, "1 0 0")
    length = float(np.linalg.norm(axis))
    if length == 0:
        raise HandError(f"{path}: joint {joint.get('name')!r} has a zero axis")
    return axis / length


def _limits(path: Path, joint: ET.Element) -> tuple[float, float, float, float]:
    """Lower, upper [rad] or [m], effort [N·m] or [N], velocity."""
    limit = joint.find("limit")
    name, continuous = joint.get("name"), joint.get("type") == "continuous"
    if limit is None:
        if not continuous:
            raise HandError(f"{path}: joint {name!r} has no <limit>")
        limit = ET.Element("limit")
    lower, upper, effort, velocity = (
        float(read_numbers(path, limit, key, 1, "0")[0]) for key in ("lower", "upper", "effort", "velocity")
    )
    if continuous:
        lower, upper = -np.pi, np.pi
    if lower > upper:
        raise HandError(f"{path}: joint {name!r} has lower {lower:g} above upper {upper:g}")
    return lower, upper, effort if effort > 0 else np.inf, velocity if velocity > 0 else np.inf


def _inertials(path: Path, links: list[ET.Element]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses [kg], centres of mass [m] and inertias about them [kg·m²] in link axes."""
    masses, coms, inertias = np.zeros(len(links)), np.zeros((len(links), 3)), np.zeros((len(links), 3, 3))
    for i, link in enumerate(links):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        rotation, coms[i] = read_origin(path, inertial)
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is not None:
            masses[i] = read_numbers(path, mass, "value", 1, "0")[0]
        if inertia is not None:
            xx, xy, xz, yy, yz, zz = (
                read_numbers(path, inertia, f"i{key}", 1, "0")[0] for key in ("xx", "xy", "xz", "yy", "yz", "zz")
            )
            inertias[i] = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    return masses, coms, inertias


def _groups(parent: Int[np.ndarray, "links"], link_joint: Int[np.ndarray, "links"]) -> Int[np.ndarray, "links"]:
    """Links welded to their parent take its number; numbers are those of each group's first link."""
    groups = np.arange(len(parent))
    for link in range(1, len(parent)):
        if link_joint[link] < 0:
            groups[link] = groups[parent[link]]
    return groups
