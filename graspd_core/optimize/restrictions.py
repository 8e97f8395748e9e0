"""Say what a caller asks of grasps beside that they hold: the hand's direction, what it touches, what an arm reaches.

A restriction acts at two places. Initial poses that cannot lead to an admissible grasp are drawn again. Candidates that
are not admissible are refused before any trial. A run without restrictions does neither.
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

# Initial poses as rows: origins of the base [m], unit quaternions wxyz, joint values, and which of them are allowed.
Places = Float[np.ndarray, "batch 3"]
Turns = Float[np.ndarray, "batch 4"]
JointRows = Float[np.ndarray, "batch joints"]
Allowed = Bool[np.ndarray, "batch"]


@dataclass(frozen=True)
class Roll:
    """A wanted turn of the hand about its direction of approach.

    Attributes:
        side: unit vector square to the hand's approach, base frame.
        zero: unit vector that `side` points along at a roll of 0, once made square to the approach, object frame.
        angle: wanted, right-handed about the approach [rad].
        tolerance: either way [rad].
    """

    side: Float[np.ndarray, "3"]
    zero: Float[np.ndarray, "3"]
    angle: float
    tolerance: float

    def missing(self, approach: Positions, rotation: Float[Tensor, "batch 3 3"]) -> Values:
        """Return the turn about the approach, in −π to π, that would bring each hand to the wanted roll [rad]."""
        zero, side = torch.as_tensor(self.zero).to(approach), rotation @ torch.as_tensor(self.side).to(approach)
        square = zero - (approach @ zero)[:, None] * approach
        roll = torch.atan2((torch.linalg.cross(square, side) * approach).sum(-1), (square * side).sum(-1))
        return torch.remainder(self.angle - roll + np.pi, 2 * np.pi) - np.pi


@dataclass(frozen=True)
class Aim:
    """Where starts are wanted.

    Attributes:
        direction: unit direction of approach, object frame. None: any.
        angle: greatest angle between it and a hand's approach [rad].
        roll: about the approach. None: any.
        places: points of the surface that the palm is to face [m]. None: any.
    """

    direction: Float[np.ndarray, "3"] | None = None
    angle: float = np.pi
    roll: Roll | None = None
    places: Float[np.ndarray, "places 3"] | None = None


@dataclass(frozen=True)
class Refusal:
    """Why a candidate is not admitted, as a phrase that follows a number: "outside the approach cone"."""

    reason: str


@runtime_checkable
class Restriction(Protocol):
    """What is asked of the grasps of one run, as the caller writes it."""

    def bind(self, scene: Scene, hand: HandModel) -> BoundRestriction:
        """Return the restriction for this scene and this hand.

        Raises ConfigError: it is malformed, or does not fit the scene or the hand.
        """
        ...


class BoundRestriction:
    """A restriction for one scene and one hand. Every check accepts by default. Subclasses override those they need.

    All poses are `T_object_base`, in the object frame of the scene that `plan_grasps` was given.
    """

    @property
    def impossible(self) -> str:
        """Why no grasp can be admitted, as a sentence. Then nothing is searched. Empty if one may be admitted."""
        return ""

    @property
    def asked(self) -> str:
        """Name of what is asked for, for the message of a run that found nothing."""
        return type(self).__name__

    def why_none(self, others: BoundRestrictions) -> str:
        """Say why no candidate was found under this and the run's `others`. Empty if `asked` says enough."""
        return ""

    @property
    def aim(self) -> Aim | None:
        """Where initial poses are drawn, None for anywhere. Of several aims the first counts."""
        return None

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """What the search keeps the hand off, beside the scene's own obstacles. No trial knows of it."""
        return ()

    def starts(self, positions: Places, quaternions: Turns, joints: JointRows) -> Allowed:
        """Return which initial poses may lead to an admissible grasp. Positions [m], unit quaternions wxyz."""
        return np.ones(len(positions), dtype=bool)

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        """Return each candidate, perhaps with more in it than before, or why it is refused, in their order."""
        return grasps


@dataclass(frozen=True)
class BoundRestrictions:
    """All restrictions of a run.

    Attributes:
        each: applied one after the other. The first that refuses a candidate says why.
        origin: of the poses that are given and returned here, in the frame of `each` [m].
    """

    each: tuple[BoundRestriction, ...] = ()
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    def moved(self, origin: Float[np.ndarray, "3"]) -> BoundRestrictions:
        """Return the same restrictions for poses about another origin [m]."""
        return replace(self, origin=origin)

    @property
    def impossible(self) -> str:
        """Why the first restriction that admits nothing does so. Empty if each may admit something."""
        return next((one.impossible for one in self.each if one.impossible), "")

    @property
    def aim(self) -> Aim | None:
        """Where initial poses are drawn, None for anywhere."""
        aim = next((one.aim for one in self.each if one.aim is not None), None)
        return aim if aim is None or aim.places is None else replace(aim, places=aim.places - self.origin)

    def searched(self, scene: Scene) -> Scene:
        """Return the scene as the search sees it, about `origin`: with what restrictions keep the hand off."""
        obstacles = tuple(moved_obstacle(o, -self.origin) for one in self.each for o in one.obstacles)
        return replace(scene, obstacles=(*scene.obstacles, *obstacles)) if obstacles else scene

    def starts(self, positions: Places, quaternions: Turns, joints: JointRows) -> Allowed:
        """Return which initial poses all restrictions allow. What one forbids is not shown to the next."""
        allowed = np.ones(len(positions), dtype=bool)
        for one in self.each:
            rows = np.flatnonzero(allowed)
            allowed[rows] = one.starts(positions[rows] + self.origin, quaternions[rows], joints[rows])
        return allowed

    def admit(self, grasps: Sequence[Grasp]) -> tuple[tuple[Grasp, ...], Counter[str]]:
        """Return the candidates that all restrictions admit, in their order, and how many were refused why."""
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
    """Say what the restrictions of a run refused, most frequent reason first. Empty if they refused nothing.

    Example: "12 candidates held, 9 refused: 7 outside the approach cone, 2 with a contact outside the region".
    `held` counts the grasps that are as good as was asked for, `tried` the candidates that were admitted.
    """
    if refused:
        reasons = ", ".join(f"{n} {reason}" for reason, n in sorted(refused.items(), key=lambda item: -item[1]))
        return f"{held} candidates held, {sum(refused.values())} refused: {reasons}"
    if not restrictions.each or tried:
        return ""
    told = f"no candidate was found under {', '.join(one.asked for one in restrictions.each)}"
    rest = ((one, tuple(other for other in restrictions.each if other is not one)) for one in restrictions.each)
    reasons = (one.why_none(replace(restrictions, each=others)) for one, others in rest)
    return "; ".join([told, *filter(None, reasons)])
