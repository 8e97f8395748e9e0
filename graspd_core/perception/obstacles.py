"""Build obstacles around the object: convex hulls that the hand avoids, made from seen points or from known shapes.

The obstacle of a neighbouring object is the convex hull of its seen points and their projection onto the support plane.
So space beneath overhangs counts as full. Nothing is guessed behind the seen side, because a thick guess would block
free space. A neighbour that surrounds the target is halved until its parts leave the target free.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, KDTree

from graspd_core.config import ObstacleConfig, SceneConfig
from graspd_core.errors import ConfigError
from graspd_core.mesh.convex_parts import convex_hull, hull_surface, limited_hull
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.surface_queries import make_surface, surface_distance, winding_inside
from graspd_core.mesh.topology import is_closed, scaled_normals
from graspd_core.perception.cloud.point_cloud import Points, Vector
from graspd_core.perception.scene import DEEPEST, SPARE, Obstacle, Scene, make_obstacle
from graspd_core.se3 import perpendicular, rotation_from_quaternion
from graspd_core.types import Plane, Posture, TriangleMesh

# Parts of a neighbour have at least this fraction of its length. A hull may fill this much space to the target [m].
_LEAST_PART, _FILLED = 1 / 8, 0.01
_TARGET_SAMPLES = 2000  # surface points of the target, to measure its distance from neighbours
_HELD_CORNERS = 128  # most corners of the hull of a held object
# A collision object counts as the target if the intersection over union of their hulls is at least this. A box around a
# ball has 0.5, and so has a box that is a quarter too large in each direction. Objects that only touch have 0.
_SAME = 0.3
_OVERLAP_SAMPLES = 4000  # random points that measure the overlap
# Surface area for each sample of a shape near the object [m²], and the least and most samples of a shape.
_AREA_OF_A_SAMPLE = 1e-4
_FEWEST, _MOST = 200, 4000
_CORNERS = 200  # most points that a hull is computed of


def make_obstacles(
    points: Sequence[Float[np.ndarray, "_ 3"]],
    support: Plane | None,
    target: TriangleMesh,
    reach: float,
    settings: ObstacleConfig | None = None,
) -> tuple[Obstacle, ...]:
    """Return the obstacles of neighbouring objects, made from seen points, in the frame of the points [m].

    Args:
        points: seen points of each neighbour [m]. Neighbours with too few finite points are left out.
        support: plane that the neighbours stand on, or None. The seen points are extruded down to this plane.
        target: the object to grasp.
        reach: greatest distance from the target [m]. Farther neighbours are left out.
        settings: settings of the hulls.
    """
    settings = settings or ObstacleConfig()
    near = KDTree(np.vstack([target.vertices, surface_samples(target, _TARGET_SAMPLES, 0)[0]]))
    found = []
    for seen in points:
        seen = seen[np.isfinite(seen).all(1)]
        if len(seen) < settings.min_points or near.query(seen)[0].min() > reach:
            continue
        up = None if support is None else support.normal
        axes = np.eye(3) if up is None else np.column_stack([right := perpendicular(up), np.cross(up, right)])
        side = max(settings.part_size, _LEAST_PART * float(np.ptp(seen @ axes, axis=0).max()))
        for gap, hull in _hulls(seen, axes, side, near, support, settings.padding):
            found += [make_obstacle(hull)] if gap <= reach else []
    return tuple(found)


def _hulls(
    seen: Float[np.ndarray, "_ 3"],
    axes: Float[np.ndarray, "3 k"],
    side: float,
    target: KDTree,
    support: Plane | None,
    padding: float,
    whole: bool = True,
) -> Iterator[tuple[float, TriangleMesh]]:
    """Yield hulls of parts of the points, and each part's distance from the target's points [m].

    A neighbour whose hull fills the target's place is halved across the longest of `axes`, down to `side` [m]. Parts
    must also leave the space between their points and the target free. A whole neighbour may fill this space, because
    its unseen back may be there.
    """
    gap, hull = float(target.query(seen)[0].min()), padded_hull(seen, support, padding)
    planes = ConvexHull(hull.vertices).equations
    free = float((np.asarray(target.data) @ planes[:, :3].T + planes[:, 3]).max(1).min())
    local = seen @ axes
    low, high = local.min(0), local.max(0)
    longest = int((high - low).argmax())
    if free >= (-2 * padding if whole else gap - padding - _FILLED) or high[longest] - low[longest] <= side:
        yield gap, hull
        return
    lower = local[:, longest] < 0.5 * (low[longest] + high[longest])
    for half in (seen[lower], seen[~lower]):
        yield from _hulls(half, axes, side, target, support, padding, whole=False)


def padded_hull(points: Points, support: Plane | None, padding: float) -> TriangleMesh:
    """Return the convex hull of the points and their projection onto the support, grown by `padding` [m]."""
    corners = points
    if support is not None:
        height = points @ support.normal - support.offset
        corners = np.vstack([points, points - height[:, None] * support.normal])
    # Without a support, the points of a flat face have no hull. The padding below makes them thicker.
    if (hull := convex_hull(corners)) is not None:
        corners = corners[hull.vertices]
    skin = padding * np.vstack([np.eye(3), -np.eye(3)])
    return hull_surface((corners[:, None] + skin).reshape(-1, 3))


def held_hull(mesh: TriangleMesh, base: Posture) -> TriangleMesh:
    """Return the convex hull [m] of a held object in the frame of the hand's base link.

    `base` is the link's pose in the object frame. At most 128 corners keep motion planners fast.
    """
    rotation = rotation_from_quaternion(torch.as_tensor(base.quaternion_wxyz, dtype=torch.float64)).numpy()
    return limited_hull((mesh.vertices - base.position) @ rotation, _HELD_CORNERS)


def with_neighbours(
    scene: Scene, things: Mapping[str, Sequence[TriangleMesh]], settings: SceneConfig | None = None
) -> Scene:
    """Return the scene with collision objects, e.g. of a MoveIt planning scene, added as obstacles.

    A collision object that largely overlaps the target is taken for the target, and left out with a warning. Collision
    objects that do not rise above the support, or that are too far away, are left out without a warning. If a
    collision object reaches deep into an object that cameras saw, no grasp counts as verified.

    Args:
        scene: the scene of the object to grasp.
        things: closed meshes of each collision object by its name, in the object's frame [m].
        settings: `segmentation.obstacle_range` limits distances from the object. `obstacles` holds the hulls' settings.

    Raises ConfigError: a collision object reaches deep into an object whose surface is known.
    """
    settings = settings or SceneConfig()
    mesh, reach = scene.object.mesh, settings.segmentation.obstacle_range
    low, high = mesh.vertices.min(0) - reach, mesh.vertices.max(0) + reach
    support = scene.support
    level = 0.0 if support is None else support.offset + settings.obstacles.padding
    known, found, same, doubts = scene.known_points(), [], [], []
    for name, shapes in things.items():
        near = [s for s in shapes if (s.vertices.min(0) <= high).all() and (s.vertices.max(0) >= low).all()]
        if near and _overlap(np.concatenate([s.vertices for s in shapes]), mesh.vertices) >= _SAME:
            same.append(f"collision object {name!r} fills the place of the object to grasp and counts as that object")
            continue
        points = [_points_within(shape, low, high) for shape in near]
        # A few points of a camera are far off.
        deep = float(np.quantile(_depths_in(near, known), 1.0 if scene.evidence is None else 1.0 - SPARE))
        if (deep := max([deep, *map(partial(_depth_of, scene), points)])) > DEEPEST:
            doubts.append(f"collision object {name!r} reaches {1e3 * deep:.0f} mm into the object to grasp")
        found += [p for p in points if len(p) and (support is None or (p @ support.normal).max() > level)]
    obstacles = make_obstacles(found, None, mesh, reach, settings.obstacles) if found else ()
    evidence = scene.evidence
    if doubts and evidence is None:
        raise ConfigError(f"{doubts[0]}; valid: at most {1e3 * DEEPEST:.0f} mm; correct its pose or the object's")
    evidence = evidence and replace(evidence, doubts=(*evidence.doubts, *doubts))
    warned = replace(scene.object, warnings=(*scene.object.warnings, *same))
    return replace(scene, object=warned, evidence=evidence, obstacles=(*scene.obstacles, *obstacles))


def _depths_in(shapes: Sequence[TriangleMesh], points: Points) -> Float[np.ndarray, "points"]:
    """Return how deep each point is in the shapes [m], 0 outside. Open shapes have no inside."""
    depths = np.zeros(len(points))
    for shape in filter(is_closed, shapes):
        places = np.flatnonzero(((points > shape.vertices.min(0)) & (points < shape.vertices.max(0))).all(1))
        places = places[winding_inside(shape, points[places])] if len(places) else places
        if len(places):
            depths[places] = np.maximum(depths[places], surface_distance(make_surface(shape), points[places]))
    return depths


def _depth_of(scene: Scene, points: Float[np.ndarray, "_ 3"]) -> float:
    """Return how deep the points are in the scene's object [m], 0 for an object that cameras saw in part."""
    if scene.evidence is not None or not len(points):
        return 0.0
    return -float(sample_sdf(scene.sdf, torch.as_tensor(points).to(scene.sdf.field))[0].min())


def _overlap(a: Float[np.ndarray, "_ 3"], b: Float[np.ndarray, "_ 3"]) -> float:
    """Return the intersection over union of the convex hulls of two sets of points, 0 if a hull is flat."""
    one, other = (convex_hull(_hull_corners(points)) for points in (a, b))
    if one is None or other is None:
        return 0.0
    low, high = b.min(0), b.max(0)
    points = low + (high - low) * np.random.default_rng(0).random((_OVERLAP_SAMPLES, 3))
    equations = np.vstack([one.equations, other.equations])
    shared = float((points @ equations[:, :3].T + equations[:, 3] <= 0).all(1).mean() * np.prod(high - low))
    return shared / (one.volume + other.volume - shared)


def _hull_corners(points: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "_ 3"]:
    if len(points) <= _CORNERS:
        return points
    rays = np.random.default_rng(0).normal(size=(_CORNERS, 3))
    return points[np.unique([int((points @ ray).argmax()) for ray in rays])]


def _points_within(shape: TriangleMesh, low: Vector, high: Vector) -> Float[np.ndarray, "_ 3"]:
    """Clip a shape to a box. Return points with the same hull as the clipped shape: on its surface, and box corners."""
    from trimesh.intersections import slice_faces_plane

    vertices, faces = shape.vertices, shape.faces
    for normal, corner in [*((axis, low) for axis in np.eye(3)), *((-axis, high) for axis in np.eye(3))]:
        vertices, faces, _ = slice_faces_plane(vertices, faces, normal, corner)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
    corners = corners[((corners >= shape.vertices.min(0)) & (corners <= shape.vertices.max(0))).all(1)]
    points = [corners[winding_inside(shape, corners)]] if len(corners) else []
    if len(faces):
        area = 0.5 * float(np.linalg.norm(scaled_normals(vertices, faces), axis=1).sum())
        count = int(np.clip(area / _AREA_OF_A_SAMPLE, _FEWEST, _MOST))
        surface = TriangleMesh(vertices, faces.astype(np.int64))
        points += [_hull_corners(vertices[np.unique(faces)]), surface_samples(surface, count, 0)[0]]
    return np.concatenate(points) if points else np.zeros((0, 3))
