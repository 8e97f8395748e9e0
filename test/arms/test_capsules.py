"""Capsules: their distances against MuJoCo's, and that they hold what they stand for."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from graspd_core.arms.arm import capsules_about, segment_distance
from graspd_core.hands.model import Primitive, PrimitiveKind
from graspd_core.se3 import axis_rotation

# MuJoCo's types are not public to checkers.
mujoco: Any = pytest.importorskip("mujoco")

SEEDS = st.integers(0, 2**32 - 1)


def distance_in_mujoco(ends: np.ndarray, radii: np.ndarray) -> float:
    """Of two capsules."""
    geoms = "".join(
        f'<geom type="capsule" fromto="{" ".join(map(repr, pair.ravel().tolist()))}" size="{radius!r}"/>'
        for pair, radius in zip(ends, radii.tolist(), strict=True)
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)


@given(SEEDS)
def test_distances_are_those_of_mujoco(seed: int):
    rng = np.random.default_rng(seed)
    ends, radii = rng.uniform(-1, 1, (2, 2, 3)), rng.uniform(0.01, 0.2, 2)
    wanted = distance_in_mujoco(ends, radii)
    a, b, c, d = torch.as_tensor(ends.reshape(4, 3))
    # MuJoCo's capsules have ends of their own: to its tolerance.
    assert np.isclose(float(segment_distance(a, b, c, d)) - radii.sum(), wanted, atol=1e-6)


@given(SEEDS, st.sampled_from(["parallel", "point", "points", "crossing", "in line"]))
def test_degenerate_segments_have_their_distance(seed: int, kind: str):
    rng = np.random.default_rng(seed)
    a, way, up = rng.uniform(-1, 1, 3), rng.uniform(0.1, 1, 3), np.array([0.0, 0.0, 1.0])
    c, d = {
        "parallel": (a + np.cross(way, [1.0, 0.0, 0.0]), a + way + np.cross(way, [1.0, 0.0, 0.0])),
        "point": (a + 3 * up, a + 3 * up),
        "points": (a + way, a + way),
        "crossing": (a + 0.5 * way - up, a + 0.5 * way + up),
        "in line": (a + 2 * way, a + 3 * way),
    }[kind]
    b = a if kind == "points" else a + way
    # Dense samples of both are never nearer than the distance, and come within a step of it.
    shares = np.linspace(0, 1, 401)[:, None]
    pairs = (a + shares * (b - a))[:, None] - (c + shares * (d - c))[None]
    sampled = np.linalg.norm(pairs, axis=-1).min()
    distance = float(segment_distance(*map(torch.as_tensor, (a, b, c, d))))
    assert distance - 1e-9 <= sampled <= distance + 0.01


@given(SEEDS, st.sampled_from(get_args(PrimitiveKind)))
def test_a_capsule_holds_the_solid_that_it_is_about(seed: int, kind: PrimitiveKind):
    rng = np.random.default_rng(seed)
    size = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2, "hull": 0}[kind]
    corners = rng.normal(size=(20, 3)) * rng.uniform(0.01, 0.3, 3)
    faces = ConvexHull(corners).simplices.astype(np.int64) if kind == "hull" else np.zeros((0, 3), dtype=np.int64)
    rotation = axis_rotation(np.array([0.0, 0.6, 0.8]), rng.uniform(0, 3))
    half = tuple(rng.uniform(0.01, 0.3, size).tolist())
    at = rng.uniform(-1, 1, 3)
    vertices = corners if kind == "hull" else np.zeros((0, 3))
    capsule = capsules_about([Primitive(0, kind, rotation, at, half, vertices, faces)])
    surface = solid_points(kind, half, corners, rng) @ rotation.T + at
    point = torch.as_tensor(surface)
    start, end = (torch.as_tensor(x[0]).expand_as(point) for x in (capsule.start, capsule.end))
    assert float(segment_distance(point, point, start, end).max()) <= capsule.radius[0] + 1e-9


def solid_points(kind: str, size: tuple[float, ...], corners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points of a solid's surface or corners, in its frame."""
    if kind == "hull":
        return corners
    if kind == "box":
        return rng.choice([-1.0, 1.0], (50, 3)) * np.asarray(size)
    direction = rng.normal(size=(200, 3))
    if kind == "cylinder":
        flat = direction[:, :2] / np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
        return np.column_stack([size[0] * flat, rng.choice([-1.0, 1.0], 200) * size[1]])
    ball = size[0] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    shift = rng.choice([-1.0, 1.0], 200) * (size[1] if kind == "capsule" else 0.0)
    return ball + shift[:, None] * [0.0, 0.0, 1.0]
