"""Settings of the postures that are made of an optimised pose."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GraspStagesConfig:
    """Pregrasp and squeeze.

    Attributes:
        touch_reach: links this near to the object count as touching [m].
        grip_force: sum of the normal forces of the squeeze [N].
        stiffness: position gain of the hand's joint controllers, of turning joints [N·m/rad].
        slide_stiffness: the same of sliding joints [N/m].
        effort_share: share of a joint's effort limit that the squeeze may use.
        clearance: distance from the object that the pregrasp opens to [m].
        open_steps: steps of the search for the pregrasp.
        open_joint_rate: its step size of the joints [rad]; sliding ones take 0.05 m for a radian.
        open_base_rate: its step size of the base [m].
    """

    touch_reach: float = 0.002
    grip_force: float = 40.0
    stiffness: float = 5.0
    slide_stiffness: float = 2000.0
    effort_share: float = 1.0
    clearance: float = 0.012
    open_steps: int = 40
    open_joint_rate: float = 0.04
    open_base_rate: float = 0.002
