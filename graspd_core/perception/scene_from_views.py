"""From what depth cameras saw to a scene: the object cut out and made whole, and what stands in the hand's way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from graspd_core.config import SceneConfig
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.obstacles import make_obstacles
from graspd_core.perception.reconstruct.merge_views import Evidence
from graspd_core.perception.reconstruct.reconstruct import Reconstruction, reconstruct
from graspd_core.perception.scene import ObjectModel, Obstacle, Scene, build_scene, refuse_numbers
from graspd_core.perception.segment.segment import Segmentation, segment
from graspd_core.perception.segment.target_selection import Target
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import Plane, TriangleMesh


def scene_from_views(
    views: Sequence[PointCloud],
    *,
    target: Target | None = None,
    alone: bool = False,
    settings: SceneConfig | None = None,
    mass: float | None = None,
    friction: float = 0.6,
    source: str = "cloud",
    resolution: int = 48,
    device: torch.device | str = "cpu",
    ahead: Callable[[ObjectModel, Evidence], None] | None = None,
) -> Scene:
    """The scene that one or several views show, in their common frame; what was guessed is in the object's warnings.

    Args:
        views: what each camera saw [m]; points may be NaN.
        target: which of the things seen is meant; without it, the one nearest the first view's axis.
        alone: the views show the object and nothing else, so that all they show is taken.
        settings: of segmentation, reconstruction and obstacles.
        mass: [kg]; None assumes the heavy end of what the volume allows, and warns of it.
        friction: Coulomb coefficient between hand and object.
        source: name of the views, for messages.
        resolution: the distance grid has at most the cube of it in nodes.
        ahead: called as soon as the object is known, before its distance grid is built, to begin what does without.

    Raises:
        CloudError: the views show no usable object; NoObjectError where what was asked for is not in them.
        MeshError: the object they show is too small or too large, or a number is out of range.
    """
    started = time.perf_counter()
    refuse_numbers(source, mass=mass, friction=friction, resolution=resolution)
    settings = settings or SceneConfig()
    # The child, where there is one, is free for other work while the distance grid is built here.
    whole, support, obstacles, warnings = run_isolated(_reconstructed, views, target, alone, settings)
    scene = build_scene(
        whole.mesh,
        source=source,
        mass=mass,
        friction=friction,
        resolution=resolution,
        device=device,
        warnings=warnings + whole.warnings,
        started=started,
        support=support,
        obstacles=obstacles,
        confidence=whole.confidence,
        ahead=ahead and (lambda model: ahead(model, whole.evidence)),
    )
    return replace(scene, evidence=whole.evidence)


def _reconstructed(
    views: Sequence[PointCloud], target: Target | None, alone: bool, settings: SceneConfig
) -> tuple[Reconstruction, Plane | None, tuple[Obstacle, ...], tuple[str, ...]]:
    """The surface of the object, what it stands on, what stands about it, and how surely it was cut out."""
    if alone:
        seen = Segmentation(tuple(views), None, (), ())
    else:
        seen = segment(views, target=target, settings=settings.segmentation)
    whole = reconstruct(seen.views, seen.support, settings.reconstruction, () if alone else views)
    return whole, seen.support, _obstacles(seen, whole.mesh, settings), seen.warnings


def _obstacles(seen: Segmentation, mesh: TriangleMesh, settings: SceneConfig) -> tuple[Obstacle, ...]:
    reach = settings.segmentation.obstacle_range
    return make_obstacles(seen.obstacles, seen.support, mesh, reach, settings.obstacles)
