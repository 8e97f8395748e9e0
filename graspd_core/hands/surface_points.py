"""Sample the hand's outer surface: contact candidates for the optimiser, dense samples for the metrics.

Points inside another primitive of their rigid group are left out. Points that lie inside a neighbouring link at every
joint value are left out too. Random points are uniform by area. Feature points lie on edges, corners and rims.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from graspd_core.errors import HandError
from graspd_core.hands.kinematics import LinkNumbers, LinkPoses, in_base, link_poses
from graspd_core.hands.link_distance import primitive_sdf, within_bounds
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.mesh.convex_parts import even_directions
from graspd_core.mesh.sharp_features import farthest_first
from graspd_core.mesh.surface_queries import closest_points, make_surface
from graspd_core.mesh.topology import scaled_normals
from graspd_core.runtime import disk_cache as cache

Points = Float[np.ndarray, "points 3"]
# Points in link frames [m], the link of each point, and the area that each point represents [m²].
Samples = tuple[Points, LinkNumbers, Float[np.ndarray, "points"]]


def primitive_area(primitive: Primitive) -> float:
    """Return the surface area of a primitive [m²]."""
    size = primitive.size
    if primitive.kind == "box":
        return 8.0 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    if primitive.kind == "sphere":
        return 4.0 * np.pi * size[0] ** 2
    if primitive.kind == "capsule":
        return 4.0 * np.pi * size[0] * (size[0] + size[1])
    if primitive.kind == "cylinder":
        return 2.0 * np.pi * size[0] * (size[0] + 2.0 * size[1])
    return 0.5 * float(np.linalg.norm(scaled_normals(primitive.vertices, primitive.faces), axis=1).sum())


def surface_points(primitive: Primitive, count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    """Draw `count` random surface points [m] with outward normals, in the link frame."""
    if primitive.kind == "box":
        points, normals = _box(np.asarray(primitive.size), count, rng)
    elif primitive.kind == "hull":
        points, normals = _hull(primitive, count, rng)
    else:
        points, normals = _round(primitive, count, rng)
    return _to_link(primitive, points, normals)


def feature_points(primitive: Primitive, spacing: float) -> tuple[Points, Points, Bool[np.ndarray, "points"]]:
    """Return points on edges and rims (hulls: corners), at most `spacing` [m] apart, with normals and a corner mask."""
    if primitive.kind == "box":
        points, normals, corner = _box_edges(np.asarray(primitive.size), spacing)
    elif primitive.kind == "cylinder":
        points, normals = _rims(primitive.size[0], primitive.size[1], spacing)
        corner = np.zeros(len(points), dtype=bool)
    elif primitive.kind == "hull":
        points = primitive.vertices
        normals = units(points - points.mean(0))
        corner = np.ones(len(points), dtype=bool)
    else:
        points, normals, corner = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=bool)
    return *_to_link(primitive, points, normals), corner


def outermost(points: Float[np.ndarray, "_ 3"], count: int) -> Float[np.ndarray, "_ 3"]:
    """Return the points that are extreme along `count` evenly spread directions."""
    # Computing in parts limits the memory, because a fine mesh has a hundred thousand points.
    parts = np.array_split(even_directions(count), -(-count // 64), axis=1)
    return points[np.unique(np.concatenate([(points @ part).argmax(0) for part in parts]))]


def _to_link(primitive: Primitive, points: Points, normals: Points) -> tuple[Points, Points]:
    return points @ primitive.rotation.T + primitive.translation, normals @ primitive.rotation.T


def units(vectors: Float[np.ndarray, "*n 3"], least: float = 0.0) -> Float[np.ndarray, "*n 3"]:
    """Return unit vectors. A vector not longer than `least` gives zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > least, vectors / np.maximum(length, 1e-300), 0.0)


def _box(half: Float[np.ndarray, "3"], count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    face_areas = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
    axis = rng.choice(3, size=count, p=face_areas / face_areas.sum())
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = rng.choice([-1.0, 1.0], size=count)
    points = np.where(normals != 0, normals, rng.uniform(-1.0, 1.0, (count, 3))) * half
    return points, normals


def _round(primitive: Primitive, count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    """Sample a sphere, capsule or cylinder: the lateral surface, and caps that are half spheres or discs."""
    radius = primitive.size[0]
    half = primitive.size[1] if len(primitive.size) > 1 else 0.0
    flat = primitive.kind == "cylinder"
    caps = radius / 2 if flat else radius
    on_barrel = rng.uniform(size=count) < half / (half + caps) if half else np.zeros(count, dtype=bool)
    turn = rng.uniform(-np.pi, np.pi, count)
    around = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)])
    height = np.where(on_barrel, 0.0, rng.uniform(-1.0, 1.0, count))  # Heights on a sphere are uniform (Archimedes).
    side = np.sign(height)
    if flat:
        reach = np.where(on_barrel, 1.0, np.sqrt(rng.uniform(size=count)))
        normals = np.where(on_barrel[:, None], around, side[:, None] * np.array([0.0, 0.0, 1.0]))
        points = radius * reach[:, None] * around
    else:
        normals = np.sqrt(1.0 - height**2)[:, None] * around + height[:, None] * np.array([0.0, 0.0, 1.0])
        points = radius * normals
    points[:, 2] += np.where(on_barrel, rng.uniform(-half, half, count), side * half)
    return points, normals


def _hull(primitive: Primitive, count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    areas = np.linalg.norm(scaled_normals(primitive.vertices, primitive.faces), axis=1)
    chosen = primitive.faces[rng.choice(len(areas), size=count, p=areas / areas.sum())]
    a, b, c = (primitive.vertices[chosen[:, i]] for i in range(3))
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a + u * (b - a) + v * (c - a), units(np.cross(b - a, c - a))


def _box_edges(half: Float[np.ndarray, "3"], spacing: float) -> tuple[Points, Points, Bool[np.ndarray, "points"]]:
    corners = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, 8).T
    points, normals = [corners * half], [units(corners)]
    for axis in range(3):
        inner = np.linspace(-1.0, 1.0, int(np.ceil(2 * half[axis] / spacing)) + 1)[1:-1]
        starts = corners[corners[:, axis] < 0]
        edge = np.repeat(starts, len(inner), axis=0)
        edge[:, axis] = np.tile(inner, len(starts))
        outward = np.repeat(starts, len(inner), axis=0)
        outward[:, axis] = 0.0
        points.append(edge * half)
        normals.append(units(outward))
    corner = np.arange(sum(len(p) for p in points)) < 8
    return np.concatenate(points), np.concatenate(normals), corner


def _rims(radius: float, half: float, spacing: float) -> tuple[Points, Points]:
    turn = np.linspace(0.0, 2 * np.pi, max(6, int(np.ceil(2 * np.pi * radius / spacing))), endpoint=False)
    around = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    up = np.array([0.0, 0.0, 1.0])
    points = np.concatenate([radius * around + half * up, radius * around - half * up])
    return points, units(np.concatenate([around + up, around - up]))


# Fields of the hand model that do not influence the samples.
_BESIDES = {"name", "urdf", "warnings", "mount", "base_place", "adjacent"}
_BESIDES |= {"candidate_points", "candidate_normals", "candidate_link"}
_CONTENT = {item.name for item in fields(HandModel)} - _BESIDES
# A point counts as on another solid's surface if it is closer than a tenth of this [m].
_STEP = 1e-6
# A point counts as covered if it is still near another solid of its group after this step along its normal [m]. In a
# crease the hand cannot touch anything.
_CREASE = 1e-4
# Greatest number of random points drawn per wanted point.
_MOST_DRAWN = 200
# Greatest number of points on edges and corners from which candidates are chosen.
_MOST_FEATURES = 20_000
# Greatest share of candidates that are corners.
_CORNER_SHARE = 0.3
# The spacing of candidates is inversely proportional to these weights. A surface that faces the grasp has weight 1.
_TIP_WEIGHT, _EDGE_WEIGHT, _BACK_WEIGHT = 2.0, 1.25, 0.5


@dataclass(frozen=True, eq=False)
class _Pool:
    """Surface points in link frames [m]. `source` has the primitive of each point, `areas` the area per point [m²]."""

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]
    links: Int[np.ndarray, "points"]
    source: Int[np.ndarray, "points"]
    areas: Float[np.ndarray, "points"]
    corner: Bool[np.ndarray, "points"]

    def take(self, keep: np.ndarray) -> _Pool:
        return _Pool(*(array[keep] for array in vars(self).values()))


@lru_cache(maxsize=8)
def with_candidates(hand: HandModel, count: int) -> HandModel:
    """Return the hand with `count` contact candidates, unchanged if it has them. Raises HandError: `count` below 1."""
    if count < 1:
        raise HandError(f"candidates: {count}; valid: 1 or more")
    if count == len(hand.candidate_link):
        return hand
    shapes = {"candidate_points": (3,), "candidate_normals": (3,), "candidate_link": ()}
    return replace(hand, **kept(hand, f"candidates-palm-{count}", 1, shapes, lambda: candidates(hand, count, seed=0)))


def candidates(hand: HandModel, count: int, seed: int) -> tuple[Points, Points, LinkNumbers]:
    """Return evenly spread contact candidates: points [m] and outward normals in link frames, and their links.

    Corners that face a grasped object are chosen first. Then farthest-point sampling (Gonzalez 1985) runs within each
    rigid group. Candidates are denser on fingertips and sparser on the hand's back (`_weights`). The first n candidates
    cover the hand evenly too. If a link has a skin, its candidates lie on the skin. Forearm and wrist get none.
    """
    rng = np.random.default_rng(seed)
    features = _exposed(hand, _feature_pool(hand))
    faces = _exposed(hand, _random_pool(hand, 20 * count, rng))
    pool = _Pool(*(np.concatenate(pair) for pair in zip(vars(features).values(), vars(faces).values(), strict=True)))
    pool = pool.take(~np.isin(hand.link_group[pool.links], _before_palm(hand)))
    weights, facing = _weights(hand, pool)
    placed = in_base(link_poses(hand, hand.open_posture), pool.points, pool.links)
    corners = np.flatnonzero(pool.corner & facing)
    groups = hand.link_group[pool.links]
    limit = int(_CORNER_SHARE * count)
    if len(corners) > limit:
        corners = corners[_farthest(placed[corners], groups[corners], weights[corners], np.zeros(0, int), limit)]
    picked = _farthest(placed, groups, weights, corners, count)
    # The second sampling sorts the candidates, so that the first few are not only corners.
    picked = picked[_farthest(placed[picked], groups[picked], weights[picked], np.zeros(0, int), count)]
    pool = pool.take(picked)
    points, normals = pool.points.copy(), pool.normals.copy()
    for link, skin in hand.skins:
        own = pool.links == link
        points[own], normals[own] = closest_points(make_surface(skin), points[own])
    return points, normals, pool.links


def dense_samples(hand: HandModel, *, count: int = 4000, seed: int = 1) -> Samples:
    """Return at least `count` random points of the outer surface: points in link frames [m], links, areas [m²].

    The points are independent of the candidates. The areas sum to the area of the outer surface. Raises HandError:
    almost all of the hand's surface lies inside other primitives.
    """
    rng = np.random.default_rng(seed)
    drawn, pool = count, _exposed(hand, _random_pool(hand, count, rng))
    while len(pool.points) < count:
        drawn = int(np.ceil(1.05 * drawn * count / max(len(pool.points), 1)))
        if drawn > _MOST_DRAWN * count:
            raise HandError(f"{hand.urdf}: almost all of the surface lies inside other solids; move the solids apart")
        pool = _exposed(hand, _random_pool(hand, drawn, rng))
    return pool.points, pool.links, pool.areas


def samples_with_edges(hand: HandModel, *, count: int, seed: int) -> Samples:
    """Return `dense_samples`, then points of zero area on edges and on hull corners. Cached by the hand's content."""

    def build() -> Samples:
        edges = _exposed(hand, _feature_pool(hand, 0.002))
        parts = zip(dense_samples(hand, count=count, seed=seed), (edges.points, edges.links, edges.areas), strict=True)
        points, links, areas = (np.concatenate(pair) for pair in parts)
        return points, links, areas

    found = kept(hand, f"surface-{count}-{seed}", count, {"points": (3,), "links": (), "areas": ()}, build)
    return found["points"], found["links"], found["areas"]


def kept(
    hand: HandModel,
    what: str,
    rows: int,
    shapes: Mapping[str, tuple[int, ...]],
    build: Callable[[], tuple[np.ndarray, ...]],
) -> cache.Arrays:
    """Return the arrays that `build` computes, cached on disk by the content of the hand.

    Args:
        what: name of the arrays, with all settings that they depend on.
        rows: least number of rows of each array.
        shapes: name of each array, in the order of `build`, and the shape of its rows.
    """

    def valid(arrays: cache.Arrays) -> bool:
        if {name: array.shape[1:] for name, array in arrays.items()} != shapes:
            return False
        counts = {len(array) if array.ndim else 0 for array in arrays.values()}
        return len(counts) == 1 and min(counts) >= rows

    content = cache.digest(value for name, value in sorted(vars(hand).items()) if name in _CONTENT)
    return cache.remember(f"hand-{content}-{what}", lambda: dict(zip(shapes, build(), strict=True)), valid)


def _pool(
    hand: HandModel, parts: Sequence[tuple[np.ndarray, ...]], areas: np.ndarray, corner: Bool[np.ndarray, "points"]
) -> _Pool:
    points, normals = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    counts = [len(part[0]) for part in parts]
    links, source = np.repeat([p.link for p in hand.primitives], counts), np.repeat(np.arange(len(counts)), counts)
    return _Pool(points, normals, links, source, areas, corner)


def _random_pool(hand: HandModel, count: int, rng: np.random.Generator) -> _Pool:
    areas = np.array([primitive_area(p) for p in hand.primitives])
    # Small solids get a few points too, but only one each if there are thousands of solids.
    least = np.clip(count // len(areas), 1, 8)
    counts = np.maximum(least, np.ceil(count * areas / areas.sum())).astype(int)
    parts = [surface_points(p, int(n), rng) for p, n in zip(hand.primitives, counts, strict=True)]
    return _pool(hand, parts, np.repeat(areas / counts, counts), np.zeros(counts.sum(), dtype=bool))


def _feature_pool(hand: HandModel, spacing: float = 0.004) -> _Pool:
    parts = [feature_points(p, spacing) for p in hand.primitives]
    corner = np.concatenate([part[2] for part in parts])
    pool = _pool(hand, parts, np.zeros(len(corner)), corner)
    # If there are too many points, every n-th point is taken, so that every solid keeps its share.
    total = len(pool.points)
    return pool if total <= _MOST_FEATURES else pool.take(np.linspace(0, total - 1, _MOST_FEATURES).astype(int))


def _exposed(hand: HandModel, pool: _Pool) -> _Pool:
    """Return the points of the pool that are on the outer surface of the hand."""
    pool = pool.take(~_covered_in_group(hand, pool))
    groups, above = hand.link_group[pool.links], parent_groups(hand)
    always = np.ones(len(pool.points), dtype=bool)
    # Neighbouring groups have one joint between them. So moving all joints together covers the range of each joint.
    for share in np.linspace(0.0, 1.0, 5):
        poses = link_poses(hand, hand.lower + share * (hand.upper - hand.lower))
        placed = in_base(poses, pool.points, pool.links)
        inside = np.zeros(len(pool.points), dtype=bool)
        for group, primitives in _by_group(hand).items():
            neighbour = (above[groups] == group) | (groups == above[group])
            at = np.flatnonzero(always & neighbour & (groups != group))
            for _, primitive in primitives:
                at = at[~inside[at]]
                inside[at] = _distance(poses, primitive, placed[at]) < 0.0
        always &= inside
    return pool.take(~always)


def _covered_in_group(hand: HandModel, pool: _Pool) -> Bool[np.ndarray, "points"]:
    """Return True for points in, on or just in front of another primitive of their rigid group."""
    poses = link_poses(hand, hand.open_posture)
    placed = in_base(poses, pool.points, pool.links)
    raised = in_base(poses, pool.points + _CREASE * pool.normals, pool.links)
    covered = np.zeros(len(pool.points), dtype=bool)
    groups = hand.link_group[pool.links]
    for group, primitives in _by_group(hand).items():
        members = np.flatnonzero(groups == group)
        for number, primitive in primitives:
            at = members[(pool.source[members] != number) & ~covered[members]]
            here, outside = (_distance(poses, primitive, points[at]) for points in (placed, raised))
            flush = (np.abs(here) < 0.1 * _STEP) & (number < pool.source[at])
            covered[at] = (here < -0.1 * _STEP) | (outside < 0.5 * _CREASE) | flush
    return covered


def _by_group(hand: HandModel) -> dict[int, list[tuple[int, Primitive]]]:
    found: dict[int, list[tuple[int, Primitive]]] = {}
    for number, primitive in enumerate(hand.primitives):
        found.setdefault(int(hand.link_group[primitive.link]), []).append((number, primitive))
    return found


def _distance(poses: LinkPoses, primitive: Primitive, points: Points) -> Float[np.ndarray, "points"]:
    """Return the signed distance [m] of base-frame points to a primitive. Infinite outside its bounding box."""
    rotations, translations = poses
    local = (points - translations[primitive.link]) @ rotations[primitive.link]
    distance = np.full(len(local), np.inf)
    near = within_bounds((primitive,), local, _CREASE)
    if near.any():
        distance[near] = primitive_sdf(primitive, torch.as_tensor(local[near])).numpy()
    return distance


def parent_groups(hand: HandModel) -> Int[np.ndarray, "links"]:
    """Return for each group its nearest ancestor group with primitives, -1 for none.

    Groups without primitives are skipped, because a joint with several axes is a chain of hinges with massless links.
    """
    parent = hand.link_parent
    above = np.where(parent >= 0, hand.link_group[np.maximum(parent, 0)], -1)
    solid = np.isin(np.arange(hand.num_links), hand.link_group[[p.link for p in hand.primitives]])
    # In depth-first order, the ancestor of a parent is known before its children are visited.
    for link, group in enumerate(above.tolist()):
        if group >= 0 and not solid[group]:
            above[link] = above[group]
    return above


def _before_palm(hand: HandModel) -> list[int]:
    """Return the groups of forearm and wrist: from the root on, each with one child group. Empty without a palm."""
    above, found = parent_groups(hand), list[int]()
    solid = np.unique(hand.link_group[[primitive.link for primitive in hand.primitives]])
    below = solid[above[solid] < 0]
    while len(below) == 1:
        found.append(int(below[0]))
        below = solid[above[solid] == found[-1]]
    return found[:-1] if len(below) else []


def _weights(hand: HandModel, pool: _Pool) -> tuple[Float[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
    """Return the density of candidates around each point, and True for each point that faces a grasped object.

    A point on a finger faces the object if closing the hand moves the point along its outward normal. On the palm, the
    palm normal replaces this motion. Density is higher on fingertips: the outer half of a finger's last rigid group.
    """
    poses = rotations, origins = link_poses(hand, hand.open_posture)
    groups = hand.link_group[pool.links]
    placed = in_base(poses, pool.points, pool.links)
    closing = hand.open_posture + 0.02 * (hand.closed_posture - hand.open_posture)
    motion = in_base(link_poses(hand, closing), pool.points, pool.links) - placed
    motion[groups == hand.link_group[0]] = hand.palm_normal
    outward = np.einsum("pij,pj->pi", rotations[pool.links], pool.normals)
    facing = (outward * units(motion, 1e-9)).sum(1)
    weights = _BACK_WEIGHT + 0.5 * (1.0 - _BACK_WEIGHT) * (1.0 + facing)
    weights[(pool.areas == 0) & (facing > -0.1)] *= _EDGE_WEIGHT
    reach = np.linalg.norm(placed - origins[groups], axis=1)
    heads = np.unique(hand.link_group)
    for group in np.setdiff1d(heads, np.append(parent_groups(hand)[heads], hand.link_group[0])):
        members = groups == group
        if members.any():
            tip = members & (reach > 0.5 * reach[members].max())
            weights[tip] = np.maximum(weights[tip], np.where(facing[tip] > -0.7, _TIP_WEIGHT, 1.0))
    return weights, facing > -0.1


def _farthest(
    points: Points, groups: LinkNumbers, weights: Float[np.ndarray, "points"], chosen: np.ndarray, count: int
) -> Int[np.ndarray, "picked"]:
    """Run farthest-point sampling with weighted distances. The distance between different groups is infinite."""
    members = {group: np.flatnonzero(groups == group) for group in np.unique(groups)}

    def mates(index: int) -> np.ndarray:
        return members[groups[index]]

    def distances(index: int) -> np.ndarray:
        return np.linalg.norm(points[mates(index)] - points[index], axis=1) * weights[mates(index)]

    return farthest_first(len(points), count, chosen.tolist(), distances, mates)
