"""Signed distance field on a grid: exact at nodes near the surface, interpolated trilinearly between nodes.

Distances are in metres, negative inside. Autograd of `sample_sdf` gives the derivative of the interpolated distance,
which jumps between cells. The returned normal is interpolated from exact directions and is smoother. Beyond the grid,
distance and normal are extrapolated (`sample_sdf`). No gradient flows through `build_sdf`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import label
from torch import Tensor
from torch.nn.functional import grid_sample

from graspd_core.mesh.surface_queries import Surface, closest_points, make_surface, winding_inside
from graspd_core.mesh.topology import is_closed
from graspd_core.se3 import EPSILON, safe_norm
from graspd_core.types import TriangleMesh

# One vector for each node, and one length for each node [m].
_Vectors, _Lengths = Float[np.ndarray, "3 x y z"], Float[np.ndarray, "x y z"]

# Nearer to the surface than this fraction of a cell, the direction to the surface is noise. The face's normal is used.
NEAR_SURFACE = 1e-3

# Free space around the object that the grid covers [m]. Farther away, distances are extrapolated. Near hollow objects,
# they are too long by 0.5 mm on average at 5 cm (10 mm at worst), and by 1.3 mm at 8 cm (20 mm at worst). No contact
# happens there, and fewer cells outside mean finer cells at the surface.
PADDING = 0.015

# Nodes within this many cells of the surface are exact. This includes all eight nodes of each crossed cell.
BAND = 3**0.5
# Nodes per side of a block (its middle node is exact), and sweeps in which nodes try their neighbours' closest points.
_BLOCK, _SWEEPS = 3, 3


@dataclass(frozen=True)
class GridSDF:
    """Signed distances and normals on a box-shaped grid of nodes around an object, in the object frame.

    Attributes:
        field: signed distance φ [m] and unit normal ∇φ at each node.
        origin: position of the first node [m].
        spacing: side of a cubic cell [m], a scalar tensor.
        half: half the side lengths of the box [m]. They are stored, so that sampling sends no node counts to the GPU.
    """

    field: Float[Tensor, "4 x y z"]
    origin: Float[Tensor, "3"]
    spacing: Float[Tensor, ""]
    half: Float[Tensor, "3"]

    def to(self, device: torch.device | str, dtype: torch.dtype) -> GridSDF:
        """Return the grid on another device and in another data type."""
        return GridSDF(*(x.to(device=device, dtype=dtype) for x in vars(self).values()))


def build_sdf(
    mesh: TriangleMesh, *, resolution: int = 48, padding: float = PADDING, dtype: torch.dtype = torch.float32
) -> GridSDF:
    """Sample a mesh's signed distance on at most `resolution`³ nodes, laid out by `grid_layout`.

    The generalised winding number gives the sign, so open, overlapping, doubled and inverted surfaces are allowed. If a
    surface encloses nothing, φ ≥ 0 everywhere (see `is_solid`). Distances up to √3 cells (`BAND`) are exact. Farther
    away, a node may use a surface point that is not the closest, so |φ| can be too large but never too small. On the
    built-in shapes, the error is at most 0.5 cells, 0.03 on average. On ten scans, it is at most 0.43, 0.02 on average.

    Args:
        resolution: nodes per side for a cubic object. Other objects get almost as many nodes in total, in finer cells.
        padding: free space around the bounding box [m], limited to half the object's extent.
    """
    counts, origin, spacing = grid_layout(mesh, resolution, padding)
    centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    # The mesh is moved to its centre, because differences lose digits far from the origin.
    centred = TriangleMesh(mesh.vertices - centre, mesh.faces)
    axes = [x + spacing * np.arange(n) for x, n in zip(origin - centre, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"))
    closest, normals = _closest_to_nodes(make_surface(centred), nodes, spacing)
    offset = nodes - closest
    inside = _inside(centred, nodes, _length(offset), spacing)
    field = _field(offset, normals, inside, spacing)
    half = (np.array(counts) - 1) * spacing / 2
    return GridSDF(*(torch.as_tensor(x, dtype=dtype) for x in (field, origin, spacing, half)))


def grid_layout(
    mesh: TriangleMesh, resolution: int, padding: float = PADDING
) -> tuple[tuple[int, int, int], Float[np.ndarray, "3"], float]:
    """Return the finest grid of cubic cells that covers the padded bounding box with at most `resolution`³ nodes.

    Return the number of nodes along each axis, the position of the first node [m], and the side of a cell [m].
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    extent = float((high - low).max())
    sides = high - low + 2 * min(padding, extent / 2)
    # The allowance of 1e-9 keeps rounding from adding a cell to a side that is a whole number of cells long.
    count = lambda spacing: np.ceil(sides / spacing - 1e-9).astype(int) + 1  # noqa: E731
    fine, spacing = 0.0, float(sides.max())
    # The number of nodes falls in steps as the spacing grows. Bisection finds the least spacing that fits.
    while (middle := (fine + spacing) / 2) not in (fine, spacing):
        fine, spacing = (fine, middle) if count(middle).prod() <= resolution**3 else (middle, spacing)
    counts = count(spacing)
    x, y, z = counts.tolist()
    return (x, y, z), (low + high - (counts - 1) * spacing) / 2, spacing


def sample_sdf(
    sdf: GridSDF, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Return signed distance [m] and outward unit normal at points [m] in the object frame. Both are differentiable.

    Outside the grid, c = b − φ(b) n(b) replaces the closest surface point, where b is the point clamped to the grid. So
    distance and normal are continuous at the border.
    """
    half = sdf.half
    unit = points / half - (sdf.origin / half + 1).to(points)
    clamped = unit.clamp(-1.0, 1.0)
    channels = interpolate(sdf.field, clamped.reshape(-1, 3))
    phi, gradient = channels[0].reshape(points.shape[:-1]), channels[1:].T.reshape(points.shape)
    # Inside the grid `from_surface` is the gradient times a positive number, so the two lengths cancel exactly
    # and no branch is needed. If φ is not positive, any positive `reach` works. 1 mm keeps float32 clear of zero.
    reach = phi.clamp_min(1e-3)
    from_surface = (unit - clamped) * half + reach[..., None] * gradient
    length = safe_norm(from_surface)
    return phi + length - reach * safe_norm(gradient), from_surface / length.clamp_min(EPSILON)[..., None]


def interpolate(
    field: Float[Tensor, "channels x y z"], places: Float[Tensor, "points 3"]
) -> Float[Tensor, "channels points"]:
    """Interpolate node values linearly at places from -1 to 1 along each axis. Beyond, use the value at the border."""
    # grid_sample takes x for the last axis of its input.
    swapped = field[None].permute(0, 1, 4, 3, 2)
    return grid_sample(swapped, places[None, None, None], align_corners=True, padding_mode="border")[0, :, 0, 0]


def is_solid(sdf: GridSDF) -> bool:
    """Return True if a node lies inside the object. Open sheets, and walls far thinner than a cell, contain no node."""
    return bool((sdf.field[0] < 0).any())


def _closest_to_nodes(surface: Surface, nodes: _Vectors, spacing: float) -> tuple[_Vectors, _Vectors]:
    """Return a surface point and its face normal for each node. Up to `BAND` cells away, the point is the closest.

    In each block of nodes, the middle node's exact distance gives lower bounds for the other nodes. A node with a bound
    above `BAND` cells gets a zero normal, and the middle node's point or a neighbour's point (`_sweep`).
    """
    counts = nodes.shape[1:]
    middles = [np.minimum(np.arange(_BLOCK // 2, n + _BLOCK // 2, _BLOCK), n - 1) for n in counts]
    middle_of = np.ix_(*(np.arange(n) // _BLOCK for n in counts))
    lattice = nodes[:, *np.ix_(*middles)]
    found, _ = closest_points(surface, lattice.reshape(3, -1).T)
    found = found.T.reshape(lattice.shape)
    bound = _length(lattice - found)[middle_of] - _length(nodes - lattice[:, *middle_of])
    near = bound <= BAND * spacing
    closest = found[:, *middle_of]
    normals = np.zeros_like(closest)
    exact, faces = closest_points(surface, nodes[:, near].T)
    closest[:, near], normals[:, near] = exact.T, faces.T
    squared = ((nodes - closest) ** 2).sum(0)
    # Sweeps must not replace an exact point, not even by rounding.
    squared[near] = 0.0
    for _ in range(_SWEEPS):
        _sweep(nodes, closest, squared)
    return closest, normals


def _sweep(nodes: _Vectors, closest: _Vectors, squared: _Lengths) -> None:
    """Give each node a neighbour's surface point if that point is nearer. Change `closest` and `squared` in place."""
    for axis in range(3):
        # All three are NumPy views with this axis first, so writing to them changes the arrays.
        at, to, best = np.moveaxis(nodes, axis + 1, 1), np.moveaxis(closest, axis + 1, 1), np.moveaxis(squared, axis, 0)
        for here, there in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
            offered = to[:, there]
            distance = ((at[:, here] - offered) ** 2).sum(0)
            nearer = distance < best[here]
            # `offered` and the target overlap, but fancy indexing copies all values before it writes any.
            to[:, here][:, nearer] = offered[:, nearer]
            best[here][nearer] = distance[nearer]


def _inside(mesh: TriangleMesh, nodes: _Vectors, distance: _Lengths, spacing: float) -> Bool[np.ndarray, "x y z"]:
    """Return which nodes lie inside the mesh.

    Around a closed surface, the winding number is constant in each region without surface. Between two neighbouring
    nodes that are both over half a cell from the surface, there is no surface. So one query answers for a region.
    Around an open surface, the winding number changes in free space too, so every node is queried.
    """
    if not is_closed(mesh):
        return winding_inside(mesh, nodes.reshape(3, -1).T).reshape(distance.shape)
    labelled: Any = label(distance > 0.51 * spacing)
    region, regions = labelled
    queried = region == 0
    _, first = np.unique(region, return_index=True)
    queried.ravel()[first] = True
    inside = np.zeros(distance.shape, dtype=bool)
    inside[queried] = winding_inside(mesh, nodes[:, queried].T)
    answers = np.zeros(regions + 1, dtype=bool)
    answers[region.ravel()[first]] = inside.ravel()[first]
    return np.where(region > 0, answers[region], inside)


def _field(
    offset: _Vectors, normals: _Vectors, inside: Bool[np.ndarray, "x y z"], spacing: float
) -> Float[np.ndarray, "4 x y z"]:
    """Return the signed distance φ [m] and its unit gradient at each node.

    `offset` is the node minus its nearest surface point. The gradient is offset/φ, or at the surface the face's normal.
    """
    distance = _length(offset)
    phi = np.where(inside, -distance, distance)
    far = distance > NEAR_SURFACE * spacing
    direction = offset / np.where(far, phi, 1.0)
    # In an inverted mesh, most face normals point against the gradient. The nodes away from the surface decide.
    agree = np.sign((direction * normals).sum(0)[far].sum()) or 1.0
    return np.concatenate([phi[None], np.where(far, direction, agree * normals)])


def _length(vectors: Float[np.ndarray, "3 *grid"]) -> Float[np.ndarray, "*grid"]:
    return np.sqrt((vectors**2).sum(0))
