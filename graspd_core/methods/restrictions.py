"""What a caller asks of grasps beside that they hold: where the hand comes from, what it touches, what an arm reaches.

A restriction acts at two places: initial poses that can lead to no admissible grasp are drawn anew, and candidates that
are not admissible are refused before any trial is spent on them. A run without restrictions does neither.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.hands.model import HandModel
from graspd_core.scene.far_objects import moved_grasp
from graspd_core.scene.scene import Scene
from graspd_core.types import Grasp


@dataclass(frozen=True)
class Refusal:
    """Why a candidate is not admitted, as a phrase that follows a number: "outside the approach cone"."""

    reason: str


@runtime_checkable
class Restriction(Protocol):
    """What is asked of the grasps of one run, as the caller writes it."""

    def bind(self, scene: Scene, hand: HandModel) -> BoundRestriction:
        """The restriction for this scene and this hand.

        Raises:
            ConfigError: it is malformed, or does not fit the scene or the hand.
        """
        ...


@runtime_checkable
class BoundRestriction(Protocol):
    """A restriction for one scene and one hand. What a class that derives from this leaves out, admits everything.

    All poses are `T_object_base`, in the object frame of the scene that `plan_grasps` was given.
    """

    @property
    def impossible(self) -> str:
        """Why no grasp at all can be admitted, as a sentence; empty where one may be. Nothing is searched then."""
        return ""

    def starts(
        self,
        positions: Float[np.ndarray, "batch 3"],
        quaternions: Float[np.ndarray, "batch 4"],
        joints: Float[np.ndarray, "batch joints"],
    ) -> Bool[np.ndarray, "batch"]:
        """Which initial poses may lead to an admissible grasp; positions in metres, unit quaternions wxyz."""
        return np.ones(len(positions), dtype=bool)

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        """Each candidate as it is admitted, perhaps with more in it than before, or why it is not; in their order."""
        return grasps


@dataclass(frozen=True)
class BoundRestrictions:
    """All restrictions of a run.

    Attributes:
        each: applied one after the other; the first that refuses a candidate says why.
        origin: of the poses that are given and returned here, in the frame that the restrictions think in [m].
    """

    each: tuple[BoundRestriction, ...] = ()
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    def moved(self, origin: Float[np.ndarray, "3"]) -> BoundRestrictions:
        """The same for poses about another origin [m]."""
        return replace(self, origin=origin)

    @property
    def impossible(self) -> str:
        """Why the first restriction that admits nothing does so; empty where each may admit something."""
        return next((one.impossible for one in self.each if one.impossible), "")

    def starts(
        self,
        positions: Float[np.ndarray, "batch 3"],
        quaternions: Float[np.ndarray, "batch 4"],
        joints: Float[np.ndarray, "batch joints"],
    ) -> Bool[np.ndarray, "batch"]:
        """Which initial poses all restrictions allow; those that one forbids are not shown to the next."""
        allowed = np.ones(len(positions), dtype=bool)
        for one in self.each:
            rows = np.flatnonzero(allowed)
            allowed[rows] = one.starts(positions[rows] + self.origin, quaternions[rows], joints[rows])
        return allowed

    def admit(self, grasps: Sequence[Grasp]) -> tuple[tuple[Grasp, ...], Counter[str]]:
        """The candidates that all restrictions admit, in their order, and how many were refused for which reason."""
        if not self.each:
            return tuple(grasps), Counter()
        admitted, refused = [moved_grasp(grasp, self.origin) for grasp in grasps], Counter[str]()
        for one in self.each:
            answers = one.admit(admitted)
            refused.update(answer.reason for answer in answers if isinstance(answer, Refusal))
            admitted = [answer for answer in answers if not isinstance(answer, Refusal)]
        return tuple(moved_grasp(grasp, -self.origin) for grasp in admitted), refused


UNRESTRICTED = BoundRestrictions()


def refusals_in_words(refused: Mapping[str, int], held: int) -> str:
    """What the restrictions of a run refused, most frequent reason first; empty where they refused nothing.

    Example: "12 candidates held, 9 refused: 7 outside the approach cone, 2 with a contact outside the region".
    """
    if not refused:
        return ""
    reasons = ", ".join(f"{n} {reason}" for reason, n in sorted(refused.items(), key=lambda item: -item[1]))
    return f"{held} candidates held, {sum(refused.values())} refused: {reasons}"
