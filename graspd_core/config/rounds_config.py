"""Settings of the rounds of optimiser and trial."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RoundsConfig:
    """Rounds of optimiser and trial: where too few grasps held, what is missing is sought again from other starts.

    An effort of one is the method's settings as they are; less is that share of its steps, more is as many times its
    starts.

    Attributes:
        most: rounds at most.
        first_budget: of the first round, on an object of known shape that stands alone; elsewhere it is one.
        growth: times as much effort with every further round.
    """

    most: int = 3
    first_budget: float = 0.5
    growth: float = 2.0
