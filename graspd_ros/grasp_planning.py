"""Requests and answers of the standard action `grasping_msgs/action/GraspPlanning`. Grasps are MoveIt messages.

The object's shape comes from its meshes. Without meshes, the primitives are used, and without both, the point cluster.
The object stands on the support surface, a plane that the hand must not cross.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from graspd_msgs.msg import Grasp, GraspArray, GraspProgress
from grasping_msgs.action import GraspPlanning

from graspd_core import HandModel, Scene, TriangleMesh, load_scene
from graspd_core.hands.kinematics import RETREAT
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import joined
from graspd_ros.convert import array_of, nanoseconds
from graspd_ros.error_codes import ErrorCode, RequestError
from graspd_ros.inputs.request_builder import RequestBuilder
from graspd_ros.inputs.sensor_frames import cloud_frame
from graspd_ros.inputs.solids import bad_message, placed_shapes, plane_of, with_support
from graspd_ros.outputs.moveit import moveit_grasp
from graspd_ros.parameters import Settings
from graspd_ros.request import Request


class PlanningMessages:
    """Converts the node's messages for a GraspPlanning goal. Feedback: grasps found so far. Result: final grasps."""

    def __init__(self, hand: HandModel) -> None:
        self._hand = hand
        self._found: list[Any] = []
        self._touch: tuple[str, ...] = ()
        self._up: tuple[str, tuple[float, float, float]] | None = None

    def watching(self, request: Request, goal: Any) -> Request:
        """Store the object's name. Return the request with `closes_late`. Its `load` also stores the up direction."""
        self._touch = (goal.object.name,) if goal.object.name else ()

        def loaded() -> Scene:
            scene = request.load()
            if scene.support is not None:
                x, y, z = map(float, scene.support.normal)
                self._up = request.frame, (x, y, z)
            return scene

        return replace(request, load=loaded, closes_late=True)

    def progressed(self, message: GraspProgress) -> None:
        """Do nothing, because the action has no message for progress."""

    def found(self, message: Grasp) -> GraspPlanning.Feedback | None:
        if not message.arrival_joints.name:
            return None
        self._found.append(self._grasp(message))
        return GraspPlanning.Feedback(grasps=list(self._found))

    def result(self, message: GraspArray) -> GraspPlanning.Result:
        """Return the grasps that failed no trial and have an arrival posture (fingers not yet closed), best first."""
        good = [grasp for grasp in message.grasps if all(trial.passed for trial in grasp.trials)]
        return GraspPlanning.Result(grasps=[self._grasp(grasp) for grasp in good if grasp.arrival_joints.name])

    def succeeded(self, result: GraspPlanning.Result) -> bool:
        """Return True if the result has a grasp. A goal without grasps is aborted."""
        return bool(result.grasps)

    def _grasp(self, message: Grasp) -> Any:
        """Return a grasp as a MoveIt message. The hand retreats up or, if up is unknown, back along the approach."""
        x, y, z = (array_of(message.pregrasp_pose.position) - array_of(message.grasp_pose.position)).tolist()
        back = (x, y, z) if any((x, y, z)) else (0.0, 0.0, 1.0)
        frame, direction = self._up or (message.header.frame_id, back)
        retreat = {"retreat": direction, "retreat_frame": frame, "retreat_distance": RETREAT}
        return moveit_grasp(message, **retreat, effort=self._hand.effort.tolist(), touch=self._touch)


def request_from_goal(builder: RequestBuilder, request_id: str, settings: Settings, goal: Any) -> Request:
    """Return a goal's request. Raises GraspdError if the goal names another hand or its object has no usable shape."""
    if goal.group_name not in ("", builder.hand):
        fault = f"group_name: unknown hand {goal.group_name[:128]!r}; this node plans for {builder.hand!r}"
        raise RequestError(ErrorCode.WRONG_HAND, fault)
    target, plane = goal.object, plane_of(goal.object.surface)
    header, cluster, settings = target.header, target.point_cluster, replace(settings, segment=False)
    if target.meshes:
        load = _loader(placed_shapes("mesh", target.meshes, target.mesh_poses, "object"), settings)
    elif target.primitives:
        load = _loader(placed_shapes("primitive", target.primitives, target.primitive_poses, "object"), settings)
    elif not cluster.data:
        raise bad_message("object", "no meshes, no primitives and no point_cluster; give one of these")
    else:
        header = cluster.header = cluster.header if cluster.header.frame_id else target.header
        given, seen = target.header.frame_id, header.frame_id
        if plane is not None and given not in ("", seen):
            fault = f"surface: frame {given!r}, point_cluster: {seen!r}; give both in one frame"
            raise bad_message("object", fault)
        load = builder.loader_of(settings, cloud_frame(cluster, nanoseconds(builder.now())))
    frame, load = header.frame_id or settings.mesh_frame, with_support(load, plane)
    return builder.request(request_id, "grasp_planning", frame, header.stamp, settings, load)


def _loader(shapes: list[TriangleMesh], settings: Settings) -> Callable[[], Scene]:
    mass, mesh = settings.mass or None, joined(*shapes)
    return lambda: run_isolated(load_scene, mesh, mass=mass, friction=settings.friction)
