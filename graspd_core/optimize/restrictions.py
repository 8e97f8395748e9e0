"""Starts that are aimed: the hand comes from a wanted direction, rolled as wanted, to a wanted part of the object.

What a caller asks of grasps beside that they hold: where the hand comes from, what it touches, what an arm reaches.

A restriction acts at two places: initial poses that can lead to no admissible grasp are drawn anew, and candidates that
are not admissible are refused before any trial is spent on them. A run without restrictions does neither.
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
from graspd_core.perception.scene import Obstacle, Scene, moved_grasp, moved_obstacle
from graspd_core.se3 import aligning_rotation, normalize, rotation_from_axis_angle
from graspd_core.types import Grasp

# Spread of the joints.
_JOINT_NOISE = 0.1
# A palm stays off what lies so near to its axis [m].
_PALM_RADIUS = 0.04
# Starts use so much of the cone and of the tolerance of the roll: the search turns them a little.
_INNER = 0.8


@dataclass(frozen=True)
class StartPool:
    """Hands that starts are chosen from, object frame.

    Attributes:
        grip: what of the hand is put to the object, base frame: the middle of the palm, or between fingertips [m].
        standoff: how far from the object it is put [m].
        middle: where it lies [m].
        rotation: turn of the base.
        translation: origin of the base [m].
        joints: [rad].
        depth: how far the wanted place lies behind what the palm meets first [m]; 0 where no place is wanted.
    """

    grip: Float[Tensor, "batch 3"]
    standoff: Float[Tensor, "batch"]
    middle: Float[Tensor, "batch 3"]
    rotation: Float[Tensor, "batch 3 3"]
    translation: Float[Tensor, "batch 3"]
    joints: Float[Tensor, "batch joints"]
    depth: Float[Tensor, "batch"]

    def __getitem__(self, rows: Tensor) -> StartPool:
        return StartPool(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class Roll:
    """A wanted turn of the hand about its direction of approach.

    Attributes:
        side: unit vector square to the hand's approach, base frame.
        zero: unit vector that `side` points along at a roll of 0, once made square to the approach; object frame.
        angle: wanted, right-handed about the approach [rad].
        tolerance: either way [rad].
    """

    side: Float[np.ndarray, "3"]
    zero: Float[np.ndarray, "3"]
    angle: float
    tolerance: float

    def missing(
        self, approach: Float[Tensor, "batch 3"], rotation: Float[Tensor, "batch 3 3"]
    ) -> Float[Tensor, "batch"]:
        """Turn about the approach, in −π to π, that would bring each hand to the wanted roll [rad]."""
        zero, side = torch.as_tensor(self.zero).to(approach), rotation @ torch.as_tensor(self.side).to(approach)
        square = zero - (approach @ zero)[:, None] * approach
        roll = torch.atan2((torch.linalg.cross(square, side) * approach).sum(-1), (square * side).sum(-1))
        return torch.remainder(self.angle - roll + np.pi, 2 * np.pi) - np.pi


@dataclass(frozen=True)
class Aim:
    """Where starts are wanted.

    Attributes:
        direction: unit direction of approach, object frame; None: any.
        angle: greatest angle between it and a hand's approach [rad].
        roll: about the approach; None: any.
        places: points of the surface that the palm is to face [m]; None: any.
    """

    direction: Float[np.ndarray, "3"] | None = None
    angle: float = np.pi
    roll: Roll | None = None
    places: Float[np.ndarray, "places 3"] | None = None

    def moved(self, offset: Float[np.ndarray, "3"]) -> Aim:
        """The same in a frame whose origin lies at −`offset` [m]."""
        return self if self.places is None else replace(self, places=self.places + offset)


def uniform(low: float, high: float, count: int, generator: torch.Generator) -> Float[Tensor, "count"]:
    """Numbers drawn between two bounds, float64."""
    return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)


def open_joints(hand: HandModel, count: int, generator: torch.Generator) -> Float[Tensor, "count joints"]:
    """Joint values about the open posture, within the limits [rad]."""
    spread = torch.as_tensor(hand.upper - hand.lower)
    noise = _JOINT_NOISE * (torch.rand(count, len(spread), generator=generator, dtype=torch.float64) - 0.5)
    joints = torch.as_tensor(hand.open_posture) + noise * spread
    return joints.clamp(torch.as_tensor(hand.lower), torch.as_tensor(hand.upper))


def aimed(
    pool: StartPool, aim: Aim, surface: Float[Tensor, "points 3"], hand: HandModel, generator: torch.Generator
) -> StartPool:
    """The hands turned and moved as is wanted; joints stay, and what is not wanted otherwise.

    A palm, or the middle between fingertips, faces a wanted place and stands off what lies about the line from there.

    Args:
        pool: hands drawn without an aim.
        aim: direction, roll and places.
        surface: points of the object that palms stay off [m].
        hand: whose palm and approach they are.
        generator: of what is drawn.
    """
    count, rotation = len(pool.joints), pool.rotation
    if aim.direction is not None:
        axis = torch.as_tensor(aim.direction).expand(count, 3)
        least = float(np.cos(_INNER * aim.angle))
        tilted = torch.acos(uniform(least, 1.0, count, generator).clamp(-1.0, 1.0))
        square = normalize(torch.linalg.cross(axis, torch.randn(count, 3, generator=generator, dtype=torch.float64)))
        approach = (rotation_from_axis_angle(square, tilted) @ axis[..., None]).squeeze(-1)
        rotation = aligning_rotation(torch.as_tensor(hand.approach), approach)
        turn = uniform(-np.pi, np.pi, count, generator)
        rotation = rotation_from_axis_angle(approach, turn) @ rotation
    if aim.roll is not None:
        approach = rotation @ torch.as_tensor(hand.approach)
        turn = aim.roll.missing(approach, rotation)
        turn = turn + _INNER * uniform(-aim.roll.tolerance, aim.roll.tolerance, count, generator)
        rotation = rotation_from_axis_angle(approach, turn) @ rotation
    places = surface if aim.places is None else torch.as_tensor(aim.places)
    faced = places[torch.randint(len(places), (count,), generator=generator)]
    facing = rotation @ torch.as_tensor(hand.palm_normal)
    depth = _standing_off(faced, facing, surface)
    middle = faced - (depth + pool.standoff)[:, None] * facing
    translation = middle - (rotation @ pool.grip[..., None]).squeeze(-1)
    depth = torch.zeros_like(depth) if aim.places is None else depth
    return replace(pool, middle=middle, rotation=rotation, translation=translation, depth=depth)


def _standing_off(
    places: Float[Tensor, "batch 3"], facing: Float[Tensor, "batch 3"], surface: Float[Tensor, "points 3"]
) -> Float[Tensor, "batch"]:
    away = surface[None] - places[:, None]
    back = -(away * facing[:, None]).sum(-1)
    near = (away + back[..., None] * facing[:, None]).norm(dim=-1) < _PALM_RADIUS
    return torch.where(near, back, 0.0).amax(-1).clamp_min(0.0)


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


class BoundRestriction:
    """A restriction for one scene and one hand. What a class that derives from this leaves out, admits everything.

    All poses are `T_object_base`, in the object frame of the scene that `plan_grasps` was given.
    """

    @property
    def impossible(self) -> str:
        """Why no grasp at all can be admitted, as a sentence; empty where one may be. Nothing is searched then."""
        return ""

    @property
    def asked(self) -> str:
        """What is asked for, by name, where nothing at all was found under it."""
        return type(self).__name__

    @property
    def aim(self) -> Aim | None:
        """Where initial poses are drawn; None: anywhere. Of several aims the first counts."""
        return None

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """What the search keeps the hand off, beside the scene's own obstacles; no trial knows of it."""
        return ()

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

    @property
    def aim(self) -> Aim | None:
        """Where initial poses are drawn; None: anywhere."""
        aim = next((one.aim for one in self.each if one.aim is not None), None)
        return None if aim is None else aim.moved(-self.origin)

    def searched(self, scene: Scene) -> Scene:
        """The scene as the search sees it, in the frame of `origin`: with what restrictions keep the hand off."""
        obstacles = tuple(moved_obstacle(o, -self.origin) for one in self.each for o in one.obstacles)
        return replace(scene, obstacles=(*scene.obstacles, *obstacles)) if obstacles else scene

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


def restrictions_in_words(restrictions: BoundRestrictions, refused: Mapping[str, int], held: int, tried: int) -> str:
    """What the restrictions of a run refused, most frequent reason first; empty where they refused nothing.

    Example: "12 candidates held, 9 refused: 7 outside the approach cone, 2 with a contact outside the region".

    Args:
        restrictions: of the run.
        refused: candidates by reason.
        held: how many grasps are as good as was asked for.
        tried: how many candidates were admitted.
    """
    if refused:
        reasons = ", ".join(f"{n} {reason}" for reason, n in sorted(refused.items(), key=lambda item: -item[1]))
        return f"{held} candidates held, {sum(refused.values())} refused: {reasons}"
    if restrictions.each and not tried:
        return f"no candidate was found under {', '.join(one.asked for one in restrictions.each)}"
    return ""
