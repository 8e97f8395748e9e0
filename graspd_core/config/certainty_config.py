"""Settings of how sure a verified grasp must be where a part of the object's shape was guessed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CertaintyConfig:
    """What a grasp of an object whose hidden side was guessed must survive to be called verified.

    Attributes:
        probability: of holding on the true object, at least; 0 asks for trials of the likeliest shape alone, more for
            further ones (docs/clouds.md).
    """

    probability: float = 0.9
