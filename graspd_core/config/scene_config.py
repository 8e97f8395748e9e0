"""Settings of the way from clouds to a scene, and the file that holds them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from graspd_core.config.mapping import from_mapping, read_yaml
from graspd_core.config.reconstruction_config import ReconstructionConfig
from graspd_core.config.segmentation_config import SegmentationConfig
from graspd_core.errors import ConfigError

# Below these nothing is left to work with; every other number is above zero.
_MINIMA = {"max_voxels": 1000, "neighbours": 4, "max_points": 1000, "max_faces": 100}


@dataclass(frozen=True)
class ObstacleConfig:
    """How the things beside the object become convex hulls that the hand keeps out of.

    Attributes:
        padding: skin around what was seen; more keeps the hand farther away [m].
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
    """Read the settings of a scene from a YAML file; what it leaves out has its default.

    Raises:
        ConfigError: no such file, malformed YAML, an unknown key (the valid ones are listed), or a bad value.
    """
    path = Path(path)
    config = from_mapping(SceneConfig, read_yaml(path), where=path.name)
    for part in dataclasses.fields(config):
        for name, value in dataclasses.asdict(getattr(config, part.name)).items():
            _refuse(f"{path.name}.{part.name}.{name}", value, _MINIMA.get(name, 0))
    low, high = config.segmentation.roi_low, config.segmentation.roi_high
    if low and high and not all(a < b for a, b in zip(low, high, strict=True)):
        raise ConfigError(f"{path.name}.segmentation.roi_low: {low} must be below roi_high={high} on every axis")
    seen, guessed = config.reconstruction.seen_distance, config.reconstruction.guessed_distance
    if seen >= guessed:
        raise ConfigError(
            f"{path.name}.reconstruction.seen_distance: {seen:g} must be below guessed_distance={guessed:g}"
        )
    return config


def _refuse(where: str, value: Any, least: int) -> None:
    if isinstance(value, int | float) and (value < least or value <= 0):
        raise ConfigError(f"{where}: {value!r} must be {f'at least {least}' if least else 'above zero'}")
