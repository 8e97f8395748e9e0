"""Settings of simulated annealing."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AnnealingConfig:
    """A GraspIt!-style planner: simulated annealing in a low-dimensional space of hand postures.

    Attributes:
        chains_per_grasp: chains run for each grasp asked for, one grasp each; the best by ε are kept.
        keep_per_grasp: closed grasps kept for each grasp asked for.
        steps: states tried by each chain.
        eigengrasps: dimensions of the space of hand postures.
        contacts_per_link: places on the inside of each link that are drawn to the object.
        normal_weight: what a contact location that faces away from the object costs, as a distance [m].
        translation_jump: largest jump of the base [m].
        rotation_jump: largest turn of the base about each of its axes [rad].
        posture_jump: largest jump along an eigengrasp, as a share of its range.
        close_steps: of the closing of the best states, from open to closed.
        directions: wrenches that ε is the least resistance against.
    """

    chains_per_grasp: float = 4.0
    keep_per_grasp: float = 2.0
    steps: int = 2500
    eigengrasps: int = 2
    contacts_per_link: int = 2
    normal_weight: float = 0.05
    translation_jump: float = 0.1
    rotation_jump: float = 0.63
    posture_jump: float = 0.25
    close_steps: int = 60
    directions: int = 256
