"""Exact signed distances of primitives: oracles for the grids, and the shapes of hand links.

All are negative inside, in metres, in the primitive's own frame. Gradients are exact where the distance is
differentiable; on a centre or an axis, where it is not, they are zero (see `se3.safe_norm`), never NaN.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.se3 import safe_norm


def sphere_sdf(points: Float[Tensor, "*batch 3"], radius: float | Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
    """Distance [m] to a sphere about the origin."""
    return safe_norm(points) - radius


def capsule_sdf(
    points: Float[Tensor, "*batch 3"],
    radius: float | Float[Tensor, "*#batch"],
    half_length: float | Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch"]:
    """Distance [m] to a capsule along z: all points within `radius` of the segment |z| ≤ `half_length`."""
    z = points[..., 2]
    beyond = z.sign() * (z.abs() - half_length).clamp_min(0.0)
    return safe_norm(torch.cat([points[..., :2], beyond[..., None]], -1)) - radius


def box_sdf(points: Float[Tensor, "*batch 3"], half_extents: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch"]:
    """Distance [m] to an axis-aligned box about the origin."""
    return _corner_sdf(points.abs() - half_extents)


def cylinder_sdf(
    points: Float[Tensor, "*batch 3"],
    radius: float | Float[Tensor, "*#batch"],
    half_length: float | Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch"]:
    """Distance [m] to a flat-ended cylinder along z, |z| ≤ `half_length`."""
    return _corner_sdf(torch.stack([safe_norm(points[..., :2]) - radius, points[..., 2].abs() - half_length], -1))


def _corner_sdf(past: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Distance to a corner of `n` orthogonal faces from the signed distances past each face."""
    return safe_norm(past.clamp_min(0.0)) + past.amax(-1).clamp_max(0.0)
