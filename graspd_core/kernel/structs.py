"""The structures of src/layout.hpp, field by field; `builds.load` compares their sizes."""

from __future__ import annotations

import ctypes

_INT, _FLOAT, _POINTER = ctypes.c_int32, ctypes.c_float, ctypes.c_void_p
_Fields = list[tuple[str, type]]


def _of(kind: type, names: str) -> _Fields:
    return [(name, kind) for name in names.split()]


class Hand(ctypes.Structure):
    """Links and joints."""

    _fields_ = [
        *_of(_INT, "links joints groups"),
        *_of(_POINTER, "parent joint kind constant sine cosine slide axis multiplier shift"),
        *_of(_POINTER, "lower upper joint_scale pivot reach"),
    ]


class Points(ctypes.Structure):
    """Points fixed to links."""

    _fields_ = [*_of(_INT, "count stride runs"), *_of(_POINTER, "xyz run_start run_link group_start")]


class Grid(ctypes.Structure):
    """A signed distance field."""

    _fields_ = [("field", _POINTER), *_of(_INT, "nx ny nz"), ("origin", _FLOAT * 3), ("spacing", _FLOAT)]


class Solids(ctypes.Structure):
    """Boxes and round solids."""

    _fields_ = [("count", _INT), *_of(_POINTER, "pose core radius round link group")]


class Spheres(ctypes.Structure):
    """Proxy spheres."""

    _fields_ = [("centers", Points), *_of(_POINTER, "radius weight")]


class Object(ctypes.Structure):
    """The thing to grasp."""

    _fields_ = [
        ("grid", Grid),
        ("confidence", _POINTER),
        ("center", _FLOAT * 3),
        ("length", _FLOAT),
        ("features", _POINTER),
        *_of(_INT, "feature_count feature_stride coarse_features"),
    ]


class Obstacles(ctypes.Structure):
    """Support and neighbours."""

    _fields_ = [
        *_of(_INT, "grids has_support"),
        ("grid", _POINTER),
        ("normal", _FLOAT * 3),
        *_of(_FLOAT, "offset margin"),
        ("corners", Points),
        ("spheres", Points),
        *_of(_POINTER, "corner_radius sphere_radius"),
    ]


class Weights(ctypes.Structure):
    """Weights of the loss terms, in the order of `closed_form_config.LossWeights`."""

    _fields_ = _of(_FLOAT, "wrench_resistance distance penetration self_collision posture obstacle")


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
        *_of(_INT, "directions task_points feature_pairs"),
        ("direction", _POINTER),
        *_of(_FLOAT, "friction sharp_reach"),
    ]


class Schedule(ctypes.Structure):
    """How the search steps."""

    _fields_ = [
        ("weights", Weights),
        ("polish_weights", Weights),
        *_of(_FLOAT, "delta_start delta_end radius_start translation_rate rotation_rate joint_rate"),
        *_of(_INT, "explore_steps refine_steps polish_steps soft"),
    ]


class State(ctypes.Structure):
    """Rows of every start."""

    _fields_ = _of(_POINTER, "x mean square radius best_x best_loss loss")


class Pregrasp(ctypes.Structure):
    """How a pregrasp is sought."""

    _fields_ = [*_of(_FLOAT, "clearance joint_rate base_rate joint_cost base_cost"), ("steps", _INT)]


# In the order of `graspd_sizes`.
STRUCTURES = (Hand, Points, Grid, Solids, Spheres, Object, Obstacles, Weights, Problem, Schedule, State, Pregrasp)


def names_of(structure: type[ctypes.Structure]) -> list[str]:
    """Names of a structure's fields."""
    return [field[0] for field in structure._fields_]
