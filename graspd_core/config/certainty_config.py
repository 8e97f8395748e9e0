"""Settings of how sure a verified grasp must be of an object that cameras saw."""

from __future__ import annotations

from dataclasses import dataclass

from graspd_core.errors import ConfigError

# Share of grasps that hold on the true object, of those that failed under none, one, two, three and more of the
# hypotheses: lower ends of 90 % intervals over 479 grasps of 60 single views of ten shapes and ten scans.
HELD_AFTER = (0.98, 0.93, 0.93, 0.87, 0.51)


@dataclass(frozen=True)
class CertaintyConfig:
    """What a grasp of an object that cameras saw must survive to be called verified.

    Attributes:
        probability: of holding on the true object, at least; 0 asks for trials of the likeliest shape alone, more for
            further ones (docs/clouds.md).

    Raises:
        ConfigError: nothing is so sure.
    """

    probability: float = 0.9

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= HELD_AFTER[0]:
            raise ConfigError(f"certainty.probability: {self.probability}; valid: 0 to {HELD_AFTER[0]}")
