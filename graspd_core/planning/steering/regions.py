"""Parts of space: boxes, balls and what lies near to given points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_core.errors import ConfigError, shown
from graspd_core.se3 import rotation_from_quaternion

# A few numbers, as a caller may write them.
Numbers = Sequence[float | int] | np.ndarray


def numbers(name: str, given: Any, count: int) -> tuple[float, ...]:
    """So many finite numbers. Raises ConfigError: they are not, by the name of what was given."""
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ConfigError(f"{name}: {shown(given)}; valid: {count} finite numbers")
    return tuple(values.tolist())


@dataclass(frozen=True)
class Box:
    """A box.

    Attributes:
        center: its middle, object frame [m].
        size: its edges' lengths [m].
        quaternion_wxyz: how its edges are turned, of any length; not at all by default.

    Raises:
        ConfigError: a number is not finite, an edge not longer than 0, the quaternion 0.
    """

    center: Numbers
    size: Numbers
    quaternion_wxyz: Numbers = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name, count in (("center", 3), ("size", 3), ("quaternion_wxyz", 4)):
            object.__setattr__(self, name, numbers(f"box {name}", getattr(self, name), count))
        if min(self.size) <= 0:
            raise ConfigError(f"box size: {shown(self.size)}; valid: three lengths above 0, in metres")
        if not any(self.quaternion_wxyz):
            raise ConfigError("box quaternion_wxyz: all 0; valid: w, x, y, z, not all 0")

    @cached_property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """`R_object_box`."""
        return rotation_from_quaternion(torch.tensor(tuple(self.quaternion_wxyz), dtype=torch.float64)).numpy()

    def local(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the object frame in the box's own [m]."""
        return (points - np.asarray(self.center)) @ self.rotation

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Signed distance of points [m], negative inside."""
        beyond = np.abs(self.local(points)) - np.asarray(self.size) / 2
        return np.linalg.norm(beyond.clip(0.0), axis=-1) + beyond.max(-1).clip(max=0.0)


@dataclass(frozen=True)
class Sphere:
    """A ball.

    Attributes:
        center: its middle, object frame [m].
        radius: [m].

    Raises:
        ConfigError: a number is not finite, or the radius not above 0.
    """

    center: Numbers
    radius: float | int

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", numbers("sphere center", self.center, 3))
        if not np.isfinite(self.radius) or self.radius <= 0:
            raise ConfigError(f"sphere radius: {self.radius} m; valid: above 0")

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Signed distance of points [m], negative inside."""
        return np.linalg.norm(points - np.asarray(self.center), axis=-1) - self.radius


@dataclass(frozen=True, eq=False)
class NearPoints:
    """What lies near to points, as those that a mask of an image shows.

    Attributes:
        points: object frame [m].
        radius: how near [m].

    Raises:
        ConfigError: there is no finite point, or the radius is not above 0.
    """

    points: Float[np.ndarray, "points 3"]
    radius: float = 0.01
    _tree: KDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=float)
        points = points[np.isfinite(points).all(-1)] if points.ndim == 2 and points.shape[-1] == 3 else points[:0]
        if len(points) == 0:
            raise ConfigError("region points: none is finite; valid: rows of x, y, z in metres")
        if not np.isfinite(self.radius) or self.radius <= 0:
            raise ConfigError(f"region radius: {self.radius} m; valid: above 0")
        object.__setattr__(self, "_tree", KDTree(points))

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """How far points are from the nearest point, less the radius [m]; negative inside."""
        return self._tree.query(points)[0] - self.radius


Region = Box | Sphere | NearPoints
