"""Restrict the grasps of a run: the approach direction, the contact region, or the poses that an arm can reach.

A restriction acts twice. Initial poses that cannot lead to an admissible grasp are replaced. Candidates that are not
admissible are refused before any trial. A run without restrictions skips both checks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from graspd_core.hands.model import HandModel
from graspd_core.optimize.loop import Positions, Values
from graspd_core.perception.scene import Obstacle, Scene, moved_grasp, moved_obstacle
from graspd_core.types import Grasp

# Initial poses as rows: base origins [m], unit quaternions wxyz, joint values, and True for each allowed pose.
Places = Float[np.ndarray, "batch 3"]
Turns = Float[np.ndarray, "batch 4"]
JointRows = Float[np.ndarray, "batch joints"]
Allowed = Bool[np.ndarray, "batch"]


@dataclass(frozen=True)
class Roll:
    """A wanted rotation of the hand about its approach direction.

    Attributes:
        side: unit vector perpendicular to the hand's approach direction, base frame.
        zero: direction of `side` at a roll of 0, object frame. The component along the approach is ignored.
        angle: wanted roll, right-handed about the approach [rad].
        tolerance: allowed deviation to either side [rad].
    """

    side: Float[np.ndarray, "3"]
    zero: Float[np.ndarray, "3"]
    angle: float
    tolerance: float

    def missing(self, approach: Positions, rotation: Float[Tensor, "batch 3 3"]) -> Values:
        """Return the rotation about the approach that would give each hand the wanted roll [rad], in −π to π."""
        zero, side = torch.as_tensor(self.zero).to(approach), rotation @ torch.as_tensor(self.side).to(approach)
        square = zero - (approach @ zero)[:, None] * approach
        roll = torch.atan2((torch.linalg.cross(square, side) * approach).sum(-1), (square * side).sum(-1))
        return torch.remainder(self.angle - roll + np.pi, 2 * np.pi) - np.pi


@dataclass(frozen=True)
class Aim:
    """Constraints on the poses of starts.

    Attributes:
        direction: unit approach direction, object frame. None allows any direction.
        angle: greatest angle between `direction` and a hand's approach [rad].
        roll: wanted roll about the approach. None allows any roll.
        places: surface points that the palm may face [m]. None allows any point.
    """

    direction: Float[np.ndarray, "3"] | None = None
    angle: float = np.pi
    roll: Roll | None = None
    places: Float[np.ndarray, "places 3"] | None = None


@dataclass(frozen=True)
class Refusal:
    """The reason for refusing a candidate. Messages put a number first: "7" + "outside the approach cone"."""

    reason: str


@runtime_checkable
class Restriction(Protocol):
    """A restriction as the caller states it. Before a run, `bind` applies it to a scene and a hand."""

    def bind(self, scene: Scene, hand: HandModel) -> BoundRestriction:
        """Return the restriction for this scene and this hand.

        Raises ConfigError: the restriction is malformed, or does not fit the scene or the hand.
        """
        ...


class BoundRestriction:
    """A restriction for one scene and one hand. Every check accepts by default. Subclasses override some checks.

    All poses are `T_object_base`, in the object frame of the scene passed to `plan_grasps`.
    """

    @property
    def impossible(self) -> str:
        """The reason why no grasp can be admitted, as a message for the user. Empty if a grasp may be possible."""
        return ""

    @property
    def description(self) -> str:
        """Name of the restriction in the message of a run that found no candidate."""
        return type(self).__name__

    def why_none(self, others: BoundRestrictions) -> str:
        """Return why no candidate meets this restriction and all `others` of the run. Empty if unknown."""
        return ""

    @property
    def aim(self) -> Aim | None:
        """Constraints on the initial poses, None for no constraint. With several restrictions the first aim is used."""
        return None

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Additional obstacles that the hand avoids in the search. The trials do not contain these obstacles."""
        return ()

    def starts(self, positions: Places, quaternions: Turns, joints: JointRows) -> Allowed:
        """Return True for each initial pose that may lead to an admissible grasp. Quaternions are wxyz and unit."""
        return np.ones(len(positions), dtype=bool)

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        """Return for each candidate, in order, the grasp (perhaps with data added) or the reason for refusing it."""
        return grasps


@dataclass(frozen=True)
class BoundRestrictions:
    """All restrictions of a run.

    Attributes:
        each: the restrictions, applied in order. The first restriction that refuses a candidate gives the reason.
        origin: origin of the frame that this class's methods use, in the frame that `each` restriction uses [m].
    """

    each: tuple[BoundRestriction, ...] = ()
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    @property
    def impossible(self) -> str:
        """The reason of the first restriction that can admit no grasp. Empty if every restriction may admit grasps."""
        return next((one.impossible for one in self.each if one.impossible), "")

    @property
    def aim(self) -> Aim | None:
        """Constraints on the initial poses, None for no constraint."""
        aim = next((one.aim for one in self.each if one.aim is not None), None)
        return aim if aim is None or aim.places is None else replace(aim, places=aim.places - self.origin)

    def searched(self, scene: Scene) -> Scene:
        """Return `scene`, which is relative to `origin`, with the additional obstacles of the restrictions."""
        obstacles = tuple(moved_obstacle(o, -self.origin) for one in self.each for o in one.obstacles)
        return replace(scene, obstacles=(*scene.obstacles, *obstacles)) if obstacles else scene

    def starts(self, positions: Places, quaternions: Turns, joints: JointRows) -> Allowed:
        """Return True for each initial pose that all restrictions allow."""
        allowed = np.ones(len(positions), dtype=bool)
        for one in self.each:
            rows = np.flatnonzero(allowed)
            allowed[rows] = one.starts(positions[rows] + self.origin, quaternions[rows], joints[rows])
        return allowed

    def admit(self, grasps: Sequence[Grasp]) -> tuple[tuple[Grasp, ...], Counter[str]]:
        """Return the admitted candidates in order, and the number of refused candidates for each reason."""
        if not self.each:
            return tuple(grasps), Counter()
        admitted, refused = [moved_grasp(grasp, self.origin) for grasp in grasps], Counter[str]()
        for one in self.each:
            answers = one.admit(admitted)
            refused.update(answer.reason for answer in answers if isinstance(answer, Refusal))
            admitted = [answer for answer in answers if not isinstance(answer, Refusal)]
        return tuple(moved_grasp(grasp, -self.origin) for grasp in admitted), refused


UNRESTRICTED = BoundRestrictions()


def restrictions_in_words(restrictions: BoundRestrictions, refused: Mapping[str, int], held: int, tried: int) -> str:
    """Return a sentence that counts the refused candidates by reason, most frequent reason first.

    Example: "12 candidates held, 9 refused: 7 outside the approach cone, 2 with a contact outside the region".
    If no candidate was found, the text names the restrictions. If all candidates were admitted, the text is empty.
    `held` is the number of candidates that passed the trials. `tried` is the number of admitted candidates.
    """
    if refused:
        reasons = ", ".join(f"{n} {reason}" for reason, n in sorted(refused.items(), key=lambda item: -item[1]))
        return f"{held} candidates held, {sum(refused.values())} refused: {reasons}"
    if not restrictions.each or tried:
        return ""
    message = f"no candidate was found under {', '.join(one.description for one in restrictions.each)}"
    rest = ((one, tuple(other for other in restrictions.each if other is not one)) for one in restrictions.each)
    reasons = (one.why_none(replace(restrictions, each=others)) for one, others in rest)
    return "; ".join([message, *filter(None, reasons)])
