"""Plan verified grasps for multi-fingered hands. This package exports every name that a user of the library needs.

    from graspd_core import load_hand, load_scene, plan_grasps

    result = plan_grasps(load_scene("mug.obj"), load_hand("allegro_right"), count=16, seed=0)

Names are loaded on first use, so `import graspd_core` takes milliseconds and does not import torch. Lengths are in
metres, angles in radians, quaternions wxyz. Bad input raises a `GraspdError`. docs/api.md lists the names by purpose.
"""

from __future__ import annotations

import importlib
import re
import sys
import warnings
from functools import cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, cast

# Names that version 0.1 exported here. Until version 0.3 they still work, with a warning.
_MOVED = {
    "io.grasps_json": "grasp_figures grasps_of load_document",
    "hands.kinematics": "link_poses retreat_posture",
    "hands.model": "Mount all_joint_names all_joint_positions",
    "planning.plan_grasps": "check_request",
    "runtime.worker_process": "limit_malloc_arenas run_isolated start_planning_worker trim_heap",
    "perception.cloud.point_cloud": "transform_cloud",
}
# The module of each public name. Type checkers read the same file.
_IMPORTS = re.findall(r"^from graspd_core\.(\S+) import (\w+)", Path(__file__).with_suffix(".pyi").read_text(), re.M)
_MODULE_OF = {name: module for module, name in _IMPORTS}
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
    """Import finder for old paths of moved modules, after all other finders. Its ImportError names the new path."""

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
