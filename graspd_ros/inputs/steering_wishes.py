"""What a GraspRequest asks of a grasp's place and direction, in the frame of the object."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Pose
from graspd_msgs.msg import GraspRequest
from jaxtyping import Float
from shape_msgs.msg import SolidPrimitive

from graspd_core import Box, NearPoints, Sphere, Steering
from graspd_core.planning.steering import zero_of_roll
from graspd_ros.inputs.frames import pose_of_matrix
from graspd_ros.inputs.requests import pose_matrix
from graspd_ros.outputs.error_codes import ErrorCode, RequestError

MOST_BOXES = 64
# The defaults of `Steering` stand for an angle of 0.
_DEFAULTS = Steering()

# Reads the points that a mask shows, in the frame of the request's object [m]; slow, may raise a GraspdError.
MaskPoints = Callable[[], Float[np.ndarray, "points 3"]]
Pose4 = Float[np.ndarray, "4 4"]


def asks_for_any(message: GraspRequest) -> bool:
    """Whether a request asks for any place or direction at all."""
    angles = message.approach_angle, message.roll, message.roll_tolerance
    masked = message.region_mask.height > 0
    return any((_direction(message), message.use_roll, *angles, message.region.dimensions, masked, message.avoid))


def steering_of(message: GraspRequest, T_object_header: Pose4, shown: MaskPoints | None = None) -> Steering:
    """The wishes of a request in the object's frame.

    Args:
        message: has them in the frame of its header.
        T_object_header: that frame in the object's own.
        shown: gives what `region_mask` shows; None leaves the mask out.

    Raises:
        GraspdError: a field, what it holds and what is valid.
    """
    _check(message)
    rotation = T_object_header[:3, :3]
    region, direction = _region(message, T_object_header), _direction(message)
    if region is None and shown is not None and message.region_mask.height:
        region = NearPoints(shown())
    zero = None
    if message.use_roll and np.isfinite(direction).all() and direction:
        zero = tuple((rotation @ zero_of_roll(np.array(direction) / np.linalg.norm(direction))).tolist())
    return Steering(
        approach_direction=tuple((rotation @ direction).tolist()) if direction else None,
        approach_angle=message.approach_angle or _DEFAULTS.approach_angle,
        region=region,
        avoid=[_box("avoid", solid, pose, T_object_header) for solid, pose in _avoided(message)],
        roll=message.roll if message.use_roll else None,
        roll_tolerance=message.roll_tolerance or _DEFAULTS.roll_tolerance,
        roll_zero=zero,
    )


def _check(message: GraspRequest) -> None:
    """Refuse wishes that lack another, and those that say the same twice."""
    if message.approach_angle and not _direction(message):
        raise _bad("approach_angle: it needs approach_direction")
    if (message.roll or message.roll_tolerance) and not message.use_roll:
        raise _bad("roll: use_roll is false; set it true to ask for a roll")
    if message.region_mask.height and message.region.dimensions:
        raise _bad("region_mask: region is given too; give one of them")
    if message.region_mask.height and message.source not in (GraspRequest.CLOUD, GraspRequest.LATEST_CLOUD):
        raise _bad(f"region_mask: with source {message.source}; valid with CLOUD=0 and LATEST_CLOUD=2")
    if len(message.avoid) != len(message.avoid_poses) or len(message.avoid) > MOST_BOXES:
        counts = f"{len(message.avoid)} boxes, {len(message.avoid_poses)} poses"
        raise _bad(f"avoid: {counts}; valid: one avoid_poses for each, at most {MOST_BOXES}")


def _direction(message: GraspRequest) -> tuple[float, ...]:
    """The approach asked for; empty where it is all 0."""
    given = message.approach_direction.x, message.approach_direction.y, message.approach_direction.z
    return given if any(given) else ()


def _avoided(message: GraspRequest) -> list[tuple[SolidPrimitive, Pose]]:
    return list(zip(message.avoid, message.avoid_poses, strict=True))


def _region(message: GraspRequest, T_object_header: Pose4) -> Box | Sphere | None:
    solid = message.region
    if not solid.dimensions:
        return None
    if solid.type == SolidPrimitive.SPHERE:
        if len(solid.dimensions) != 1:
            raise _bad(f"region: {len(solid.dimensions)} dimensions; valid: the radius of a SPHERE")
        pose = T_object_header @ pose_matrix(message.region_pose, "region_pose")
        return Sphere(pose[:3, 3], float(solid.dimensions[0]))
    return _box("region", solid, message.region_pose, T_object_header)


def _box(name: str, solid: SolidPrimitive, pose: Pose, T_object_header: Pose4) -> Box:
    valid = "BOX=1 or SPHERE=2" if name == "region" else "BOX=1"
    if solid.type != SolidPrimitive.BOX or len(solid.dimensions) != 3:
        raise _bad(
            f"{name}: type {solid.type} of {len(solid.dimensions)} dimensions; valid: {valid}, 3 lengths of a box"
        )
    placed = pose_of_matrix(T_object_header @ pose_matrix(pose, f"{name}_pose{'s' * (name == 'avoid')}"))
    at, turn = placed.position, placed.orientation
    return Box((at.x, at.y, at.z), list(solid.dimensions), (turn.w, turn.x, turn.y, turn.z))


def _bad(message: str) -> RequestError:
    return RequestError(ErrorCode.BAD_REQUEST, message)
