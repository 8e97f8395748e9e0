"""Settings of the random baseline."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RandomClosureConfig:
    """Approach at random, close until contact.

    Attributes:
        rounds: of as many approaches as grasps are asked for, until as many touch well enough.
        touching: rigid groups of links that must touch.
        close_steps: of the closing, from open to closed.
    """

    rounds: int = 4
    touching: int = 3
    close_steps: int = 60
