"""How far the object's surface is known, as a grid beside its signed distance: 1 where it was seen, 0 where guessed."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import grid_sample

from graspd_core.mesh.sdf import GridSDF

# Cells from the surface within which a node looks for its vertex; every surface has nodes this near.
_NEAR_SURFACE_CELLS = 2.0


def confidence_grid(
    vertices: Float[np.ndarray, "vertices 3"], confidence: Float[np.ndarray, "vertices"], sdf: GridSDF
) -> Float[Tensor, "x y z"]:
    """The confidence in the vertex nearest to each node by the surface; elsewhere, that of the nearest such node."""
    spacing = float(sdf.spacing)
    near = sdf.field[0].abs().cpu().numpy() < _NEAR_SURFACE_CELLS * spacing
    nodes = sdf.origin.cpu().numpy() + spacing * np.argwhere(near)
    grid = np.zeros(near.shape)
    grid[near] = confidence[KDTree(vertices).query(nodes)[1]]
    # Far from the vertices a search among them costs a second; a step on the grid costs nothing.
    source: Any = distance_transform_edt(~near, return_distances=False, return_indices=True)
    return torch.as_tensor(grid[tuple(source)]).to(sdf.field)


def sample_confidence(
    grid: Float[Tensor, "x y z"], sdf: GridSDF, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points"]:
    """Trilinear; beyond the grid that of its border. Differentiable in the points."""
    unit = points / sdf.half - (sdf.origin / sdf.half + 1)
    # grid_sample takes x for the last axis of its input.
    field = grid.permute(2, 1, 0)[None, None]
    sampled = grid_sample(field, unit.reshape(1, 1, 1, -1, 3), align_corners=True, padding_mode="border")
    return sampled.reshape(points.shape[:-1])
