"""Shapes in messages: primitives, meshes, the support plane, and collision objects of a planning scene.

Collision objects arrive as `moveit_msgs/CollisionObject` and are obstacles of every later request.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from geometry_msgs.msg import Pose
from shape_msgs.msg import Mesh, SolidPrimitive
from shape_msgs.msg import Plane as PlaneMessage

from graspd_core import Scene, SceneConfig, TriangleMesh, with_neighbours
from graspd_core.config import load_scene_config
from graspd_core.errors import TransformError
from graspd_core.perception.scene import on_support
from graspd_core.types import Plane
from graspd_ros.convert import Matrix, moved_plane, moved_points, pose_matrix
from graspd_ros.error_codes import RequestError, bad_request
from graspd_ros.request import FrameLookup, Request

MOST_OBJECTS = 1000
FARTHEST = 1e6  # largest valid size or coordinate of a shape [m]. Products of much larger numbers overflow
# Number of dimensions of each kind of solid.
_SIZES = {SolidPrimitive.BOX: 3, SolidPrimitive.SPHERE: 1, SolidPrimitive.CYLINDER: 2, SolidPrimitive.CONE: 2}


def placed_shapes(
    kind: Literal["mesh", "primitive"], shapes: Collection[Any], poses: Collection[Pose], owner: str
) -> list[TriangleMesh]:
    """Return the meshes of shapes at their poses. Without poses, the shapes stay at the origin.

    Raises RequestError, which names `owner`: a shape or pose is invalid, or there is not one pose for each shape.
    """
    make = _mesh if kind == "mesh" else _primitive
    if len(poses) not in (0, len(shapes)):
        raise bad_message(owner, f"{kind}_poses: {len(poses)} poses for {len(shapes)} shapes; give one for each shape")
    parts = [make(shape, owner) for shape in shapes]
    matrices = [pose_matrix(pose, f"{owner}: {kind}_poses") for pose in poses] or [np.eye(4)] * len(parts)
    return [moved_mesh(part, T) for part, T in zip(parts, matrices, strict=True)]


def moved_mesh(mesh: TriangleMesh, T: Matrix) -> TriangleMesh:
    """Return a mesh transformed by `T` to another frame."""
    return TriangleMesh(moved_points(mesh.vertices, T), mesh.faces)


def _mesh(shape: Mesh, owner: str) -> TriangleMesh:
    vertices = np.array([[p.x, p.y, p.z] for p in shape.vertices]).reshape(-1, 3)
    faces = np.array([list(t.vertex_indices) for t in shape.triangles], dtype=np.int64).reshape(-1, 3)
    if not len(faces) or not (np.abs(vertices) <= FARTHEST).all() or faces.max() >= len(vertices):
        counts = f"meshes: {len(vertices)} vertices and {len(faces)} triangles"
        valid = f"finite vertices within {FARTHEST:g} m, and triangles of vertex indices"
        raise bad_message(owner, f"{counts}; valid: {valid}")
    return TriangleMesh(vertices, faces)


def _primitive(shape: SolidPrimitive, owner: str) -> TriangleMesh:
    sizes = np.array(shape.dimensions, dtype=float)
    if shape.type not in _SIZES:
        raise bad_message(owner, f"primitives: type {shape.type}; valid: BOX=1, SPHERE=2, CYLINDER=3, CONE=4")
    if len(sizes) != _SIZES[shape.type] or not ((sizes > 0) & (sizes <= FARTHEST)).all():
        valid = f"{_SIZES[shape.type]} numbers above 0, at most {FARTHEST:g} [m]"
        raise bad_message(owner, f"primitives: dimensions {sizes.tolist()}; valid: {valid}")
    solid = _solid(shape.type, sizes)
    return TriangleMesh(np.array(solid.vertices), np.array(solid.faces, dtype=np.int64))


def _solid(kind: int, sizes: np.ndarray) -> Any:
    import trimesh

    if kind == SolidPrimitive.BOX:
        return trimesh.creation.box(extents=sizes)
    if kind == SolidPrimitive.SPHERE:
        return trimesh.creation.icosphere(subdivisions=3, radius=sizes[0])
    height, radius = sizes[SolidPrimitive.CYLINDER_HEIGHT], sizes[SolidPrimitive.CYLINDER_RADIUS]
    if kind == SolidPrimitive.CYLINDER:
        return trimesh.creation.cylinder(radius=radius, height=height)
    # The origin of a ROS cone is at half of its height.
    cone = trimesh.creation.cone(radius=radius, height=height)
    cone.apply_translation([0.0, 0.0, -height / 2])
    return cone


def bad_message(owner: str, message: str) -> RequestError:
    """Return an error about an object. The error text begins with the object's name, `owner`."""
    return bad_request(f"{owner}: {message}")


def plane_of(surface: PlaneMessage, T_object_frame: Matrix | None = None) -> Plane | None:
    """Return the support plane in the object's frame, or None if all numbers are 0. Raises RequestError if invalid."""
    a, b, c, d = map(float, surface.coef)
    if not any((a, b, c, d)):
        return None
    length = float(np.linalg.norm([a, b, c]))
    if not (np.isfinite([a, b, c, d]).all() and length > 0):
        raise bad_request(f"surface: {[a, b, c, d]} is not a plane; valid: finite numbers, a, b, c not all 0")
    plane = Plane(np.array([a, b, c]) / length, -d / length)
    return plane if T_object_frame is None else moved_plane(plane, T_object_frame)


def with_support(load: Callable[[], Scene], plane: Plane | None) -> Callable[[], Scene]:
    """Return a loader like `load`. If `plane` is given, it becomes the support of the loaded scene (`on_support`).

    If the object is below the plane, the normal is reversed, with a warning, because its sign is often arbitrary.
    """
    if plane is None:
        return load

    def loaded() -> Scene:
        scene = load()
        heights = scene.object.mesh.vertices @ plane.normal - plane.offset
        if heights.min() + heights.max() >= 0:
            return on_support(scene, plane)
        told = "surface: its normal points away from the object, so the plane was turned"
        scene = replace(scene, object=replace(scene.object, warnings=(*scene.object.warnings, told)))
        return on_support(scene, Plane(-plane.normal, -plane.offset))

    return loaded


@dataclass(frozen=True, eq=False)
class SceneObject:
    """Collision object at the pose `T_frame_object` in `frame`. `shapes` are in the object's own frame [m]."""

    frame: str
    T_frame_object: Matrix
    shapes: tuple[TriangleMesh, ...]


def updated_objects(objects: Mapping[str, SceneObject], message: Any) -> Mapping[str, SceneObject]:
    """Return the collision objects by id, with the change of a `moveit_msgs/CollisionObject` applied.

    Raises RequestError if the id is unknown, or a shape, pose or operation is invalid.
    """
    name, owner, operation = message.id, f"collision object {message.id[:128]!r}", message.operation
    operations = {message.ADD: "ADD", message.REMOVE: "REMOVE", message.APPEND: "APPEND", message.MOVE: "MOVE"}
    if operation == message.REMOVE and not name:
        return {}
    if not name:
        raise bad_message(owner, "id: empty; give a name; an empty id is valid only to REMOVE all objects")
    if operation not in operations:
        raise bad_message(owner, f"operation: {operation[0]}; valid: ADD=0, REMOVE=1, APPEND=2, MOVE=3")
    there = objects.get(name)
    if there is None and operation in (message.REMOVE, message.MOVE):
        raise bad_message(owner, f"{operations[operation]}: unknown id; known: {', '.join(objects) or 'none'}")
    if operation == message.REMOVE:
        return {other: kept for other, kept in objects.items() if other != name}
    if there is None and len(objects) >= MOST_OBJECTS:
        raise bad_message(owner, f"{MOST_OBJECTS} collision objects are stored, which is the limit; REMOVE some")
    return {**objects, name: _changed(there, message, owner)}


def _changed(there: SceneObject | None, message: Any, owner: str) -> SceneObject:
    if message.planes:
        raise bad_message(owner, "planes: infinite planes are not supported; give a box, or the request's surface")
    solids = placed_shapes("primitive", message.primitives, message.primitive_poses, owner)
    shapes = (*solids, *placed_shapes("mesh", message.meshes, message.mesh_poses, owner))
    # As in MoveIt, appended shapes are relative to the object's existing pose.
    if message.operation == message.APPEND and there is not None:
        return replace(there, shapes=(*there.shapes, *shapes))
    if not message.header.frame_id:
        raise bad_message(owner, "header.frame_id: empty; give the frame of the pose")
    frame, T = message.header.frame_id, pose_matrix(message.pose, f"{owner}: pose")
    if message.operation == message.MOVE and there is not None:
        if shapes:
            raise bad_message(owner, "operation: MOVE takes no shapes; use ADD, or remove the shapes")
        return SceneObject(frame, T, there.shapes)
    if not shapes:
        raise bad_message(owner, "no primitives and no meshes; give at least one")
    return SceneObject(frame, T, shapes)


def with_collision_objects(request: Request, lookup: FrameLookup) -> Request:
    """Return the request with its collision objects: `load` adds them as obstacles, and `solids` has their meshes.

    `lookup` transforms between frames at the request's time. Raises TransformError: an object's frame is unknown.
    """
    settings, load, placed = request.settings, request.load, dict[str, list[TriangleMesh]]()
    for name, neighbour in request.collision_objects.items():
        try:
            T = request.to_object(neighbour.frame, neighbour.T_frame_object, lookup)
        except TransformError as error:
            raise TransformError(f"collision object {name!r}: {error}") from None
        placed[name] = [moved_mesh(shape, T) for shape in neighbour.shapes]

    def loaded() -> Scene:
        config = load_scene_config(settings.scene_config) if settings.scene_config else SceneConfig()
        return with_neighbours(load(), placed, config)

    return replace(request, load=loaded, solids=placed)
