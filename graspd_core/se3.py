"""Compute with rigid transforms on torch tensors. `T_a_b` maps coordinates in frame b to frame a. Quaternions are wxyz.

Gradients are exact everywhere except in `safe_norm`, whose gradient at zero is defined as zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

# Lengths below this count as zero. All of graspd uses this constant.
EPSILON = 1e-12


def perpendicular(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return a unit vector normal to a non-zero direction. Equal directions give equal results."""
    side = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return side / np.linalg.norm(side)


def safe_norm(x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Return the Euclidean norm over the last axis. The gradient at zero is zero, not NaN."""
    squared = (x * x).sum(-1)
    is_zero = squared <= EPSILON**2
    return torch.where(
        is_zero, torch.zeros_like(squared), torch.where(is_zero, torch.ones_like(squared), squared).sqrt()
    )


def normalize(x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """Return the vectors along the last axis scaled to unit length. A zero vector stays zero."""
    return x / safe_norm(x).clamp_min(EPSILON)[..., None]


def rotation_from_quaternion(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrices of wxyz quaternions of any non-zero length."""
    w, x, y, z = normalize(q).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternion_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Return unit wxyz quaternions with w ≥ 0 (Shepperd's method: the largest component is the divisor)."""
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        [
            torch.stack([squares[..., 0], wx, wy, wz], -1),
            torch.stack([wx, squares[..., 1], xy, xz], -1),
            torch.stack([wy, xy, squares[..., 2], yz], -1),
            torch.stack([wz, xz, yz, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = normalize(candidates.gather(-2, best).squeeze(-2))
    return torch.where(q[..., :1] < 0, -q, q)


def rotation_from_axis_angle(
    axis: Float[Tensor, "*#batch 3"], angle: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrices about unit axes by angles [rad]."""
    half = 0.5 * angle[..., None]
    return rotation_from_quaternion(torch.cat([half.cos(), half.sin() * axis], -1))


def axis_rotation(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix about a unit axis by an angle [rad]."""
    turn = torch.tensor(angle, dtype=torch.float64)
    return rotation_from_axis_angle(torch.as_tensor(axis, dtype=torch.float64), turn).numpy()


def quaternion_between(
    source: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], *, around: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4"]:
    """Return the shortest rotation (wxyz) between unit vectors. Opposite vectors get half a turn about `around`."""
    quaternion = np.array([1.0 + source @ target, *np.cross(source, target)])
    length = np.linalg.norm(quaternion)
    return quaternion / length if length > EPSILON else np.array([0.0, *around])


@dataclass(frozen=True, eq=False)
class SE3:
    """Rigid transforms `T_a_b`, one for each entry of the batch.

    Attributes:
        rotation: rotation `R_a_b` from frame b to frame a.
        translation: origin of frame b in frame a [m].
    """

    rotation: Float[Tensor, "*batch 3 3"]
    translation: Float[Tensor, "*batch 3"]

    def __getitem__(self, index: Any) -> SE3:
        """Return the transforms at an index of the batch, e.g. `poses[:, links]`."""
        return SE3(self.rotation[index], self.translation[index])

    def apply(self, points: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """Map points of frame b to frame a."""
        return points @ self.rotation.transpose(-1, -2) + self.translation[..., None, :]

    def apply_inverse(self, points: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """Map points of frame a to frame b."""
        return (points - self.translation[..., None, :]) @ self.rotation

    def compose(self, other: SE3) -> SE3:
        """Return `T_a_c`, the product of `T_a_b` and `other`, which is `T_b_c`. The batch of `other` may be larger."""
        turned = (self.rotation @ other.translation[..., None]).squeeze(-1)
        return SE3(self.rotation @ other.rotation, turned + self.translation)


def random_rotations(count: int, generator: torch.Generator, dtype: torch.dtype) -> Float[Tensor, "count 3 3"]:
    """Draw uniform random rotations (normalised Gaussian quaternions)."""
    return rotation_from_quaternion(torch.randn(count, 4, generator=generator, dtype=dtype))


def aligning_rotation(source: Float[Tensor, "3"], targets: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """Return rotations that turn the unit vector `source` onto each unit vector of `targets`, with arbitrary roll."""
    # Two Householder reflections make a rotation. The first maps `source` to `middle`, the second to the target.
    helper = torch.eye(3, dtype=targets.dtype)[source.abs().argmin()]
    middle = torch.linalg.cross(source, helper)
    middle = middle / middle.norm()
    return reflection_onto(middle.expand_as(targets), targets) @ reflection_onto(
        source.expand_as(targets), middle.expand_as(targets)
    )


def reflection_onto(a: Float[Tensor, "batch 3"], b: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """Return Householder reflections that swap the unit vectors a and b. If a equals b, a stays fixed."""
    v = a - b
    same = v.norm(dim=-1, keepdim=True) < 1e-9
    # If a equals b, every mirror plane that contains the vector a leaves it fixed.
    fallback = torch.linalg.cross(a, torch.eye(3, dtype=a.dtype)[a.abs().argmin(-1)])
    v = torch.where(same, fallback, v)
    v = v / v.norm(dim=-1, keepdim=True)
    return torch.eye(3, dtype=a.dtype) - 2 * v[..., :, None] * v[..., None, :]
