"""Define the settings of the closed-form method."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms. Every term is scaled so that 1 is a reasonable weight.

    Attributes:
        wrench_resistance: resistance against the worst disturbances.
        distance: attraction of the hand to the surface.
        penetration: depth of the hand below the object's padded surface.
        self_collision: overlap of the hand with itself.
        posture: distance of joints from the middle of their range.
        obstacle: depth in the support or in an obstacle. Without support and obstacles there is no such term.
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
        starts_per_grasp: number of starts for each requested grasp. Exploring drops hopeless starts.
        fingertip_starts: share of starts with half-closed fingers, with tips at the object. Others have an open hand.
        explore_steps: number of first steps, in which hopeless starts are dropped.
        refine_steps: number of steps after exploring, with the kept starts.
        polish_steps: number of last steps. They use all sharp points of the object, and `polish_weights`.
        fine_steps: number of the last polishing steps, which use all contact candidates.
        keep_per_grasp: number of starts kept after exploring, for each requested grasp.
        drops: how many times exploring drops starts, at equal intervals. Each time the same share of starts is dropped.
        activation: `soft` contact decays with distance. `hard` contact, for an ablation, is 1 up to `delta_end`.
        delta_start: width of the soft contact in the first step [m].
        delta_end: width of the soft contact after exploring [m].
        radius_start: greatest padding of the object in the first step [m]. A start near the object has less padding.
        translation_rate: step size of the base position [m].
        rotation_rate: step size of the base quaternion [half rad].
        joint_rate: step size of the joints [rad]. For prismatic joints 0.05 m count as one radian.
        searches: greatest number of searches. The search is repeated only if too few grasps are expected to hold.
        weights: weights of the loss terms while exploring and refining.
        polish_weights: weights of the loss terms while polishing.
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
    """Return the indices of the steps that begin by dropping starts."""
    return [round(settings.explore_steps * drop / settings.drops) for drop in range(1, settings.drops + 1)]


def rows_kept(settings: ClosedFormConfig, keep: int, rows: int, index: int) -> int:
    """Return how many of `rows` starts take part in step `index`. After exploring, `keep` starts are left."""
    at = drop_steps(settings)
    if index not in at or keep >= rows:
        return rows
    left = len(at) - at.index(index)
    return round(rows * (keep / rows) ** (1 / left))


# With a budget above 1, the fingers wrap the object: polishing is at least this long, and these weights at least this
# high. On views of `graspd bench cameras` (seeds 90 to 97), 1.5 times as many candidates then lift the assumed mass.
_WRAPPING_STEPS = {"polish_steps": 320, "fine_steps": 120}
_WRAPPING_DISTANCE, _WRAPPING_POLISH = 15.0, {"distance": 1500.0, "penetration": 80.0}


def at_budget(settings: ClosedFormConfig, budget: float) -> ClosedFormConfig:
    """Return the settings for `budget` times the usual effort.

    A budget below 1 multiplies the steps and allows one search. Fewer starts would hardly save time in a small batch.
    A budget above 1, for hard objects, multiplies starts, and draws the whole hand to the surface.
    """
    if budget > 1.0:
        return _wrapping(settings, budget)
    steps = {
        name: math.ceil(getattr(settings, name) * budget)
        for name in ("explore_steps", "refine_steps", "polish_steps", "fine_steps")
    }
    return replace(settings, **steps, searches=settings.searches if budget == 1.0 else 1)


def _wrapping(settings: ClosedFormConfig, times: float) -> ClosedFormConfig:
    starts = {name: getattr(settings, name) * times for name in ("starts_per_grasp", "keep_per_grasp")}
    steps = {name: max(getattr(settings, name), least) for name, least in _WRAPPING_STEPS.items()}
    polish = {name: max(getattr(settings.polish_weights, name), least) for name, least in _WRAPPING_POLISH.items()}
    weights = replace(settings.weights, distance=max(settings.weights.distance, _WRAPPING_DISTANCE))
    return replace(
        settings, **starts, **steps, weights=weights, polish_weights=replace(settings.polish_weights, **polish)
    )
