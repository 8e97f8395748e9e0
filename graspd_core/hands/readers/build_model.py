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

from graspd_core.errors import HandError, shown
from graspd_core.hands.model import HandModel, Mimic, Primitive
from graspd_core.hands.readers.joint_limits import Coupling, JointSpec, settled

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
    specs = [by_name[link] for link in order]
    chain, couplings, mended = settled(path, [into[link] for link in order[1:]], couplings)
    joint_fields = _actuated([joint for joint in chain if joint.kind != "fixed" and joint.name not in couplings])
    if not joint_fields["joint_names"]:
        raise HandError(f"{path}: {name!r} has no joint that moves ({len(order)} links), so that it could not grasp")
    return HandModel(
        name=name,
        urdf=str(path),
        link_names=tuple(order),
        **joint_fields,
        palm_center=np.zeros(3),
        palm_normal=np.array([1.0, 0.0, 0.0]),
        approach=np.array([1.0, 0.0, 0.0]),
        **_linked(order, chain, couplings),
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


def _actuated(joints: Sequence[JointSpec]) -> dict[str, Any]:
    keys = ("lower", "upper", "effort", "velocity")
    limits = {key: np.array([getattr(joint, key) for joint in joints], dtype=float) for key in keys}
    middle = 0.5 * (limits["lower"] + limits["upper"])
    names = tuple(joint.name for joint in joints)
    return {"joint_names": names, **limits, "open_posture": middle, "closed_posture": middle}


def _linked(order: Sequence[str], chain: Sequence[JointSpec], couplings: Mapping[str, Coupling]) -> dict[str, Any]:
    """The fields of a hand that say how its links hang from each other; `chain` are the joints of all but the first."""
    index = {link: i for i, link in enumerate(order)}
    actuated = [joint.name for joint in chain if joint.kind != "fixed" and joint.name not in couplings]
    number = {joint: i for i, joint in enumerate(actuated)}
    link_joint, group = np.full(len(order), -1), np.arange(len(order))
    mimics: list[Mimic] = []
    for link, joint in enumerate(chain, start=1):
        if joint.kind == "fixed":
            # Links welded to each other have the number of the first of them.
            group[link] = group[index[joint.parent]]
            continue
        leader, multiplier, offset = couplings.get(joint.name, Coupling(joint.name, 1.0, 0.0))
        link_joint[link] = number[leader]
        if joint.name in couplings:
            mimics.append(Mimic(joint.name, link, number[leader], multiplier, offset))
    return {
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
                    f"{path}: joint {joint.name!r} has the {end} link {shown(link)}, which the file does not define"
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
