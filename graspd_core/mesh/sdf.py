"""Signed distance on a grid: exact at the nodes near the surface, sampled by trilinear interpolation.

Negative inside, metres. Gradient: autograd of `sample_sdf` gives the derivative of the interpolated distance, which
jumps between cells. The returned normal is interpolated from exact directions and is smoother. Beyond the grid both are
those of the distance to one extrapolated surface point. Building carries no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from graspd_core.mesh.surface_queries import Surface, closest_points, make_surface, winding_inside
from graspd_core.mesh.topology import is_closed
from graspd_core.se3 import EPSILON, safe_norm
from graspd_core.types import TriangleMesh

# A vector, and a length, of each node [m].
_Vectors, _Lengths = Float[np.ndarray, "3 x y z"], Float[np.ndarray, "x y z"]

# Nearer to the surface than this share of a cell, the direction to it is rounding noise: the face's normal is taken.
NEAR_SURFACE = 1e-3

# Free space about the object that the grid covers [m]. Beyond it distances are extrapolated, off hollow things too long
# by half a millimetre in the mean at 5 cm and by 1.3 at 8, by 10 and 20 at worst. Nothing touches there, and every cell
# that is saved makes those at the surface finer.
PADDING = 0.015

# Nodes up to this many cells from the surface have the exact distance: all eight nodes of every cell that it crosses.
BAND = 3**0.5
# Nodes a side of a block, whose middle node is exact. Sweeps in which nodes look at their neighbours' closest points.
_BLOCK, _SWEEPS = 3, 3


@dataclass(frozen=True)
class GridSDF:
    """A box of nodes about an object, as many along each axis as the object is long there.

    Attributes:
        field: φ [m], then the unit normal ∇φ, at each node.
        origin: the first node [m].
        spacing: side of a cell, which is a cube [m], a scalar tensor.
        half: half of the box's sides [m], stored so that no count of nodes goes to the GPU at every sample.
    """

    field: Float[Tensor, "4 x y z"]
    origin: Float[Tensor, "3"]
    spacing: Float[Tensor, ""]
    half: Float[Tensor, "3"]

    def to(self, device: torch.device | str, dtype: torch.dtype) -> GridSDF:
        """Return the same grid on another device and in another type."""
        return GridSDF(*(x.to(device=device, dtype=dtype) for x in vars(self).values()))


@dataclass(frozen=True)
class GridLayout:
    """Where the nodes of a grid lie.

    Attributes:
        counts: nodes along each axis.
        origin: the first node [m].
        spacing: side of a cell [m].
    """

    counts: tuple[int, int, int]
    origin: Float[np.ndarray, "3"]
    spacing: float


def build_sdf(
    mesh: TriangleMesh,
    *,
    resolution: int = 48,
    padding: float = PADDING,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> GridSDF:
    """Sample a mesh's signed distance on at most `resolution`³ nodes, laid out by `grid_layout`.

    The sign is that of the generalised winding number, so open, overlapping, doubled and inverted surfaces are welcome.
    A surface that encloses nothing has φ ≥ 0 everywhere (`is_solid` tells). Distances up to √3 cells (`BAND`) are
    exact. Beyond, a node points to a surface point that is not always its closest. There |φ| is never too small, and
    too large by at most half a cell, by 0.03 in the mean (tested on the shapes, ten scans: 0.43 and 0.02).

    Args:
        resolution: nodes along each side of a cube. Another object has as many in all, and finer cells.
        padding: free space kept around the bounding box [m], at most half the object's extent.
    """
    layout = grid_layout(mesh, resolution, padding)
    centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    # About the centre: far from the origin, differences lose digits.
    centred = TriangleMesh(mesh.vertices - centre, mesh.faces)
    axes = [x + layout.spacing * np.arange(n) for x, n in zip(layout.origin - centre, layout.counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"))
    closest, normals = _closest_to_nodes(make_surface(centred), nodes, layout.spacing)
    offset = nodes - closest
    inside = _inside(centred, nodes, _length(offset), layout.spacing)
    field = _field(offset, normals, inside, layout.spacing)
    half = (np.array(layout.counts) - 1) * layout.spacing / 2
    return GridSDF(
        *(torch.as_tensor(x, dtype=dtype, device=device) for x in (field, layout.origin, layout.spacing, half))
    )


def grid_layout(mesh: TriangleMesh, resolution: int, padding: float = PADDING) -> GridLayout:
    """Return the finest cubic cells that cover the padded bounding box with at most `resolution`³ nodes."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    extent = float((high - low).max())
    sides = high - low + 2 * min(padding, extent / 2)
    # The last allowance keeps a side that is a whole number of cells from getting one more by rounding.
    count = lambda spacing: np.ceil(sides / spacing - 1e-9).astype(int) + 1  # noqa: E731
    fine, spacing = 0.0, float(sides.max())
    # Between these the number of nodes falls in steps: halving finds where it comes to fit, to the last digit.
    while (middle := (fine + spacing) / 2) not in (fine, spacing):
        fine, spacing = (fine, middle) if count(middle).prod() <= resolution**3 else (middle, spacing)
    counts = count(spacing)
    x, y, z = counts.tolist()
    return GridLayout((x, y, z), (low + high - (counts - 1) * spacing) / 2, spacing)


def sample_sdf(
    sdf: GridSDF, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Return signed distance [m] and outward unit normal at points of the object frame, differentiable in the points.

    Outside the grid, with b the point clamped to the grid, c = b − φ(b) n(b) replaces the closest surface point. This
    is continuous at the border.
    """
    half = sdf.half
    unit = points / half - (sdf.origin / half + 1)
    clamped = unit.clamp(-1.0, 1.0)
    # grid_sample takes x for the last axis of its input.
    field = sdf.field[None].permute(0, 1, 4, 3, 2)
    sampled = grid_sample(field, clamped.reshape(1, 1, 1, -1, 3), align_corners=True, padding_mode="border")
    channels = sampled.reshape(4, -1)
    phi, gradient = channels[0].reshape(points.shape[:-1]), channels[1:].T.reshape(points.shape)
    # Inside the grid `from_surface` is the gradient times a positive number, so the two lengths cancel exactly
    # and no branch is needed. Any positive reach does where φ is not. A millimetre keeps float32 clear of zero.
    reach = phi.clamp_min(1e-3)
    from_surface = (unit - clamped) * half + reach[..., None] * gradient
    length = safe_norm(from_surface)
    return phi + length - reach * safe_norm(gradient), from_surface / length.clamp_min(EPSILON)[..., None]


def is_solid(sdf: GridSDF) -> bool:
    """Tell whether any node is inside. An open sheet, or a wall much thinner than a cell, has none."""
    return bool((sdf.field[0] < 0).any())


def _closest_to_nodes(surface: Surface, nodes: _Vectors, spacing: float) -> tuple[_Vectors, _Vectors]:
    """Return surface points, exactly the closest ones within `BAND`, and the normals of their faces, zero beyond it.

    The middle node of each block is exact too. Its distance less the way to a node is a lower bound of the node's
    distance, which tells what can lie in the band. The other nodes start with the point of their middle node.
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
    # Nothing is nearer than the exact points, not by rounding either.
    squared[near] = 0.0
    for _ in range(_SWEEPS):
        _sweep(nodes, closest, squared)
    return closest, normals


def _sweep(nodes: _Vectors, closest: _Vectors, squared: _Lengths) -> None:
    """Give each node, in place, the point of a neighbour that is nearer to it, along each axis and back."""
    for axis in range(3):
        # Views with this axis first: what is written to them is written to the arrays.
        at, to, best = np.moveaxis(nodes, axis + 1, 1), np.moveaxis(closest, axis + 1, 1), np.moveaxis(squared, axis, 0)
        for here, there in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
            offered = to[:, there]
            distance = ((at[:, here] - offered) ** 2).sum(0)
            nearer = distance < best[here]
            # `offered` and the target overlap: fancy indexing copies what is read before anything is written.
            to[:, here][:, nearer] = offered[:, nearer]
            best[here][nearer] = distance[nearer]


def _inside(mesh: TriangleMesh, nodes: _Vectors, distance: _Lengths, spacing: float) -> Bool[np.ndarray, "x y z"]:
    """Return which nodes lie inside.

    Around a closed surface the winding number is constant in each region without surface. Two neighbouring nodes that
    are both half a cell away have no surface between them, so one query answers for the region. Around an open surface
    the number changes in mid-air, so every node is queried.
    """
    from scipy.ndimage import label

    if not is_closed(mesh):
        return winding_inside(mesh, nodes.reshape(3, -1).T).reshape(distance.shape)
    labelled: Any = label(distance > 0.51 * spacing)
    region, regions = labelled
    asked = region == 0
    _, first = np.unique(region, return_index=True)
    asked.ravel()[first] = True
    inside = np.zeros(distance.shape, dtype=bool)
    inside[asked] = winding_inside(mesh, nodes[:, asked].T)
    answers = np.zeros(regions + 1, dtype=bool)
    answers[region.ravel()[first]] = inside.ravel()[first]
    return np.where(region > 0, answers[region], inside)


def _field(
    offset: _Vectors, normals: _Vectors, inside: Bool[np.ndarray, "x y z"], spacing: float
) -> Float[np.ndarray, "4 x y z"]:
    """Return φ and its unit gradient (x − c)/φ. On the surface the gradient is the face's normal, turned outwards."""
    distance = _length(offset)
    phi = np.where(inside, -distance, distance)
    far = distance > NEAR_SURFACE * spacing
    direction = offset / np.where(far, phi, 1.0)
    # An inverted mesh shows beside its surface: there the face's normal points against the direction.
    agree = np.sign((direction * normals).sum(0)[far].sum()) or 1.0
    return np.concatenate([phi[None], np.where(far, direction, agree * normals)])


def _length(vectors: Float[np.ndarray, "3 *grid"]) -> Float[np.ndarray, "*grid"]:
    return np.sqrt((vectors**2).sum(0))
