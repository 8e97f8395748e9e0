"""Points on the surface of one primitive, with outward normals, in the frame of its link.

Random points are uniform by area. Feature points are what a sparse random set misses: edges, corners and rims.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.hands.model import Primitive

Points = Float[np.ndarray, "points 3"]


def primitive_area(primitive: Primitive) -> float:
    """Surface area [m²]."""
    size = primitive.size
    if primitive.kind == "box":
        return 8.0 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    if primitive.kind == "sphere":
        return 4.0 * np.pi * size[0] ** 2
    if primitive.kind == "capsule":
        return 4.0 * np.pi * size[0] * (size[0] + size[1])
    if primitive.kind == "cylinder":
        return 2.0 * np.pi * size[0] * (size[0] + 2.0 * size[1])
    return float(_triangle_areas(primitive).sum())


def surface_points(primitive: Primitive, count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    """`count` random surface points [m] and their outward normals."""
    if primitive.kind == "box":
        points, normals = _box(np.asarray(primitive.size), count, rng)
    elif primitive.kind == "hull":
        points, normals = _hull(primitive, count, rng)
    else:
        points, normals = _round(primitive, count, rng)
    return _to_link(primitive, points, normals)


def feature_points(primitive: Primitive, spacing: float) -> tuple[Points, Points, Bool[np.ndarray, "points"]]:
    """Points on edges and rims at most `spacing` [m] apart, their mean normals, and which of them are corners."""
    if primitive.kind == "box":
        points, normals, corner = _box_edges(np.asarray(primitive.size), spacing)
    elif primitive.kind == "cylinder":
        points, normals = _rims(primitive.size[0], primitive.size[1], spacing)
        corner = np.zeros(len(points), dtype=bool)
    elif primitive.kind == "hull":
        points = primitive.vertices
        normals = _unit(points - points.mean(0))
        corner = np.ones(len(points), dtype=bool)
    else:
        points, normals, corner = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=bool)
    return *_to_link(primitive, points, normals), corner


def outermost(points: Float[np.ndarray, "_ 3"], count: int) -> Float[np.ndarray, "_ 3"]:
    """The points that lie farthest out along `count` directions, which are spread evenly on a golden spiral."""
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    rays = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    # By parts: a fine mesh has a hundred thousand points.
    parts = np.array_split(rays, -(-count // 64), axis=1)
    return points[np.unique(np.concatenate([(points @ part).argmax(0) for part in parts]))]


def _to_link(primitive: Primitive, points: Points, normals: Points) -> tuple[Points, Points]:
    return points @ primitive.rotation.T + primitive.translation, normals @ primitive.rotation.T


def _unit(vectors: Points) -> Points:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _box(half: Float[np.ndarray, "3"], count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    face_areas = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
    axis = rng.choice(3, size=count, p=face_areas / face_areas.sum())
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = rng.choice([-1.0, 1.0], size=count)
    points = np.where(normals != 0, normals, rng.uniform(-1.0, 1.0, (count, 3))) * half
    return points, normals


def _round(primitive: Primitive, count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    """Sphere, capsule and cylinder: a barrel, and caps that are half balls or discs."""
    radius = primitive.size[0]
    half = primitive.size[1] if len(primitive.size) > 1 else 0.0
    flat = primitive.kind == "cylinder"
    caps = radius / 2 if flat else radius
    on_barrel = rng.uniform(size=count) < half / (half + caps) if half else np.zeros(count, dtype=bool)
    turn = rng.uniform(-np.pi, np.pi, count)
    around = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)])
    height = np.where(on_barrel, 0.0, rng.uniform(-1.0, 1.0, count))  # Archimedes: a sphere's height is uniform
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
    areas = _triangle_areas(primitive)
    chosen = primitive.faces[rng.choice(len(areas), size=count, p=areas / areas.sum())]
    a, b, c = (primitive.vertices[chosen[:, i]] for i in range(3))
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a + u * (b - a) + v * (c - a), _unit(np.cross(b - a, c - a))


def _triangle_areas(primitive: Primitive) -> Float[np.ndarray, "faces"]:
    a, b, c = (primitive.vertices[primitive.faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _box_edges(half: Float[np.ndarray, "3"], spacing: float) -> tuple[Points, Points, Bool[np.ndarray, "points"]]:
    corners = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, 8).T
    points, normals = [corners * half], [_unit(corners)]
    for axis in range(3):
        inner = np.linspace(-1.0, 1.0, int(np.ceil(2 * half[axis] / spacing)) + 1)[1:-1]
        starts = corners[corners[:, axis] < 0]
        edge = np.repeat(starts, len(inner), axis=0)
        edge[:, axis] = np.tile(inner, len(starts))
        outward = np.repeat(starts, len(inner), axis=0)
        outward[:, axis] = 0.0
        points.append(edge * half)
        normals.append(_unit(outward))
    corner = np.arange(sum(len(p) for p in points)) < 8
    return np.concatenate(points), np.concatenate(normals), corner


def _rims(radius: float, half: float, spacing: float) -> tuple[Points, Points]:
    turn = np.linspace(0.0, 2 * np.pi, max(6, int(np.ceil(2 * np.pi * radius / spacing))), endpoint=False)
    around = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    up = np.array([0.0, 0.0, 1.0])
    points = np.concatenate([radius * around + half * up, radius * around - half * up])
    return points, _unit(np.concatenate([around + up, around - up]))
