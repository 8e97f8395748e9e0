"""Signs that a cluster is two things that touch: a neck between two broad parts."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

# A neck is at most this share as wide as the narrower part, and each part at least this share of the outline.
NECK = 0.5
PART = 0.2


def looks_double(
    points: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "3 2"], eye: Float[np.ndarray, "3"], cell: float
) -> bool:
    """Whether a cluster has a neck both from above and as the camera sees it.

    From above alone, what hides itself has necks; in the image alone, what is narrow in the middle.

    Args:
        points: evenly dense [m].
        axes: two unit vectors in the support, columns.
        eye: where the camera stood [m].
        cell: no finer than the points are apart [m].
    """
    view = points.mean(0) - eye
    image = np.linalg.svd(view[None])[2][1:].T
    return has_neck(points @ axes, cell) and has_neck(points @ image, cell)


def has_neck(flat: Float[np.ndarray, "n 2"], cell: float) -> bool:
    """Whether the outline of points in a plane falls into two broad parts when its narrow places are taken away."""
    from scipy.ndimage import binary_closing, binary_fill_holes, distance_transform_edt, label

    margin = 3
    index = np.round((flat - flat.min(0)) / cell).astype(int) + margin
    raster = np.zeros(index.max(0) + margin + 1, dtype=bool)
    raster[tuple(index.T)] = True
    filled = np.asarray(binary_fill_holes(binary_closing(raster, iterations=2)), dtype=bool)
    width: Any = distance_transform_edt(filled)
    for level in np.arange(1.0, NECK * width.max()):
        names, many = label(width > level)  # pyright: ignore[reportGeneralTypeIssues]
        widest = np.array([width[names == k].max() for k in range(1, many + 1)])
        # What erosion has left of a part was wider by the level all round.
        away: list[Any] = [distance_transform_edt(names != k) for k in range(1, many + 1)]
        share = np.array([(near <= level).sum() for near in away]) / filled.sum()
        broad = (level <= NECK * widest) & (share >= PART)
        if broad.sum() >= 2:
            return True
    return False
