"""Settings of the closed-form method."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms. Every term is scaled so that one is a sensible weight.

    Attributes:
        wrench_resistance: resistance against the worst disturbances.
        distance: attraction of the hand to the surface.
        penetration: depth below the padded surface.
        self_collision: overlap of the hand with itself.
        posture: joints away from the middle of their range.
        obstacle: depth in the support or in a neighbour. Scenes without any have no such term.
    """

    wrench_resistance: float = 3.0
    distance: float = 1.0
    penetration: float = 1.0
    self_collision: float = 1.0
    posture: float = 0.02
    obstacle: float = 1.0


@dataclass(frozen=True)
class ClosedFormConfig:
    """The closed-form relaxation (docs/method.md).

    Attributes:
        starts_per_grasp: starts tried for each grasp asked for. Hopeless ones are dropped on the way.
        fingertip_starts: share of them that begins with half-closed fingertips at the object, the others with the palm.
        explore_steps: steps with all starts, before the hopeless ones are dropped.
        refine_steps: steps with those that are kept.
        polish_steps: last steps, with all of the object's sharp points and weights that make contact exact.
        fine_steps: the last of them, with all candidates too.
        keep_per_grasp: starts kept after exploring, for each grasp asked for.
        drops: times that exploring drops starts, evenly spread, each time the same share of those left.
        activation: whether contact fades over its width or, for the ablation, ends at `delta_end`.
        delta_start: width of the soft contact at the start [m].
        delta_end: width of the soft contact at the end [m].
        radius_start: greatest padding of the object at the start [m].
        translation_rate: step size of the base position [m].
        rotation_rate: step size of the base quaternion [half rad].
        joint_rate: step size of the joints [rad]. Sliding ones take 0.05 m for a radian.
        searches: times at most that starts are tried, again only where too few grasps are expected to hold.
        weights: of the loss terms while exploring and refining.
        polish_weights: of the loss terms while polishing.
    """

    starts_per_grasp: float = 8.0
    fingertip_starts: float = 0.25
    explore_steps: int = 50
    refine_steps: int = 80
    polish_steps: int = 80
    fine_steps: int = 30
    keep_per_grasp: float = 2.0
    drops: int = 2
    activation: Literal["soft", "hard"] = "soft"
    delta_start: float = 0.02
    delta_end: float = 0.004
    radius_start: float = 0.03
    translation_rate: float = 0.003
    rotation_rate: float = 0.03
    joint_rate: float = 0.03
    searches: int = 3
    weights: LossWeights = field(default_factory=lambda: LossWeights(distance=4.0, self_collision=20.0))
    polish_weights: LossWeights = field(
        default_factory=lambda: LossWeights(
            wrench_resistance=6.0, distance=300.0, penetration=10.0, self_collision=100.0, obstacle=10.0
        )
    )


def drop_steps(settings: ClosedFormConfig) -> list[int]:
    """Return the steps before which exploring drops starts."""
    return [round(settings.explore_steps * drop / settings.drops) for drop in range(1, settings.drops + 1)]


def rows_kept(settings: ClosedFormConfig, keep: int, rows: int, index: int) -> int:
    """Return how many of so many rows go on before step `index`. `keep` are left when exploring ends."""
    at = drop_steps(settings)
    if index not in at or keep >= rows:
        return rows
    left = len(at) - at.index(index)
    return round(rows * (keep / rows) ** (1 / left))


def at_budget(settings: ClosedFormConfig, budget: float) -> ClosedFormConfig:
    """Return the settings at a budget: below one that share of the steps and one search, above one more starts.

    Steps are what a small batch costs, and fewer of them do on easy objects. Starts are what hard objects want.
    """
    share, times = min(budget, 1.0), max(budget, 1.0)
    steps = {
        name: math.ceil(getattr(settings, name) * share)
        for name in ("explore_steps", "refine_steps", "polish_steps", "fine_steps")
    }
    starts = {name: getattr(settings, name) * times for name in ("starts_per_grasp", "keep_per_grasp")}
    searches = settings.searches if budget >= 1.0 else 1
    return replace(settings, **steps, **starts, searches=searches)
