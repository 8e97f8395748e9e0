"""Things about the object whose whole shape is known, as a planning scene knows them, as obstacles of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from graspd_core.config import SceneConfig
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.winding_number import winding_inside
from graspd_core.scene.obstacles import make_obstacles
from graspd_core.scene.scene import Scene
from graspd_core.types import Plane, TriangleMesh

# From this share of what the hulls of a thing and of the object fill together, the thing is the object itself: a box
# about a ball has half of it, a box a quarter too large every way still 0.5, things that only touch have nothing.
_SAME = 0.3
_OVERLAP_SAMPLES = 4000
# Of what is seen of a shape near the object [m²]; and the least and most points of one.
_AREA_OF_A_SAMPLE = 1e-4
_FEWEST, _MOST = 200, 4000
_CORNERS = 200


def with_neighbours(
    scene: Scene, things: Mapping[str, Sequence[TriangleMesh]], settings: SceneConfig | None = None
) -> Scene:
    """The scene with things about the object, by name, as obstacles; what is far away costs next to nothing.

    A thing that fills the object's own place is the object as a planning scene holds it: it is left out, and a warning
    of the object says so. What does not rise above the support is the support, and is left out too.

    Args:
        scene: of the object.
        things: closed shapes of each, in the object's frame [m].
        settings: how near things are taken (`segmentation.obstacle_range`), and the hulls (`obstacles`).
    """
    settings = settings or SceneConfig()
    mesh, reach = scene.object.mesh, settings.segmentation.obstacle_range
    low, high = mesh.vertices.min(0) - reach, mesh.vertices.max(0) + reach
    found, same = [], []
    for name, shapes in things.items():
        near = [shape for shape in shapes if _meets(shape, low, high)]
        if near and _overlap(np.concatenate([s.vertices for s in shapes]), mesh.vertices) >= _SAME:
            same.append(f"collision object {name!r} fills the object's own place: taken for the object, no obstacle")
            continue
        points = [_points_within(shape, low, high) for shape in near]
        found += [p for p in points if len(p) and _rises(p, scene.support, settings.obstacles.padding)]
    obstacles = make_obstacles(found, None, mesh, reach, settings.obstacles) if found else ()
    warnings = (*scene.object.warnings, *same)
    return replace(scene, object=replace(scene.object, warnings=warnings), obstacles=(*scene.obstacles, *obstacles))


def _meets(shape: TriangleMesh, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> bool:
    return bool((shape.vertices.min(0) <= high).all() and (shape.vertices.max(0) >= low).all())


def _overlap(a: Float[np.ndarray, "_ 3"], b: Float[np.ndarray, "_ 3"]) -> float:
    """What the hulls of points share, of what they fill together; 0 where one is flat."""
    try:
        hulls = [ConvexHull(_hull_corners(a)), ConvexHull(_hull_corners(b))]
    except QhullError:
        return 0.0
    low, high = b.min(0), b.max(0)
    points = low + (high - low) * np.random.default_rng(0).random((_OVERLAP_SAMPLES, 3))
    inside = [(points @ hull.equations[:, :3].T + hull.equations[:, 3] <= 0).all(1) for hull in hulls]
    shared = float((inside[0] & inside[1]).mean() * np.prod(high - low))
    return shared / (hulls[0].volume + hulls[1].volume - shared)


def _hull_corners(points: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "_ 3"]:
    """The points, or some that span nearly the same hull where they are many: a scan has hundreds of thousands."""
    if len(points) <= _CORNERS:
        return points
    rays = np.random.default_rng(0).normal(size=(_CORNERS, 3))
    return points[np.unique([int((points @ ray).argmax()) for ray in rays])]


def _points_within(
    shape: TriangleMesh, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "_ 3"]:
    """Points whose hull is that of the shape within a box: of its surface and of the box's corners."""
    from trimesh.intersections import slice_faces_plane

    vertices, faces = shape.vertices, shape.faces
    for normal, corner in [*((axis, low) for axis in np.eye(3)), *((-axis, high) for axis in np.eye(3))]:
        vertices, faces, _ = slice_faces_plane(vertices, faces, normal, corner)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
    corners = corners[((corners >= shape.vertices.min(0)) & (corners <= shape.vertices.max(0))).all(1)]
    points = [corners[winding_inside(shape, corners)]] if len(corners) else []
    if len(faces):
        sides = np.diff(vertices[faces], axis=1)
        area = 0.5 * float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum())
        count = int(np.clip(area / _AREA_OF_A_SAMPLE, _FEWEST, _MOST))
        surface = TriangleMesh(vertices, faces.astype(np.int64))
        points += [_hull_corners(vertices[np.unique(faces)]), surface_samples(surface, count, 0)[0]]
    return np.concatenate(points) if points else np.zeros((0, 3))


def _rises(points: Float[np.ndarray, "_ 3"], support: Plane | None, margin: float) -> bool:
    return support is None or float((points @ support.normal).max()) > support.offset + margin
