"""A `HandModel` from links and joints, whichever format they were read from: checks, order, couplings, limits.

The order of links and joints is depth-first, children in the order of the file's joints.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from graspd_core.errors import HandError
from graspd_core.hands.model import HandModel, JointKind, Mimic, Primitive
from graspd_core.hands.readers.mimic import Coupling, narrowed
from graspd_core.se3 import axis_rotation

# More than this is no hand, and would take minutes to check against itself.
_MOST_LINKS, _MOST_SOLIDS, _LONGEST_CHAIN = 300, 2000, 100
# A joint that moves less than this is welded [rad] or [m].
_STILL = 1e-6
# Wider limits than this say nothing [rad]; a slide that is longer is in another unit [m].
_WIDEST, _LONGEST_SLIDE = 4 * np.pi, 2.0


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
        path: of the file, for errors.
        name: of the hand.
        links, joints: one tree.
        couplings: of the coupled joints by name, chains resolved.
        warnings: what reading has found.

    Raises:
        HandError: the links are not one tree, or nothing in it moves; names the file and the culprit.
    """
    order = _depth_first(path, links, joints)
    by_name, into = {link.name: link for link in links}, {joint.child: joint for joint in joints}
    index = {link: i for i, link in enumerate(order)}
    moving = [into[link] for link in order[1:] if into[link].kind != "fixed"]
    actuated = [joint for joint in moving if joint.name not in couplings]
    number = {joint.name: i for i, joint in enumerate(actuated)}
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
    lower, upper, effort, velocity = (
        np.array([getattr(joint, key) for joint in actuated], dtype=float)
        for key in ("lower", "upper", "effort", "velocity")
    )
    coupled = {joint.name: (joint.lower, joint.upper, joint.velocity) for joint in moving if joint.name in couplings}
    lower, upper, velocity, given_up = narrowed(lower, upper, velocity, mimics, coupled)
    lower, upper, made_finite = _finite(path, actuated, lower, upper)
    for mimic in mimics:
        slide = abs(mimic.multiplier) * float(upper[mimic.joint] - lower[mimic.joint])
        if kinds[mimic.link] == "prismatic" and slide > _LONGEST_SLIDE:
            raise _too_long(path, mimic.name, slide)
    middle = 0.5 * (lower + upper)
    specs = [by_name[link] for link in order]
    hand = HandModel(
        name=name,
        urdf=str(path),
        link_names=tuple(order),
        joint_names=tuple(joint.name for joint in actuated),
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
        link_mass=np.array([spec.mass for spec in specs]),
        link_com=np.stack([spec.com for spec in specs]),
        link_inertia=np.stack([spec.inertia for spec in specs]),
        primitives=tuple(replace(p, link=i) for i, spec in enumerate(specs) for p in spec.primitives),
        adjacent=np.eye(count, dtype=bool),
        candidate_points=np.zeros((0, 3)),
        candidate_normals=np.zeros((0, 3)),
        candidate_link=np.zeros(0, dtype=np.int64),
        warnings=(*warnings, *given_up, *made_finite),
        mimics=tuple(mimics),
    )
    hand = _with_still_joints_welded(hand)
    if not hand.joint_names:
        raise HandError(f"{path}: {name!r} has no joint that moves ({count} links), so that it could not grasp")
    return hand


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


def _groups(parent: Int[np.ndarray, "links"], link_joint: Int[np.ndarray, "links"]) -> Int[np.ndarray, "links"]:
    """Links welded to their parent take its number; numbers are those of each group's first link."""
    groups = np.arange(len(parent))
    for link in range(1, len(parent)):
        if link_joint[link] < 0:
            groups[link] = groups[parent[link]]
    return groups


def _finite(
    path: Path, joints: Sequence[JointSpec], lower: Float[np.ndarray, "joints"], upper: Float[np.ndarray, "joints"]
) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "joints"], tuple[str, ...]]:
    """Limits that mean something: a joint that turns without end is kept within ±π; what was done about it."""
    lower, upper, warnings = lower.copy(), upper.copy(), []
    # Limits in use go up to the largest float.
    with np.errstate(over="ignore"):
        ranges = upper - lower
    for i, joint in enumerate(joints):
        if joint.kind == "prismatic" and not ranges[i] <= _LONGEST_SLIDE:
            raise _too_long(path, joint.name, float(ranges[i]))
        if joint.kind == "revolute" and not ranges[i] <= _WIDEST:
            # One turn: the one from -π to π, moved no farther than the limits ask for.
            lower[i] = min(max(-np.pi, lower[i]), upper[i] - 2 * np.pi)
            upper[i] = lower[i] + 2 * np.pi
            warnings.append(f"joint {joint.name!r} turns without end: kept to [{lower[i]:.3g}, {upper[i]:.3g}] rad")
    return lower, upper, tuple(warnings)


def _too_long(path: Path, joint: str, slide: float) -> HandError:
    return HandError(
        f"{path}: joint {joint!r} slides by {slide:g} m; a hand's slides are limited, to {_LONGEST_SLIDE:g} m at most"
    )


def _with_still_joints_welded(hand: HandModel) -> HandModel:
    """The hand with joints that cannot move, because their limits coincide, fixed where they are."""
    still = hand.upper - hand.lower < _STILL
    if not still.any():
        return hand
    rotations, translations = hand.link_offset_rotation.copy(), hand.link_offset_translation.copy()
    kinds, axes, link_joint = list(hand.joint_kind), hand.joint_axis.copy(), hand.link_joint.copy()
    for link in np.flatnonzero((hand.link_joint >= 0) & still[np.maximum(hand.link_joint, 0)]):
        value = hand.link_multiplier[link] * hand.lower[hand.link_joint[link]] + hand.link_shift[link]
        if kinds[link] == "prismatic":
            translations[link] = translations[link] + rotations[link] @ axes[link] * value
        else:
            rotations[link] = rotations[link] @ axis_rotation(axes[link], value)
        kinds[link], axes[link], link_joint[link] = "fixed", 0.0, -1
    renumbered = np.where(link_joint >= 0, (np.cumsum(~still) - 1)[np.maximum(link_joint, 0)], -1)
    welded = [name for name, stays in zip(hand.joint_names, still, strict=True) if stays]
    return replace(
        hand,
        joint_names=tuple(name for name, stays in zip(hand.joint_names, still, strict=True) if not stays),
        **{key: getattr(hand, key)[~still] for key in ("lower", "upper", "effort", "velocity")},
        open_posture=hand.open_posture[~still],
        closed_posture=hand.closed_posture[~still],
        link_joint=renumbered,
        link_offset_rotation=rotations,
        link_offset_translation=translations,
        joint_axis=axes,
        joint_kind=tuple(kinds),
        link_group=_groups(hand.link_parent, renumbered),
        mimics=tuple(replace(m, joint=int(renumbered[m.link])) for m in hand.mimics if renumbered[m.link] >= 0),
        warnings=(*hand.warnings, *(f"joint {name!r} cannot move: its limits coincide; welded" for name in welded)),
    )
