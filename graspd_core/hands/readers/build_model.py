"""Build a `HandModel` from links and joints of any file format: check them, order them, resolve limits and couplings.

Links and joints are ordered depth-first, with children in file order. Actuated joints get finite limits, such that
coupled joints stay within their limits too. Joints with equal limits become fixed. Chains of coupled joints
(`<mimic joint="..." multiplier="..." offset="..."/>`) are resolved to actuated joints.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from graspd_core.errors import HandError, short_repr
from graspd_core.hands.model import HandModel, JointKind, Mimic, Primitive
from graspd_core.hands.readers.xml_io import read_numbers
from graspd_core.se3 import axis_rotation

# Most links, most shapes, and longest chain of joints. Checking a larger hand for self-collision would take minutes.
_MOST_LINKS, _MOST_SOLIDS, _LONGEST_CHAIN = 300, 2000, 100
_DEFAULTS = (("multiplier", "1"), ("offset", "0"))
# Greatest valid multiplier and offset of a coupled joint.
_LARGEST = 1e6
# A joint with less travel than this becomes fixed [rad] or [m].
_STILL = 1e-6
# A joint limit between these two values [rad] is probably given in degrees.
_FULL_TURN, _CIRCLE = 2 * np.pi + 0.05, 360.5
# A joint with a wider range counts as endless [rad]. A prismatic joint with longer travel has a wrong unit [m].
_WIDEST, _LONGEST_SLIDE = 4 * np.pi, 2.0


@dataclass(frozen=True, eq=False)
class LinkSpec:
    """A link of a file: mass [kg], centre of mass [m], inertia about this centre in link axes [kg·m²], primitives."""

    name: str
    mass: float = 0.0
    com: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    inertia: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    primitives: tuple[Primitive, ...] = ()


class Coupling(NamedTuple):
    """The coupling of a joint to the joint `leader`: value = `multiplier` · value of leader + `offset` [rad] or [m]."""

    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class JointSpec:
    """A joint of a file.

    Attributes:
        name: unique name of the joint.
        parent, child: names of the links.
        kind: revolute, prismatic or fixed.
        rotation, translation: `T_parent_child` at joint value zero [m].
        axis: unit axis in the child's frame. Zero for a fixed joint.
        lower, upper: joint limits [rad] or [m]. Infinite if not given.
        effort: greatest torque [N·m] or force [N]. Infinite if not given.
        velocity: greatest speed [rad/s] or [m/s]. Infinite if not given.
    """

    name: str
    parent: str
    child: str
    kind: JointKind
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    lower: float = -np.inf
    upper: float = np.inf
    effort: float = np.inf
    velocity: float = np.inf


def refuse_crowds(path: Path, links: int, joints: int, solids: int) -> None:
    """Raise HandError if a file has too many links, joints or shapes for a hand. Call this before reading shapes."""
    for what, count, most in (
        ("links", links, _MOST_LINKS),
        ("joints", joints, _MOST_LINKS),
        ("collision and visual shapes", solids, _MOST_SOLIDS),
    ):
        if count > most:
            raise HandError(f"{path}: {count} {what}; a hand has at most {most}")


def assemble(
    path: Path,
    name: str,
    links: Sequence[LinkSpec],
    joints: Sequence[JointSpec],
    couplings: Mapping[str, Coupling],
    warnings: tuple[str, ...] = (),
) -> HandModel:
    """Return the hand without candidates and adjacent pairs. Postures are mid-range. The palm is at the base's origin.

    Args:
        path, name: path of the file for error messages, and name of the hand.
        links, joints: links and joints that form one tree.
        couplings: couplings to actuated joints, by name of the coupled joint.
        warnings: warnings from reading the file.

    Raises:
        HandError: the links do not form one tree, or no joint moves. The message names the file and the fault.
    """
    order = _depth_first(path, links, joints)
    by_name, into = {link.name: link for link in links}, {joint.child: joint for joint in joints}
    specs = [by_name[link] for link in order]
    chain, couplings, mended = _settled(path, [into[link] for link in order[1:]], couplings)
    tree = _tree(order, chain, couplings)
    if not tree["joint_names"]:
        told = f"{path}: {name!r} has no joint that moves ({len(order)} links); valid: one movable joint or more"
        raise HandError("; ".join([told, *mended]))
    return HandModel(
        name=name,
        urdf=str(path),
        link_names=tuple(order),
        **tree,
        palm_center=np.zeros(3),
        palm_normal=np.array([1.0, 0.0, 0.0]),
        approach=np.array([1.0, 0.0, 0.0]),
        link_mass=np.array([spec.mass for spec in specs]),
        link_com=np.stack([spec.com for spec in specs]),
        link_inertia=np.stack([spec.inertia for spec in specs]),
        primitives=tuple(replace(p, link=i) for i, spec in enumerate(specs) for p in spec.primitives),
        adjacent=np.eye(len(order), dtype=bool),
        warnings=(*warnings, *mended),
    )


def _tree(order: Sequence[str], chain: Sequence[JointSpec], couplings: Mapping[str, Coupling]) -> dict[str, Any]:
    """Return the `HandModel` fields of links and joints. `chain` has the joint above each link except link 0."""
    actuated = [joint for joint in chain if joint.kind != "fixed" and joint.name not in couplings]
    keys = ("lower", "upper", "effort", "velocity")
    limits = {key: np.array([getattr(joint, key) for joint in actuated], dtype=float) for key in keys}
    middle = 0.5 * (limits["lower"] + limits["upper"])
    index = {link: i for i, link in enumerate(order)}
    number = {joint.name: i for i, joint in enumerate(actuated)}
    link_joint, group = np.full(len(order), -1), np.arange(len(order))
    mimics: list[Mimic] = []
    for link, joint in enumerate(chain, start=1):
        if joint.kind == "fixed":
            # A rigid group has the index of its first link.
            group[link] = group[index[joint.parent]]
            continue
        leader, multiplier, offset = couplings.get(joint.name, Coupling(joint.name, 1.0, 0.0))
        link_joint[link] = number[leader]
        if joint.name in couplings:
            mimics.append(Mimic(joint.name, link, number[leader], multiplier, offset))
    return {
        "joint_names": tuple(number),
        **limits,
        "open_posture": middle,
        "closed_posture": middle,
        "link_parent": np.array([-1, *(index[joint.parent] for joint in chain)]),
        "link_joint": link_joint,
        "link_offset_rotation": np.stack([np.eye(3), *(joint.rotation for joint in chain)]),
        "link_offset_translation": np.stack([np.zeros(3), *(joint.translation for joint in chain)]),
        "joint_axis": np.stack([np.zeros(3), *(joint.axis for joint in chain)]),
        "joint_kind": ("fixed", *(joint.kind for joint in chain)),
        "link_group": group,
        "mimics": tuple(mimics),
    }


def _depth_first(path: Path, links: Sequence[LinkSpec], joints: Sequence[JointSpec]) -> list[str]:
    """Return the link names depth-first. Raises HandError: links and joints do not form one tree."""
    names = [link.name for link in links]
    _refuse_repeated(path, "link", names)
    _refuse_repeated(path, "joint", [joint.name for joint in joints])
    if not 0 < len(names) <= _MOST_LINKS:
        raise HandError(f"{path}: {len(names)} links; a hand has 1 to {_MOST_LINKS}")
    children: set[str] = set()
    for joint in joints:
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in names:
                text = f"{path}: joint {joint.name!r} has the {end} link {short_repr(link)}"
                raise HandError(f"{text}, which the file does not define")
        if joint.child in children:
            raise HandError(f"{path}: link {joint.child!r} is the child of two joints; a hand is a tree")
        children.add(joint.child)
    roots = [link for link in names if link not in children]
    if len(roots) != 1:
        raise HandError(f"{path}: a hand has one root link, this file has {len(roots)}: {', '.join(roots) or 'a loop'}")
    depth: dict[str, int] = {}
    ahead = [(roots[0], 0)]
    while ahead:
        link, below = ahead.pop()
        depth[link] = below
        ahead += [(joint.child, below + 1) for joint in reversed(joints) if joint.parent == link]
    lost = [link for link in names if depth.get(link, _LONGEST_CHAIN + 1) > _LONGEST_CHAIN]
    if lost:
        raise HandError(
            f"{path}: links in a loop, or not reachable from the root: {', '.join(lost[:5])}; "
            f"valid: a tree with at most {_LONGEST_CHAIN} joints from the root to a link"
        )
    return list(depth)


def _refuse_repeated(path: Path, what: str, names: Sequence[str]) -> None:
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        raise HandError(f"{path}: {what} {repeated[0]!r} is defined twice; valid: unique names")


def _settled(
    path: Path, joints: Sequence[JointSpec], couplings: Mapping[str, Coupling]
) -> tuple[list[JointSpec], dict[str, Coupling], tuple[str, ...]]:
    """Return the joints with usable limits, the remaining couplings, and warnings.

    Limits of actuated joints are reduced to what their coupled joints allow. Endless rotation is reduced to one turn.
    An actuated joint without travel becomes fixed, as do its coupled joints. Raises HandError: a travel exceeds 2 m.
    """
    moving = [joint for joint in joints if joint.kind != "fixed"]
    followers = [joint for joint in moving if joint.name in couplings]
    leaders = {joint.name: joint for joint in moving if joint.name not in couplings}
    warnings = [
        f"joint {joint.name!r}: limits of {joint.lower:g} to {joint.upper:g} rad; if they are in degrees, write radians"
        for joint in moving
        if joint.kind == "revolute" and _FULL_TURN < max(-joint.lower, joint.upper) <= _CIRCLE
    ]
    for follower in followers:
        coupling = couplings[follower.name]
        narrow = _narrowed(leaders[coupling.leader], follower, coupling)
        if narrow.lower < narrow.upper or coupling.multiplier == 0:
            leaders[coupling.leader] = narrow
        else:
            leaders[coupling.leader] = replace(leaders[coupling.leader], velocity=narrow.velocity)
            warnings.append(f"coupled joint {follower.name!r}: its limits leave no range, and are ignored")
    for name, joint in leaders.items():
        leaders[name] = _finite(path, joint)
        if leaders[name] is not joint:
            turn = f"[{leaders[name].lower:.3g}, {leaders[name].upper:.3g}]"
            limits = "no limits" if np.isinf(joint.upper - joint.lower) else "limits more than two turns apart"
            warnings.append(f"joint {name!r} has {limits}: restricted to {turn} rad")
    for follower in followers:
        leader, multiplier, _ = couplings[follower.name]
        slide = abs(multiplier) * (leaders[leader].upper - leaders[leader].lower)
        if follower.kind == "prismatic" and slide > _LONGEST_SLIDE:
            raise _too_long(path, follower.name, slide)
    still = {name: joint.lower for name, joint in leaders.items() if joint.upper - joint.lower < _STILL}
    at_zero = " at 0, which is what a <limit> without lower and upper means"
    warnings += [
        f"joint {name!r} cannot move: its limits coincide{at_zero if value == 0 else ''}; taken as fixed"
        for name, value in still.items()
    ]
    left = {name: coupling for name, coupling in couplings.items() if coupling.leader not in still}
    for name in couplings.keys() - left.keys():
        leader, multiplier, offset = couplings[name]
        still[name] = multiplier * still[leader] + offset
    settled = [leaders.get(joint.name, joint) for joint in joints]
    return (
        [_welded(joint, still[joint.name]) if joint.name in still else joint for joint in settled],
        left,
        (*warnings,),
    )


def _narrowed(leader: JointSpec, follower: JointSpec, coupling: Coupling) -> JointSpec:
    """Return the actuated joint with limits and speed reduced to what its coupled joint allows."""
    _, multiplier, offset = coupling
    if multiplier == 0:
        return leader
    low, high = sorted(((follower.lower - offset) / multiplier, (follower.upper - offset) / multiplier))
    velocity = min(leader.velocity, follower.velocity / abs(multiplier))
    return replace(leader, lower=max(leader.lower, low), upper=min(leader.upper, high), velocity=velocity)


def _finite(path: Path, joint: JointSpec) -> JointSpec:
    """Return the joint. Endless rotation becomes one turn. Raises HandError: a prismatic joint travels over 2 m."""
    reach = joint.upper - joint.lower
    if joint.kind == "prismatic" and not reach <= _LONGEST_SLIDE:
        raise _too_long(path, joint.name, reach)
    if joint.kind == "prismatic" or reach <= _WIDEST:
        return joint
    # The turn is −π to π, or shifted as little as needed to lie within the limits.
    lower = min(max(-np.pi, joint.lower), joint.upper - 2 * np.pi)
    return replace(joint, lower=lower, upper=lower + 2 * np.pi)


def _welded(joint: JointSpec, value: float) -> JointSpec:
    fixed = replace(joint, kind="fixed", axis=np.zeros(3))
    if joint.kind == "prismatic":
        return replace(fixed, translation=joint.translation + joint.rotation @ joint.axis * value)
    return replace(fixed, rotation=joint.rotation @ axis_rotation(joint.axis, value))


def _too_long(path: Path, joint: str, slide: float) -> HandError:
    return HandError(
        f"{path}: joint {joint!r} has a travel of {slide:g} m; valid: limits that allow at most {_LONGEST_SLIDE:g} m"
    )


def read_couplings(path: Path, joints: Sequence[ET.Element]) -> dict[str, Coupling]:
    """Read the couplings of all joints with a `<mimic>`. Each key is the name of the coupled joint.

    Each `leader` is an actuated joint. The `<mimic>` of a fixed joint is ignored. Raises HandError: the leader
    is the joint itself, missing or fixed, or a number is invalid.
    """
    moving = {str(joint.get("name")): joint for joint in joints if joint.get("type") != "fixed"}
    direct: dict[str, Coupling] = {}
    for name, joint in moving.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        leader = mimic.get("joint")
        if leader not in moving:
            raise HandError(
                f"{path}: joint {name!r} mimics {leader!r}, which is not a movable joint; valid: {', '.join(moving)}"
            )
        multiplier, offset = (read_numbers(path, mimic, key, 1, text)[0] for key, text in _DEFAULTS)
        direct[name] = Coupling(leader, float(multiplier), float(offset))
    return resolved_couplings(path, direct)


def resolved_couplings(path: Path, direct: Mapping[str, Coupling]) -> dict[str, Coupling]:
    """Return the couplings, each resolved to the actuated joint at the end of its chain.

    Raises HandError: couplings form a circle, or a multiplier or offset is too large.
    """
    resolved: dict[str, Coupling] = {}
    for name, (leader, multiplier, offset) in direct.items():
        seen = [name]
        while leader in direct:
            if leader in seen:
                raise HandError(f"{path}: joints mimic each other in a circle: {' -> '.join([*seen, leader])}")
            seen.append(leader)
            # m₁(m₂ q + o₂) + o₁ = m₁m₂ q + m₁o₂ + o₁
            leader, further, beyond = direct[leader]
            multiplier, offset = multiplier * further, multiplier * beyond + offset
        if not max(abs(multiplier), abs(offset)) <= _LARGEST:
            raise HandError(
                f"{path}: joint {name!r} mimics {leader!r} with multiplier {multiplier:g} and offset {offset:g}; "
                f"valid: at most {_LARGEST:g}"
            )
        resolved[name] = Coupling(leader, multiplier, offset)
    return resolved
