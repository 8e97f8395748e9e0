"""The scene that a run plans on: about its object, on the grid that the settings ask for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.errors import ConfigError
from graspd_core.mesh.sdf import GridSDF, grid_layout
from graspd_core.scene.confidence import sample_confidence
from graspd_core.scene.far_objects import moved_plane, moved_sdf
from graspd_core.scene.scene import Scene, moved_obstacle, near_object, object_sdf


def planning_scene(scene: Scene, resolution: int) -> tuple[Scene, Float[np.ndarray, "3"]]:
    """The scene as it is planned on, and where its origin lies in the scene given [m].

    The origin is another one for an object farther from it than a hundred times its size: float32 could not tell a
    contact there from a gap. A distance grid of another resolution is built anew. Where neither is so, this is the
    scene itself.

    Raises:
        ConfigError: no such resolution.
    """
    if not 8 <= resolution <= 256:
        raise ConfigError(f"resolution: {resolution} nodes; valid: 8 to 256")
    model, far = near_object(scene.object)
    as_asked = tuple(scene.sdf.field.shape[1:]) == grid_layout(model.mesh, resolution).counts
    if as_asked and not far.any():
        return scene, far
    sdf = object_sdf(model, resolution).to(scene.sdf.field.device, scene.sdf.field.dtype)
    confidence = scene.confidence
    if confidence is not None and not as_asked:
        confidence = sample_confidence(confidence, moved_sdf(scene.sdf, -far), _nodes(sdf)).reshape(sdf.field.shape[1:])
    support = scene.support and moved_plane(scene.support, -far)
    obstacles = tuple(moved_obstacle(obstacle, -far) for obstacle in scene.obstacles)
    evidence = scene.evidence and replace(scene.evidence, origin=scene.evidence.origin - far)
    changed = {"support": support, "obstacles": obstacles, "confidence": confidence, "evidence": evidence}
    return replace(scene, object=model, sdf=sdf, **changed), far


def _nodes(sdf: GridSDF) -> Float[Tensor, "x yz 3"]:
    x, y, z = sdf.field.shape[1:]
    index = torch.cartesian_prod(*(torch.arange(n) for n in (x, y, z))).to(sdf.field)
    return (sdf.origin + sdf.spacing * index).reshape(x, y * z, 3)
