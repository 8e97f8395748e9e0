"""Plan verified grasps for multi-fingered hands. This package exports every name that a user of the library needs.

    from graspd_core import load_hand, load_scene, plan_grasps

    result = plan_grasps(load_scene("mug.obj"), load_hand("allegro_right"), count=16, seed=0)

Names are loaded on first use, so `import graspd_core` takes milliseconds and does not import torch. Lengths are in
metres, angles in radians, quaternions wxyz. Bad input raises a `GraspdError`. docs/api.md lists the names by purpose.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from functools import cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from graspd_core.arms.arm import Arm as Arm
    from graspd_core.arms.arm import arm_names as arm_names
    from graspd_core.arms.arm import load_arm as load_arm
    from graspd_core.arms.reach import Reach as Reach
    from graspd_core.config import SceneConfig as SceneConfig
    from graspd_core.errors import GraspdError as GraspdError
    from graspd_core.hands.kinematics import hand_mesh as hand_mesh
    from graspd_core.hands.library import hand_names as hand_names
    from graspd_core.hands.library import load_hand as load_hand
    from graspd_core.hands.model import HandModel as HandModel
    from graspd_core.io.grasps_json import load_grasps as load_grasps
    from graspd_core.io.grasps_json import save_result as save_result
    from graspd_core.library.grasp_library import GraspLibrary as GraspLibrary
    from graspd_core.library.known_grasps import known_grasps as known_grasps
    from graspd_core.library.known_grasps import known_or_planned as known_or_planned
    from graspd_core.mesh.mesh_files import load_mesh as load_mesh
    from graspd_core.mesh.mesh_files import save_mesh as save_mesh
    from graspd_core.mesh.shapes import make_shape as make_shape
    from graspd_core.optimize.candidates import PlannerInput as PlannerInput
    from graspd_core.optimize.candidates import PlannerOutput as PlannerOutput
    from graspd_core.optimize.initial_poses import draw_starts as draw_starts
    from graspd_core.optimize.loop import Poses as Poses
    from graspd_core.optimize.plan_config import METHODS as METHODS
    from graspd_core.optimize.plan_config import Method as Method
    from graspd_core.optimize.plan_config import PlanConfig as PlanConfig
    from graspd_core.optimize.plan_config import load_preset as load_preset
    from graspd_core.optimize.plan_config import override as override
    from graspd_core.optimize.plan_config import preset_names as preset_names
    from graspd_core.optimize.problem import Problem as Problem
    from graspd_core.optimize.problem import build_problem as build_problem
    from graspd_core.perception.cloud.camera import PinholeCamera as PinholeCamera
    from graspd_core.perception.cloud.camera import cloud_from_depth as cloud_from_depth
    from graspd_core.perception.cloud.camera import depth_in_metres as depth_in_metres
    from graspd_core.perception.cloud.depth_files import load_depth_view as load_depth_view
    from graspd_core.perception.cloud.point_cloud import PointCloud as PointCloud
    from graspd_core.perception.load_scene import load_scene as load_scene
    from graspd_core.perception.obstacles import with_neighbours as with_neighbours
    from graspd_core.perception.scene import Scene as Scene
    from graspd_core.perception.scene_from_views import scene_from_views as scene_from_views
    from graspd_core.perception.segment.target_selection import Target as Target
    from graspd_core.planning.plan_grasps import plan_grasps as plan_grasps
    from graspd_core.planning.plan_grasps import warm_up as warm_up
    from graspd_core.planning.regions import Box as Box
    from graspd_core.planning.regions import NearPoints as NearPoints
    from graspd_core.planning.regions import Sphere as Sphere
    from graspd_core.planning.steering import Steering as Steering
    from graspd_core.types import ArmPath as ArmPath
    from graspd_core.types import Grasp as Grasp
    from graspd_core.types import GraspResult as GraspResult
    from graspd_core.types import Outcome as Outcome
    from graspd_core.types import Posture as Posture
    from graspd_core.types import Progress as Progress
    from graspd_core.types import TrialResult as TrialResult
    from graspd_core.types import TriangleMesh as TriangleMesh
    from graspd_core.types import Verdict as Verdict
    from graspd_core.verify.metrics import METRICS as METRICS
    from graspd_core.verify.metrics import Metric as Metric
    from graspd_core.verify.prepared_grasp import MetricsContext as MetricsContext
    from graspd_core.verify.prepared_grasp import PreparedGrasp as PreparedGrasp
    from graspd_core.verify.trial_registry import TRIALS as TRIALS
    from graspd_core.verify.trial_registry import Trial as Trial
    from graspd_core.verify.trial_registry import TrialContext as TrialContext
    from graspd_core.verify.verification import verify_grasps as verify_grasps

# The public names of each module.
_MODULES = {
    "perception.load_scene": "load_scene",
    "perception.scene_from_views": "scene_from_views",
    "perception.obstacles": "with_neighbours",
    "perception.scene": "Scene",
    "config": "SceneConfig",
    "perception.segment.target_selection": "Target",
    "perception.cloud.point_cloud": "PointCloud",
    "perception.cloud.camera": "PinholeCamera cloud_from_depth depth_in_metres",
    "perception.cloud.depth_files": "load_depth_view",
    "mesh.mesh_files": "load_mesh save_mesh",
    "mesh.shapes": "make_shape",
    "hands.library": "hand_names load_hand",
    "hands.model": "HandModel",
    "hands.kinematics": "hand_mesh",
    "arms.arm": "Arm arm_names load_arm",
    "planning.plan_grasps": "plan_grasps warm_up",
    "arms.reach": "Reach",
    "planning.steering": "Steering",
    "planning.regions": "Box NearPoints Sphere",
    "optimize.plan_config": "METHODS Method PlanConfig load_preset override preset_names",
    "optimize.candidates": "PlannerInput PlannerOutput",
    "optimize.loop": "Poses",
    "optimize.initial_poses": "draw_starts",
    "optimize.problem": "Problem build_problem",
    "verify.verification": "verify_grasps",
    "library.grasp_library": "GraspLibrary",
    "library.known_grasps": "known_grasps known_or_planned",
    "verify.trial_registry": "TRIALS Trial TrialContext",
    "verify.prepared_grasp": "MetricsContext PreparedGrasp",
    "verify.metrics": "METRICS Metric",
    "types": "ArmPath Grasp GraspResult Outcome Posture Progress TrialResult TriangleMesh Verdict",
    "io.grasps_json": "load_grasps save_result",
    "errors": "GraspdError",
}
# Names that version 0.1 exported here. Until version 0.3 they still work, with a warning.
_MOVED = {
    "io.grasps_json": "grasp_figures grasps_of load_document",
    "hands.kinematics": "link_poses retreat_posture",
    "hands.model": "Mount all_joint_names all_joint_positions",
    "planning.plan_grasps": "check_request",
    "runtime.worker_process": "limit_malloc_arenas run_isolated start_planning_worker trim_heap",
    "perception.cloud.point_cloud": "transform_cloud",
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}
_MOVED_TO = {name: module for module, names in _MOVED.items() for name in names.split()}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    module = _MODULE_OF.get(name)
    if module is None and name in _MOVED_TO:
        module = _MOVED_TO[name]
        there = f"import it from {__name__}.{module}"
        warnings.warn(f"{__name__}.{name} is removed in version 0.3; {there}", DeprecationWarning, stacklevel=2)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _MovedModules:
    """Import finder that runs last. For the old path of a moved module, its ImportError names the new path."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if not fullname.startswith(f"{__name__}."):
            return None
        moved = _moved_modules()
        if fullname in moved:
            raise ImportError(_moved_to(fullname, moved[fullname]), name=fullname)
        if not any(old.startswith(f"{fullname}.") for old in moved):
            return None
        # Python first imports the parent package of a moved module. Its folder is gone, so return an empty package.
        return ModuleSpec(fullname, cast(Any, self), is_package=True)

    def create_module(self, spec: ModuleSpec) -> None:
        """Return None, so that Python creates the module."""

    def exec_module(self, module: ModuleType) -> None:
        def __getattr__(name: str) -> Any:
            moved, old = _moved_modules(), f"{module.__name__}.{name}"
            if old in moved:
                raise ImportError(_moved_to(old, moved[old]), name=old)
            inside = sorted({new for old, new in moved.items() if old.startswith(f"{module.__name__}.")})
            raise AttributeError(_moved_to(module.__name__, ", ".join(inside)))

        module.__dict__["__getattr__"] = __getattr__


def _moved_to(old: str, new: str) -> str:
    return f"{old} is {new} since version 0.2"


@cache
def _moved_modules() -> dict[str, str]:
    import json

    rows = json.loads(Path(__file__).with_name("moved.json").read_text())
    return {f"{__name__}.{old}": new for new, olds in rows.items() for old in olds.split()}


sys.meta_path.append(_MovedModules())
