"""Capsules: the solids that an arm and its hand are held against each other, the support and the obstacles as.

A capsule is all that is nearer to a segment than its radius, so that every distance is one of segments: exact between
capsules and to a plane. Any other solid gets a capsule about it, which is larger than the solid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.hands.model import Primitive
from graspd_core.se3 import SE3

# A squared length below this is a point's [m²].
_POINT = 1e-12


@dataclass(frozen=True)
class Capsules:
    """Some capsules, each fixed in a link.

    Attributes:
        link: number of the link of each.
        start, end: the ends of their segments, link frame [m].
        radius: [m].
    """

    link: Int[np.ndarray, "n"]
    start: Float[np.ndarray, "n 3"]
    end: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]


def capsules_about(primitives: Sequence[Primitive]) -> Capsules:
    """A capsule about each solid; spheres and capsules as they are."""
    rows = [_about(primitive) for primitive in primitives]
    turned = [
        [primitive.rotation @ point + primitive.translation for point in row[:2]]
        for primitive, row in zip(primitives, rows, strict=True)
    ]
    ends = np.array(turned, dtype=float).reshape(-1, 2, 3)
    link = np.array([primitive.link for primitive in primitives], dtype=np.int64)
    return Capsules(link, ends[:, 0], ends[:, 1], np.array([row[2] for row in rows], dtype=float))


def _about(primitive: Primitive) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Ends and radius of a capsule about a solid, in the solid's frame."""
    size, up = primitive.size, np.array([0.0, 0.0, 1.0])
    if primitive.kind == "sphere":
        return np.zeros(3), np.zeros(3), size[0]
    if primitive.kind in ("capsule", "cylinder"):
        return -size[1] * up, size[1] * up, size[0]
    corners = primitive.vertices
    if primitive.kind == "box":
        corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3) * np.asarray(size)
    return _about_points(corners)


def _about_points(corners: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """A capsule about points, along the direction in which they spread most, as thin and then as short as can be."""
    center = 0.5 * (corners.min(0) + corners.max(0))
    local = corners - center
    axis = np.linalg.svd(local, full_matrices=False)[2][0]
    along = local @ axis
    away = np.linalg.norm(local - np.outer(along, axis), axis=1)
    radius = float(away.max())
    # The caps reach past the ends; a point beside the axis needs them to reach less far than one on it.
    slack = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    low, high = float((along + slack).min()), float((along - slack).max())
    if low > high:
        low = high = 0.5 * (low + high)
    return center + low * axis, center + high * axis, radius


def placed(
    capsules: Capsules, links: SE3
) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n 3"], Float[Tensor, "n"]]:
    """Ends [m] and radii of capsules at link poses, in the frame of the poses."""
    poses = links[:, torch.as_tensor(capsules.link)]
    ends = [torch.as_tensor(points).to(poses.translation) for points in (capsules.start, capsules.end)]
    start, end = ((poses.rotation @ points[..., None]).squeeze(-1) + poses.translation for points in ends)
    return start, end, torch.as_tensor(capsules.radius).to(poses.translation)


def segment_distance(
    a: Float[Tensor, "*#batch 3"],
    b: Float[Tensor, "*#batch 3"],
    c: Float[Tensor, "*#batch 3"],
    d: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch"]:
    """Distance [m] of the segments from a to b and from c to d, either of which may be a point.

    C. Ericson, Real-Time Collision Detection, 5.1.9: the nearest points of the lines, each brought back into its
    segment, the other then found anew.
    """
    along, other, between = b - a, d - c, a - c
    aa, ee = (along * along).sum(-1), (other * other).sum(-1)
    f, cc, bb = (other * between).sum(-1), (along * between).sum(-1), (along * other).sum(-1)
    safe_a, safe_e = aa.clamp_min(_POINT), ee.clamp_min(_POINT)
    denominator = aa * ee - bb * bb
    # Of parallel segments any point will do for a start.
    apart = denominator > 1e-9 * aa * ee
    s = torch.where(apart, (bb * f - cc * ee) / torch.where(apart, denominator, 1.0), 0.0).clamp(0.0, 1.0)
    t = torch.where(ee > _POINT, ((bb * s + f) / safe_e), 0.0).clamp(0.0, 1.0)
    s = torch.where(aa > _POINT, ((bb * t - cc) / safe_a), 0.0).clamp(0.0, 1.0)
    return (between + s[..., None] * along - t[..., None] * other).norm(dim=-1)
