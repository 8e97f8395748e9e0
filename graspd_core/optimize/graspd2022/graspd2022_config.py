"""Settings of the published Grasp'D."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class InitialPosesConfig:
    """Where the optimiser starts.

    Attributes:
        starts_per_grasp: starts for each grasp asked for.
        kind: `published`, palm towards a random surface point from `standoff` away, or `hull`, as the other methods.
        standoff: distance of the palm from the surface point [m].
    """

    starts_per_grasp: float = 1.0
    kind: Literal["published", "hull"] = "published"
    standoff: float = 0.1


@dataclass(frozen=True)
class LevelSetConfig:
    """Coarse to fine: contact with the level set φ = r, r shrinking to zero.

    Attributes:
        schedule: level set at the start: `radius_start` (`paper`), or the least distance less `clearance` (`code`).
        radius_start: of the paper [m].
        clearance: of the hand at the start from the level set of the code [m].
        coarse_steps: first steps, in which the level set shrinks to the surface. Zero leaves coarse to fine out.
    """

    schedule: Literal["paper", "code"] = "paper"
    radius_start: float = 0.1
    clearance: float = 0.01
    coarse_steps: int = 5000


@dataclass(frozen=True)
class ContactConfig:
    """The penalty contact.

    Attributes:
        leak: slope of the depth out of contact. Zero makes the gradient the plain one.
        stiffness: normal force of a contact by its depth [N/m].
        friction_stiffness: friction by tangential speed, below Coulomb's bound [N·s/m].
        friction: Coulomb coefficient.
        all_candidates: contacts at all of the hand's candidates, rather than at those of `problem.candidates`.
    """

    leak: float = 0.1
    stiffness: float = 1e6
    friction_stiffness: float = 1e8
    friction: float = 0.8
    all_candidates: bool = False


@dataclass(frozen=True)
class SimulationConfig:
    """The one step of the object.

    Attributes:
        scaling: `published`, stiffness and time step as they are, in SI, or `object`, the time step in which
            `stopping_force` stops this object.
        stopping_force: of the scaling by object [N].
        time_step: of the published scaling [s].
        speed: of the object in each of its three coordinates, forwards, backwards and none [m/s].
    """

    scaling: Literal["published", "object"] = "published"
    stopping_force: float = 5.0
    time_step: float = 1e-5
    speed: float = 0.01


@dataclass(frozen=True)
class RelaxationConfig:
    """Desired forces as variables (after contact-invariant optimisation).

    Attributes:
        enabled: desired forces as variables. Without it the motion after one step is minimised directly.
        desired: a desired force is a free `force`, a free `wrench` (the code's) or one in the friction `cone`.
        force_rate: step size of the desired forces [N].
    """

    enabled: bool = True
    desired: Literal["force", "wrench", "cone"] = "force"
    force_rate: float = 0.01


@dataclass(frozen=True)
class PoseStepsConfig:
    """How the pose is stepped. The defaults are the paper's, other choices those of grasping/src/cio.py.

    Attributes:
        optimiser: `adamax`, or the code's `adam`.
        translation_share: step size of the base's position, by `pose_rate`.
        rotation_share: step size of the base's quaternion, by `pose_rate`.
        in_turns: a step moves the position of the base alone, then orientation and joints at what that led to.
        within_limits: joints are put inside their limits after every move, else limits are a constraint alone.
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
        task_bound: how much motion the desired forces may leave: 60 is all of it, the code's 10 a sixth [1/60 of v²].
        limit_bound: joints may exceed their limits by this much in sum [rad].
        damping: of the multipliers.
        multiplier_rate: step size of the multipliers.
    """

    task_bound: float = 10.0
    limit_bound: float = 0.01
    damping: float = 1.0
    multiplier_rate: float = 0.01


@dataclass(frozen=True)
class ObjectiveWeights:
    """Weights of what is minimised.

    Attributes:
        physics: of the squared differences between desired and actual forces [1/N²].
        range: of the joints' distance from mid-range.
        inter: of the hand's overlap with itself, and with obstacles where there are any.
    """

    physics: float = 0.01
    range: float = 0.01
    inter: float = 1.0


@dataclass(frozen=True)
class Graspd2022Config:
    """Grasp'D as published (docs/method.md, §1). Where paper and released code differ, a switch, the paper's first.

    Attributes:
        initial: where the optimiser starts.
        level_set: coarse to fine: contact with the level set φ = r, r shrinking to zero.
        contact: the penalty contact.
        simulation: the one step of the object.
        relaxation: desired forces as variables (after contact-invariant optimisation).
        pose_steps: how the pose is stepped.
        constraints: bounds on L_task and L_limit, and their multipliers.
        weights: weights of what is minimised.
        steps: of the optimiser.
        pose_rate: step size of the pose [m], [half rad] and [rad].
        beta2: decay rate of the gradient's infinity norm (Adamax) or of its squares (Adam).
        warm_up: first steps, in which the step sizes of pose and forces grow linearly from zero.
        final_rate: share of the step sizes that is left at the end, faded along half a cosine. One keeps them.
        keep: the `best` iterate on the true surface, or the `last`.
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
