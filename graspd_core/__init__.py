"""graspd: verified grasps for multi-fingered hands.

from graspd_core import plan_grasps, load_hand, load_scene
result = plan_grasps(load_scene("mug.obj"), load_hand("allegro_right"), count=16, seed=0)

Every public name is loaded on first use: the optimiser pulls torch in, and `import graspd_core.errors` should not.
"""

# ruff: noqa: F401 - what type checkers see of the lazy names

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from graspd_core.formats.grasps_json import grasp_figures, save_result
    from graspd_core.formats.read_grasps import grasps_of, load_document
    from graspd_core.hands.hand_mesh import hand_mesh
    from graspd_core.hands.kinematics import link_poses
    from graspd_core.hands.library import hand_names, load_hand
    from graspd_core.hands.model import HandModel, Mount, all_joint_names, all_joint_positions
    from graspd_core.mesh.mesh_files import load_mesh, save_mesh
    from graspd_core.mesh.shapes import make_shape
    from graspd_core.methods.plan_config import PlanConfig, load_preset, preset_names
    from graspd_core.planning.plan_grasps import check_request, plan_grasps, warm_up
    from graspd_core.planning.planning_worker import start_planning_worker
    from graspd_core.pointcloud.camera import PinholeCamera
    from graspd_core.pointcloud.depth_image import cloud_from_depth, depth_in_metres
    from graspd_core.pointcloud.point_cloud import PointCloud, transform_cloud
    from graspd_core.runtime.heap import limit_malloc_arenas, trim_heap
    from graspd_core.runtime.worker_process import run_isolated
    from graspd_core.scene.load_scene import load_scene
    from graspd_core.scene.scene import Scene
    from graspd_core.scene.scene_from_views import scene_from_views
    from graspd_core.segmentation.target_selection import Target
    from graspd_core.trials.lift_trial import retreat_posture
    from graspd_core.types import Grasp, GraspResult, Outcome, Posture, TriangleMesh, Verdict

_MODULES = {
    "methods.plan_config": ("PlanConfig", "load_preset", "preset_names"),
    "formats.grasps_json": ("grasp_figures", "save_result"),
    "formats.read_grasps": ("grasps_of", "load_document"),
    "hands.hand_mesh": ("hand_mesh",),
    "hands.kinematics": ("link_poses",),
    "hands.library": ("hand_names", "load_hand"),
    "hands.model": ("HandModel", "Mount", "all_joint_names", "all_joint_positions"),
    "mesh.mesh_files": ("load_mesh", "save_mesh"),
    "mesh.shapes": ("make_shape",),
    "planning.plan_grasps": ("check_request", "plan_grasps", "warm_up"),
    "planning.planning_worker": ("start_planning_worker",),
    "pointcloud.camera": ("PinholeCamera",),
    "pointcloud.depth_image": ("cloud_from_depth", "depth_in_metres"),
    "pointcloud.point_cloud": ("PointCloud", "transform_cloud"),
    "runtime.heap": ("trim_heap", "limit_malloc_arenas"),
    "runtime.worker_process": ("run_isolated",),
    "scene.load_scene": ("load_scene",),
    "scene.scene": ("Scene",),
    "scene.scene_from_views": ("scene_from_views",),
    "segmentation.target_selection": ("Target",),
    "trials.lift_trial": ("retreat_posture",),
    "types": ("Grasp", "GraspResult", "Outcome", "Posture", "TriangleMesh", "Verdict"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
