"""Limits of joints that mean something: those of coupled joints kept too, none without end, and none without room.

Coupled joints: `<mimic joint="..." multiplier="..." offset="..."/>`, chains resolved to actuated joints.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from graspd_core.errors import HandError
from graspd_core.hands.model import JointKind
from graspd_core.hands.readers.xml_io import read_numbers
from graspd_core.se3 import axis_rotation

_DEFAULTS = (("multiplier", "1"), ("offset", "0"))
# No joint of a hand moves so much farther than another, nor starts so far off.
_LARGEST = 1e6
# A joint that moves less than this is welded [rad] or [m].
_STILL = 1e-6
# Wider limits than this say nothing [rad]; a slide that is longer is in another unit [m].
_WIDEST, _LONGEST_SLIDE = 4 * np.pi, 2.0


class Coupling(NamedTuple):
    """A coupled joint's value is `multiplier` times that of joint `leader` plus `offset` [rad] or [m]."""

    leader: str
    multiplier: float
    offset: float


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


def settled(
    path: Path, joints: Sequence[JointSpec], couplings: Mapping[str, Coupling]
) -> tuple[list[JointSpec], dict[str, Coupling], tuple[str, ...]]:
    """The joints with limits that can be moved within, the couplings that are left, and a warning for what was done.

    Actuated joints are kept within what their followers allow, those that turn without end within one turn; what
    cannot move is welded where it is, with its followers.

    Raises:
        HandError: a joint slides farther than anything in a hand does.
    """
    moving = [joint for joint in joints if joint.kind != "fixed"]
    followers = [joint for joint in moving if joint.name in couplings]
    leaders = {joint.name: joint for joint in moving if joint.name not in couplings}
    warnings: list[str] = []
    for follower in followers:
        coupling = couplings[follower.name]
        narrow = _narrowed(leaders[coupling.leader], follower, coupling)
        if narrow.lower < narrow.upper or coupling.multiplier == 0:
            leaders[coupling.leader] = narrow
        else:
            leaders[coupling.leader] = replace(leaders[coupling.leader], velocity=narrow.velocity)
            warnings.append(f"coupled joint {follower.name!r}: its limits leave no room to move, and were not kept")
    for name, joint in leaders.items():
        leaders[name] = _finite(path, joint)
        if leaders[name] is not joint:
            turn = f"[{leaders[name].lower:.3g}, {leaders[name].upper:.3g}]"
            warnings.append(f"joint {name!r} turns without end: kept to {turn} rad")
    for follower in followers:
        leader, multiplier, _ = couplings[follower.name]
        slide = abs(multiplier) * (leaders[leader].upper - leaders[leader].lower)
        if follower.kind == "prismatic" and slide > _LONGEST_SLIDE:
            raise _too_long(path, follower.name, slide)
    still = {name: joint.lower for name, joint in leaders.items() if joint.upper - joint.lower < _STILL}
    warnings += [f"joint {name!r} cannot move: its limits coincide; welded" for name in still]
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
    """The leader within limits and speed that keep its follower within its own too."""
    _, multiplier, offset = coupling
    if multiplier == 0:
        return leader
    low, high = sorted(((follower.lower - offset) / multiplier, (follower.upper - offset) / multiplier))
    velocity = min(leader.velocity, follower.velocity / abs(multiplier))
    return replace(leader, lower=max(leader.lower, low), upper=min(leader.upper, high), velocity=velocity)


def _finite(path: Path, joint: JointSpec) -> JointSpec:
    """The joint, or one that turns without end kept to one turn."""
    reach = joint.upper - joint.lower
    if joint.kind == "prismatic" and not reach <= _LONGEST_SLIDE:
        raise _too_long(path, joint.name, reach)
    if joint.kind == "prismatic" or reach <= _WIDEST:
        return joint
    # The turn from -π to π, moved no farther than the limits ask for.
    lower = min(max(-np.pi, joint.lower), joint.upper - 2 * np.pi)
    return replace(joint, lower=lower, upper=lower + 2 * np.pi)


def _welded(joint: JointSpec, value: float) -> JointSpec:
    fixed = replace(joint, kind="fixed", axis=np.zeros(3))
    if joint.kind == "prismatic":
        return replace(fixed, translation=joint.translation + joint.rotation @ joint.axis * value)
    return replace(fixed, rotation=joint.rotation @ axis_rotation(joint.axis, value))


def _too_long(path: Path, joint: str, slide: float) -> HandError:
    return HandError(
        f"{path}: joint {joint!r} slides by {slide:g} m; a hand's slides are limited, to {_LONGEST_SLIDE:g} m at most"
    )


def read_couplings(path: Path, joints: Sequence[ET.Element]) -> dict[str, Coupling]:
    """The couplings of all joints with a `<mimic>`, by name; each leader is an actuated joint.

    A fixed joint has no value to give, so its own `<mimic>` is not looked at.

    Raises:
        HandError: a joint follows itself, one that is not there or one that is fixed, or has a bad number.
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
                f"{path}: joint {name!r} mimics {leader!r}, which is no movable joint; choose from {', '.join(moving)}"
            )
        multiplier, offset = (read_numbers(path, mimic, key, 1, text)[0] for key, text in _DEFAULTS)
        direct[name] = Coupling(leader, float(multiplier), float(offset))
    return resolved_couplings(path, direct)


def resolved_couplings(path: Path, direct: Mapping[str, Coupling]) -> dict[str, Coupling]:
    """Couplings as written, each led back to the actuated joint at the end of its chain.

    Raises:
        HandError: joints follow each other in a circle, or by a number that is no hand's.
    """
    return {name: _resolved(path, name, direct) for name in direct}


def _resolved(path: Path, name: str, direct: Mapping[str, Coupling]) -> Coupling:
    """The coupling to the actuated joint at the end of the chain: m₁(m₂ q + o₂) + o₁ = m₁m₂ q + m₁o₂ + o₁."""
    coupling, seen = direct[name], [name]
    while coupling.leader in direct:
        if coupling.leader in seen:
            raise HandError(f"{path}: joints mimic each other in a circle: {' -> '.join([*seen, coupling.leader])}")
        seen.append(coupling.leader)
        further = direct[coupling.leader]
        coupling = Coupling(
            further.leader,
            coupling.multiplier * further.multiplier,
            coupling.multiplier * further.offset + coupling.offset,
        )
    if not max(abs(coupling.multiplier), abs(coupling.offset)) <= _LARGEST:
        raise HandError(
            f"{path}: joint {name!r} mimics {coupling.leader!r} with multiplier {coupling.multiplier:g} and offset "
            f"{coupling.offset:g}; the largest that is taken is {_LARGEST:g}"
        )
    return coupling
