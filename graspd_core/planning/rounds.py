"""How much effort each round of optimiser and trial takes."""

from __future__ import annotations

from graspd_core.methods.plan_config import PlanConfig
from graspd_core.scene.scene import Scene


def rounds_of(scene: Scene, config: PlanConfig, verify: str) -> list[PlanConfig]:
    """Settings of every round, each with more effort than the last.

    A cheap first round pays where its failures are found out at little cost: by a hold trial, on an object whose shape
    is known and that has nothing about it.
    """
    rounds = config.rounds
    cheap = verify != "none" and scene.support is None and not scene.obstacles and scene.confidence is None
    first = rounds.first_budget if cheap else 1.0
    most = rounds.first_budget * rounds.growth ** (rounds.most - 1)
    efforts = (min(first * rounds.growth**attempt, max(first, most)) for attempt in range(rounds.most))
    return [config.at_budget(effort) for effort in efforts]
