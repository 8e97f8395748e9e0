"""Settings that several folders share, as frozen dataclasses. Each method's own settings are in its folder."""

from __future__ import annotations

import typing
from typing import Literal

from graspd_core.config.mapping import from_mapping
from graspd_core.config.planning_config import (
    CertaintyConfig,
    GraspStagesConfig,
    ProblemConfig,
    RobustConfig,
    RoundsConfig,
)
from graspd_core.config.scene_config import (
    ObstacleConfig,
    ReconstructionConfig,
    SceneConfig,
    SegmentationConfig,
    load_scene_config,
)

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
