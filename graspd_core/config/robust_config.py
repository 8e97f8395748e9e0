"""Settings of the ranking by robustness."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RobustConfig:
    """Verified grasps tried again with the hand out of place by up to 5 mm and 5°: those that still hold come first.

    Attributes:
        rank: whether that is done; it takes `trials` further hold trials for every verified grasp.
        trials: hold trials of each.
        hold_time: how long each of their six pulls lasts [s].
    """

    rank: bool = False
    trials: int = 8
    hold_time: float = 0.5
