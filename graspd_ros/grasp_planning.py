"""The standard plug: `grasping_msgs/action/GraspPlanning`, whose objects become requests and whose grasps are MoveIt's.

Of an object the meshes are taken, else the primitives, else the point cluster. The support surface becomes the plane
that it stands on, towards which no hand may go.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from graspd_msgs.msg import Grasp, GraspArray, GraspProgress
from grasping_msgs.action import GraspPlanning
from grasping_msgs.msg import Object
from shape_msgs.msg import SolidPrimitive

from graspd_core import HandModel, Scene, load_scene
from graspd_core.errors import GraspdError
from graspd_core.runtime.worker_process import run_isolated
from graspd_ros.inputs.request_builder import RequestBuilder
from graspd_ros.inputs.requests import Listener, Request, pose_matrix
from graspd_ros.inputs.support_surface import plane_of, with_support
from graspd_ros.outputs.error_codes import ErrorCode, RequestError
from graspd_ros.outputs.moveit import moveit_grasp
from graspd_ros.parameters import Settings

if TYPE_CHECKING:
    import trimesh

RETREAT = 0.1  # metres
# As a solid's dimensions stand in the message.
_BOX, _SPHERE, _CYLINDER, _CONE = (
    SolidPrimitive.BOX,
    SolidPrimitive.SPHERE,
    SolidPrimitive.CYLINDER,
    SolidPrimitive.CONE,
)
_SIZES = {_BOX: 3, _SPHERE: 1, _CYLINDER: 2, _CONE: 2}


class PlanningMessages:
    """What a goal of GraspPlanning tells: the grasps found thus far, then all of them."""

    def __init__(self, hand: HandModel) -> None:
        self._hand = hand
        self._found: list[Any] = []

    def progressed(self, message: GraspProgress) -> None:
        """Nothing: the action has no word for it."""

    def found(self, message: Grasp) -> GraspPlanning.Feedback:
        """One more."""
        self._found.append(self._grasp(message))
        return GraspPlanning.Feedback(grasps=list(self._found))

    def result(self, message: GraspArray) -> GraspPlanning.Result:
        """Those that did not fail, best first."""
        good = [grasp for grasp in message.grasps if grasp.verdict != Grasp.FAILED]
        return GraspPlanning.Result(grasps=[self._grasp(grasp) for grasp in good])

    def _grasp(self, message: Grasp) -> Any:
        """Back along the way that it came: nobody says here where up is."""
        start, end = message.pregrasp_pose.position, message.grasp_pose.position
        back = (start.x - end.x, start.y - end.y, start.z - end.z)
        if not any(back):
            back = (0.0, 0.0, 1.0)
        return moveit_grasp(
            message,
            retreat=back,
            retreat_frame=message.header.frame_id,
            retreat_distance=RETREAT,
            effort=self._hand.effort.tolist(),
        )


def request_from_goal(
    builder: RequestBuilder,
    hand: str,
    request_id: str,
    settings: Settings,
    goal: GraspPlanning.Goal,
    listener: Listener | None = None,
) -> Request:
    """What the worker works off for a goal.

    Raises:
        GraspdError: the group is no hand of this node, or the object has no shape that can be used.
    """
    if goal.group_name not in ("", hand):
        told = f"group_name: {goal.group_name[:128]!r} is no hand here; this node plans for {hand!r}"
        raise RequestError(ErrorCode.WRONG_HAND, told)
    target = goal.object
    plane = plane_of(target.surface)
    if target.meshes or target.primitives:
        mesh, header = _solid(target), target.header
        load = with_support(lambda: _load(mesh, settings), plane)
        return builder.from_loader(request_id, "grasp_planning", header, settings, load, listener)
    cluster = target.point_cluster
    if not cluster.data:
        raise _bad("no meshes, no primitives and no point_cluster; give one of them")
    header = cluster.header if cluster.header.frame_id else target.header
    if plane is not None and target.header.frame_id not in ("", header.frame_id):
        raise _bad(f"surface: in {target.header.frame_id!r}, the point_cluster in {header.frame_id!r}; give one frame")
    request = builder.from_cluster(request_id, replace(settings, segment=False), cluster, header, listener)
    return replace(request, load=with_support(request.load, plane))


def _load(mesh: trimesh.Trimesh, settings: Settings) -> Scene:
    with tempfile.TemporaryDirectory(prefix="graspd-") as directory:
        path = Path(directory) / "object.ply"
        mesh.export(path)
        return run_isolated(load_scene, str(path), mass=settings.mass, friction=settings.friction)


def _solid(target: Object) -> trimesh.Trimesh:
    """The object's meshes, else its primitives, in the frame of its header."""
    import trimesh

    kind, shapes, poses = "mesh", target.meshes, target.mesh_poses
    if not shapes:
        kind, shapes, poses = "primitive", target.primitives, target.primitive_poses
    if len(poses) not in (0, len(shapes)):
        raise _bad(f"{kind}_poses: {len(poses)} poses of {len(shapes)} shapes; give one for each")
    parts = [_mesh(shape) if kind == "mesh" else _primitive(shape) for shape in shapes]
    for part, pose in zip(parts, poses, strict=bool(poses)):
        part.apply_transform(pose_matrix(pose, f"{kind}_poses"))
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + before for part, before in zip(parts, counts[:-1], strict=True)]
    return trimesh.Trimesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces), process=False)


def _mesh(shape: Any) -> trimesh.Trimesh:
    import trimesh

    vertices = np.array([[p.x, p.y, p.z] for p in shape.vertices]).reshape(-1, 3)
    faces = np.array([list(t.vertex_indices) for t in shape.triangles], dtype=np.int64).reshape(-1, 3)
    if not len(faces) or not np.isfinite(vertices).all() or faces.max() >= len(vertices):
        raise _bad(f"meshes: {len(vertices)} vertices and {len(faces)} triangles that are no mesh")
    return trimesh.Trimesh(vertices, faces, process=False)


def _primitive(shape: SolidPrimitive) -> trimesh.Trimesh:
    import trimesh

    sizes = np.array(shape.dimensions, dtype=float)
    if shape.type not in _SIZES:
        raise _bad(f"primitives: type {shape.type}; valid: BOX=1, SPHERE=2, CYLINDER=3, CONE=4")
    if len(sizes) != _SIZES[shape.type] or not (np.isfinite(sizes) & (sizes > 0)).all():
        raise _bad(f"primitives: dimensions {sizes.tolist()}; valid: {_SIZES[shape.type]} positive numbers [m]")
    if shape.type == _BOX:
        return trimesh.creation.box(extents=sizes)
    if shape.type == _SPHERE:
        return trimesh.creation.icosphere(subdivisions=3, radius=sizes[0])
    height, radius = sizes[SolidPrimitive.CYLINDER_HEIGHT], sizes[SolidPrimitive.CYLINDER_RADIUS]
    if shape.type == _CYLINDER:
        return trimesh.creation.cylinder(radius=radius, height=height)
    # ROS centres a cone on half of its height.
    cone = trimesh.creation.cone(radius=radius, height=height)
    cone.apply_translation([0.0, 0.0, -height / 2])
    return cone


def _bad(message: str) -> GraspdError:
    return RequestError(ErrorCode.BAD_REQUEST, f"object: {message}")
