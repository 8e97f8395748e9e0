"""Settings of the closed-form relaxation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms; every term is scaled so that one is a sensible weight.

    Attributes:
        task: resistance against the worst disturbances.
        distance: attraction of the fingers to the surface.
        penetration: depth below the padded surface.
        self_collision: overlap of the hand with itself.
        posture: joints away from the middle of their range.
        obstacle: depth in the support or in a neighbour; scenes without any have no such term.
    """

    task: float = 3.0
    distance: float = 1.0
    penetration: float = 1.0
    self_collision: float = 1.0
    posture: float = 0.02
    obstacle: float = 1.0


@dataclass(frozen=True)
class ClosedFormConfig:
    """The closed-form relaxation (docs/method.md).

    Attributes:
        starts_per_grasp: starts tried for each grasp asked for; hopeless ones are dropped on the way.
        explore_steps: steps with all starts, before the hopeless ones are dropped.
        refine_steps: steps with those that are kept.
        polish_steps: last steps, with all candidates and the object's sharp points.
        keep_per_grasp: starts kept after exploring, for each grasp asked for.
        candidates: contact candidates looked at by most steps.
        fine_candidates: contact candidates looked at while polishing.
        features: sharp points of the object looked at while polishing.
        directions: disturbance wrenches.
        friction: coefficient planned with; below the object's own, so that contacts keep a margin.
        activation: whether contact fades over its width or, for the ablation, ends at `delta_end`.
        delta_start: width of the soft contact at the start [m].
        delta_end: width of the soft contact at the end [m].
        radius_start: greatest padding of the object at the start [m].
        translation_rate: step size of the base position [m].
        rotation_rate: step size of the base quaternion [half rad].
        joint_rate: step size of the joints [rad]; sliding ones take 0.05 m for a radian.
        weights: of the loss terms while exploring and refining.
        polish_weights: of the loss terms while polishing.
        obstacle_factor: times as many starts are tried and kept where there is a support or a neighbour, which rule
            out most ways to grasp a thing.
        confidence_floor: what a contact counts on surface that was only guessed; one where it was seen.
    """

    starts_per_grasp: float = 4.0
    explore_steps: int = 50
    refine_steps: int = 80
    polish_steps: int = 50
    keep_per_grasp: float = 2.0
    candidates: int = 256
    fine_candidates: int = 600
    features: int = 128
    directions: int = 24
    friction: float = 0.4
    activation: Literal["soft", "hard"] = "soft"
    delta_start: float = 0.02
    delta_end: float = 0.004
    radius_start: float = 0.03
    translation_rate: float = 0.003
    rotation_rate: float = 0.03
    joint_rate: float = 0.03
    obstacle_factor: float = 2.0
    confidence_floor: float = 0.4
    weights: LossWeights = field(default_factory=LossWeights)
    polish_weights: LossWeights = field(
        default_factory=lambda: LossWeights(
            task=6.0, distance=300.0, penetration=10.0, self_collision=100.0, obstacle=10.0
        )
    )
