"""Settings of the way from clouds to a scene, and the file that holds them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from graspd_core.config.mapping import from_mapping, yaml_values
from graspd_core.errors import ConfigError

# Below these nothing is left to work with. Every other number is above zero.
_MINIMA = {"max_voxels": 1000, "neighbours": 4, "max_points": 1000, "max_faces": 100}


@dataclass(frozen=True)
class SegmentationConfig:
    """How an object is cut out of a scene that depth cameras saw.

    Attributes:
        roi_low: lower corner of the workspace, in the cloud's frame [m]. None: no bound.
        roi_high: upper corner of the workspace, in the cloud's frame [m]. None: no bound.
        max_range: points farther than this from their camera are ignored [m].
        voxel: side of the voxels that the scene is thinned by, finer than half of `gap` [m].
        max_voxels: larger scenes get larger voxels, which bounds the time.
        plane_tolerance: least height above the support that counts as above it, more where the camera is noisier [m].
        max_plane_tolerance: the most that this height may become where the camera is noisy [m].
        plane_search_width: half width of the slab in which a plane is searched, wider for noisy cameras [m].
        ransac_trials: planes that are tried, more if the support is a small share of the scene.
        support_size: the smaller side of a support's visible part is at least this [m].
        support_margin: a flat part goes on so far beyond what was seen of it [m].
        support_area_ratio: area of a support over the area of what stands on it, at least.
        contact: what stands on a support comes at least this near to it, occlusion and noise considered [m].
        gap: things at least this far apart are two [m].
        max_link: points farther apart than this are never one thing, however sparse the cloud is [m].
        neighbour_share: points with fewer neighbours than this share of the median are flying pixels.
        hanging_reach: a piece that ends above the support, a handle, belongs to what is this near [m].
        unsupported_reach: without a support, pieces this near that touch in an image are one thing [m].
        smallest_object: things smaller than this are noise [m].
        largest_object: things larger than this are background: walls, floors, furniture [m].
        min_points: things seen by fewer points than this are noise.
        border_width: what is this near to the edge of the image may go on beyond, some three pixels [rad].
        target_reach: a target point this near to a thing means that thing [m].
        target_share: a box or mask that covers this share of a thing means all of it.
        obstacle_range: other things are reported as far as this from the object [m].
        piled: things lie on each other: parts at a seam are things although they do not reach the support, and a heap
            of any size may stand on it.
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
    """How the views of an object become a closed mesh.

    Attributes:
        max_points: points of all views together that are used, which bounds the time.
        neighbours: points that each local plane is fitted to. More smooth noise and detail alike.
        stray_distance: points farther than this from their neighbours' plane are flying pixels [m].
        outline_slack: cameras see outlines and surfaces to within this [m].
        surface_tolerance: a guessed point this near to a seen surface confirms the guess [m].
        open_share: a surface with a smaller share missing is not completed.
        revolution_share: a body of revolution explains this share of what was seen, at least.
        symmetry_worth: a symmetry of a lower score is chance. The highest score is 2.6.
        poisson: whose surface goes through the points: of a grid, then of Open3D where that does not fit, or of open3d.
        poisson_cell: the finest cells of Open3D's are about so wide: twice the camera's noise [m].
        min_cell: least cell of the grid that the surface is closed on, likewise [m].
        fit_distance: 85 % of the seen points lie this near to the mesh, or it is refused [m].
        max_faces: faces of the mesh, at most.
        seen_distance: surface this near to a seen point has confidence 1 [m].
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
    """How the things beside the object become convex hulls that the hand keeps out of.

    Attributes:
        padding: skin around what was seen [m].
        part_size: a thing whose hull would hold the object, a tray, is split into parts of this size [m].
        min_points: things of fewer points are noise.
    """

    padding: float = 0.005
    part_size: float = 0.05
    min_points: int = 10


@dataclass(frozen=True)
class SceneConfig:
    """How clouds become a scene.

    Attributes:
        segmentation: the object is cut out of the cloud.
        reconstruction: the object's points become a closed mesh.
        obstacles: the things beside it become hulls.
    """

    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    reconstruction: ReconstructionConfig = field(default_factory=ReconstructionConfig)
    obstacles: ObstacleConfig = field(default_factory=ObstacleConfig)


def load_scene_config(path: str | Path) -> SceneConfig:
    """Read the settings of a scene from a YAML file.

    Missing ones have their defaults. Raises ConfigError: no such file, malformed YAML, an unknown key (the valid ones
    are listed), or a bad value.
    """
    with yaml_values(path := Path(path)) as values:
        config = from_mapping(SceneConfig, values, where=path.name)
        _refuse_values(config)
    return config


def _refuse_values(config: SceneConfig) -> None:
    for part in dataclasses.fields(config):
        for name, value in dataclasses.asdict(getattr(config, part.name)).items():
            _refuse(f"{part.name}.{name}", value, _MINIMA.get(name, 0))
    low, high = config.segmentation.roi_low, config.segmentation.roi_high
    if low and high and not all(a < b for a, b in zip(low, high, strict=True)):
        raise ConfigError(f"segmentation.roi_low: {low} must be below roi_high={high} on every axis")
    seen, guessed = config.reconstruction.seen_distance, config.reconstruction.guessed_distance
    if seen >= guessed:
        raise ConfigError(f"reconstruction.seen_distance: {seen:g} must be below guessed_distance={guessed:g}")


def _refuse(where: str, value: Any, least: int) -> None:
    if isinstance(value, int | float) and not isinstance(value, bool) and (value < least or value <= 0):
        raise ConfigError(f"{where}: {value!r} must be {f'at least {least}' if least else 'above zero'}")
