"""Limits of joints that mean something, and joints without room to move, welded where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from graspd_core.errors import HandError
from graspd_core.hands.model import HandModel, JointKind, Mimic
from graspd_core.se3 import axis_rotation

# A joint that moves less than this is welded [rad] or [m].
_STILL = 1e-6
# Wider limits than this say nothing [rad]; a slide that is longer is in another unit [m].
_WIDEST, _LONGEST_SLIDE = 4 * np.pi, 2.0


def finite_limits(
    path: Path,
    names: Sequence[str],
    kinds: Sequence[JointKind],
    lower: Float[np.ndarray, "joints"],
    upper: Float[np.ndarray, "joints"],
) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "joints"], tuple[str, ...]]:
    """Limits [rad] or [m] with joints that turn without end kept within ±π, and a warning for each of them.

    Raises:
        HandError: a joint slides farther than anything in a hand does.
    """
    lower, upper, warnings = lower.copy(), upper.copy(), []
    # Limits in use go up to the largest float.
    with np.errstate(over="ignore"):
        ranges = upper - lower
    for i, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        if kind == "prismatic" and not ranges[i] <= _LONGEST_SLIDE:
            raise _too_long(path, name, float(ranges[i]))
        if kind == "revolute" and not ranges[i] <= _WIDEST:
            # One turn: the one from -π to π, moved no farther than the limits ask for.
            lower[i] = min(max(-np.pi, lower[i]), upper[i] - 2 * np.pi)
            upper[i] = lower[i] + 2 * np.pi
            warnings.append(f"joint {name!r} turns without end: kept to [{lower[i]:.3g}, {upper[i]:.3g}] rad")
    return lower, upper, tuple(warnings)


def refuse_long_slides(
    path: Path,
    mimics: Sequence[Mimic],
    kinds: Sequence[JointKind],
    lower: Float[np.ndarray, "joints"],
    upper: Float[np.ndarray, "joints"],
) -> None:
    """Raise HandError for a coupled joint that slides too far; `kinds` are those of all links, limits the leaders'."""
    for mimic in mimics:
        slide = abs(mimic.multiplier) * float(upper[mimic.joint] - lower[mimic.joint])
        if kinds[mimic.link] == "prismatic" and slide > _LONGEST_SLIDE:
            raise _too_long(path, mimic.name, slide)


def _too_long(path: Path, joint: str, slide: float) -> HandError:
    return HandError(
        f"{path}: joint {joint!r} slides by {slide:g} m; a hand's slides are limited, to {_LONGEST_SLIDE:g} m at most"
    )


def welded_groups(parent: Int[np.ndarray, "links"], link_joint: Int[np.ndarray, "links"]) -> Int[np.ndarray, "links"]:
    """Links welded to their parent take its number; numbers are those of each group's first link."""
    groups = np.arange(len(parent))
    for link in range(1, len(parent)):
        if link_joint[link] < 0:
            groups[link] = groups[parent[link]]
    return groups


def with_still_joints_welded(hand: HandModel) -> HandModel:
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
        link_group=welded_groups(hand.link_parent, renumbered),
        mimics=tuple(replace(m, joint=int(renumbered[m.link])) for m in hand.mimics if renumbered[m.link] >= 0),
        warnings=(*hand.warnings, *(f"joint {name!r} cannot move: its limits coincide; welded" for name in welded)),
    )
