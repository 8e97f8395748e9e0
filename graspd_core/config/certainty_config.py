"""Settings of how sure a verified grasp must be where a part of the object's shape was guessed."""

from __future__ import annotations

from dataclasses import dataclass

from graspd_core.errors import ConfigError

# Share of grasps that hold on the true object, of those that failed under none, one and two of the hypotheses, by
# `graspd bench rgbd` (docs/clouds.md).
HELD_AFTER = (0.97, 0.93, 0.75)


@dataclass(frozen=True)
class CertaintyConfig:
    """What a grasp of an object whose hidden side was guessed must survive to be called verified.

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
