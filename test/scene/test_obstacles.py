"""Neighbours from what was seen of them: hulls that hold every point, reach the table, and stay thin where unseen."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.config import ObstacleConfig
from graspd_core.mesh.mesh_files import mass_properties
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.obstacles import make_obstacles, padded_hull
from graspd_core.types import Plane

TARGET = make_shape("box")
PADDING = ObstacleConfig().padding
TABLE = Plane(np.array([0.0, 0.0, 1.0]), -0.045)


def face(x: float, low: float) -> np.ndarray:
    """A seen face 100 mm wide and 100 mm high, across x, from a height on [m]."""
    y, z = np.meshgrid(np.linspace(-0.05, 0.05, 15), np.linspace(low, low + 0.1, 15))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def test_a_face_is_carried_down_to_the_table_and_stays_thin():
    (neighbour,) = make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.3)
    low, high = neighbour.mesh.vertices.min(0), neighbour.mesh.vertices.max(0)
    # The skin reaches as far along every axis.
    assert low == pytest.approx([0.15 - PADDING, -0.05 - PADDING, -0.045 - PADDING])
    assert high == pytest.approx([0.15 + PADDING, 0.05 + PADDING, 0.1 + PADDING])
    floating = padded_hull(face(0.15, 0.0), None, PADDING)
    assert floating.vertices[:, 2].min() == pytest.approx(-PADDING)


def test_the_distance_is_that_of_the_hull():
    (neighbour,) = make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.3)
    x = torch.tensor([[0.15, 0.0, 0.05], [0.15, 0.0, -0.02], [0.1, 0.0, 0.05], [0.2, 0.0, 0.05]])
    distance = sample_sdf(neighbour.sdf, x)[0].numpy()
    # Outside the grid is exact but for the blur of its cells; a slab of 10 mm between cells of 6 mm is less deep in it.
    assert distance[2:] == pytest.approx([0.045, 0.045], abs=5e-4)
    assert (distance[:2] >= -0.005).all()
    assert (distance[:2] < -0.001).all()


def test_things_out_of_reach_and_specks_are_left_out():
    # The box's side is at 30 mm.
    assert len(make_obstacles([face(0.15, 0.0), face(0.35, 0.0)], TABLE, TARGET, 0.2)) == 1
    assert make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.119) == ()
    assert len(make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.125)) == 1
    holes = np.full((400, 3), np.nan)
    holes[:9] = face(0.15, 0.0)[:9]
    assert make_obstacles([holes, np.zeros((0, 3))], TABLE, TARGET, 1.0) == ()
    assert make_obstacles([], None, TARGET, 1.0) == ()


@pytest.mark.parametrize("support", [TABLE, None])
def test_a_tray_about_the_object_leaves_it_room(support):
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 120), (-0.04, -0.02, 0.0))
    ring = np.column_stack([0.12 * np.cos(turn.ravel()), 0.12 * np.sin(turn.ravel()), height.ravel()])
    found = make_obstacles([ring], support, TARGET, 0.3)
    distance = np.stack([sample_sdf(n.sdf, torch.as_tensor(TARGET.vertices).float())[0].numpy() for n in found])
    assert distance.min() > 0.02
    # Each of its points is still in the way.
    held = np.stack([sample_sdf(n.sdf, torch.as_tensor(ring).float())[0].numpy() for n in found])
    assert held.min(0).max() < 0


@settings(max_examples=15)
@given(seed=st.integers(0, 2**31), flat=st.booleans())
def test_every_seen_point_and_its_shadow_lie_within(seed: int, flat: bool):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    points = rng.normal(size=(40, 3)) * 0.05
    if flat:
        points[:, 0] = 0.1
    support = Plane(normal, float((points @ normal).min()) - 0.03)
    hull = padded_hull(points, support, PADDING)
    a, b, c = hull.vertices[hull.faces].transpose(1, 0, 2)
    outward = np.cross(b - a, c - a)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    shadows = points - (points @ normal - support.offset)[:, None] * normal
    depth = ((a[None] - np.vstack([points, shadows])[:, None]) * outward).sum(-1).min(1)
    # The skin is an octahedron, thinnest across its faces.
    assert depth.min() >= PADDING / np.sqrt(3) - 1e-9
    assert mass_properties(hull)[0] > 0
