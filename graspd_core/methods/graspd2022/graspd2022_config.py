"""Settings of the published Grasp'D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Graspd2022Config:
    """Grasp'D as published (docs/method.md, §1); where paper and released code differ, a switch, the paper's first.

    Attributes:
        starts_per_grasp: starts for each grasp asked for.
        starts: `published`, palm towards a random surface point from `standoff` away; `hull`, those of `closed_form`.
        standoff: distance of the palm from the surface point [m].
        all_candidates: contacts at all of the hand's candidates, rather than at those of `closed_form.candidates`.
        steps: of the optimiser.
        coarse_steps: first steps, in which the level set shrinks to the surface; zero leaves coarse to fine out.
        radius: level set at the start: `paper`, `radius_start`; `code`, the start's least distance less a centimetre.
        radius_start: of the paper [m].
        leak: slope of the depth out of contact; zero makes the gradient the plain one.
        relaxation: desired forces as variables; without it the motion after one step is minimised directly.
        desired: a desired force is a free `force`, a free `wrench` (the code's) or one in the friction `cone`.
        scaling: `published`, stiffness and time step as they are, in SI; `object`, the time step is the one in which
            `stopping_force` stops this object.
        stopping_force: of the scaling by object [N].
        stiffness: normal force of a contact by its depth [N/m].
        friction_stiffness: friction by tangential speed, below Coulomb's bound [N·s/m].
        friction: Coulomb coefficient.
        time_step: of the published scaling [s].
        speed: of the object in each of its three coordinates, forwards, backwards and none [m/s].
        task_bound: how much motion the desired forces may leave: 60 is all of it, the code's 10 a sixth [1/60 of v²].
        limit_bound: joints may exceed their limits by this much in sum [rad].
        damping: of the multipliers.
        multiplier_rate: step size of the multipliers.
        pose_rate: step size of the pose [m], [half rad] and [rad].
        force_rate: step size of the desired forces [N].
        memory: share of the greatest gradient so far that Adamax keeps from step to step.
        final_rate: share of the step sizes that is left at the end, faded along half a cosine; one keeps them.
        keep: the `best` iterate on the true surface, or the `last`.
        physics_weight: of the squared differences between desired and actual forces [1/N²].
        range_weight: of the joints' distance from mid-range.
        inter_weight: of the hand's overlap with itself, and with obstacles where there are any.
    """

    starts_per_grasp: float = 1.0
    starts: Literal["published", "hull"] = "published"
    standoff: float = 0.1
    all_candidates: bool = False
    steps: int = 7000
    coarse_steps: int = 5000
    radius: Literal["paper", "code"] = "paper"
    radius_start: float = 0.1
    leak: float = 0.1
    relaxation: bool = True
    desired: Literal["force", "wrench", "cone"] = "force"
    scaling: Literal["published", "object"] = "published"
    stopping_force: float = 5.0
    stiffness: float = 1e6
    friction_stiffness: float = 1e8
    friction: float = 0.8
    time_step: float = 1e-5
    speed: float = 0.01
    task_bound: float = 10.0
    limit_bound: float = 0.01
    damping: float = 1.0
    multiplier_rate: float = 0.01
    pose_rate: float = 0.003
    force_rate: float = 0.01
    memory: float = 0.999
    final_rate: float = 1.0
    keep: Literal["best", "last"] = "best"
    physics_weight: float = 0.01
    range_weight: float = 0.01
    inter_weight: float = 1.0
