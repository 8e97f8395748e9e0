"""Verified grasps for multi-fingered hands: every name that a user of the library needs is here.

    from graspd_core import load_hand, load_scene, plan_grasps

    result = plan_grasps(load_scene("mug.obj"), load_hand("allegro_right"), count=16, seed=0)

A name is loaded on first use: `import graspd_core` takes milliseconds, torch comes with the first name that needs it.
Lengths are in metres, angles in radians, quaternions wxyz. Bad input raises a `GraspdError`.
docs/api.md lists the names by purpose.
"""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from graspd_core.arms.arm import Arm as Arm
    from graspd_core.arms.arm_file import arm_names as arm_names
    from graspd_core.arms.arm_file import load_arm as load_arm
    from graspd_core.config import SceneConfig as SceneConfig
    from graspd_core.errors import GraspdError as GraspdError
    from graspd_core.formats.grasps_json import save_result as save_result
    from graspd_core.formats.read_grasps import load_grasps as load_grasps
    from graspd_core.hands.hand_mesh import hand_mesh as hand_mesh
    from graspd_core.hands.library import hand_names as hand_names
    from graspd_core.hands.library import load_hand as load_hand
    from graspd_core.hands.model import HandModel as HandModel
    from graspd_core.library.grasp_library import GraspLibrary as GraspLibrary
    from graspd_core.library.known_grasps import known_grasps as known_grasps
    from graspd_core.library.known_grasps import known_or_planned as known_or_planned
    from graspd_core.mesh.mesh_files import load_mesh as load_mesh
    from graspd_core.mesh.mesh_files import save_mesh as save_mesh
    from graspd_core.mesh.shapes import make_shape as make_shape
    from graspd_core.methods.plan_config import PlanConfig as PlanConfig
    from graspd_core.methods.plan_config import load_preset as load_preset
    from graspd_core.methods.plan_config import override as override
    from graspd_core.methods.plan_config import preset_names as preset_names
    from graspd_core.methods.problem import build_problem as build_problem
    from graspd_core.metrics.metric_registry import METRICS as METRICS
    from graspd_core.metrics.metric_registry import Metric as Metric
    from graspd_core.planning.plan_grasps import plan_grasps as plan_grasps
    from graspd_core.planning.plan_grasps import warm_up as warm_up
    from graspd_core.planning.reach import Reach as Reach
    from graspd_core.planning.steering.regions import Box as Box
    from graspd_core.planning.steering.regions import NearPoints as NearPoints
    from graspd_core.planning.steering.regions import Sphere as Sphere
    from graspd_core.planning.steering.steering import Steering as Steering
    from graspd_core.planning.verify_grasps import verify_grasps as verify_grasps
    from graspd_core.pointcloud.camera import PinholeCamera as PinholeCamera
    from graspd_core.pointcloud.depth_image import cloud_from_depth as cloud_from_depth
    from graspd_core.pointcloud.depth_image import depth_in_metres as depth_in_metres
    from graspd_core.pointcloud.point_cloud import PointCloud as PointCloud
    from graspd_core.scene.known_neighbours import with_neighbours as with_neighbours
    from graspd_core.scene.load_scene import load_scene as load_scene
    from graspd_core.scene.scene import Scene as Scene
    from graspd_core.scene.scene_from_views import scene_from_views as scene_from_views
    from graspd_core.segmentation.target_selection import Target as Target
    from graspd_core.trials.trial_registry import TRIALS as TRIALS
    from graspd_core.trials.trial_registry import Trial as Trial
    from graspd_core.types import ArmPath as ArmPath
    from graspd_core.types import Grasp as Grasp
    from graspd_core.types import GraspResult as GraspResult
    from graspd_core.types import Outcome as Outcome
    from graspd_core.types import Posture as Posture
    from graspd_core.types import Progress as Progress
    from graspd_core.types import TrialResult as TrialResult
    from graspd_core.types import TriangleMesh as TriangleMesh
    from graspd_core.types import Verdict as Verdict

# The names of each module.
_MODULES = {
    "scene.load_scene": "load_scene",
    "scene.scene_from_views": "scene_from_views",
    "scene.known_neighbours": "with_neighbours",
    "scene.scene": "Scene",
    "config": "SceneConfig",
    "segmentation.target_selection": "Target",
    "pointcloud.point_cloud": "PointCloud",
    "pointcloud.camera": "PinholeCamera",
    "pointcloud.depth_image": "cloud_from_depth depth_in_metres",
    "mesh.mesh_files": "load_mesh save_mesh",
    "mesh.shapes": "make_shape",
    "hands.library": "hand_names load_hand",
    "hands.model": "HandModel",
    "hands.hand_mesh": "hand_mesh",
    "arms.arm": "Arm",
    "arms.arm_file": "arm_names load_arm",
    "planning.plan_grasps": "plan_grasps warm_up",
    "planning.reach": "Reach",
    "planning.steering.steering": "Steering",
    "planning.steering.regions": "Box NearPoints Sphere",
    "methods.plan_config": "PlanConfig load_preset override preset_names",
    "methods.problem": "build_problem",
    "planning.verify_grasps": "verify_grasps",
    "library.grasp_library": "GraspLibrary",
    "library.known_grasps": "known_grasps known_or_planned",
    "trials.trial_registry": "TRIALS Trial",
    "metrics.metric_registry": "METRICS Metric",
    "types": "ArmPath Grasp GraspResult Outcome Posture Progress TrialResult TriangleMesh Verdict",
    "formats.grasps_json": "save_result",
    "formats.read_grasps": "load_grasps",
    "errors": "GraspdError",
}
# Names that version 0.1 had here: they are found with a warning until 0.3.
_MOVED = {
    "formats.grasps_json": "grasp_figures",
    "formats.read_grasps": "grasps_of load_document",
    "hands.kinematics": "link_poses",
    "hands.model": "Mount all_joint_names all_joint_positions",
    "planning.plan_grasps": "check_request",
    "planning.planning_worker": "start_planning_worker",
    "pointcloud.point_cloud": "transform_cloud",
    "runtime.heap": "limit_malloc_arenas trim_heap",
    "runtime.worker_process": "run_isolated",
    "trials.lift_trial": "retreat_posture",
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}
_MOVED_TO = {name: module for module, names in _MOVED.items() for name in names.split()}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    module = _MODULE_OF.get(name)
    if module is None and name in _MOVED_TO:
        module = _MOVED_TO[name]
        there = f"{__name__}.{module}"
        warnings.warn(f"{__name__}.{name} goes with version 0.3; it is in {there}", DeprecationWarning, stacklevel=2)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
