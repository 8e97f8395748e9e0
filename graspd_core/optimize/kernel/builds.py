"""Load the build of the compiled kernel that this machine can run, or report why no build can run.

The environment variable `GRASPD_KERNEL` is `off` (torch alone), the name of a build, or the path of a library. The
default is the best build that runs here. The structures mirror those of src/layout.hpp. Loading compares the sizes.
"""

from __future__ import annotations

import ctypes
import os
import platform
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from graspd_core.errors import ConfigError

# The builds of `setup.py`, best first: name of the file, and required flags in /proc/cpuinfo.
BUILDS = {
    "v4": frozenset({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    "v3": frozenset({"avx2", "fma", "bmi2", "f16c"}),
    "baseline": frozenset(),
}
POLL = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_int64)
_INT, _FLOAT, _DOUBLE, _AT = ctypes.c_int32, ctypes.c_float, ctypes.c_double, ctypes.c_void_p
# Argument types of each function.
_ARGUMENTS = {
    "graspd_evaluate": [_AT, _AT, _INT, _AT, _AT, _FLOAT, _INT, _INT, _INT, _AT, _AT, _AT, _INT],
    "graspd_least_distance": [_AT, _INT, _AT, _AT, _INT],
    "graspd_find_pregrasps": [_AT, _AT, _INT, _AT, _AT, _AT, _INT, POLL],
    "graspd_settle": [_AT, _AT, _INT, _AT, _AT, _INT, POLL],
    "graspd_nearest_features": [_AT, _INT, _AT, _AT, _AT, _AT, _INT],
    "graspd_least_gap": [_AT, _INT, _AT, _FLOAT, _AT, _INT],
    "graspd_self_overlap": [_AT, _INT, _AT, _AT, _INT],
    "graspd_wrench_hull": [_INT, _AT, _AT],
    "graspd_build_surface": [_INT, _AT, _AT, _AT],
    "graspd_signed_distance": [_AT, _INT, _AT, _AT, _DOUBLE, _AT],
    "graspd_hand_depth": [_AT, _AT, _INT, _AT, _AT, _AT, _AT],
    "graspd_shared_volume": [_AT, _AT, _AT, _DOUBLE, _AT],
    "graspd_run_steps": [_AT, _AT, _AT, _INT, _INT, _INT, _INT, POLL],
}


@dataclass(frozen=True)
class Kernel:
    """A build of the kernel. If `library` is None, torch evaluates instead and `reason` says why."""

    name: str
    library: ctypes.CDLL | None
    reason: str = ""


def kernel() -> Kernel:
    """Return the build that this process uses. Raises ConfigError: GRASPD_KERNEL is not a build or a file."""
    return _kernel(os.environ.get("GRASPD_KERNEL", ""))


@lru_cache
def _kernel(wanted: str) -> Kernel:
    if wanted not in ("", "off", *BUILDS) and not Path(wanted).is_file():
        raise ConfigError(
            f"GRASPD_KERNEL: {wanted!r}; valid: off, {', '.join(BUILDS)}, the path of a library, or nothing"
        )
    if wanted == "off":
        return Kernel("", None, "GRASPD_KERNEL is off")
    if wanted not in ("", *BUILDS):
        return _load(Path(wanted), wanted)
    reasons = []
    for name, needed in BUILDS.items():
        if wanted in ("", name):
            missing = needed - _instructions()
            found = Kernel("", None, f"no {min(missing)}") if missing else load(name)
            if found.library is not None:
                return found
            reasons.append(f"{name}: {found.reason}")
    return Kernel("", None, "; ".join(reasons))


def load(name: str) -> Kernel:
    """Load a build, without checking that this machine supports the build's instructions."""
    paths = sorted(Path(__file__).parent.glob(f"{name}.*so"))
    if not paths:
        return Kernel("", None, "not built; was there a C++ compiler when graspd was installed?")
    return _load(paths[0], name)


def _load(path: Path, name: str) -> Kernel:
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        return Kernel("", None, str(error))
    sizes = (ctypes.c_int32 * 64)()
    known = all(hasattr(library, function) for function in ("graspd_sizes", *_ARGUMENTS))
    count = library.graspd_sizes(sizes) if known else 0
    if list(sizes[:count]) != [ctypes.sizeof(structure) for structure in STRUCTURES]:
        return Kernel("", None, "built from other sources: install graspd again")
    for function, arguments in _ARGUMENTS.items():
        getattr(library, function).argtypes = arguments
    return Kernel(name, library)


def _instructions() -> frozenset[str]:
    """Return the instruction sets of this machine's processor. Empty if they cannot be read."""
    if platform.machine() != "x86_64":
        return frozenset()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.split(":")[1] for line in lines if line.startswith("flags")), "").split())


def _of(kind: type, names: str) -> list[tuple[str, type]]:
    return [(name, kind) for name in names.split()]


class Hand(ctypes.Structure):
    _fields_ = [
        *_of(_INT, "links joints groups"),
        *_of(_AT, "parent joint kind constant sine cosine slide axis multiplier shift"),
        *_of(_AT, "lower upper joint_scale pivot reach"),
    ]


class Points(ctypes.Structure):
    _fields_ = [*_of(_INT, "count stride runs"), *_of(_AT, "xyz run_start run_link group_start")]


class Grid(ctypes.Structure):
    _fields_ = [("field", _AT), *_of(_INT, "nx ny nz"), ("origin", _FLOAT * 3), ("spacing", _FLOAT)]


class Solids(ctypes.Structure):
    _fields_ = [("count", _INT), *_of(_AT, "pose core radius round link group near"), ("stride", _INT)]


class Spheres(ctypes.Structure):
    _fields_ = [("centers", Points), *_of(_AT, "radius weight")]


class Object(ctypes.Structure):
    _fields_ = [
        ("grid", Grid),
        ("confidence", _AT),
        ("center", _FLOAT * 3),
        ("length", _FLOAT),
        ("features", _AT),
        *_of(_INT, "feature_count feature_stride coarse_features"),
    ]


class Obstacles(ctypes.Structure):
    _fields_ = [
        *_of(_INT, "grids has_support"),
        ("grid", _AT),
        ("normal", _FLOAT * 3),
        *_of(_FLOAT, "offset margin"),
        ("corners", Points),
        ("spheres", Points),
        *_of(_AT, "corner_radius sphere_radius"),
    ]


class Weights(ctypes.Structure):
    # The fields are in the order of `closed_form_config.LossWeights`.
    _fields_ = _of(_FLOAT, "wrench_resistance distance penetration self_collision posture obstacle")


class Problem(ctypes.Structure):
    _fields_ = [
        ("hand", Hand),
        ("coarse", Points),
        ("fine", Points),
        ("solids", Solids),
        ("spheres", Spheres),
        ("object", Object),
        ("obstacles", Obstacles),
        *_of(_INT, "directions task_points feature_pairs"),
        ("direction", _AT),
        *_of(_FLOAT, "friction sharp_reach"),
    ]


class Schedule(ctypes.Structure):
    _fields_ = [
        ("weights", Weights),
        ("polish_weights", Weights),
        *_of(_FLOAT, "delta_start delta_end radius_start translation_rate rotation_rate joint_rate"),
        *_of(_INT, "explore_steps refine_steps polish_steps fine_steps soft"),
    ]


class State(ctypes.Structure):
    _fields_ = _of(_AT, "x mean square radius best_x best_loss loss")


class Pregrasp(ctypes.Structure):
    _fields_ = [
        *_of(_FLOAT, "clearance joint_rate base_rate joint_cost base_cost self_collision keep"),
        *_of(_INT, "steps spheres"),
    ]


class Surface(ctypes.Structure):
    _fields_ = _of(_AT, "nodes triangles")


class Bodies(ctypes.Structure):
    _fields_ = [*_of(_INT, "count links"), *_of(_AT, "pose ball core radius round link plane_start planes")]


# The structures are in the order of `graspd_sizes`.
STRUCTURES = (
    *(Hand, Points, Grid, Solids, Spheres, Object, Obstacles, Weights, Problem, Schedule, State, Pregrasp),
    *(Surface, Bodies),
)


def names_of(structure: type[ctypes.Structure]) -> list[str]:
    """Return the names of a structure's fields."""
    return [field[0] for field in structure._fields_]
