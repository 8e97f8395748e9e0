"""Signed distance on a grid: built exactly at the nodes, sampled by trilinear interpolation.

Negative inside, metres. Gradient: autograd of `sample_sdf` gives the derivative of the interpolated distance, which
jumps between cells; the returned normal is interpolated by itself from exact directions and is the smoother of the two.
Beyond the grid both are those of the distance to one extrapolated surface point. Building carries no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from graspd_core.geometry.embree import closest_points, make_surface
from graspd_core.geometry.topology import is_closed
from graspd_core.geometry.winding import winding_inside
from graspd_core.se3 import EPSILON, safe_norm
from graspd_core.types import TriangleMesh

# Nearer to the surface than this share of a cell, the direction to it is rounding noise: the face's normal is taken.
NEAR_SURFACE = 1e-3


@dataclass(frozen=True)
class GridSDF:
    """A cube of nodes about an object; every object gives the same shape, so compiled code is compiled once.

    Attributes:
        field: φ [m], then the unit normal ∇φ, at each node.
        origin: the first node [m].
        spacing: side of a cell [m], a scalar tensor.
    """

    field: Float[Tensor, "4 x y z"]
    origin: Float[Tensor, "3"]
    spacing: Float[Tensor, ""]

    def to(self, device: torch.device | str, dtype: torch.dtype) -> GridSDF:
        """The same grid elsewhere."""
        return GridSDF(*(x.to(device=device, dtype=dtype) for x in (self.field, self.origin, self.spacing)))


def build_sdf(
    mesh: TriangleMesh,
    *,
    resolution: int = 48,
    padding: float = 0.03,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> GridSDF:
    """Sample a mesh's signed distance on `resolution`³ nodes.

    The sign is the generalised winding number's, so open, overlapping, doubled and inverted surfaces are welcome; a
    surface that encloses nothing has φ ≥ 0 everywhere (`is_solid` tells). Distances are exact up to `padding` from the
    bounding box; in the corners of the cube beyond it they are those of `sample_sdf` outside a grid.

    Args:
        resolution: nodes along each axis.
        padding: free space kept around the longest axis [m], at most half the object's extent.
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    extent = float((high - low).max())
    padding = min(padding, extent / 2)
    spacing = (extent + 2 * padding) / (resolution - 1)
    offsets = (np.arange(resolution) - (resolution - 1) / 2) * spacing
    centre = (low + high) / 2
    # Queries are about the centre: Open3D counts in float32.
    centred = TriangleMesh(mesh.vertices - centre, mesh.faces)
    near = [np.flatnonzero(np.abs(offsets) <= half + padding + spacing) for half in (high - low) / 2]
    nodes = np.stack(np.meshgrid(*(offsets[i] for i in near), indexing="ij"), -1)
    closest, normals = closest_points(make_surface(centred), nodes.reshape(-1, 3))
    distance = np.linalg.norm(nodes - closest.reshape(nodes.shape), axis=-1)
    inside = _inside(centred, nodes, distance, spacing)
    spread = np.ix_(*(np.clip(np.arange(resolution) - i[0], 0, len(i) - 1) for i in near))
    grid = np.stack(np.meshgrid(offsets, offsets, offsets, indexing="ij"), -1)
    field = _field(
        grid, closest.reshape(nodes.shape)[spread], normals.reshape(nodes.shape)[spread], inside[spread], spacing
    )
    as_tensor = lambda x: torch.as_tensor(x, dtype=dtype, device=device)  # noqa: E731
    return GridSDF(as_tensor(field), as_tensor(centre + offsets[0]), as_tensor(spacing))


def sample_sdf(
    sdf: GridSDF, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Signed distance [m] and outward unit normal at points of the object frame, differentiable in the points.

    Outside the grid: with b the point clamped to the grid, c = b − φ(b) n(b) is taken for the closest surface point x
    has, which is continuous at the border and errs by less than the offset from the grid times the angle that the true
    direction turns along it.
    """
    half = 0.5 * (sdf.field.shape[1] - 1) * sdf.spacing
    unit = points / half - (sdf.origin / half + 1)
    clamped = unit.clamp(-1.0, 1.0)
    # grid_sample takes x for the last axis of its input.
    field = sdf.field[None].permute(0, 1, 4, 3, 2)
    sampled = grid_sample(field, clamped.reshape(1, 1, 1, -1, 3), align_corners=True, padding_mode="border")
    channels = sampled.reshape(4, -1)
    phi, gradient = channels[0].reshape(points.shape[:-1]), channels[1:].T.reshape(points.shape)
    # Inside the grid `from_surface` is the gradient times a positive number, so the two lengths cancel exactly
    # and no branch is needed. Any positive reach does where φ is not; a millimetre keeps float32 clear of zero.
    reach = phi.clamp_min(1e-3)
    from_surface = (unit - clamped) * half + reach[..., None] * gradient
    length = safe_norm(from_surface)
    return phi + length - reach * safe_norm(gradient), from_surface / length.clamp_min(EPSILON)[..., None]


def is_solid(sdf: GridSDF) -> bool:
    """Whether any node is inside; an open sheet, or a wall much thinner than a cell, has none."""
    return bool((sdf.field[0] < 0).any())


def _inside(
    mesh: TriangleMesh, nodes: Float[np.ndarray, "x y z 3"], distance: Float[np.ndarray, "x y z"], spacing: float
) -> Bool[np.ndarray, "x y z"]:
    """The nodes' side of the surface.

    Around a closed surface the winding number is constant wherever one can walk without crossing it, and two
    neighbouring nodes that are both half a cell away have none of it between them: one question answers for each such
    region. Through the holes of an open surface the number changes in mid-air, so every node is asked.
    """
    from scipy.ndimage import label

    if not is_closed(mesh):
        return winding_inside(mesh, nodes.reshape(-1, 3)).reshape(distance.shape)
    labelled: Any = label(distance > 0.51 * spacing)
    region, regions = labelled
    asked = region == 0
    _, first = np.unique(region, return_index=True)
    asked.ravel()[first] = True
    inside = np.zeros(distance.shape, dtype=bool)
    inside[asked] = winding_inside(mesh, nodes[asked])
    answers = np.zeros(regions + 1, dtype=bool)
    answers[region.ravel()[first]] = inside.ravel()[first]
    return np.where(region > 0, answers[region], inside)


def _field(grid, closest, normals, inside, spacing: float) -> Float[np.ndarray, "4 x y z"]:
    """φ and its unit gradient (x − c)/φ; on the surface the gradient is the face's normal, turned outwards."""
    offset = grid - closest
    distance = np.linalg.norm(offset, axis=-1)
    phi = np.where(inside, -distance, distance)
    far = distance > NEAR_SURFACE * spacing
    direction = offset / np.where(far, phi, 1.0)[..., None]
    # An inverted mesh shows in its far nodes: there the face's normal points against the direction.
    agree = np.sign((direction * normals).sum(-1)[far].sum()) or 1.0
    gradient = np.where(far[..., None], direction, agree * normals)
    return np.moveaxis(np.concatenate([phi[..., None], gradient], -1), -1, 0)
