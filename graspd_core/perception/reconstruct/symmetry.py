"""Search for symmetries of a partly seen object: mirror planes and centres of symmetry.

Each search moves the seen points by many candidate symmetries at once. A good candidate moves points onto seen surface,
not into space seen to be empty, and adds new surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_core.perception.cloud.free_space import FreeSpace, on_seen, weigh
from graspd_core.perception.cloud.point_cloud import Points, Vector
from graspd_core.perception.reconstruct.merge_views import Surfels, take
from graspd_core.se3 import perpendicular

# Number of points that candidates are scored on, in the fine and in the coarse search.
FINE_SAMPLES, COARSE_SAMPLES = 240, 90
# Weight of a contradiction relative to a confirmation.
CONTRADICTION_WEIGHT = 3.0
# How many normals of mirror planes to try for a standing object and for other objects, and offsets per normal.
UPRIGHT_DIRECTIONS, SPHERE_DIRECTIONS, PLANE_OFFSETS = 30, 70, 29

UP = np.array([0.0, 0.0, 1.0])

Shares = Float[np.ndarray, "_"]
# Function that scores candidates by the fractions confirmed, contradicted, met and closed (see `worth`).
Score = Callable[[Shares, Shares, Shares, Shares], Shares]


@dataclass(frozen=True)
class Symmetry:
    """A rotation or reflection p ↦ A p + b that may map the object onto itself.

    Attributes:
        linear, shift: A and b [m].
        agree, wrong: fractions of the moved points that the cameras confirm and contradict.
        worth: score that grows with the hidden surface that the symmetry shows, and with its certainty.
    """

    linear: Float[np.ndarray, "3 3"]
    shift: Vector
    agree: float
    wrong: float
    worth: float


@dataclass(frozen=True)
class _Sample:
    """Points to score candidates on: some all over the seen part, and some at its rim."""

    few: Surfels
    rim: Points


def image(symmetry: Symmetry, surfels: Surfels) -> Surfels:
    """Return the surfels moved by the symmetry."""
    return Surfels(surfels.points @ symmetry.linear.T + symmetry.shift, surfels.normals @ symmetry.linear.T)


def worth(agree: Shares, wrong: Shares, meets: Shares, closes: Shares) -> Shares:
    """Return how useful symmetries are. If all moved points fall on seen surface, a symmetry is true but useless.

    Args:
        agree, wrong: fractions of the moved points that the cameras confirm and contradict.
        meets: fraction of the seen part's rim at which the moved surface continues the seen surface.
        closes: fraction of the open side that the moved surface closes.
    """
    return (4 * agree * (1 - agree - wrong) + closes) * (0.3 + meets) - CONTRADICTION_WEIGHT * wrong


def truth(agree: Shares, wrong: Shares, meets: Shares, closes: Shares) -> Shares:
    """Return how well the cameras confirm symmetries, whether they are useful or not."""
    return agree * (0.3 + meets) - CONTRADICTION_WEIGHT * wrong


def find_mirrors(surfels: Surfels, free_space: FreeSpace) -> list[Symmetry]:
    """Return the most useful mirror plane, and the best perpendicular plane if the cameras confirm that plane too."""
    sample = _sample(surfels)
    first, normal = _best_plane(_directions(free_space.standing), sample, free_space, worth)
    if free_space.standing:
        square = np.cross(UP, normal)[None]
    else:
        side = perpendicular(normal)
        turn = np.linspace(0, np.pi, 12, endpoint=False)[:, None]
        square = np.cos(turn) * side + np.sin(turn) * np.cross(normal, side)
    second, _ = _best_plane(square, sample, free_space, truth)
    both = second.agree > 0.5 * first.agree and second.wrong < 0.01
    return [first, second] if both else [first]


def find_centre(surfels: Surfels, free_space: FreeSpace) -> Symmetry:
    """Return the best centre of symmetry. For a standing object, return the best vertical axis of 180° symmetry."""
    sample = _sample(surfels)
    low, high = surfels.points.min(0), surfels.points.max(0)
    middle, size = 0.5 * (low + high), float((high - low).max())
    across = np.linspace(-0.5, 0.5, 15 if free_space.standing else 11) * size
    depths = np.zeros(1) if free_space.standing else np.linspace(-0.7, 0.2, 10) * size
    linear = np.diag([-1.0, -1.0, 1.0]) if free_space.standing else -np.eye(3)
    best = Symmetry(linear, np.zeros(3), 0.0, 1.0, 0.0)
    for finer in (1, 5, 25):
        grid = np.stack(np.meshgrid(across / finer, across / finer, depths / finer, indexing="ij"), -1).reshape(-1, 3)
        centres = middle + grid
        shift = centres - centres @ linear.T
        everywhere = np.broadcast_to(linear, (len(shift), 3, 3))
        which, best = _pick(everywhere, shift, _rough(sample) if finer == 1 else sample, free_space, worth)
        middle = centres[which]
    return best


def _best_plane(
    normals: Float[np.ndarray, "k 3"], sample: _Sample, free_space: FreeSpace, score: Score
) -> tuple[Symmetry, Vector]:
    pivot = sample.few.points.mean(0)
    reach = (sample.few.points - pivot) @ normals.T
    low, high = reach.min(0), reach.max(0)
    size = float((high - low).max())
    tried = np.repeat(normals, PLANE_OFFSETS, 0)
    place = (low[:, None] + (high - low)[:, None] * np.linspace(-0.1, 1.1, PLANE_OFFSETS)).reshape(-1)
    scored = _rough(sample)
    for finer in (1, 3, 9):
        linear = np.eye(3) - 2 * np.einsum("ki,kj->kij", tried, tried)
        shift = 2 * (place + tried @ pivot)[:, None] * tried
        which, best = _pick(linear, shift, scored, free_space, score)
        normal, at = tried[which], place[which]
        # The next candidates are turned and shifted a little from the best.
        turned = _around(normal, 0.1 / finer, free_space.standing)
        moves = np.linspace(-0.02, 0.02, 9) * size / finer
        tried, place = np.repeat(turned, len(moves), 0), at + np.tile(moves, len(turned))
        scored = sample
    return best, normal  # pyright: ignore[reportPossiblyUnboundVariable]


def _pick(
    linear: Float[np.ndarray, "k 3 3"],
    shift: Float[np.ndarray, "k 3"],
    sample: _Sample,
    free_space: FreeSpace,
    score: Score,
) -> tuple[int, Symmetry]:
    """Return the index of the best candidate, and the candidate."""
    few = sample.few
    points = np.einsum("kij,nj->kni", linear, few.points) + shift[:, None]
    confirmed, against = weigh(free_space, points, np.einsum("kij,nj->kni", linear, few.normals))
    agree, wrong = confirmed.mean(1), against.mean(1)
    # These symmetries are their own inverse. So a rim point meets the image if its own image meets seen surface.
    rim = np.einsum("kij,nj->kni", linear, sample.rim) + shift[:, None]
    meets = on_seen(free_space, rim).mean(1) if len(sample.rim) else np.ones(len(agree))
    closes = _closes(linear, few.normals.mean(0), free_space.standing)
    which = int(score(agree, wrong, meets, closes).argmax())
    value = float(worth(agree, wrong, meets, closes)[which])
    return which, Symmetry(linear[which], shift[which], float(agree[which]), float(wrong[which]), value)


def _closes(linear: Float[np.ndarray, "k 3 3"], side: Vector, standing: bool) -> Shares:
    side = side * np.array([1.0, 1.0, 0.0]) if standing else side
    length = max(float(np.linalg.norm(side)), 1e-9)
    return 1 - np.linalg.norm(side + linear @ side, axis=1) / (2 * length)


def _sample(surfels: Surfels) -> _Sample:
    """Return random points and random rim points, by fixed seeds. A rim point has neighbours on one side only."""
    distance, near = map(np.asarray, KDTree(surfels.points).query(surfels.points, k=17))
    aside = np.linalg.norm(surfels.points[near[:, 1:]].mean(1) - surfels.points, axis=1)
    rim = surfels.points[aside > 0.45 * distance[:, 1:].mean(1)]
    spread = np.random.default_rng(1).permutation(len(rim))[: FINE_SAMPLES // 3]
    return _Sample(_some(surfels, FINE_SAMPLES), rim[spread])


def _rough(sample: _Sample) -> _Sample:
    return _Sample(_some(sample.few, COARSE_SAMPLES), sample.rim[: COARSE_SAMPLES // 3])


def _some(surfels: Surfels, count: int) -> Surfels:
    return take(surfels, np.random.default_rng(0).permutation(len(surfels.points))[:count])


def _directions(standing: bool) -> Float[np.ndarray, "k 3"]:
    """Return normals of planes to try: over a horizontal half circle for a standing object, else over half a sphere."""
    if standing:
        turn = np.pi * np.arange(UPRIGHT_DIRECTIONS) / UPRIGHT_DIRECTIONS
        return np.column_stack([np.cos(turn), np.sin(turn), np.zeros(UPRIGHT_DIRECTIONS)])
    height = (np.arange(SPHERE_DIRECTIONS) + 0.5) / SPHERE_DIRECTIONS
    turn = np.pi * (1 + 5**0.5) * np.arange(SPHERE_DIRECTIONS)
    across = np.sqrt(1 - height**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), height])


def _around(normal: Vector, angle: float, standing: bool) -> Float[np.ndarray, "k 3"]:
    """Return directions within `angle` [rad] of a normal, only horizontal directions if the object stands."""
    steps = angle * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])[:, None]
    side = np.cross(normal, UP) if standing else perpendicular(normal)
    turned = normal + steps * side
    if not standing:
        turned = np.concatenate([turned, normal + steps * np.cross(normal, side)])
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)
