"""Whether a cloud can have been seen from where its camera is said to have stood.

An organised cloud tells by itself: a pinhole camera's pixels and the lines of sight to their points differ by a
homography, since errors of depth move points along those lines. Without pixels, one camera sees no surface through
another: from a wrong place, points lie behind others on all sides of them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError
from graspd_core.perception.cloud.point_cloud import Points, Vector, measured
from graspd_core.se3 import perpendicular

# An organised cloud, NaN where nothing was seen.
Pixels = Float[np.ndarray, "height width 3"]

# A share of points that lie behind others. In 48 clouds with a D415's faults, thinned and cut out or not, the true
# place gives 0.0012 at most, nine in ten wrong places 0.005 at least.
MAX_HIDDEN_SHARE = 0.002
# Clouds of an object alone that show it from all round have more hidden than this: no camera is meant.
ALL_ROUND_SHARE = 0.15
MAX_MISFIT = 0.5  # pixels
MAX_STRETCH, MAX_SKEW = 1.15, 0.05  # of a camera's pixels, which are square
# Some of the points stand for all.
MOST_POINTS, MOST_PIXELS = 8000, 4000
FEWEST_PIXELS = 100
NEIGHBOURS = 16
# Flying pixels behind an edge are no surface: of a hidden point's neighbours so many are hidden too.
SURFACE_NEIGHBOURS, AGREEING_SHARE = 8, 0.75
HIDDEN_DEPTH, HIDDEN_DEPTH_SHARE = 0.03, 0.05  # [m], and of the distance
# A plane that holds this share of the points is a table; things on it are no farther from it than that [m].
PLANE_SHARE, PLANE_TRIALS, PLANE_TOLERANCE, THING_HEIGHT = 0.25, 200, 0.01, 0.35
# Root mean square of a table seen by a camera [m]; points all through the slab would have 0.0058.
PLANE_NOISE = 0.004
# Singular values of the camera matrix's equations: the two least are as far apart where the points are not in a plane.
MIN_CONDITION = 100.0


def check_viewpoint(points: Points, viewpoint: Vector, *, grid: Pixels | None = None, alone: bool = False) -> None:
    """Refuse a cloud that shows that its camera stood elsewhere.

    Args:
        points: finite [m].
        viewpoint: where the camera is said to have stood, in the same frame [m].
        grid: the same cloud in its pixels, NaN where nothing was seen; None where it is not organised.
        alone: whether the cloud shows one object, perhaps from all round.

    Raises:
        CloudError: and where the camera stood, if the cloud's pixels tell.
    """
    fits = None if grid is None or min(grid.shape[:2]) < 2 else _pinhole_fits(grid, viewpoint)
    place = _pinhole_place(grid) if fits is False and grid is not None else None
    if place is not None:
        x, y, z = place
        raise _refusal(viewpoint, f"its pixels show it at ({x:.3f}, {y:.3f}, {z:.3f})")
    points = _some(points, viewpoint)
    share = hidden_share(points, viewpoint)
    if share > MAX_HIDDEN_SHARE and not (alone and share > ALL_ROUND_SHARE):
        raise _refusal(viewpoint, f"{100 * share:.1f} % of its points are hidden from there by others")
    if not (alone or fits) and things_behind(points, viewpoint):
        raise _refusal(viewpoint, "things stand on the far side of the table")


def _refusal(viewpoint: Vector, reason: str) -> CloudError:
    x, y, z = viewpoint
    said = "the origin of its frame" if not np.any(viewpoint) else f"({x:g}, {y:g}, {z:g})"
    hint = "say where it stood: sensor_frame or view_point; several cameras are several views"
    return CloudError(f"cloud: its camera did not stand at {said}: {reason}; {hint}")


def hidden_share(points: Points, viewpoint: Vector) -> float:
    """Share of the points that have nearer ones all around them, seen from the viewpoint."""
    from scipy.spatial import KDTree

    ray = points - viewpoint
    distance = np.linalg.norm(ray, axis=1)
    ray /= distance[:, None]
    if len(ray) <= NEIGHBOURS:
        return 0.0
    around = np.asarray(KDTree(ray).query(ray, k=NEIGHBOURS + 1)[1])[:, 1:]
    nearer = distance[around] < (distance - np.maximum(HIDDEN_DEPTH, HIDDEN_DEPTH_SHARE * distance))[:, None]
    candidates = np.flatnonzero(nearer.sum(1) >= 3)
    hidden = np.zeros(len(ray), dtype=bool)
    hidden[candidates] = [_surrounded(ray[row], ray[around[row][nearer[row]]]) for row in candidates]
    if not hidden.any():
        return 0.0
    beside = np.asarray(KDTree(points).query(points[hidden], k=SURFACE_NEIGHBOURS + 1)[1])[:, 1:]
    return float((hidden[beside].mean(1) >= AGREEING_SHARE).sum() / len(ray))


def things_behind(points: Points, viewpoint: Vector) -> bool:
    """Whether more stands on the far side of a table, over what is seen of it, than on the side of the viewpoint."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(0)
    if len(points) <= NEIGHBOURS:
        return False
    corners = points[rng.integers(len(points), size=(PLANE_TRIALS, 3))]
    normals: np.ndarray = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 0] / lengths[lengths > 0, None], corners[lengths > 0]
    if not len(normals):
        return False
    height = np.abs(points[:: 1 + len(points) // 2000] @ normals.T - (corners[:, 0] * normals).sum(1))
    best = int(np.argmax(np.count_nonzero(height < PLANE_TOLERANCE, axis=0)))
    normal = normals[best] * (1.0 if (viewpoint - corners[best, 0]) @ normals[best] > 0 else -1.0)
    height = (points - corners[best, 0]) @ normal
    on = np.abs(height) < PLANE_TOLERANCE
    if on.mean() < PLANE_SHARE:
        return False
    offset = points[on] - points[on].mean(0)
    if not np.linalg.svd(offset, compute_uv=False)[2] < PLANE_NOISE * np.sqrt(len(offset)):
        return False
    first = perpendicular(normal)
    flat = points @ np.column_stack([first, np.cross(normal, first)])
    over = Delaunay(flat[on]).find_simplex(flat) >= 0
    near, far = (over & (side > 1.5 * PLANE_TOLERANCE) & (side < THING_HEIGHT) for side in (height, -height))
    return bool(far.mean() > MAX_HIDDEN_SHARE and far.sum() > near.sum())


def _some(points: Points, viewpoint: Vector) -> Float[np.ndarray, "m 3"]:
    # In any order: clouds are often sorted by place, and the first of them would be a part of the scene.
    points = points[np.random.default_rng(0).permutation(len(points))[: 2 * MOST_POINTS]]
    return points[measured(points, viewpoint)][:MOST_POINTS]


def _surrounded(ray: Vector, others: Points) -> bool:
    first = perpendicular(ray)
    offset = others - ray
    angle = np.sort(np.arctan2(offset @ np.cross(ray, first), offset @ first))
    gaps = np.diff(angle, append=angle[0] + 2 * np.pi)
    return bool(gaps.max() < np.pi)


def _pinhole_fits(grid: Pixels, viewpoint: Vector) -> bool | None:
    """Whether a pinhole camera at the viewpoint explains the pixels; None where there are too few."""
    pixels, points = _pixels(grid)
    ray = points - viewpoint
    distance = np.linalg.norm(ray, axis=1)
    seen = (distance > 1e-6) & points.any(1)
    if seen.sum() < FEWEST_PIXELS:
        return None
    ray, pixel, size = ray[seen] / distance[seen, None], pixels[seen], max(grid.shape[:2])
    H = _null(_cross_rows(ray, pixel))[0].reshape(3, 3)
    guess = pixel @ H.T
    guess /= np.linalg.norm(guess, axis=1, keepdims=True)
    angle = np.arcsin(np.clip(np.linalg.norm(np.cross(guess, ray), axis=1), 0.0, 1.0))
    # H is a rotation times the inverse of the camera's matrix, but for its scale.
    square = H.T @ H
    widths = np.linalg.norm(square[:2, :2], axis=1)
    pixel_angle = np.linalg.norm(H[:, 0]) / np.linalg.norm(H[:, 2]) / size
    skew = square[0, 1] / np.sqrt(square[0, 0] * square[1, 1]) if widths.all() else 1.0
    stretch, misfit = square[0, 0] / square[1, 1], np.median(angle) / max(pixel_angle, 1e-12)
    is_square = 1 / MAX_STRETCH < stretch < MAX_STRETCH and abs(skew) < MAX_SKEW
    return bool(misfit < MAX_MISFIT and is_square)


def _pinhole_place(grid: Pixels) -> Vector | None:
    """Where the camera stood whose pixels these are; None where no pinhole fits or the scene is too flat to tell."""
    pixels, points = _pixels(grid)
    points, pixels = points[points.any(1)], pixels[points.any(1)]
    if len(points) < FEWEST_PIXELS:
        return None
    centre, size = points.mean(0), points.std()
    local = np.c_[(points - centre) / max(size, 1e-12), np.ones(len(points))]
    solution, condition = _null(_cross_rows(pixels, local))
    P = solution.reshape(3, 4)
    image = local @ P.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(image[:, :2] / image[:, 2:] - pixels[:, :2], axis=1) * max(grid.shape[:2])
    if condition < MIN_CONDITION or not np.median(off) < MAX_MISFIT:
        return None
    return centre + size * np.linalg.solve(P[:, :3], -P[:, 3])


def _pixels(grid: Pixels) -> tuple[Points, Points]:
    """Homogeneous pixels, as shares of the image's larger side from its middle, and their points; some of them."""
    height, width = grid.shape[:2]
    step = max(1, int(np.sqrt(height * width / MOST_PIXELS)))
    some = grid[::step, ::step]
    v, u = np.mgrid[0:height:step, 0:width:step]
    seen = np.isfinite(some).all(2)
    pixels = np.c_[u[seen] - width / 2, v[seen] - height / 2] / max(height, width)
    return np.c_[pixels, np.ones(len(pixels))], some[seen]


def _cross_rows(a: Points, b: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "rows columns"]:
    zero = np.zeros_like(b)
    first, second, third = (a[:, [k]] * b for k in range(3))
    rows = ([zero, -third, second], [third, zero, -first], [-second, first, zero])
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def _null(rows: Float[np.ndarray, "rows columns"]) -> tuple[Float[np.ndarray, "columns"], float]:
    _, values, vectors = np.linalg.svd(rows, full_matrices=False)
    return vectors[-1], float(values[-2] / max(values[-1], 1e-12 * values[0]))
