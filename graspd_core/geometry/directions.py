"""Directions in space."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def perpendicular(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A unit vector square to a direction of any length but zero; any, but always the same."""
    side = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return side / np.linalg.norm(side)
