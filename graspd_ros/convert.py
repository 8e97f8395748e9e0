"""Conversions between messages and values of graspd_core, and transforms of results to another frame.

Only this module converts quaternions between wxyz (core) and xyzw (messages). `T_a_b` maps coordinates in frame b to
frame a.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from graspd_core.errors import TransformError
from graspd_core.transforms import SECOND
from graspd_core.types import Contact, Grasp, GraspResult, Plane, Posture
from graspd_ros.error_codes import bad_request

Matrix = Float[np.ndarray, "4 4"]

_FARTHEST = 1e3  # largest valid coordinate [m]. A larger coordinate is an input mistake and loses precision
_ROUNDED = 0.05  # largest difference of a quaternion's length from 1. People round quaternions by hand


def nanoseconds(stamp: Time | Duration) -> int:
    """Return a stamp or a duration as one number [ns]."""
    return stamp.sec * SECOND + stamp.nanosec


def set_nanoseconds(stamp: Time | Duration, value: int) -> None:
    """Set a stamp or a duration to `value` [ns]."""
    stamp.sec, stamp.nanosec = divmod(value, SECOND)


def duration_of(seconds: float) -> Duration:
    """Return seconds as a duration, rounded up to whole nanoseconds, so that no motion is faster than allowed."""
    whole, rest = divmod(math.ceil(seconds * 1e9), SECOND)
    return Duration(sec=whole, nanosec=rest)


def array_of(point: Point | Vector3) -> Float[np.ndarray, "3"]:
    """Return a point or a vector as an array."""
    return np.array([point.x, point.y, point.z])


def point_of(position: Sequence[float] | np.ndarray) -> Point:
    """Return a position as a message."""
    x, y, z = map(float, position)
    return Point(x=x, y=y, z=z)


def vector_of(direction: Sequence[float] | np.ndarray) -> Vector3:
    """Return a direction or a size as a message."""
    x, y, z = map(float, direction)
    return Vector3(x=x, y=y, z=z)


def wxyz_of(turn: Quaternion) -> Float[np.ndarray, "4"]:
    """Return a quaternion as an array in the order wxyz."""
    return np.array([turn.w, turn.x, turn.y, turn.z])


def pose_of(position: Sequence[float] | np.ndarray, quaternion_wxyz: Sequence[float] | np.ndarray) -> Pose:
    """Return the pose message of a position [m] and a quaternion."""
    w, x, y, z = map(float, quaternion_wxyz)
    return Pose(position=point_of(position), orientation=Quaternion(x=x, y=y, z=z, w=w))


def pose_of_posture(posture: Posture) -> Pose:
    """Return the pose message of the hand's base link in a posture."""
    return pose_of(posture.position, posture.quaternion_wxyz)


def pose_of_matrix(T: Matrix) -> Pose:
    """Return a homogeneous transform as a pose message."""
    return pose_of(T[:3, 3], wxyz_of_matrix(T))


def wxyz_of_matrix(T: Matrix) -> Float[np.ndarray, "4"]:
    """Return the rotation of a homogeneous transform as a unit quaternion wxyz."""
    return np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)


def matrix_of_pose(pose: Pose) -> Matrix:
    """Return a pose as a matrix. Raises TransformError: not finite, or the quaternion is not a unit one."""
    return matrix_of(array_of(pose.position), wxyz_of(pose.orientation))


def near(point: Point, name: str, what: str = "") -> Float[np.ndarray, "3"]:
    """Check a point of field `name`, and return it as an array [m]. Raises RequestError: not finite, or beyond 1 km."""
    place = array_of(point)
    if not (np.abs(place) <= _FARTHEST).all():
        raise bad_request(f"{name}: {what}{place.tolist()}; valid: finite, within {_FARTHEST:g} m")
    return place


def pose_matrix(pose: Pose, name: str = "object_pose") -> Matrix:
    """Return field `name`'s pose as a matrix. A zero quaternion means no rotation. Raises RequestError if invalid."""
    near(pose.position, name, "position ")
    length = float(np.linalg.norm(wxyz_of(pose.orientation)))
    if length == 0:
        pose = Pose(position=pose.position)
    elif not abs(length - 1) < 0.01:
        raise bad_request(f"{name}: its quaternion has length {length:.3g}; valid: 1, or 0 for no rotation")
    return matrix_of_pose(pose)


def matrix_of_transform(transform: Transform) -> Matrix:
    """Return a transform as a matrix. Raises TransformError if the transform is invalid (see `matrix_of`)."""
    place, turn = transform.translation, transform.rotation
    return matrix_of((place.x, place.y, place.z), (turn.w, turn.x, turn.y, turn.z))


def matrix_of_posture(posture: Posture) -> Matrix:
    """Return the pose of the hand's base link as a matrix. Raises TransformError if the pose is invalid."""
    return matrix_of(posture.position, posture.quaternion_wxyz)


def matrix_of(position: Sequence[float] | np.ndarray, quaternion_wxyz: Sequence[float] | np.ndarray) -> Matrix:
    """Return a pose as a matrix [m]. Raises TransformError: not finite, or the quaternion is not a unit one."""
    px, py, pz = map(float, position)
    w, x, y, z = map(float, quaternion_wxyz)
    # Plain numbers are faster than small arrays. Robots send thousands of transforms a second.
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not (math.isfinite(px) and math.isfinite(py) and math.isfinite(pz)):
        raise TransformError(f"position {[px, py, pz]}; valid: finite numbers")
    if not abs(length - 1) <= _ROUNDED:
        raise TransformError(f"quaternion x y z w {[x, y, z, w]}: its length is {length:.3g}; valid: 1")
    x, y, z, w = x / length, y / length, z / length, w / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), px],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), py],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), pz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def moved_points(points: Float[np.ndarray, "n 3"], T: Matrix) -> Float[np.ndarray, "n 3"]:
    """Return points [m] transformed by `T` to another frame."""
    return points @ T[:3, :3].T + T[:3, 3]


def moved_result(result: GraspResult, T_new_old: Matrix) -> GraspResult:
    """Return a result in another frame: its postures, contacts, support plane and proposed next camera pose."""
    return replace(
        result,
        tried=tuple(moved_grasp(grasp, T_new_old) for grasp in result.tried),
        support=None if result.support is None else moved_plane(result.support, T_new_old),
        next_view=None if result.next_view is None else T_new_old @ result.next_view,
    )


def moved_grasp(grasp: Grasp, T: Matrix) -> Grasp:
    """Return a grasp transformed by `T` to another frame."""
    names = [name for name in ("pregrasp", "grasp", "squeeze", "arrival") if getattr(grasp, name) is not None]
    postures = {name: _moved_posture(getattr(grasp, name), T) for name in names}
    return replace(grasp, **postures, contacts=tuple(_moved_contact(contact, T) for contact in grasp.contacts))


def moved_plane(plane: Plane, T: Matrix) -> Plane:
    """Return a plane transformed by `T` to another frame."""
    normal = T[:3, :3] @ plane.normal
    return replace(plane, normal=normal, offset=plane.offset + float(normal @ T[:3, 3]))


def _moved_posture(posture: Posture, T: Matrix) -> Posture:
    pose = T @ matrix_of_posture(posture)
    return replace(posture, position=pose[:3, 3], quaternion_wxyz=wxyz_of_matrix(pose))


def _moved_contact(contact: Contact, T: Matrix) -> Contact:
    x, y, z = map(float, T[:3, :3] @ contact.position + T[:3, 3])
    nx, ny, nz = map(float, T[:3, :3] @ contact.normal)
    force = contact.force and tuple(map(float, T[:3, :3] @ contact.force))
    return replace(contact, position=(x, y, z), normal=(nx, ny, nz), force=force)
