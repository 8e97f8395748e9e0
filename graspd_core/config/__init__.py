"""Settings: nested frozen dataclasses, one field list for YAML presets, the command line and ROS parameters."""

from __future__ import annotations

import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from graspd_core.config.baselines import AnnealingConfig, RandomClosureConfig
from graspd_core.config.closed_form import ClosedFormConfig, LossWeights
from graspd_core.config.grasp_stages import GraspStagesConfig
from graspd_core.config.graspd2022 import Graspd2022Config
from graspd_core.config.mapping import from_mapping, read_config
from graspd_core.config.reconstruction import ReconstructionConfig
from graspd_core.config.robust import RobustConfig
from graspd_core.config.rounds import RoundsConfig
from graspd_core.config.scene import ObstacleConfig, SceneConfig, load_scene_config
from graspd_core.config.segmentation import SegmentationConfig
from graspd_core.errors import ConfigError
from graspd_core.paths import config_dir

__all__ = [
    "METHODS",
    "VERIFICATIONS",
    "AnnealingConfig",
    "ClosedFormConfig",
    "GraspStagesConfig",
    "Graspd2022Config",
    "LossWeights",
    "ObstacleConfig",
    "PlanConfig",
    "RandomClosureConfig",
    "ReconstructionConfig",
    "RobustConfig",
    "RoundsConfig",
    "SceneConfig",
    "SegmentationConfig",
    "from_mapping",
    "load_preset",
    "load_scene_config",
    "preset_names",
]

Method = Literal["closed_form", "graspd2022", "annealing", "random_closure"]
Verify = Literal["standard", "hard", "none"]
METHODS: tuple[str, ...] = typing.get_args(Method)
VERIFICATIONS: tuple[str, ...] = typing.get_args(Verify)


@dataclass(frozen=True)
class PlanConfig:
    """Everything a run of `plan_grasps` is set by, apart from the scene, the hand and the seed.

    Attributes:
        resolution: the signed distance grid has at most the cube of it in nodes; a cube has as many along each side.
        method: how poses are searched for; `graspd_core.methods.candidates.SEARCHES` has one search for each.
        closed_form: settings of the closed-form relaxation.
        graspd2022: settings of the published Grasp'D.
        annealing: settings of the GraspIt!-style planner.
        random_closure: settings of the floor.
        postures: pregrasp and squeeze.
        rounds: of optimiser and trial.
        robust: the order of the verified grasps.
    """

    resolution: int = 48
    method: Method = "closed_form"
    closed_form: ClosedFormConfig = field(default_factory=ClosedFormConfig)
    graspd2022: Graspd2022Config = field(default_factory=Graspd2022Config)
    annealing: AnnealingConfig = field(default_factory=AnnealingConfig)
    random_closure: RandomClosureConfig = field(default_factory=RandomClosureConfig)
    postures: GraspStagesConfig = field(default_factory=GraspStagesConfig)
    rounds: RoundsConfig = field(default_factory=RoundsConfig)
    robust: RobustConfig = field(default_factory=RobustConfig)


def preset_names() -> tuple[str, ...]:
    """Names of the boxed presets."""
    return tuple(sorted(path.stem for path in (config_dir() / "presets").glob("*.yaml")))


def load_preset(name: str) -> PlanConfig:
    """A boxed preset by name, or a preset file by path.

    Raises:
        ConfigError: no such preset (the valid ones are listed), malformed YAML, or a bad key or value.
    """
    path = Path(name) if Path(name).suffix in (".yaml", ".yml") else config_dir() / "presets" / f"{name}.yaml"
    if not path.is_file():
        raise ConfigError(f"unknown preset {name!r}; valid presets: {', '.join(preset_names())}, or a .yaml file")
    return read_config(PlanConfig, path)
