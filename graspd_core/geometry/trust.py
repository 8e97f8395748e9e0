"""How far the object's surface is known, as a grid beside its signed distance: 1 where it was seen, 0 where guessed."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import grid_sample

from graspd_core.geometry.sdf import GridSDF


def trust_grid(
    vertices: Float[np.ndarray, "vertices 3"], trust: Float[np.ndarray, "vertices"], sdf: GridSDF
) -> Float[Tensor, "x y z"]:
    """The trust of the vertex nearest to each node of the distance grid."""
    axes = [float(first) + float(sdf.spacing) * np.arange(sdf.field.shape[1]) for first in sdf.origin]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    nearest = KDTree(vertices).query(nodes.reshape(-1, 3))[1]
    return torch.as_tensor(trust[nearest].reshape(nodes.shape[:3])).to(sdf.field)


def sample_trust(
    grid: Float[Tensor, "x y z"], sdf: GridSDF, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points"]:
    """Trilinear; beyond the grid that of its border. Differentiable in the points."""
    half = 0.5 * (grid.shape[0] - 1) * sdf.spacing
    unit = points / half - (sdf.origin / half + 1)
    # grid_sample takes x for the last axis of its input.
    field = grid.permute(2, 1, 0)[None, None]
    sampled = grid_sample(field, unit.reshape(1, 1, 1, -1, 3), align_corners=True, padding_mode="border")
    return sampled.reshape(points.shape[:-1])
