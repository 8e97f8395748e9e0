"""Hold the settings that several folders share, as frozen dataclasses. Settings of one method are in its folder."""

from __future__ import annotations

from graspd_core.config.mapping import from_mapping as from_mapping
from graspd_core.config.planning_config import CertaintyConfig as CertaintyConfig
from graspd_core.config.planning_config import GraspStagesConfig as GraspStagesConfig
from graspd_core.config.planning_config import ProblemConfig as ProblemConfig
from graspd_core.config.planning_config import RobustConfig as RobustConfig
from graspd_core.config.planning_config import RoundsConfig as RoundsConfig
from graspd_core.config.scene_config import ObstacleConfig as ObstacleConfig
from graspd_core.config.scene_config import ReconstructionConfig as ReconstructionConfig
from graspd_core.config.scene_config import SceneConfig as SceneConfig
from graspd_core.config.scene_config import SegmentationConfig as SegmentationConfig
from graspd_core.config.scene_config import load_scene_config as load_scene_config

VERIFICATIONS = ("standard", "hard", "full", "hard_full", "none")
