"""A `HandModel` from links and joints, whichever format they were read from: checks, order, couplings.

The order of links and joints is depth-first, children in the order of the file's joints.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import HandError
from graspd_core.hands.model import HandModel, JointKind, Mimic, Primitive
from graspd_core.hands.readers.joint_limits import (
    finite_limits,
    refuse_long_slides,
    welded_groups,
    with_still_joints_welded,
)
from graspd_core.hands.readers.mimic import Coupling, narrowed

# More than this is no hand, and would take minutes to check against itself.
_MOST_LINKS, _MOST_SOLIDS, _LONGEST_CHAIN = 300, 2000, 100


@dataclass(frozen=True, eq=False)
class LinkSpec:
    """One link as a file gives it: mass [kg], centre [m] and inertia about it [kg·m²] in link axes; solids."""

    name: str
    mass: float = 0.0
    com: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    inertia: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    primitives: tuple[Primitive, ...] = ()


@dataclass(frozen=True, eq=False)
class JointSpec:
    """One joint as a file gives it: where its child sits in the parent, and how it moves; infinite where unset.

    Attributes:
        name: unique among joints.
        parent, child: link names.
        kind: how it moves.
        rotation, translation: `T_parent_child` at joint value zero [m].
        axis: unit, in the child's frame; zero where fixed.
        lower, upper: limits [rad] or [m].
        effort: greatest torque [N·m] or force [N].
        velocity: greatest speed [rad/s] or [m/s].
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
    """Raise HandError for more links, joints or solids than a hand has, before any of them is looked at."""
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
    """The hand without candidates: postures mid-range, palm at the base's origin, every pair of links checked.

    Args:
        path, name: of the file, for errors, and of the hand.
        links, joints: one tree.
        couplings: of the coupled joints by name, chains resolved.
        warnings: what reading has found.

    Raises:
        HandError: the links are not one tree, or nothing in it moves; names the file and the culprit.
    """
    order = _depth_first(path, links, joints)
    by_name, into = {link.name: link for link in links}, {joint.child: joint for joint in joints}
    moving = [into[link] for link in order[1:] if into[link].kind != "fixed"]
    specs, tree = [by_name[link] for link in order], _linked(order, into, moving, couplings)
    limits, mended = _limits(path, moving, tree["mimics"], tree["joint_kind"])
    middle = 0.5 * (limits["lower"] + limits["upper"])
    hand = HandModel(
        name=name,
        urdf=str(path),
        link_names=tuple(order),
        **limits,
        open_posture=middle,
        closed_posture=middle,
        palm_center=np.zeros(3),
        palm_normal=np.array([1.0, 0.0, 0.0]),
        approach=np.array([1.0, 0.0, 0.0]),
        **tree,
        link_mass=np.array([spec.mass for spec in specs]),
        link_com=np.stack([spec.com for spec in specs]),
        link_inertia=np.stack([spec.inertia for spec in specs]),
        primitives=tuple(replace(p, link=i) for i, spec in enumerate(specs) for p in spec.primitives),
        adjacent=np.eye(len(order), dtype=bool),
        candidate_points=np.zeros((0, 3)),
        candidate_normals=np.zeros((0, 3)),
        candidate_link=np.zeros(0, dtype=np.int64),
        warnings=(*warnings, *mended),
    )
    hand = with_still_joints_welded(hand)
    if not hand.joint_names:
        raise HandError(f"{path}: {name!r} has no joint that moves ({len(order)} links), so that it could not grasp")
    return hand


def _linked(
    order: Sequence[str],
    into: Mapping[str, JointSpec],
    moving: Sequence[JointSpec],
    couplings: Mapping[str, Coupling],
) -> dict[str, Any]:
    """The fields of a hand that say how its links hang from each other; `into` is each link's own joint."""
    index = {link: i for i, link in enumerate(order)}
    actuated = [joint.name for joint in moving if joint.name not in couplings]
    number = {joint: i for i, joint in enumerate(actuated)}
    count = len(order)
    parent, link_joint = np.full(count, -1), np.full(count, -1)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    axes = np.zeros((count, 3))
    kinds: list[JointKind] = ["fixed"] * count
    mimics: list[Mimic] = []
    for link in range(1, count):
        joint = into[order[link]]
        parent[link], kinds[link] = index[joint.parent], joint.kind
        rotations[link], translations[link] = joint.rotation, joint.translation
        if joint.kind == "fixed":
            continue
        axes[link] = joint.axis
        coupling = couplings.get(joint.name)
        link_joint[link] = number[joint.name if coupling is None else coupling.leader]
        if coupling is not None:
            mimics.append(Mimic(joint.name, link, int(link_joint[link]), coupling.multiplier, coupling.offset))
    return {
        "joint_names": tuple(actuated),
        "link_parent": parent,
        "link_joint": link_joint,
        "link_offset_rotation": rotations,
        "link_offset_translation": translations,
        "joint_axis": axes,
        "joint_kind": tuple(kinds),
        "link_group": welded_groups(parent, link_joint),
        "mimics": tuple(mimics),
    }


def _limits(
    path: Path, moving: Sequence[JointSpec], mimics: Sequence[Mimic], kinds: Sequence[JointKind]
) -> tuple[dict[str, Float[np.ndarray, "joints"]], tuple[str, ...]]:
    """The actuated joints' limits, by the names of a hand's fields, and what was done to them.

    `moving` are all movable joints, `kinds` those of every link's joint.
    """
    followers = {mimic.name for mimic in mimics}
    actuated = [joint for joint in moving if joint.name not in followers]
    coupled = {joint.name: (joint.lower, joint.upper, joint.velocity) for joint in moving if joint.name in followers}
    lower, upper, effort, velocity = (
        np.array([getattr(joint, key) for joint in actuated], dtype=float)
        for key in ("lower", "upper", "effort", "velocity")
    )
    lower, upper, velocity, given_up = narrowed(lower, upper, velocity, mimics, coupled)
    names = [joint.name for joint in actuated]
    lower, upper, made_finite = finite_limits(path, names, [joint.kind for joint in actuated], lower, upper)
    refuse_long_slides(path, mimics, kinds, lower, upper)
    return {"lower": lower, "upper": upper, "effort": effort, "velocity": velocity}, (*given_up, *made_finite)


def _depth_first(path: Path, links: Sequence[LinkSpec], joints: Sequence[JointSpec]) -> list[str]:
    """Link names, a link before its children, once links and joints are known to make one tree."""
    names = [link.name for link in links]
    _refuse_repeated(path, "link", names)
    _refuse_repeated(path, "joint", [joint.name for joint in joints])
    if not 0 < len(names) <= _MOST_LINKS:
        raise HandError(f"{path}: {len(names)} links; a hand has 1 to {_MOST_LINKS}")
    above: dict[str, str] = {}
    for joint in joints:
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in names:
                raise HandError(
                    f"{path}: joint {joint.name!r} has the {end} link {link!r}, which the file does not define"
                )
        if joint.child in above:
            raise HandError(f"{path}: link {joint.child!r} is the child of two joints; a hand is a tree")
        above[joint.child] = joint.parent
    roots = [link for link in names if link not in above]
    if len(roots) != 1:
        raise HandError(f"{path}: a hand has one root link, this file has {len(roots)}: {', '.join(roots) or 'a loop'}")
    lost = [link for link in names if not _reaches(roots[0], link, above)]
    if lost:
        raise HandError(
            f"{path}: links in a loop or more than {_LONGEST_CHAIN} joints from the root, "
            f"not reachable from the root: {', '.join(lost[:5])}"
        )
    order, ahead = [], roots
    while ahead:
        link = ahead.pop()
        order.append(link)
        ahead.extend(joint.child for joint in reversed(joints) if joint.parent == link)
    return order


def _refuse_repeated(path: Path, what: str, names: Sequence[str]) -> None:
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        raise HandError(f"{path}: {what} {repeated[0]!r} is defined twice; names are unique")


def _reaches(root: str, link: str, above: Mapping[str, str]) -> bool:
    for _ in range(_LONGEST_CHAIN):
        if link == root:
            return True
        link = above.get(link, root)
    return False
