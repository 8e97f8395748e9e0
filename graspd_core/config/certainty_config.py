"""Settings of how sure a verified grasp must be of an object that cameras saw."""

from __future__ import annotations

from dataclasses import dataclass

from graspd_core.errors import ConfigError

# Shares of grasps that hold on the true object, lower ends of 90 % intervals over 957 grasps of 120 single views of ten
# shapes and ten scans: of those that hold on the likeliest shape; of these, that also hold out of place and with less
# friction; of these, that also hold on another shape of the hidden side.
HELD = (0.91, 0.94, 0.97)
# And of those that fail at the second of these, at the third.
HELD_THOUGH_FAILED = (0.76, 0.84)


@dataclass(frozen=True)
class CertaintyConfig:
    """What a grasp of an object that cameras saw must survive to be called verified.

    Attributes:
        probability: of holding on the true object, at least; 0 asks for trials of the likeliest shape alone, more for
            further ones (docs/clouds.md).

    Raises:
        ConfigError: nothing is so sure.
    """

    probability: float = 0.95

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= HELD[-1]:
            raise ConfigError(f"certainty.probability: {self.probability}; valid: 0 to {HELD[-1]}")
