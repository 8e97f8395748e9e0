"""Settings of the problem that every method's poses are measured in."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ProblemConfig:
    """How scene and hand are laid out as tensors; every method's poses become grasps and are ranked in these terms.

    Attributes:
        candidates: contact candidates looked at by most steps.
        fine_candidates: contact candidates looked at while polishing.
        patch_size: how many of them make a patch that is drawn to the surface by itself, so that all of the hand comes
            to touch; zero: of each rigid group of links the nearest candidate is drawn.
        features: sharp points of the object looked at while polishing.
        directions: disturbance wrenches.
        friction: coefficient planned with; below the object's own, so that contacts keep a margin.
        confidence_floor: what a contact counts on surface that was only guessed; one where it was seen.
    """

    candidates: int = 256
    fine_candidates: int = 600
    patch_size: int = 0
    features: int = 128
    directions: int = 24
    friction: float = 0.4
    confidence_floor: float = 0.4
