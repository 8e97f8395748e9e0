"""Which points no other point beats."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def pareto_front(points: Float[np.ndarray, "points axes"]) -> Bool[np.ndarray, "points"]:
    """Which points are on the front where less is better on every axis.

    A point is off it when another is no worse on every axis and better on one; equal points are on it together.
    """
    no_worse = (points[:, None] <= points[None]).all(-1)
    better = (points[:, None] < points[None]).any(-1)
    return np.asarray(~(no_worse & better).any(0))
