"""Settings that several folders share: frozen dataclasses, a file each. A method's own lie in its folder."""

from __future__ import annotations

import typing
from typing import Literal

from graspd_core.config.certainty_config import CertaintyConfig
from graspd_core.config.grasp_stages_config import GraspStagesConfig
from graspd_core.config.mapping import from_mapping
from graspd_core.config.problem_config import ProblemConfig
from graspd_core.config.reconstruction_config import ReconstructionConfig
from graspd_core.config.robust_config import RobustConfig
from graspd_core.config.rounds_config import RoundsConfig
from graspd_core.config.scene_config import ObstacleConfig, SceneConfig, load_scene_config
from graspd_core.config.segmentation_config import SegmentationConfig

__all__ = [
    "VERIFICATIONS",
    "CertaintyConfig",
    "GraspStagesConfig",
    "ObstacleConfig",
    "ProblemConfig",
    "ReconstructionConfig",
    "RobustConfig",
    "RoundsConfig",
    "SceneConfig",
    "SegmentationConfig",
    "from_mapping",
    "load_scene_config",
]

Verify = Literal["standard", "hard", "full", "hard_full", "none"]
VERIFICATIONS: tuple[str, ...] = typing.get_args(Verify)
