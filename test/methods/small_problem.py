"""One small problem in float64 that the tests of this folder share."""

from typing import Any

import torch

from graspd_core import HandModel, Problem, Scene, build_problem
from graspd_core.config import ProblemConfig


def small_problem(scene: Scene, hand: HandModel, dtype: torch.dtype = torch.float64, **settings: Any) -> Problem:
    """The problem of a scene and a hand with 60 coarse candidates and other settings as given."""
    config = ProblemConfig(candidates=60, features=24, directions=12, friction=0.5, **settings)
    return build_problem(scene, hand, config, seed=0, dtype=dtype)
