"""Settings of the published Grasp'D."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Graspd2022Config:
    """Grasp'D as published (docs/method.md).

    Attributes:
        steps: of the optimiser.
    """

    steps: int = 7000
