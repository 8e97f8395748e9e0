"""Build a scene from a mesh file, a point cloud file, a depth image, a built-in shape, or a mesh."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from graspd_core.config import SceneConfig
from graspd_core.errors import CloudError, MeshError
from graspd_core.mesh.mesh_files import MESH_ENDINGS, read_mesh
from graspd_core.mesh.shapes import file_state, make_shape
from graspd_core.perception.cloud.cloud_files import (
    CLOUD_ENDINGS,
    RECORDINGS,
    is_cloud_file,
    load_views,
    recording_message,
)
from graspd_core.perception.cloud.depth_files import is_depth_image, load_depth_view
from graspd_core.perception.cloud.mesh_views import view_in_mesh
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.scene import Scene, build_scene, refuse_numbers
from graspd_core.perception.segment.target_selection import Target
from graspd_core.types import TriangleMesh

SHAPE_PREFIX = "shape:"


def load_scene(
    source: str | Path | TriangleMesh,
    *,
    mass: float | None = None,
    friction: float = 0.6,
    scale: float = 1.0,
    resolution: int = 48,
    device: torch.device | str = "cpu",
    target: Target | None = None,
    alone: bool = False,
    view_point: Sequence[float] | None = None,
    settings: SceneConfig | None = None,
    camera: str | Path | None = None,
) -> Scene:
    """Build the scene of one object.

    Args:
        source: a mesh, the path of a mesh, `shape:NAME`, or the path of a point cloud or depth image to reconstruct.
        mass: mass of the object [kg]. None assumes the greatest plausible mass (`heavy_mass`), with a warning.
        friction: Coulomb friction coefficient between hand and object.
        scale: factor that converts the file's coordinates to metres.
        resolution: the distance grid has at most `resolution`³ nodes. `plan_grasps` uses the value of its preset.
        target: which object of a point cloud to grasp.
        alone: whether a point cloud shows only the object.
        view_point: position of a point cloud's camera [m]. None uses the position in the file, or else the origin.
        settings: settings for building a scene from a point cloud.
        camera: file of the camera that took the depth image `source` (docs/clouds.md). With a depth image, `scale` is
            in metres per unit of depth, and 1 means the unit that the camera's file gives.

    Raises:
        MeshError: the mesh cannot be read or used, an argument for clouds is given, or a number is out of range.
        CloudError: the cloud cannot be read or shows no object.
    """
    started = time.perf_counter()
    given, state = ("mesh", ()) if isinstance(source, TriangleMesh) else (str(source), file_state(str(source)))
    numbers = {"mass": mass, "friction": friction, "resolution": resolution}
    refuse_numbers(given, scale=scale, **numbers)
    mesh, views, warnings = None, (), ()
    if not isinstance(source, TriangleMesh) and (camera is not None or is_depth_image(source) or is_cloud_file(source)):
        views = scaled_views(source, camera, scale, view_point)
    else:
        mesh, warnings = _read_mesh(source, given, scale)
        view = view_in_mesh(mesh, given)
        if view_point is not None:
            raise _clouds_only("view_point", given)
        if view is not None:
            views, warnings = (view,), (f"{given}: shows one camera's view, so its points are used as a cloud",)
    if views or mesh is None:
        # The import is here, because a mesh does not need this module.
        from graspd_core.perception.scene_from_views import scene_from_views

        about = {"target": target, "alone": alone, "settings": settings, "source": given, "device": device}
        scene = scene_from_views(views, **about, **numbers)
        scene = replace(scene, object=replace(scene.object, warnings=warnings + scene.object.warnings))
    elif target is not None or settings is not None:
        raise _clouds_only("scene settings" if target is None else "target", given)
    else:
        about = {"source": given, "scale": scale, "device": device, "started": started, "warnings": warnings}
        scene = build_scene(mesh, **about, **numbers)
    return replace(scene, object=replace(scene.object, scale=scale, file_state=state))


def _clouds_only(argument: str, source: str) -> MeshError:
    return MeshError(f"{argument}: given with {source}, a mesh; valid with clouds")


def scaled_views(
    source: str | Path, camera: str | Path | None, scale: float = 1.0, view_point: Sequence[float] | None = None
) -> list[PointCloud]:
    """Return the views of a point cloud file or a depth image [m]. Raises CloudError like `load_scene`."""
    if camera is not None:
        if view_point is not None:
            raise CloudError(f"view_point: {source} is a depth image; only a cloud of points takes a view point")
        return [load_depth_view(source, camera, None if scale == 1.0 else scale)]
    if is_depth_image(source):
        raise CloudError(f"{source}: a depth image needs the camera that took it: --camera camera.json")
    return list(load_views(source, None if view_point is None else np.asarray(view_point, dtype=float), scale))


def _read_mesh(source: str | Path | TriangleMesh, name: str, scale: float) -> tuple[TriangleMesh, tuple[str, ...]]:
    if name.startswith(SHAPE_PREFIX):
        source = make_shape(name.removeprefix(SHAPE_PREFIX))
    if isinstance(source, TriangleMesh):
        return TriangleMesh(source.vertices * scale, source.faces), ()
    endings = sorted({*MESH_ENDINGS, *CLOUD_ENDINGS})
    if Path(source).suffix.lower().lstrip(".") in RECORDINGS:
        raise MeshError(f"{name}: {recording_message(Path(source))}")
    if Path(source).is_file() and Path(source).suffix.lower().lstrip(".") not in endings:
        raise MeshError(f"{name}: unknown ending {Path(source).suffix!r}; valid endings: {', '.join(endings)}")
    return read_mesh(source, scale=scale)
