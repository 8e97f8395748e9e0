"""The same method with more or less effort: what the rounds of a run differ by."""

from __future__ import annotations

import math
from dataclasses import replace

from graspd_core.config import PlanConfig


def at_budget(config: PlanConfig, effort: float) -> PlanConfig:
    """The settings at an effort: below one that share of the steps, above it as many times the starts.

    Steps are what a small batch costs, and fewer of them do on easy objects; starts are what hard objects want. Only
    the closed form knows efforts; other methods keep their settings.
    """
    settings = config.closed_form
    share, times = min(effort, 1.0), max(effort, 1.0)
    steps = {
        name: math.ceil(getattr(settings, name) * share) for name in ("explore_steps", "refine_steps", "polish_steps")
    }
    starts = {name: getattr(settings, name) * times for name in ("starts_per_grasp", "keep_per_grasp")}
    return replace(config, closed_form=replace(settings, **steps, **starts))
