"""Check whether a cloud can have been seen from the given position of its camera.

An organised cloud (with one point per pixel) is checked by the pixels: a homography must map the pixels of a pinhole
camera to the lines of sight. Depth errors only move points along these lines. Without pixels, two rules are checked: a
camera sees no surface through another surface, and no surface from behind. If the given position is wrong, some points
seem to be hidden behind other points. A part of each curved surface then seems to face away from the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from graspd_core.errors import CloudError
from graspd_core.mesh.components import connected_parts
from graspd_core.mesh.convex_parts import convex_hull
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector, longest_side, measured
from graspd_core.se3 import perpendicular

# An organised cloud [m], NaN where nothing was seen.
Pixels = Float[np.ndarray, "height width 3"]
# For each point: the normal, the index of the surface, and whether both are certain.
Surfaces = tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"], Bool[np.ndarray, "n"]]

# Largest fraction of points that other points may hide, and of an object's points that may face away. Chosen on 91
# views by four cameras of the families `CHOSEN_ON` in graspd_bench/studies/cameras.py. Some were thinned or cut out.
MAX_HIDDEN_SHARE, MAX_AWAY_SHARE = 0.006, 0.06
MAX_MISFIT = 0.5  # largest median error of the fitted camera [pixels]
MAX_STRETCH, MAX_SKEW = 1.15, 0.05  # aspect ratio and skew of pixels: a camera's pixels are nearly square
# Maximum numbers of points and of pixels to check. With fewer than the minimum numbers, nothing is checked.
MOST_POINTS, MOST_PIXELS = 4000, 4000
FEWEST_POINTS, FEWEST_PIXELS = 50, 100
NEIGHBOURS = 8  # nearest points in space around a point
# Cell size of the image of the points, in point spacings, and most cells in a row. A point is hidden if NEARER_CELLS of
# the eight cells around its cell show a nearer point. AGREEING_SHARE of the neighbours in space must be hidden too,
# because flying pixels behind an edge are no surface.
CELL_SPACINGS, MOST_CELLS, NEARER_CELLS, AGREEING_SHARE = 1.5, 1000, 7, 0.75
# Hiding points are nearer by this [m], and by a fraction of the distance (scenes) or a multiple of roughness (objects).
HIDDEN_DEPTH, HIDDEN_DEPTH_SHARE, ROUGHNESS_TIMES = 0.03, 0.05, 8.0
# Neighbours share a surface if the absolute cosine of their normals is above SAME_SURFACE. A normal is certain if the
# variance along it is below FLATNESS times the next variance. Points seen at a cosine below GRAZING do not count.
SAME_SURFACE, FLATNESS, GRAZING = 0.6, 0.15, 0.1
LINK_SPACINGS = 3.0  # neighbours farther apart than this many median spacings are not linked
# The inside and the outside of a thin wall are parallel and near, but no surface: neighbours are not linked if one is
# off the other's tangent plane by this multiple of the roughness, or by this multiple of the median spacing. Chosen on
# views of mugs, bowls and four families by four cameras (seeds 500 to 513).
ASIDE_TIMES, ASIDE = 3.0, 0.1
THING_SPACING = 0.004  # an object's points are thinned to one point per voxel of this side [m]
ABOUT_THING, FARTHEST = 0.12, 1e7  # margin around an object's points, and largest plausible coordinate [m]
# Positions 45° or more away are tried too. The given position is doubtful if more than this fraction of them fit. For
# nine of ten clouds with true positions, at most 0.2 of them fit (scenes), or at most 0.34 (cut-out objects).
OTHER_SIDE, MOST_CHANCE = float(np.cos(np.pi / 4)), 0.3
# An object without its table also fits a camera right behind it, but looks hollow. Few objects bulge less than this.
LEAST_BULGE = 0.05
# A table is a plane with PLANE_SHARE of the points. Objects on it are at most THING_HEIGHT high. Lengths are in [m].
PLANE_SHARE, PLANE_TRIALS, PLANE_TOLERANCE, THING_HEIGHT = 0.25, 200, 0.01, 0.35
# A camera is above the plane of a table by at least this fraction of its distance from the table.
LEAST_ELEVATION = 0.03
# Largest RMS distance of a table's points from its plane [m]. Points spread evenly in PLANE_TOLERANCE have 0.0058.
PLANE_NOISE = 0.004
# Least ratio of the second smallest to the smallest singular value of the camera equations. Coplanar points have less.
MIN_CONDITION = 100.0
# A point lies in empty space if all points around its line of sight are farther by this [m], and by this fraction of
# its distance. A view contradicts the others if more than MOST_EMPTY_THING of their points of the object, or MOST_EMPTY
# of their points near the object, lie in space that the view saw to be empty. In 16 scenes of four shapes, with two or
# three true poses and two levels of noise, the fractions were at most 0.04 and 0.006.
EMPTY_DEPTH, EMPTY_DEPTH_SHARE, MOST_EMPTY_THING, MOST_EMPTY, EMPTY_POINTS = 0.01, 0.02, 0.1, 0.05, 1000

# 72 even directions on a golden spiral. With only 24 directions, 0.25 to 0.5 of them fitted a box instead of 0.21.
_TURNS = np.pi * (3 - np.sqrt(5)) * np.arange(72)
_HEIGHTS = 1 - (2 * np.arange(72) + 1) / 72
_DIRECTIONS = np.column_stack([np.cos(_TURNS), np.sin(_TURNS)]) * np.sqrt(1 - _HEIGHTS**2)[:, None]
_DIRECTIONS = np.column_stack([_DIRECTIONS, _HEIGHTS])


def seen_from(pixels: Pixels, viewpoint: Vector, forward: Vector | None = None) -> PointCloud:
    """Return the cloud of an organised image, with `posed` set if its pixels fit a camera at `viewpoint`.

    NaN points are kept. An image of one row or column is not checked.

    Raises CloudError: the viewpoint is not a position, or the pixels show another position, which the error names.
    """
    viewpoint = np.asarray(viewpoint, dtype=float)
    refuse_no_place(viewpoint)
    fits = None if min(pixels.shape[:2]) < 2 else _pinhole_fits(pixels, viewpoint)
    place = _pinhole_place(pixels) if fits is False else None
    if place is not None:
        x, y, z = place
        raise _refusal(viewpoint, f"its pixels show the camera at ({x:.3f}, {y:.3f}, {z:.3f})")
    return PointCloud(pixels.reshape(-1, 3), viewpoint, forward, posed=bool(fits))


def refuse_no_place(viewpoint: np.ndarray) -> None:
    """Raise CloudError if a viewpoint is not three finite numbers."""
    if viewpoint.shape != (3,) or not np.isfinite(viewpoint).all():
        raise CloudError(f"cloud: its viewpoint is {viewpoint.tolist()}; valid: 3 finite numbers [m]")


def check_scene(views: Sequence[PointCloud]) -> None:
    """Check that views of a whole scene, in one frame, can have been seen from their viewpoints.

    Raises:
        CloudError: a view cannot have been seen from its viewpoint. The error says why.
    """
    for view in views:
        if view.posed:
            continue
        points = _some(view.points, view.viewpoint, MOST_POINTS // len(views))
        if len(points) < FEWEST_POINTS:
            continue
        distance = np.linalg.norm(points - view.viewpoint, axis=1)
        nearer = np.maximum(HIDDEN_DEPTH, HIDDEN_DEPTH_SHARE * distance)
        share = hidden_share(points, view.viewpoint, nearer, KDTree(points))
        if share > MAX_HIDDEN_SHARE:
            raise _refusal(view.viewpoint, f"{100 * share:.1f} % of its points are hidden from there by other points")
        if things_behind(points, view.viewpoint):
            raise _refusal(
                view.viewpoint, "this place lies in the table's plane, or most points lie on the table's far side"
            )


def check_viewpoint(thing: PointCloud, view: PointCloud, up: Vector | None = None) -> str:
    """Check that an object can have been seen from the view's viewpoint: not from behind, and not through surfaces.

    Args:
        thing: the points of the object that was cut out of the view.
        view: all points that the same camera saw.
        up: normal of the support plane of the object, None if the support is not seen.

    Returns:
        A warning if many other camera positions fit as well, or if the object looks hollow. Otherwise "".

    Raises:
        CloudError: the camera cannot have been at the viewpoint. The error says why.
    """
    own = _thinned(thing)
    if view.posed or len(own) < FEWEST_POINTS:
        return ""
    if ((own.min(0) < view.viewpoint) & (view.viewpoint < own.max(0))).all():
        raise _refusal(view.viewpoint, "this place lies within the object")
    near = _some(view.points[_in_box(view.points, own)], view.viewpoint, MOST_POINTS)
    if len(near) < FEWEST_POINTS:
        return ""
    surfaces, tree = _surfaces(own), KDTree(near)
    nearer = np.full(len(near), max(HIDDEN_DEPTH, ROUGHNESS_TIMES * _roughness(near, tree)))
    away = _away_share(own, surfaces, view.viewpoint)
    if away > MAX_AWAY_SHARE:
        raise _refusal(
            view.viewpoint, f"{100 * away:.0f} % of the object's points would show the camera the inside of the surface"
        )
    hidden = hidden_share(near, view.viewpoint, nearer, tree)
    if hidden > MAX_HIDDEN_SHARE:
        raise _refusal(view.viewpoint, f"{100 * hidden:.1f} % of the points around the object are hidden from there")
    if up is None and bulge(own, surfaces, view.viewpoint) < LEAST_BULGE:
        return f"from {_said(view.viewpoint)} the object is hollow, or seen from the back of its surface"
    middle = own.mean(0)
    far = float(np.linalg.norm(view.viewpoint - middle))
    said = (view.viewpoint - middle) / far
    ways = [way for way in _DIRECTIONS if way @ said < OTHER_SIDE and (up is None or way @ up > 0)]
    most, fit = int(MOST_CHANCE * len(ways)), 0
    for tried, place in enumerate(middle + far * way for way in ways):
        # The loop ends as soon as the remaining positions cannot change the answer.
        if not fit <= most < fit + len(ways) - tried:
            break
        fit += _away_share(own, surfaces, place) <= MAX_AWAY_SHARE and (
            hidden_share(near, place, nearer, tree) <= MAX_HIDDEN_SHARE
        )
    if fit <= most:
        return ""
    share = f"more than {100 * MOST_CHANCE:.0f} %"
    return f"{share} of all places for the camera fit the cloud as well as {_said(view.viewpoint)}"


def check_views(things: Sequence[PointCloud], views: Sequence[PointCloud]) -> str:
    """Return a warning if one view saw empty space where other views show the object or points near it.

    If no view contradicts the others, return "".

    Args:
        things: the points of the object in each view that shows the object.
        views: all points that each camera saw, in one frame.
    """
    box = np.concatenate([thing.points for thing in things])
    around = [(view, view.points[_in_box(view.points, box)]) for view in views]
    worst, told = 1.0, ""
    for number, view in enumerate(views, 1):
        for parts, what, most in (
            ([(thing, thing.points) for thing in things], "of the object", MOST_EMPTY_THING),
            (around, "of the points near the object", MOST_EMPTY),
        ):
            others = [points for other, points in parts if (other.viewpoint != view.viewpoint).any()]
            share = empty_share(np.concatenate(others), view) if others else 0.0
            if share / most > worst:
                worst = share / most
                told = f"view {number} saw empty space where other views show {100 * share:.0f} % {what}"
    return f"{told}: is the pose of each camera right?" if told else ""


def empty_share(points: Points, view: PointCloud) -> float:
    """Return the fraction of points that lie in space which the camera of a view saw to be empty."""
    own = _some(points, view.viewpoint, EMPTY_POINTS) - view.viewpoint
    seen = view.points[measured(view.points, view.viewpoint)] - view.viewpoint
    near, far = (np.linalg.norm(ray, axis=1) for ray in (own, seen))
    own, seen = own / near[:, None], seen / far[:, None]
    # Most points are outside the cone of the lines of sight and are dropped first.
    within = np.flatnonzero(seen @ own.mean(0) >= (own @ own.mean(0)).min(initial=1.0))
    if len(own) < FEWEST_POINTS or len(within) < FEWEST_POINTS:
        return 0.0
    within = np.random.default_rng(0).permutation(within)[:MOST_POINTS]
    tree = KDTree(seen[within])
    spacing = float(np.median(tree.query(tree.data[::8], k=5)[0][:, -1]))
    # A point without enough sights around it gets the depth of minus infinity, because the space there is unknown.
    around = np.asarray(tree.query(own, k=NEIGHBOURS, distance_upper_bound=LINK_SPACINGS * spacing)[1])
    beyond = np.append(far[within], -np.inf)[around].min(1)
    return float((beyond - near > np.maximum(EMPTY_DEPTH, EMPTY_DEPTH_SHARE * near)).mean())


def fits_nowhere(thing: PointCloud) -> bool:
    """Return True if no camera position can see all points of an object, e.g. if the points lie on all its sides."""
    own = _thinned(thing)
    if len(own) < FEWEST_POINTS:
        return False
    surfaces, middle = _surfaces(own), own.mean(0)
    far = max(float(np.linalg.norm(thing.viewpoint - middle)), 3 * longest_side(own))
    return all(_away_share(own, surfaces, middle + far * way) > MAX_AWAY_SHARE for way in _DIRECTIONS)


def _refusal(viewpoint: Vector, reason: str) -> CloudError:
    hint = "give the camera's place: sensor_frame or view_point (--view-point X Y Z); pass each camera as its own view"
    return CloudError(f"cloud: its camera did not stand at {_said(viewpoint)}: {reason}; {hint}")


def _said(viewpoint: Vector) -> str:
    x, y, z = viewpoint
    return f"({x:g}, {y:g}, {z:g})" if np.any(viewpoint) else "the origin of its frame"


def hidden_share(points: Points, viewpoint: Vector, nearer: Float[np.ndarray, "points"], tree: Any) -> float:
    """Return the fraction of points that a surface hides from the viewpoint.

    A point is hidden if points around it in the image are nearer by more than `nearer` [m]. Most of its neighbours must
    be hidden too. `tree` is the KD-tree of the points.
    """
    ray = points - viewpoint
    distance = np.linalg.norm(ray, axis=1)
    length = float(np.linalg.norm(ray.mean(0)))
    # If the viewpoint is the mean of the points, every axis is equally good.
    axis = ray.mean(0) / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
    right = perpendicular(axis)
    across = np.column_stack([ray @ right, ray @ np.cross(axis, right)])
    aside = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    # Image coordinates are angles instead of x/z and y/z, because a wrong viewpoint may lie among the points.
    image = across * (np.arctan2(aside, ray @ axis) / aside)[:, None]
    # There are few queries, so balancing the tree would cost more time than it saves.
    in_image = KDTree(image, balanced_tree=False, compact_nodes=False)
    spacing = float(np.median(in_image.query(image[::8], k=5)[0][:, -1]))
    cell = max(CELL_SPACINGS * spacing, longest_side(image) / MOST_CELLS, 1e-12)
    column, row = (np.floor((image - image.min(0)) / cell).astype(int) + 1).T
    rows = int(row.max()) + 2
    own = column * rows + row
    front = np.full((int(column.max()) + 2) * rows, np.inf)
    np.minimum.at(front, own, distance)
    beside = [k * rows + n for k in (-1, 0, 1) for n in (-1, 0, 1) if k or n]
    hidden = np.sum([front[own + step] < distance - nearer for step in beside], axis=0) >= NEARER_CELLS
    if hidden.mean() <= MAX_HIDDEN_SHARE:
        # The check of the neighbours below can only lower the fraction.
        return float(hidden.mean())
    around = tree.query(points[hidden], k=NEIGHBOURS + 1)[1][:, 1:]
    return float((hidden[around].mean(1) >= AGREEING_SHARE).sum() / len(points))


def _away_share(points: Points, surfaces: Surfaces, viewpoint: Vector) -> float:
    """Turn the normals of each surface mostly to the viewpoint. Return the fraction of points that still face away."""
    normal, surface, clear = surfaces
    ray = viewpoint - points
    cosine = (normal * ray).sum(1) / np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
    sides = [np.bincount(surface[clear], one[clear].astype(float)) for one in (cosine > GRAZING, cosine < -GRAZING)]
    return float(np.minimum(*sides).sum() / max(int(clear.sum()), 1))


def bulge(points: Points, surfaces: Surfaces, viewpoint: Vector) -> float:
    """Return how far a surface bulges towards the viewpoint, from -1 (hollow) to 1 (convex)."""
    normal, _, clear = surfaces
    offset = points[clear] - points[clear].mean(0)
    facing = normal[clear] * np.sign((normal[clear] * (viewpoint - points[clear])).sum(1))[:, None]
    return float((offset * facing).sum() / max(float(np.linalg.norm(offset, axis=1).sum()), 1e-12))


def _surfaces(points: Points) -> Surfaces:
    """Return normals of consistent sign within each surface, each point's surface index, and whether both are certain.

    In a graph, each point has two nodes, one for each sign of its normal. Edges join neighbours whose normals agree.
    """
    distance, around = KDTree(points).query(points, k=NEIGHBOURS + 1)
    patch = points[around] - points[around].mean(1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nka,nkb->nab", patch, patch))
    normal, clear = axes[:, :, 0], spread[:, 0] < FLATNESS * spread[:, 1]
    a, b = np.repeat(np.arange(len(points)), NEIGHBOURS), np.asarray(around)[:, 1:].ravel()
    agree = (normal[a] * normal[b]).sum(1)
    spacing, rough = np.median(distance[:, 1:5]), np.sqrt(np.median(spread[:, 0]) / (NEIGHBOURS + 1))
    aside = np.abs([(normal[end] * (points[b] - points[a])).sum(1) for end in (a, b)]).max(0)
    linked = clear[a] & clear[b] & (np.abs(agree) > SAME_SURFACE)
    linked &= (distance[:, 1:].ravel() < LINK_SPACINGS * spacing) & (aside < max(ASIDE_TIMES * rough, ASIDE * spacing))
    a, b, same = a[linked], b[linked], agree[linked] > 0
    many = len(points)
    ends = np.r_[np.where(same, b, b + many), np.where(same, b + many, b)]
    part = connected_parts(2 * many, np.r_[a, a + many], ends)
    surface: Int[np.ndarray, "points"] = np.minimum(part[:many], part[many:])
    sign = np.where(part[:many] == surface, 1.0, -1.0)
    return normal * sign[:, None], surface, clear & (part[:many] != part[many:])


def _roughness(points: Points, tree: Any) -> float:
    """Return the RMS distance [m] of a point's neighbours from a plane fitted to them, as the median of all points."""
    around = tree.query(points[::8], k=NEIGHBOURS + 1)[1]
    patch = points[around] - points[around].mean(1, keepdims=True)
    spread = np.linalg.eigvalsh(np.einsum("nka,nkb->nab", patch, patch) / (NEIGHBOURS + 1))
    return float(np.sqrt(max(np.median(spread[:, 0]), 0.0)))


def things_behind(points: Points, viewpoint: Vector) -> bool:
    """Return True if more points lie below the seen part of a table than on it. Below is the side away from the camera.

    Return True as well if the viewpoint lies in the table's plane, as the origin of a robot's base often does.
    """
    rng = np.random.default_rng(0)
    corners = points[rng.integers(len(points), size=(PLANE_TRIALS, 3))]
    normals: np.ndarray = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 0] / lengths[lengths > 0, None], corners[lengths > 0]
    if not len(normals):
        return False
    # The product is written out, because BLAS would start threads that wait for each other on a busy machine.
    (x, y, z), (a, b, c) = (points[:: 1 + len(points) // 2000, None].T.astype(np.float32), normals.T.astype(np.float32))
    height = np.abs(x.T * a + y.T * b + z.T * c - (corners[:, 0] * normals).sum(1).astype(np.float32))
    best = int(np.argmax(np.count_nonzero(height < PLANE_TOLERANCE, axis=0)))
    on = np.abs((points - corners[best, 0]) @ normals[best]) < PLANE_TOLERANCE
    if on.mean() < PLANE_SHARE:
        return False
    spread, axes = np.linalg.eigh(np.cov(points[on].T, bias=True))
    if not spread[0] < PLANE_NOISE**2:
        return False
    normal, middle = axes[:, 0], points[on].mean(0)
    above = float((viewpoint - middle) @ normal)
    if abs(above) < LEAST_ELEVATION * np.median(np.linalg.norm(points[on] - viewpoint, axis=1)):
        return True
    height = (points - middle) @ normal * np.sign(above)
    first = perpendicular(normal)
    flat = points @ np.column_stack([first, np.cross(normal, first)])
    seen = convex_hull(flat[on])
    if seen is None:
        return False
    over = (np.einsum("nk,fk->nf", flat, seen.equations[:, :2]) <= -seen.equations[:, 2]).all(1)
    near, far = (over & (side > 1.5 * PLANE_TOLERANCE) & (side < THING_HEIGHT) for side in (height, -height))
    return bool(far.mean() > MAX_HIDDEN_SHARE and far.sum() > near.sum())


def _thinned(thing: PointCloud) -> Float[np.ndarray, "m 3"]:
    """Return at most `MOST_POINTS` of an object's points [m]. Return none if a coordinate is too large to be metres."""
    known = thing.points[measured(thing.points, thing.viewpoint)]
    if not len(known) or np.abs(known).max() > FARTHEST:
        return np.zeros((0, 3))
    return _some(replace(thing, points=known).thinned(THING_SPACING).points, thing.viewpoint, MOST_POINTS)


def _in_box(points: Points, thing: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, "m"]:
    """Return the indices of points in a padded box around an object. Test axes in turn to drop far points early."""
    inside = np.arange(len(points))
    for axis in range(3):
        side = points[inside, axis]
        low, high = thing[:, axis].min() - ABOUT_THING, thing[:, axis].max() + ABOUT_THING
        inside = inside[(side > low) & (side < high)]
    return inside


def _some(points: Points, viewpoint: Vector, most: int) -> Float[np.ndarray, "m 3"]:
    # Points are drawn at random, because clouds are often sorted by position.
    rng = np.random.default_rng(0)
    points = points[rng.choice(len(points), min(2 * most, len(points)), replace=False)]
    return points[measured(points, viewpoint)][:most].astype(float)


def _pinhole_fits(grid: Pixels, viewpoint: Vector) -> bool | None:
    """Return whether a pinhole camera at the viewpoint explains the pixels, or None if there are too few pixels."""
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
    # Up to scale, H is a rotation times the inverse of the camera matrix.
    square = H.T @ H
    widths = np.linalg.norm(square[:2, :2], axis=1)
    pixel_angle = np.linalg.norm(H[:, 0]) / np.linalg.norm(H[:, 2]) / size
    skew = square[0, 1] / np.sqrt(square[0, 0] * square[1, 1]) if widths.all() else 1.0
    stretch, misfit = square[0, 0] / square[1, 1], np.median(angle) / max(pixel_angle, 1e-12)
    is_square = 1 / MAX_STRETCH < stretch < MAX_STRETCH and abs(skew) < MAX_SKEW
    return bool(misfit < MAX_MISFIT and is_square)


def _pinhole_place(grid: Pixels) -> Vector | None:
    """Return the camera position [m] that the pixels imply, or None if no pinhole fits or the scene is too flat."""
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
    """Return some pixels and their points [m]. Pixels are homogeneous, with the image's larger side as unit."""
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
