"""Hold the settings for building a scene from point clouds, and read them from a YAML file."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from graspd_core.config.mapping import from_mapping, yaml_values
from graspd_core.errors import ConfigError

# Least values of some settings. All numbers that are not listed must be above zero.
_MINIMA = {"max_voxels": 1000, "neighbours": 4, "max_points": 1000, "max_faces": 100}


@dataclass(frozen=True)
class SegmentationConfig:
    """Settings to separate the object to grasp from a scene that depth cameras saw.

    Attributes:
        roi_low: lower corner of the workspace, in the cloud's frame [m]. None means no bound.
        roi_high: upper corner of the workspace, in the cloud's frame [m]. None means no bound.
        max_range: points farther than this from their camera are ignored [m].
        voxel: edge length of the voxels to which the scene is downsampled, below half of `gap` [m].
        max_voxels: maximum number of voxels of a scene. Larger scenes get larger voxels, which bounds the time.
        plane_tolerance: points up to this height above a plane belong to the plane [m]. Camera noise raises the height.
        max_plane_tolerance: greatest plane tolerance, for the noisiest cameras [m].
        plane_search_width: greatest distance of inliers from a plane during the search [m]. Use more for noisy cameras.
        ransac_trials: number of planes that RANSAC tries. Use more if the support is a small part of the scene.
        support_size: least width of the visible part of a support plane [m].
        support_margin: a support is assumed to continue this far beyond its visible part [m].
        support_area_ratio: least ratio of the area of a support to the area of the objects on the support.
        contact: an object up to this far above the support counts as touching [m]. Noise or occlusion raises the limit.
        gap: points at least this far apart belong to two objects [m].
        max_link: points farther apart than this never belong to one object, even in a sparse cloud [m].
        neighbour_share: points with fewer neighbours than this fraction of the median number are flying pixels.
        hanging_reach: a piece that ends above the support, e.g. a handle, belongs to an object up to this far away [m].
        unsupported_reach: without a support, pieces at most this far apart that touch in an image form one object [m].
        smallest_object: objects smaller than this are noise [m].
        largest_object: objects larger than this are background: walls, floors, furniture [m].
        min_points: objects with fewer points than this are noise.
        border_width: an object this near to the image border may extend beyond it [rad]. The default is about 3 pixels.
        target_reach: a target point selects an object within this distance [m].
        target_share: a box or mask that covers this fraction of an object selects the whole object.
        obstacle_range: other objects up to this distance from the object to grasp become obstacles [m].
        piled: True if objects lie on each other. Parts divided by a seam are then separate objects, even if stacked. If
            a target point selects such a part, or a part hidden by a nearer one, no grasp counts as verified.
    """

    roi_low: tuple[float, float, float] | None = None
    roi_high: tuple[float, float, float] | None = None
    max_range: float = 2.0
    voxel: float = 0.003
    max_voxels: int = 150_000
    plane_tolerance: float = 0.004
    max_plane_tolerance: float = 0.02
    plane_search_width: float = 0.01
    ransac_trials: int = 400
    support_size: float = 0.1
    support_margin: float = 0.05
    support_area_ratio: float = 2.0
    contact: float = 0.02
    gap: float = 0.008
    max_link: float = 0.05
    neighbour_share: float = 0.3
    hanging_reach: float = 0.03
    unsupported_reach: float = 0.15
    smallest_object: float = 0.008
    largest_object: float = 0.35
    min_points: int = 30
    border_width: float = 0.004
    target_reach: float = 0.05
    target_share: float = 0.8
    obstacle_range: float = 0.3
    piled: bool = False


@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings for reconstructing a closed mesh from the views of an object.

    Attributes:
        max_points: maximum number of used points, all views together. This bounds the time.
        neighbours: number of points to which each local plane is fitted. More points smooth both noise and detail.
        stray_distance: points farther than this from the plane of their neighbours are flying pixels [m].
        outline_slack: error with which cameras see outlines and surfaces [m].
        surface_tolerance: a guessed point up to this far from a seen surface confirms the guess [m].
        open_share: the hidden side is guessed only if at least this fraction of the surface is missing.
        revolution_share: least fraction of the seen surface that a body of revolution must explain.
        symmetry_worth: least score of a symmetry. Lower scores may be chance. The highest score is 2.6.
        poisson: solver for the surface: "open3d" or "grid". If no grid surface fits, "grid" also uses Open3D.
        poisson_cell: approximate width of the finest cells of Open3D's solver, twice the camera's noise [m].
        min_cell: least cell width of the grid on which the surface is closed, twice the camera's noise [m].
        fit_distance: a mesh is refused if fewer than 85 % of the seen points are this near to its surface [m].
        max_faces: maximum number of faces of the mesh.
        seen_distance: surface up to this far from a seen point has confidence 1 [m].
        guessed_distance: surface farther than this from all seen points has confidence 0 [m].
    """

    max_points: int = 160_000
    neighbours: int = 28
    stray_distance: float = 0.006
    outline_slack: float = 0.003
    surface_tolerance: float = 0.004
    open_share: float = 0.12
    revolution_share: float = 0.8
    symmetry_worth: float = 0.5
    poisson: Literal["grid", "open3d"] = "grid"
    poisson_cell: float = 0.0022
    min_cell: float = 0.0017
    fit_distance: float = 0.004
    max_faces: int = 6000
    seen_distance: float = 0.004
    guessed_distance: float = 0.02


@dataclass(frozen=True)
class ObstacleConfig:
    """Settings for the convex hulls of neighbouring objects, which the hand avoids.

    Attributes:
        padding: thickness added around the seen points [m].
        part_size: a neighbour whose hull would contain the object, e.g. a tray, is halved to parts of this size [m].
        min_points: neighbours with fewer points are noise.
    """

    padding: float = 0.005
    part_size: float = 0.05
    min_points: int = 10


@dataclass(frozen=True)
class SceneConfig:
    """Settings for building a scene from point clouds."""

    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    reconstruction: ReconstructionConfig = field(default_factory=ReconstructionConfig)
    obstacles: ObstacleConfig = field(default_factory=ObstacleConfig)


def load_scene_config(path: str | Path) -> SceneConfig:
    """Read the settings of a scene from a YAML file. Missing settings keep their defaults.

    Raises ConfigError: the file is missing or malformed, a key is unknown, or a value is not valid.
    """
    with yaml_values(path := Path(path)) as values:
        config = from_mapping(SceneConfig, values, where=path.name)
        _refuse_values(config)
    return config


def _refuse_values(config: SceneConfig) -> None:
    for part in dataclasses.fields(config):
        for name, value in dataclasses.asdict(getattr(config, part.name)).items():
            least = _MINIMA.get(name, 0)
            if isinstance(value, int | float) and not isinstance(value, bool) and (value < least or value <= 0):
                valid = f"at least {least}" if least else "above zero"
                raise ConfigError(f"{part.name}.{name}: {value!r} must be {valid}")
    low, high = config.segmentation.roi_low, config.segmentation.roi_high
    if low and high and not all(a < b for a, b in zip(low, high, strict=True)):
        raise ConfigError(f"segmentation.roi_low: {low} must be below roi_high={high} on every axis")
    seen, guessed = config.reconstruction.seen_distance, config.reconstruction.guessed_distance
    if seen >= guessed:
        raise ConfigError(f"reconstruction.seen_distance: {seen:g} must be below guessed_distance={guessed:g}")
