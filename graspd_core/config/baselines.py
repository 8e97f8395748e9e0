"""Settings of the rivals that the chart compares with."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AnnealingConfig:
    """A GraspIt!-style planner: simulated annealing in a low-dimensional space of hand postures.

    Attributes:
        steps: of the annealing.
    """

    steps: int = 2000


@dataclass(frozen=True)
class RandomClosureConfig:
    """The floor: approach at random, close until contact.

    Attributes:
        close_steps: of the closing.
    """

    close_steps: int = 60
