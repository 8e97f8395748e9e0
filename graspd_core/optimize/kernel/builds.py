"""The compiled kernel: which of its builds this machine can run, and why there may be none.

`GRASPD_KERNEL` chooses: `off` for torch alone, the name of a build or the path of a library for that one, else the best
that runs here is taken.

The structures of src/layout.hpp, field by field; `builds.load` compares their sizes.
"""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from graspd_core.errors import ConfigError

# What `setup.py` builds, best first: name of the file, instructions it needs of /proc/cpuinfo.
BUILDS = {
    "v4": frozenset({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    "v3": frozenset({"avx2", "fma", "bmi2", "f16c"}),
    "baseline": frozenset(),
}
POLL = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_int64)
_INT, _FLOAT, _AT = ctypes.c_int32, ctypes.c_float, ctypes.c_void_p
_ARGUMENTS = {
    "graspd_evaluate": [_AT, _AT, _INT, _AT, _AT, _FLOAT, _INT, _INT, _INT, _AT, _AT, _AT, _INT],
    "graspd_least_distance": [_AT, _INT, _AT, _AT, _INT],
    "graspd_find_pregrasps": [_AT, _AT, _INT, _AT, _AT, _AT, _INT, POLL],
    "graspd_nearest_features": [_AT, _INT, _AT, _AT, _AT, _AT, _INT],
    "graspd_self_overlap": [_AT, _INT, _AT, _AT, _AT, _INT],
    "graspd_run_steps": [_AT, _AT, _AT, _INT, _INT, _INT, _INT, POLL],
}


@dataclass(frozen=True)
class Kernel:
    """A build of the kernel, or the reason why there is none.

    Attributes:
        name: of the build, empty without one.
        library: its functions; None: torch evaluates.
        reason: why there is none.
    """

    name: str
    library: ctypes.CDLL | None
    reason: str = ""


def kernel() -> Kernel:
    """The build that this process uses. Raises ConfigError: GRASPD_KERNEL names none."""
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


def call(function: str, *arguments: object, watch: Callable[[int], bool] | None = None) -> None:
    """Call a function of `kernel()`.

    Args:
        watch: called from this thread every few milliseconds with the steps done; true ends the call.

    Raises:
        MemoryError: too little memory for its threads.
    """
    failures: list[BaseException] = []

    def poll(done: int) -> int:
        # What it raises, as at Ctrl-C, cannot pass through C++: it ends the call, and is raised behind it.
        try:
            return bool(watch and watch(done))
        except BaseException as failure:
            failures.append(failure)
            return True

    status = getattr(kernel().library, function)(*arguments, *([] if watch is None else [POLL(poll)]))
    if failures:
        raise failures[0]
    if status != 0:
        raise MemoryError(f"{function}: too little memory")


def load(name: str) -> Kernel:
    """One build, whether this machine has its instructions or not; without a library where it cannot be loaded."""
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
    count = library.graspd_sizes(sizes)
    if list(sizes[:count]) != [ctypes.sizeof(structure) for structure in STRUCTURES]:
        return Kernel("", None, "built from other sources: install graspd again")
    for function, arguments in _ARGUMENTS.items():
        getattr(library, function).argtypes = arguments
    return Kernel(name, library)


def _instructions() -> frozenset[str]:
    """Instruction sets of this machine's processor; empty where they cannot be read."""
    if platform.machine() != "x86_64":
        return frozenset()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.split(":")[1] for line in lines if line.startswith("flags")), "").split())


_INT_ARRAY, _FLOAT_ARRAY, _POINTER = ctypes.c_int32, ctypes.c_float, ctypes.c_void_p
_Fields = list[tuple[str, type]]


def _of(kind: type, names: str) -> _Fields:
    return [(name, kind) for name in names.split()]


class Hand(ctypes.Structure):
    """Links and joints."""

    _fields_ = [
        *_of(_INT_ARRAY, "links joints groups"),
        *_of(_POINTER, "parent joint kind constant sine cosine slide axis multiplier shift"),
        *_of(_POINTER, "lower upper joint_scale pivot reach"),
    ]


class Points(ctypes.Structure):
    """Points fixed to links."""

    _fields_ = [*_of(_INT_ARRAY, "count stride runs"), *_of(_POINTER, "xyz run_start run_link group_start")]


class Grid(ctypes.Structure):
    """A signed distance field."""

    _fields_ = [
        ("field", _POINTER),
        *_of(_INT_ARRAY, "nx ny nz"),
        ("origin", _FLOAT_ARRAY * 3),
        ("spacing", _FLOAT_ARRAY),
    ]


class Solids(ctypes.Structure):
    """Boxes and round solids."""

    _fields_ = [("count", _INT_ARRAY), *_of(_POINTER, "pose core radius round link group")]


class Spheres(ctypes.Structure):
    """Proxy spheres."""

    _fields_ = [("centers", Points), *_of(_POINTER, "radius weight")]


class Object(ctypes.Structure):
    """The thing to grasp."""

    _fields_ = [
        ("grid", Grid),
        ("confidence", _POINTER),
        ("center", _FLOAT_ARRAY * 3),
        ("length", _FLOAT_ARRAY),
        ("features", _POINTER),
        *_of(_INT_ARRAY, "feature_count feature_stride coarse_features"),
    ]


class Obstacles(ctypes.Structure):
    """Support and neighbours."""

    _fields_ = [
        *_of(_INT_ARRAY, "grids has_support"),
        ("grid", _POINTER),
        ("normal", _FLOAT_ARRAY * 3),
        *_of(_FLOAT_ARRAY, "offset margin"),
        ("corners", Points),
        ("spheres", Points),
        *_of(_POINTER, "corner_radius sphere_radius"),
    ]


class Weights(ctypes.Structure):
    """Weights of the loss terms, in the order of `closed_form_config.LossWeights`."""

    _fields_ = _of(_FLOAT_ARRAY, "wrench_resistance distance penetration self_collision posture obstacle")


class Problem(ctypes.Structure):
    """All that an evaluation reads."""

    _fields_ = [
        ("hand", Hand),
        ("coarse", Points),
        ("fine", Points),
        ("solids", Solids),
        ("spheres", Spheres),
        ("object", Object),
        ("obstacles", Obstacles),
        *_of(_INT_ARRAY, "directions task_points feature_pairs"),
        ("direction", _POINTER),
        *_of(_FLOAT_ARRAY, "friction sharp_reach"),
    ]


class Schedule(ctypes.Structure):
    """How the search steps."""

    _fields_ = [
        ("weights", Weights),
        ("polish_weights", Weights),
        *_of(_FLOAT_ARRAY, "delta_start delta_end radius_start translation_rate rotation_rate joint_rate"),
        *_of(_INT_ARRAY, "explore_steps refine_steps polish_steps fine_steps soft"),
    ]


class State(ctypes.Structure):
    """Rows of every start."""

    _fields_ = _of(_POINTER, "x mean square radius best_x best_loss loss")


class Pregrasp(ctypes.Structure):
    """How a pregrasp is sought."""

    _fields_ = [*_of(_FLOAT_ARRAY, "clearance joint_rate base_rate joint_cost base_cost"), ("steps", _INT_ARRAY)]


# In the order of `graspd_sizes`.
STRUCTURES = (Hand, Points, Grid, Solids, Spheres, Object, Obstacles, Weights, Problem, Schedule, State, Pregrasp)


def names_of(structure: type[ctypes.Structure]) -> list[str]:
    """Names of a structure's fields."""
    return [field[0] for field in structure._fields_]
