"""Constrain grasps: approach direction, roll, contact region and boxes to avoid.

The part of the object outside the wanted region is an obstacle of the search. The obstacle loss then moves all contacts
into the region. The obstacle's signed distance is the maximum of the distances to the object and to the outside of the
region. This maximum is a lower bound of the true distance. Its gradient jumps where these two distances are equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float

from graspd_core.errors import ConfigError, short_repr
from graspd_core.hands.kinematics import RETREAT, in_base, link_poses
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import GridSDF
from graspd_core.optimize.initial_poses import closing_axis, depth_of_starts
from graspd_core.optimize.restrictions import (
    Aim,
    Allowed,
    BoundRestriction,
    BoundRestrictions,
    JointRows,
    Places,
    Refusal,
    Roll,
    Turns,
)
from graspd_core.perception.scene import Obstacle, Scene, moved_sdf, near_scene, object_sdf
from graspd_core.planning.regions import Box, NearPoints, Numbers, Region, Sphere, boxes_in_reach, entered, unit_vector
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp

# Distance from the region at which `untouched_part` begins, and distance that links keep from that part [m].
_BEGINS, _SKIN = 0.003, 0.004


def untouched_part(scene: Scene, region: Region) -> Obstacle:
    """Return the part of the object outside `region` as an obstacle, on the nodes of the object's distance grid."""
    sdf, (near, far) = scene.sdf, near_scene(scene)
    if far.any():
        # Float32 has rounded the origin of a distant grid, so the grid is built again near the origin and moved.
        sdf = moved_sdf(object_sdf(near.object).to(sdf.field.device, sdf.field.dtype), far)
    field, spacing = sdf.field.double().cpu().numpy(), float(sdf.spacing)
    axes = [float(x) + spacing * np.arange(n) for x, n in zip(sdf.origin, field.shape[1:], strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    left = _BEGINS - region.distance(nodes.reshape(-1, 3)).reshape(nodes.shape[:-1])
    slope = np.array(np.gradient(left, spacing))
    slope = slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-9)
    phi = field[0] - _SKIN
    values = np.where(phi > left, np.concatenate([phi[None], field[1:]]), np.concatenate([left[None], slope]))
    return Obstacle(
        scene.object.mesh, GridSDF(torch.as_tensor(values).to(sdf.field), sdf.origin, sdf.spacing, sdf.half)
    )


# Distance by which a contact may lie outside the region [m], and tolerance of angles [rad].
CONTACT_TOLERANCE = 0.005
_ROUNDING = 1e-6
# Number of samples of the object's surface, and greatest number of samples in a region that serve as aims of starts.
_SURFACE, _MOST_PLACES = 20_000, 400
# If the sine of the angle between fingers and approach is below this, the fingers define no side of the hand.
_ALONG = 0.3
# If the cosine of the angle between approach and z is above this, the roll is measured from x instead of z.
_VERTICAL = 0.95
# Directions are parallel if the sine of the angle between them is at most this.
_PARALLEL = 1e-3
# An approach direction is impossible if each of `_PROBES` starts penetrates the support by more than `_TOO_DEEP` [m].
_PROBES, _TOO_DEEP = 8, 0.06


@dataclass(frozen=True)
class Steering:
    """Steering constraints on grasps, in the object frame. A constraint that is None does not apply.

    A hand's approach is the direction in which the hand moves from the retreat over the pregrasp to the grasp. It is
    `HandModel.approach`, by default the palm's normal. The roll is the rotation of the hand's side about the approach.
    The side is the direction from the palm to the fingertips, projected normal to the approach. If the open fingers
    point along the approach, as in a gripper, the side is the closing direction.

    Attributes:
        approach_direction: wanted approach direction, of any non-zero length. (0, 0, -1) is from above.
        approach_angle: greatest angle between `approach_direction` and a grasp's approach, above 0, at most π [rad].
        region: a `Box`, a `Sphere` or `NearPoints`. Every contact lies in the region, or at most 5 mm outside.
        avoid: boxes that no link enters at pregrasp, grasp and squeeze.
        roll: wanted right-handed rotation of the side [rad]. It needs `approach_direction`, and `approach_angle` below
            π/2. At 0 the side points along z, or along x for an approach within 18° of vertical.
        roll_zero: direction of the side at roll 0, projected normal to the approach. None for z or x, as in `roll`.
        roll_tolerance: greatest deviation from `roll` in either direction, above 0, at most π [rad].

    Raises:
        ConfigError: a value is out of its range, is not finite, or contradicts another value.
    """

    approach_direction: Numbers | None = None
    approach_angle: float | int = np.pi / 6
    region: Region | None = None
    avoid: Sequence[Box] = ()
    roll: float | int | None = None
    roll_tolerance: float | int = np.pi / 12
    roll_zero: Numbers | None = None

    def __post_init__(self) -> None:
        for name in ("approach_direction", "roll_zero"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, unit_vector(name, getattr(self, name)))
        for name in ("approach_angle", "roll_tolerance"):
            if not 0 < getattr(self, name) <= np.pi:
                raise ConfigError(f"{name}: {getattr(self, name):.4g} rad; valid: above 0, at most pi (180 degrees)")
        if self.region is not None and not isinstance(self.region, Box | Sphere | NearPoints):
            raise ConfigError(f"region: {type(self.region).__name__}; valid: Box, Sphere, NearPoints")
        # A generator would be empty after this check.
        if not isinstance(self.avoid, Sequence) or any(not isinstance(box, Box) for box in self.avoid):
            raise ConfigError(f"avoid: {short_repr(self.avoid)}; valid: a sequence of Box")
        if self.roll is None:
            return
        if not np.isfinite(self.roll):
            raise ConfigError(f"roll: {self.roll} rad; valid: a finite number")
        if self.approach_direction is None:
            raise ConfigError("roll: no approach_direction is given; give the direction about which the hand rolls")
        if self.approach_angle >= np.pi / 2:
            raise ConfigError(f"roll: approach_angle is {self.approach_angle:.4g} rad; valid: below pi/2 (90 degrees)")
        zero, along = self.roll_zero, self.approach_direction
        if zero is not None and not np.linalg.norm(np.cross(zero, along)) > _PARALLEL:
            given = short_repr(zero)
            raise ConfigError(f"roll_zero: {given}; valid: a direction that is not along approach_direction")

    def bind(self, scene: Scene, hand: HandModel) -> BoundSteering:
        """Bind the steering to this hand in this scene.

        Raises:
            ConfigError: no part of the object lies in the region, or an avoided box covers that part.
        """
        direction = None if self.approach_direction is None else np.array(self.approach_direction, dtype=float)
        roll = None
        if direction is not None and self.roll is not None:
            zero = zero_of_roll(direction) if self.roll_zero is None else np.array(self.roll_zero, dtype=float)
            zero = zero - (zero @ direction) * direction
            roll = Roll(hand_side(hand), zero / np.linalg.norm(zero), self.roll, self.roll_tolerance)
        places = None if self.region is None else _part_of_object(scene, self.region, self.avoid)
        aim = Aim(direction, self.approach_angle, roll, places)
        return BoundSteering(self, scene, hand, aim)


@dataclass(frozen=True, eq=False)
class BoundSteering(BoundRestriction):
    """A `Steering` bound to one hand in one scene. `wanted` holds the constraints on initial poses."""

    steering: Steering
    scene: Scene
    hand: HandModel
    wanted: Aim

    @property
    def description(self) -> str:
        """Names of the given constraints."""
        given = {name: getattr(self.steering, name) is not None for name in ("approach_direction", "region", "roll")}
        given["avoid"] = len(self.steering.avoid) > 0
        return ", ".join(name for name, there in given.items() if there)

    @property
    def aim(self) -> Aim | None:
        """Constraints on initial poses. None without a constraint on region or approach direction."""
        constrained = self.wanted.direction is not None or self.wanted.places is not None
        return self.wanted if constrained else None

    @cached_property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The reachable parts of the avoided boxes, and the part of the object outside the region."""
        region = self.steering.region
        rest = () if region is None else (untouched_part(self.scene, region),)
        return (*boxes_in_reach(self.scene, self.hand, self.steering.avoid), *rest)

    @property
    def impossible(self) -> str:
        """Why no grasp can exist: the hand would pass through the support on its approach. "" otherwise."""
        if self.scene.support is None or self.wanted.direction is None:
            return ""
        depth = depth_of_starts(self.scene, self.hand, _PROBES, BoundRestrictions((self,)))
        if depth <= _TOO_DEEP:
            return ""
        return (
            f"approach_direction: impossible, because the hand would reach {depth * 100:.0f} cm into the support on "
            "its approach; give a direction from the free side, or a wider approach_angle"
        )

    def starts(self, positions: Places, quaternions: Turns, joints: JointRows) -> Allowed:
        """Return for each initial pose whether the palm centre is outside all avoided boxes, also at the retreat."""
        if not self.steering.avoid:
            return np.ones(len(positions), dtype=bool)
        turns = rotation_from_quaternion(torch.as_tensor(quaternions)).numpy()
        palms = [positions + turns @ (self.hand.palm_center - back * self.hand.approach) for back in (0.0, RETREAT)]
        return np.all([box.distance(palm) > 0.0 for box in self.steering.avoid for palm in palms], axis=0)

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        """Return each candidate that meets all constraints. For any other, return a `Refusal`."""
        if not grasps:
            return grasps
        steering, wanted, missed = self.steering, self.wanted, dict[str, Bool[np.ndarray, "grasps"]]()
        if wanted.direction is not None:
            angles = np.array([angle_of_approach(self.hand, grasp, wanted.direction) for grasp in grasps])
            reason = f"outside the approach cone of {np.degrees(steering.approach_angle):.0f} degrees"
            missed[reason] = angles > steering.approach_angle + _ROUNDING
        if wanted.roll is not None:
            quaternions = np.stack([grasp.grasp.quaternion_wxyz for grasp in grasps])
            turns = rotation_from_quaternion(torch.as_tensor(quaternions).double())
            missing = wanted.roll.missing(turns @ torch.as_tensor(self.hand.approach), turns)
            missed["with another roll"] = np.abs(missing.numpy()) > steering.roll_tolerance + _ROUNDING
        if steering.region is not None:
            outside = np.array([outside_region(steering.region, grasp) for grasp in grasps])
            missed["with a contact outside the region"] = outside > CONTACT_TOLERANCE
        at_each = [[getattr(grasp, stage) for grasp in grasps] for stage in ("pregrasp", "grasp", "squeeze")]
        in_boxes = [entered(self.hand, postures, steering.avoid) for postures in at_each]
        missed["with a link in an avoided box"] = np.any(in_boxes, axis=0)
        reasons = [next((why for why, rows in missed.items() if rows[i]), "") for i in range(len(grasps))]
        return [Refusal(why) if why else grasp for why, grasp in zip(reasons, grasps, strict=True)]


def angle_of_approach(hand: HandModel, grasp: Grasp, direction: Float[np.ndarray, "3"]) -> float:
    """Return the angle between a grasp's approach and a unit direction [rad]."""
    turned = rotation_from_quaternion(torch.as_tensor(grasp.grasp.quaternion_wxyz)).double().numpy()
    approach = turned @ hand.approach
    return float(np.arctan2(np.linalg.norm(np.cross(approach, direction)), approach @ direction))


def outside_region(region: Region, grasp: Grasp) -> float:
    """Return the greatest signed distance of a grasp's contacts to a region [m]. Return infinity without a contact."""
    points = np.array([contact.position for contact in grasp.contacts], dtype=float)
    return float(region.distance(points).max()) if len(points) else np.inf


def hand_side(hand: HandModel) -> Float[np.ndarray, "3"]:
    """Return the hand's side (see `Steering`): a unit vector normal to the approach, base frame."""
    links = hand.candidate_link
    points = in_base(link_poses(hand, hand.open_posture), hand.candidate_points, links)
    tips = [points[hand.link_group[links] == group].mean(0) for group in hand.fingertip_groups]
    ahead = np.mean(tips, axis=0) - hand.palm_center
    side = ahead - (ahead @ hand.approach) * hand.approach
    if np.linalg.norm(side) < _ALONG * np.linalg.norm(ahead):
        side = closing_axis(hand)
        side = side - (side @ hand.approach) * hand.approach
        # The axis has no sign, so make its largest component positive.
        side = side * np.sign(side[np.abs(side).argmax()])
    return side / np.linalg.norm(side)


def zero_of_roll(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the default direction of the side at roll 0: z, or x for a steep `direction`, projected normal to it."""
    up = np.eye(3)[0 if abs(direction[2]) > _VERTICAL else 2]
    square = up - (up @ direction) * direction
    return square / np.linalg.norm(square)


def _part_of_object(scene: Scene, region: Region, avoid: Sequence[Box]) -> Float[np.ndarray, "places 3"]:
    """Return points on the object's surface in a region [m].

    Raises ConfigError: no point lies in the region, or one avoided box contains all points in the region.
    """
    mesh = scene.object.mesh
    points = np.vstack([surface_samples(mesh, _SURFACE, seed=0)[0], mesh.vertices])
    inside = points[region.distance(points) <= 0.0]
    if len(inside) == 0:
        low, high = (" ".join(f"{v:.3f}" for v in corner) for corner in (points.min(0), points.max(0)))
        raise ConfigError(
            f"region: no part of the object lies inside; the object extends from ({low}) to ({high}) m and is "
            f"{region.distance(points).min():.3f} m away"
        )
    for number, box in enumerate(avoid):
        if (box.distance(inside) <= 0.0).all():
            raise ConfigError(f"region: avoid box {number} covers the object in the region; move the box or the region")
    return inside[:: len(inside) // _MOST_PLACES + 1]
