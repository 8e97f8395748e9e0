"""Define regions of space: boxes, spheres and neighbourhoods of points. Check whether a link enters a box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from graspd_core.errors import ConfigError, short_repr
from graspd_core.hands.kinematics import RETREAT, forward, make_kinematics
from graspd_core.hands.model import HandModel
from graspd_core.optimize.obstacle_distance import extreme_points_of_solids, hand_reach
from graspd_core.perception.scene import Obstacle, Scene, make_obstacle
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Posture, TriangleMesh, stacked

# A short sequence of numbers: a tuple, a list or an array.
Numbers = Sequence[float | int] | np.ndarray


def numbers(name: str, given: Any, count: int) -> tuple[float, ...]:
    """Return `given` as `count` finite numbers, else raise ConfigError. The message begins with `name`."""
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ConfigError(f"{name}: {short_repr(given)}; valid: {count} finite numbers")
    return tuple(values.tolist())


def unit_vector(name: str, given: Any, count: int = 3) -> tuple[float, ...]:
    """Return `given` with length 1, else raise ConfigError: all numbers are 0, or see `numbers`."""
    values = np.array(numbers(name, given, count))
    if not values.any():
        raise ConfigError(f"{name}: {short_repr(given)}; valid: {count} numbers, not all 0")
    values = values / np.abs(values).max()  # the square of a very large or small number is not finite or 0
    return tuple((values / np.linalg.norm(values)).tolist())


@dataclass(frozen=True)
class Box:
    """An oriented box.

    Attributes:
        center: centre of the box, object frame [m].
        size: edge lengths along the box axes [m].
        quaternion_wxyz: rotation of the box in the object frame, a quaternion of any non-zero length.

    Raises:
        ConfigError: a number is not finite, an edge length is not above 0, or the quaternion is 0.
    """

    center: Numbers
    size: Numbers
    quaternion_wxyz: Numbers = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("center", "size"):
            object.__setattr__(self, name, numbers(f"box {name}", getattr(self, name), 3))
        object.__setattr__(self, "quaternion_wxyz", unit_vector("box quaternion_wxyz", self.quaternion_wxyz, 4))
        if min(self.size) <= 0:
            raise ConfigError(f"box size: {short_repr(self.size)}; valid: three lengths above 0, in metres")

    @cached_property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation `R_object_box` from the box frame to the object frame."""
        return rotation_from_quaternion(torch.tensor(tuple(self.quaternion_wxyz), dtype=torch.float64)).numpy()

    def local(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Map points from the object frame to the box frame [m]."""
        return (points - np.asarray(self.center)) @ self.rotation

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the signed distance of points [m], negative inside."""
        beyond = np.abs(self.local(points)) - np.asarray(self.size) / 2
        return np.linalg.norm(beyond.clip(0.0), axis=-1) + beyond.max(-1).clip(max=0.0)


@dataclass(frozen=True)
class Sphere:
    """A sphere.

    Attributes:
        center: centre of the sphere, object frame [m].
        radius: radius [m].

    Raises:
        ConfigError: a number is not finite, or the radius is not above 0.
    """

    center: Numbers
    radius: float | int

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", numbers("sphere center", self.center, 3))
        if not np.isfinite(self.radius) or self.radius <= 0:
            raise ConfigError(f"sphere radius: {self.radius} m; valid: above 0")

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the signed distance of points [m], negative inside."""
        return np.linalg.norm(points - np.asarray(self.center), axis=-1) - self.radius


@dataclass(frozen=True, eq=False)
class NearPoints:
    """The region within a distance of given points, for example the points of an image mask.

    Attributes:
        points: points, object frame [m]. Points that are not finite are ignored.
        radius: greatest distance from the nearest point [m].

    Raises:
        ConfigError: no point is finite, or the radius is not above 0.
    """

    points: Float[np.ndarray, "points 3"]
    radius: float = 0.01
    _tree: KDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=float)
        points = points[np.isfinite(points).all(-1)] if points.ndim == 2 and points.shape[-1] == 3 else points[:0]
        if len(points) == 0:
            raise ConfigError("region points: no finite row x, y, z; valid: rows of x, y, z in metres")
        if not np.isfinite(self.radius) or self.radius <= 0:
            raise ConfigError(f"region radius: {self.radius} m; valid: above 0")
        object.__setattr__(self, "_tree", KDTree(points))

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the distance to the nearest point of the region minus the radius [m], negative inside."""
        return self._tree.query(points)[0] - self.radius


Region = Box | Sphere | NearPoints

# Greatest number of steps in the distance search of `_enter`.
_STEPS = 60
# A gap up to this width counts as contact [m].
_TOUCH = 1e-5
# Boxes grow by this as obstacles [m], because the search allows slight penetration and a squeeze closes the fingers.
_PAD = 0.004


def entered(hand: HandModel, postures: Sequence[Posture], boxes: Sequence[Box]) -> Bool[np.ndarray, "postures"]:
    """Return for each posture whether a link enters any of the boxes. Postures and boxes are in the same frame."""
    if not boxes or not postures:
        return np.zeros(len(postures), dtype=bool)
    points, radii = _placed_solids(hand, postures)
    found = [_enter(box.local(points), radii, np.asarray(box.size) / 2) for box in boxes]
    return np.any(found, axis=0)


def _placed_solids(
    hand: HandModel, postures: Sequence[Posture]
) -> tuple[Float[np.ndarray, "postures solids corners 3"], Float[np.ndarray, "solids"]]:
    """Return each primitive's extreme points by posture, and its radius [m]. Short rows repeat their first point."""
    solids = extreme_points_of_solids(hand)
    most = max(len(points) for points, _, _ in solids)
    local = np.stack([np.vstack([points, np.repeat(points[:1], most - len(points), 0)]) for points, _, _ in solids])
    positions, quaternions, joints = map(torch.as_tensor, stacked(postures))
    links = forward(make_kinematics(hand, dtype=torch.float64), joints)[:, torch.as_tensor([s[2] for s in solids])]
    inside = torch.einsum("bsij,skj->bski", links.rotation, torch.as_tensor(local)) + links.translation[:, :, None]
    placed = SE3(rotation_from_quaternion(quaternions), positions).apply(inside.flatten(1, 2)).reshape(inside.shape)
    return placed.numpy(), np.array([radius for _, radius, _ in solids])


def _enter(
    points: Float[np.ndarray, "postures solids corners 3"],
    radii: Float[np.ndarray, "solids"],
    half: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "postures"]:
    """Return for each posture whether a primitive is nearer than its radius to the box |x| ≤ `half` [m]."""
    flat = points.reshape(-1, *points.shape[2:])
    radius = np.tile(radii, len(points))
    clear = ((flat.min(1) - radius[:, None] > half) | (flat.max(1) + radius[:, None] < -half)).any(-1)
    rows = np.flatnonzero(~clear)
    x = flat[rows].mean(1)
    for _ in range(_STEPS):
        away = x - x.clip(-half, half)
        gap = np.linalg.norm(away, axis=-1)
        along = np.einsum("nki,ni->nk", flat[rows], away)
        nearest = along.argmin(1)
        bound = along.min(1) - (away * x.clip(-half, half)).sum(-1)
        parted = bound > (radius[rows] + _TOUCH) * gap
        inside = gap <= radius[rows] + _TOUCH
        clear[rows[parted & ~inside]] = True
        going = ~parted & ~inside
        if not going.any():
            break
        rows, x, away, nearest = rows[going], x[going], away[going], nearest[going]
        step = flat[rows, nearest] - x
        share = -(away * step).sum(-1) / np.maximum((step * step).sum(-1), 1e-18)
        x = x + share.clip(0.0, 1.0)[:, None] * step
    return ~clear.reshape(len(points), -1).all(-1)


def boxes_in_reach(scene: Scene, hand: HandModel, boxes: Sequence[Box]) -> tuple[Obstacle, ...]:
    """Return, as obstacles, the part of each box that the hand could reach while approaching the object."""
    reach = scene.object.radius + hand_reach(hand) + RETREAT
    found = []
    for box in boxes:
        middle, half = box.local(scene.object.center_of_mass), np.asarray(box.size) / 2
        low, high = np.maximum(-half - _PAD, middle - reach), np.minimum(half + _PAD, middle + reach)
        if (low < high).all():
            mesh = _box_mesh(box, low, high)
            found.append(make_obstacle(mesh))
    return tuple(found)


def _box_mesh(box: Box, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> TriangleMesh:
    import trimesh

    mesh = trimesh.creation.box(bounds=np.stack([low, high]))
    vertices = np.asarray(mesh.vertices) @ box.rotation.T + np.asarray(box.center)
    return TriangleMesh(vertices, np.asarray(mesh.faces, dtype=np.int64))
