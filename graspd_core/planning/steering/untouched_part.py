"""The part of an object outside a region, as an obstacle of the search: what touches it there is pushed off.

So the search itself puts all contacts into the region, with the loss and the gradient that it has for obstacles. The
distance is the greater of two, that to the object and that to the outside of the region: exact where one of them is the
nearer one's, else too small, and its gradient jumps where they are equal.
"""

from __future__ import annotations

import numpy as np
import torch

from graspd_core.mesh.sdf import GridSDF
from graspd_core.planning.steering.regions import Region
from graspd_core.scene.scene import Obstacle, Scene

# The untouched part begins so far outside the region, and links keep so far off its surface [m].
_BEGINS, _SKIN = 0.003, 0.004


def untouched_part(scene: Scene, region: Region) -> Obstacle:
    """The object outside `region`, on the nodes of the object's own grid."""
    sdf = scene.sdf
    field, spacing = sdf.field.double().cpu().numpy(), float(sdf.spacing)
    axes = [float(x) + spacing * np.arange(n) for x, n in zip(sdf.origin, field.shape[1:], strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    left = _BEGINS - region.distance(nodes.reshape(-1, 3)).reshape(nodes.shape[:-1])
    slope = np.array(np.gradient(left, spacing))
    slope = slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-9)
    phi = field[0] - _SKIN
    values = np.where(phi > left, np.concatenate([phi[None], field[1:]]), np.concatenate([left[None], slope]))
    return Obstacle(
        scene.object.mesh, GridSDF(torch.as_tensor(values).to(sdf.field), sdf.origin, sdf.spacing, sdf.half)
    )
