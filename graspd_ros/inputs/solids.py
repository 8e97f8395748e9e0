"""Shapes of messages as meshes: those of an object to grasp, and of a thing in a planning scene."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose
from shape_msgs.msg import Mesh, SolidPrimitive

from graspd_core import TriangleMesh
from graspd_ros.inputs.requests import pose_matrix
from graspd_ros.outputs.error_codes import ErrorCode, RequestError

_BOX, _SPHERE, _CYLINDER, _CONE = (
    SolidPrimitive.BOX,
    SolidPrimitive.SPHERE,
    SolidPrimitive.CYLINDER,
    SolidPrimitive.CONE,
)
# How many dimensions each has in the message.
_SIZES = {_BOX: 3, _SPHERE: 1, _CYLINDER: 2, _CONE: 2}


def mesh_shapes(shapes: Collection[Mesh], poses: Collection[Pose], owner: str) -> list[TriangleMesh]:
    """Meshes where their poses put them; without poses, where they are. Raises RequestError, which names `owner`."""
    return _placed("mesh", _mesh, shapes, poses, owner)


def primitive_shapes(shapes: Collection[SolidPrimitive], poses: Collection[Pose], owner: str) -> list[TriangleMesh]:
    """Boxes, spheres, cylinders and cones likewise."""
    return _placed("primitive", _primitive, shapes, poses, owner)


def joined(parts: Sequence[TriangleMesh]) -> TriangleMesh:
    """All parts as one mesh."""
    before = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + count for part, count in zip(parts, before[:-1], strict=True)]
    return TriangleMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def _placed(
    kind: str, make: Callable[[Any, str], TriangleMesh], shapes: Collection[Any], poses: Collection[Pose], owner: str
) -> list[TriangleMesh]:
    if len(poses) not in (0, len(shapes)):
        raise bad_message(owner, f"{kind}_poses: {len(poses)} poses of {len(shapes)} shapes; give one for each")
    parts = [make(shape, owner) for shape in shapes]
    matrices = [pose_matrix(pose, f"{owner}: {kind}_poses") for pose in poses] or [np.eye(4)] * len(parts)
    return [
        TriangleMesh(part.vertices @ T[:3, :3].T + T[:3, 3], part.faces)
        for part, T in zip(parts, matrices, strict=True)
    ]


def _mesh(shape: Mesh, owner: str) -> TriangleMesh:
    vertices = np.array([[p.x, p.y, p.z] for p in shape.vertices]).reshape(-1, 3)
    faces = np.array([list(t.vertex_indices) for t in shape.triangles], dtype=np.int64).reshape(-1, 3)
    if not len(faces) or not np.isfinite(vertices).all() or faces.max() >= len(vertices):
        raise bad_message(owner, f"meshes: {len(vertices)} vertices and {len(faces)} triangles that are no mesh")
    return TriangleMesh(vertices, faces)


def _primitive(shape: SolidPrimitive, owner: str) -> TriangleMesh:
    sizes = np.array(shape.dimensions, dtype=float)
    if shape.type not in _SIZES:
        raise bad_message(owner, f"primitives: type {shape.type}; valid: BOX=1, SPHERE=2, CYLINDER=3, CONE=4")
    if len(sizes) != _SIZES[shape.type] or not (np.isfinite(sizes) & (sizes > 0)).all():
        valid = f"{_SIZES[shape.type]} positive numbers [m]"
        raise bad_message(owner, f"primitives: dimensions {sizes.tolist()}; valid: {valid}")
    solid = _solid(shape.type, sizes)
    return TriangleMesh(np.array(solid.vertices), np.array(solid.faces, dtype=np.int64))


def _solid(kind: int, sizes: np.ndarray) -> Any:
    import trimesh

    if kind == _BOX:
        return trimesh.creation.box(extents=sizes)
    if kind == _SPHERE:
        return trimesh.creation.icosphere(subdivisions=3, radius=sizes[0])
    height, radius = sizes[SolidPrimitive.CYLINDER_HEIGHT], sizes[SolidPrimitive.CYLINDER_RADIUS]
    if kind == _CYLINDER:
        return trimesh.creation.cylinder(radius=radius, height=height)
    # ROS centres a cone on half of its height.
    cone = trimesh.creation.cone(radius=radius, height=height)
    cone.apply_translation([0.0, 0.0, -height / 2])
    return cone


def bad_message(owner: str, message: str) -> RequestError:
    """The error about something of a message."""
    return RequestError(ErrorCode.BAD_REQUEST, f"{owner}: {message}")
