"""Signs that a cluster is two things that touch: a neck between two broad parts."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

# A neck is at most this share as wide as the narrower part, and each part at least this share of the outline.
NECK = 0.5
PART = 0.2


def looks_double(
    points: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "3 2"], eye: Float[np.ndarray, "3"], cell: float
) -> bool:
    """Whether a cluster's outline on its support has a neck that no occlusion explains.

    Args:
        points: evenly dense [m].
        axes: two unit vectors in the support, columns.
        eye: where the camera stood [m].
        cell: no finer than the points are apart [m].
    """
    flat = (points - eye) @ axes
    middle = flat.mean(0)
    away = float(np.linalg.norm(middle))
    reach = float(np.linalg.norm(flat - middle, axis=1).max())
    if away < 1.5 * reach:
        return has_neck(_filled(flat, cell))
    # Across and along the directions of view: what lies between two seen points of one direction may be hidden.
    along = middle / away
    radius = np.linalg.norm(flat, axis=1)
    across = away * np.arctan2(flat @ [-along[1], along[0]], flat @ along)
    raster = _filled(np.column_stack([across, radius]), cell)
    behind = np.logical_or.accumulate(raster, axis=1)
    before = np.logical_or.accumulate(raster[:, ::-1], axis=1)[:, ::-1]
    return has_neck(behind & before)


def _filled(flat: Float[np.ndarray, "n 2"], cell: float) -> Bool[np.ndarray, "x y"]:
    """A raster of points, small gaps and holes closed, with an empty margin."""
    from scipy.ndimage import binary_closing, binary_fill_holes

    margin = 3
    index = np.round((flat - flat.min(0)) / cell).astype(int) + margin
    raster = np.zeros(index.max(0) + margin + 1, dtype=bool)
    raster[tuple(index.T)] = True
    return np.asarray(binary_fill_holes(binary_closing(raster, iterations=2)), dtype=bool)


def has_neck(filled: Bool[np.ndarray, "x y"]) -> bool:
    """Whether an outline falls into two broad parts when its narrow places are taken away."""
    from scipy.ndimage import distance_transform_edt, label

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
