"""Starts that are aimed: the hand comes from a wanted direction, rolled as wanted, to a wanted part of the object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.hands.model import HandModel
from graspd_core.se3 import aligning_rotation, normalize, rotation_from_axis_angle

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
    """How far a palm must be drawn back from each place against its facing to have the surface ahead of it [m]."""
    away = surface[None] - places[:, None]
    back = -(away * facing[:, None]).sum(-1)
    near = (away + back[..., None] * facing[:, None]).norm(dim=-1) < _PALM_RADIUS
    return torch.where(near, back, 0.0).amax(-1).clamp_min(0.0)
