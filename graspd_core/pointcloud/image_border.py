"""Where a camera's picture ends: what reaches there may go on, and nobody saw that it does not."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.pointcloud.free_space import view_frame
from graspd_core.pointcloud.point_cloud import PointCloud, longest_side

# So many points on one side of the hull, of the object and of other things each: an object that stands out alone
# against nothing makes a hull of its own.
MIN_BORDER_POINTS = 8
# Shorter sides than this share of the outline's size are no border of a picture.
MIN_SIDE_SHARE = 0.1
# A border of a picture has points all along it, in so large a share of so many parts of its length: a side from the top
# of a thing to the corner of the table behind it has none between.
SIDE_PARTS, MIN_FILLED_SHARE = 20, 0.6
# Most objects are far from the outline, which the hull of so many points shows as well as that of all.
HULL_POINTS = 2000


def reaches_image_border(
    points: Float[np.ndarray, "points 3"], eye: Float[np.ndarray, "3"], mine: Bool[np.ndarray, "points"], width: float
) -> bool:
    """Whether the points of an object lie on a side of the view's outline on which other points lie too.

    Directions within `width` [rad] of the hull of all directions are on the outline.
    """
    from scipy.spatial import ConvexHull, QhullError

    if not mine.any():
        return False
    local = (points - eye) @ view_frame(PointCloud(points, eye))
    ahead = local[:, 2] > 1e-3
    plane, mine = local[ahead, :2] / local[ahead, 2:], mine[ahead]
    if _well_within(plane[mine], plane[:: 1 + len(plane) // HULL_POINTS], width):
        return False
    try:
        hull = ConvexHull(plane)
    except (QhullError, ValueError):
        return False
    ends = plane[hull.simplices]
    long = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > MIN_SIDE_SHARE * longest_side(plane)
    own, others = plane[mine], plane[~mine]
    for (*normal, offset), (start, end) in zip(hull.equations[long], ends[long], strict=True):
        # The object's few points first: most sides are none of theirs.
        near = own[own @ np.array(normal) + offset > -width]
        if len(near) < MIN_BORDER_POINTS:
            continue
        beside = others[others @ np.array(normal) + offset > -width]
        if len(beside) < MIN_BORDER_POINTS:
            continue
        if _filled(np.concatenate([near, beside]), start, end) >= MIN_FILLED_SHARE:
            return True
    return False


def _well_within(own: Float[np.ndarray, "own 2"], some: Float[np.ndarray, "some 2"], width: float) -> bool:
    """Whether no point is within `width` of the hull of all, since none is of the hull of some, which lies within."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        sides = ConvexHull(some).equations
    except (QhullError, ValueError):
        return False
    return all((own @ side[:2] + side[2]).max(initial=-np.inf) < -width for side in sides)


def _filled(near: Float[np.ndarray, "near 2"], start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> float:
    """Share of a side's parts in which points lie."""
    side = end - start
    part = np.floor(SIDE_PARTS * ((near - start) @ side) / (side @ side))
    return len(np.unique(part[(part >= 0) & (part < SIDE_PARTS)])) / SIDE_PARTS
