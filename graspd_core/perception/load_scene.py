"""A scene from whatever names an object: a mesh file, a cloud file, an authored shape, or a mesh.

From what depth cameras saw to a scene: the object cut out and made whole, and what stands in the hand's way.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from graspd_core.config import SceneConfig
from graspd_core.errors import MeshError
from graspd_core.mesh.mesh_files import MESH_ENDINGS, read_mesh
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.cloud.cloud_files import CLOUD_ENDINGS, is_cloud_file, load_views
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.obstacles import make_obstacles
from graspd_core.perception.reconstruct.reconstruct import Reconstruction, reconstruct
from graspd_core.perception.reconstruct.shape_completion import Evidence
from graspd_core.perception.scene import ObjectModel, Obstacle, Scene, build_scene, refuse_numbers
from graspd_core.perception.segment.segment import Segmentation, segment
from graspd_core.perception.segment.target_selection import Target
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import Plane, TriangleMesh

SHAPE_PREFIX = "shape:"


def load_scene(
    source: str | Path | TriangleMesh,
    *,
    mass: float | None = 0.1,
    friction: float = 0.6,
    scale: float = 1.0,
    resolution: int = 48,
    device: torch.device | str = "cpu",
    target: Target | None = None,
    alone: bool = False,
    settings: SceneConfig | None = None,
) -> Scene:
    """Build the scene of one object.

    Args:
        source: a mesh file, a point cloud file (the object is cut out and reconstructed), `shape:NAME`, or a mesh.
        mass: [kg]; None takes 300 kg/m³ times the volume.
        friction: Coulomb coefficient between hand and object.
        scale: factor on the file's coordinates to make them metres.
        resolution: the distance grid has at most the cube of it in nodes; `plan_grasps` goes by its preset.
        target: which of the things in a cloud is meant.
        alone: a cloud shows the object and nothing else.
        settings: how a cloud becomes a scene.

    Raises:
        MeshError: the mesh cannot be read or used, or a number is out of range.
        CloudError: the cloud cannot be read or shows no object.
    """
    started = time.perf_counter()
    given = "mesh" if isinstance(source, TriangleMesh) else str(source)
    numbers = {"mass": mass, "friction": friction, "resolution": resolution}
    refuse_numbers(given, scale=scale, **numbers)
    if not isinstance(source, TriangleMesh) and is_cloud_file(source):
        # A mesh needs none of what makes an object of a cloud.

        views = [
            replace(view, points=view.points * scale, viewpoint=view.viewpoint * scale) for view in load_views(source)
        ]
        scene = scene_from_views(
            views, target=target, alone=alone, settings=settings, source=given, device=device, **numbers
        )
        return replace(scene, object=replace(scene.object, scale=scale))
    mesh, warnings = _read_mesh(source, scale)
    return build_scene(mesh, source=given, scale=scale, device=device, started=started, warnings=warnings, **numbers)


def _read_mesh(source: str | Path | TriangleMesh, scale: float) -> tuple[TriangleMesh, tuple[str, ...]]:
    if isinstance(source, TriangleMesh):
        return TriangleMesh(source.vertices * scale, source.faces), ()
    name = str(source)
    if name.startswith(SHAPE_PREFIX):
        shape = make_shape(name.removeprefix(SHAPE_PREFIX))
        return TriangleMesh(shape.vertices * scale, shape.faces), ()
    endings = sorted({*MESH_ENDINGS, *CLOUD_ENDINGS})
    if Path(source).is_file() and Path(source).suffix.lower().lstrip(".") not in endings:
        raise MeshError(f"{name}: unknown ending {Path(source).suffix!r}; valid endings: {', '.join(endings)}")
    return read_mesh(source, scale=scale)


def scene_from_views(
    views: Sequence[PointCloud],
    *,
    target: Target | None = None,
    alone: bool = False,
    settings: SceneConfig | None = None,
    mass: float | None = 0.1,
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
        mass: [kg]; None takes 300 kg/m³ times the volume.
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
