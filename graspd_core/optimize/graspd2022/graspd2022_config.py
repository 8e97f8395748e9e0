"""Define the settings of the published Grasp'D."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class InitialPosesConfig:
    """The starts of the optimiser.

    Attributes:
        starts_per_grasp: number of starts for each requested grasp.
        kind: `published` puts the palm at `standoff` from a random surface point. `hull` calls `draw_starts`.
        standoff: distance of the palm from the surface point [m].
    """

    starts_per_grasp: float = 1.0
    kind: Literal["published", "hull"] = "published"
    standoff: float = 0.1


@dataclass(frozen=True)
class LevelSetConfig:
    """Coarse-to-fine search: contact with the level set φ = r, where r shrinks to zero.

    Attributes:
        schedule: first r. `paper` takes `radius_start`. `code` takes the hand's least distance minus `clearance`.
        radius_start: first r, for the schedule `paper` [m].
        clearance: distance of the hand from the first level set, for the schedule `code` [m].
        coarse_steps: number of steps in which r shrinks to zero. 0 disables coarse-to-fine.
    """

    schedule: Literal["paper", "code"] = "paper"
    radius_start: float = 0.1
    clearance: float = 0.01
    coarse_steps: int = 5000


@dataclass(frozen=True)
class ContactConfig:
    """The penalty contact.

    Attributes:
        leak: slope of the penalty out of contact, only in gradients. 0 gives the exact gradient.
        stiffness: normal force per depth [N/m].
        friction_stiffness: friction force per tangential speed, below Coulomb's bound [N·s/m].
        friction: Coulomb coefficient.
        all_candidates: use all contact candidates of the hand. Otherwise the first `problem.candidates` are used.
    """

    leak: float = 0.1
    stiffness: float = 1e6
    friction_stiffness: float = 1e8
    friction: float = 0.8
    all_candidates: bool = False


@dataclass(frozen=True)
class SimulationConfig:
    """The single simulation step of the object.

    Attributes:
        scaling: `published` uses `time_step`. `object` uses the time in which `stopping_force` stops the object.
        stopping_force: force that stops the object, for the scaling `object` [N].
        time_step: duration of the step, for the scaling `published` [s].
        speed: along every axis, the object starts with 0, +`speed` and −`speed` in the three simulations [m/s].
    """

    scaling: Literal["published", "object"] = "published"
    stopping_force: float = 5.0
    time_step: float = 1e-5
    speed: float = 0.01


@dataclass(frozen=True)
class RelaxationConfig:
    """Desired forces as variables, as in contact-invariant optimisation.

    Attributes:
        enabled: optimise desired forces. If false, the motion after one step is minimised directly.
        desired: kind of desired force: a free `force`, a free `wrench` (as in released code), or a force in the `cone`.
        force_rate: step size of the desired forces [N].
    """

    enabled: bool = True
    desired: Literal["force", "wrench", "cone"] = "force"
    force_rate: float = 0.01


@dataclass(frozen=True)
class PoseStepsConfig:
    """Steps of the pose. The defaults follow the paper. The other values follow the released code, grasping/src/cio.py.

    Attributes:
        optimiser: `adamax`, or `adam` as in the released code.
        translation_share: step size of the base position, relative to `pose_rate`.
        rotation_share: step size of the base quaternion, relative to `pose_rate`.
        in_turns: move first the base position, then orientation and joints with a new gradient. Else move all at once.
        within_limits: clamp joints to their limits after every move. If false, limits are only a constraint.
    """

    optimiser: Literal["adamax", "adam"] = "adamax"
    translation_share: float = 1.0
    rotation_share: float = 1.0
    in_turns: bool = False
    within_limits: bool = False


@dataclass(frozen=True)
class ConstraintsConfig:
    """Bounds on L_task and L_limit, and their multipliers.

    Attributes:
        task_bound: bound on L_task, the motion left by desired forces. Without forces L_task is 60. Released code: 10.
        limit_bound: bound on the sum by which joints exceed their limits [rad].
        damping: damping coefficient of the multipliers.
        multiplier_rate: step size of the multipliers.
    """

    task_bound: float = 10.0
    limit_bound: float = 0.01
    damping: float = 1.0
    multiplier_rate: float = 0.01


@dataclass(frozen=True)
class ObjectiveWeights:
    """Weights of the minimised terms.

    Attributes:
        physics: weight of the squared differences between desired and actual forces [1/N²].
        range: weight of the joints' distance from mid-range.
        inter: weight of self-collision, and of collision with obstacles if there are any.
    """

    physics: float = 0.01
    range: float = 0.01
    inter: float = 1.0


@dataclass(frozen=True)
class Graspd2022Config:
    """Grasp'D as published (docs/method.md, §1). Where paper and released code differ, a setting selects one of them.

    Attributes:
        steps: number of optimiser steps.
        pose_rate: step size of position [m], quaternion [half rad] and joints [rad].
        beta2: decay rate of the gradient's infinity norm (Adamax) or of its square (Adam).
        warm_up: number of first steps, in which the step sizes of pose and forces grow linearly from zero.
        final_rate: last step sizes as a share of the full ones, reached by a half-cosine decay. 1 keeps them constant.
        keep: return the `best` iterate for contact at r = 0, or the `last` iterate.
    """

    initial: InitialPosesConfig = field(default_factory=InitialPosesConfig)
    level_set: LevelSetConfig = field(default_factory=LevelSetConfig)
    contact: ContactConfig = field(default_factory=ContactConfig)
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    relaxation: RelaxationConfig = field(default_factory=RelaxationConfig)
    pose_steps: PoseStepsConfig = field(default_factory=PoseStepsConfig)
    constraints: ConstraintsConfig = field(default_factory=ConstraintsConfig)
    weights: ObjectiveWeights = field(default_factory=ObjectiveWeights)
    steps: int = 7000
    pose_rate: float = 0.003
    beta2: float = 0.999
    warm_up: int = 0
    final_rate: float = 1.0
    keep: Literal["best", "last"] = "best"
