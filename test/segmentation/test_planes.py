"""Planes and clusters: what is found is what was put there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspd_core.config import SegmentationConfig
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.segment.clusters import extent, link_length, link_points, renumber
from graspd_core.perception.segment.planes import find_planes

EYE = np.array([[0.0, 0.0, 0.0]])


def sheet(rng, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A table 0.4 m below the camera, up to 1.5 m away, with noise that grows with the square of the distance."""
    points = np.column_stack([rng.uniform(0.2, 1.4, 8000), rng.uniform(-0.3, 0.3, 8000), np.full(8000, -0.4)])
    distance = np.linalg.norm(points, axis=1)
    points[:, 2] += noise * distance**2 * rng.standard_normal(8000)
    return points, distance


@given(st.integers(0, 10**6), st.floats(0.0, 2.5e-3))
def test_a_plane_is_found_however_it_is_turned(seed, noise):
    rng = np.random.default_rng(seed)
    points, distance = sheet(rng, noise)
    turn = Rotation.random(rng=rng).as_matrix()
    (part,) = find_planes(points @ turn.T, distance, EYE, SegmentationConfig())
    # Weighted least squares over thousands of points: the tilt is far below noise over size.
    assert part.plane.normal @ turn == pytest.approx([0, 0, 1], abs=2e-3)
    assert part.plane.offset == pytest.approx(-0.4, abs=1e-3)
    assert part.sides[1] == pytest.approx(0.6, abs=0.03)
    assert part.area == pytest.approx(1.2 * 0.6, rel=0.03)
    # The standard deviation by the median is itself uncertain by some per cent, and cut off at the gate.
    assert part.noise == pytest.approx(noise, rel=0.15, abs=1e-5)
    assert part.inliers.mean() > 0.98


def test_tolerance_grows_with_distance_within_bounds():
    points, distance = sheet(np.random.default_rng(0), 2e-3)
    (part,) = find_planes(points, distance, EYE, SegmentationConfig())
    near, far, beyond = part.tolerance(np.array([0.3, 1.3, 9.0]))
    assert near == 0.004
    assert far == pytest.approx(4 * 2e-3 * 1.3**2, rel=0.15)
    assert beyond == 0.02
    assert part.beneath(np.array([[0.8, 0.0, 0.3], [0.8, 0.5, 0.0]]), 0.0).tolist() == [True, False]
    assert part.beneath(np.array([[0.8, 0.5, 0.0]]), 0.25).all()
    assert part.height(np.array([[0.8, 0.0, -0.3]])) == pytest.approx([0.1], abs=1e-3)


def test_parts_a_kilometre_apart_take_no_memory():
    rng = np.random.default_rng(0)
    table, _ = sheet(rng, 0.0)
    points = np.vstack([table, table[:2000] + np.array([1000.0, 1000.0, 0.0])])
    (part, *_) = find_planes(points, np.linalg.norm(points, axis=1), EYE, SegmentationConfig())
    # The two lie in one plane, 10^10 cells of a centimetre about both: the larger is the part.
    assert part.inliers[: len(table)].all()
    assert not part.inliers[len(table) :].any()


def test_points_scattered_over_a_room_are_not_linked():
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (200, 3))
    assert link_length(points, SegmentationConfig()) == 0.05
    assert link_length(points / 100, SegmentationConfig()) < 0.05


def test_two_planes_are_two_parts():
    rng = np.random.default_rng(0)
    table, _ = sheet(rng, 0.0)
    wall = np.column_stack([np.full(4000, 1.4), rng.uniform(-0.3, 0.3, 4000), rng.uniform(-0.39, 0.1, 4000)])
    points = np.vstack([table, wall])
    parts = find_planes(points, np.linalg.norm(points, axis=1), EYE, SegmentationConfig())
    assert [part.plane.normal.round(2).tolist() for part in parts] == [[0, 0, 1], [-1, 0, 0]]
    assert not (parts[0].inliers & parts[1].inliers).any()


@pytest.mark.parametrize("shape", ["sphere", "bowl", "torus", "bottle", "mug"])
def test_small_and_curved_things_hold_no_plane(shape):
    points = surface_samples(make_shape(shape), 6000, 0)[0] - [0, 0, 0.6]
    assert find_planes(points, np.linalg.norm(points, axis=1), EYE, SegmentationConfig()) == []


def test_clusters_are_numbered_from_the_largest_and_strays_belong_to_none():
    grid = 0.003 * np.stack(np.meshgrid(range(20), range(20), indexing="ij"), -1).reshape(-1, 2)
    flat = np.column_stack([grid, np.zeros(len(grid))])
    small = flat[flat[:, 0] < 0.02] + [0.08, 0, 0]
    stray = np.array([[0.03, 0.03, 0.1], [0.3, 0.0, 0.0]])
    points = np.vstack([small, stray, flat])
    label = link_points(points, np.ones(len(points)), link_length(points, SegmentationConfig()), 0.3)
    assert (label[: len(small)] == 1).all()
    assert (label[len(small) : len(small) + 2] == -1).all()
    assert (label[len(small) + 2 :] == 0).all()
    # The same place, seen a hundred times less than the rest, is noise.
    weight = np.where(np.arange(len(points)) < len(small), 0.01, 1.0)
    assert (link_points(points, weight, 0.006, 0.3)[: len(small)] == -1).all()


def test_clusters_of_nothing():
    assert link_points(np.zeros((0, 3)), np.zeros(0), 0.01, 0.3).tolist() == []
    assert link_points(np.eye(3), np.ones(3), 0.01, 0.3).tolist() == [-1, -1, -1]
    assert renumber(np.array([4, 2, 2, -1])).tolist() == [1, 0, 0, -1]


@given(st.integers(0, 10**6))
def test_extent_does_not_depend_on_the_frame(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (500, 3)) * [0.1, 0.03, 0.02]
    turn = Rotation.random(rng=rng).as_matrix()
    assert extent(points @ turn.T + 1.0) == pytest.approx(extent(points), rel=1e-6)
    assert extent(points) == pytest.approx(0.2, abs=0.03)


def test_the_same_points_give_the_same_planes_every_time():
    """Open3D looks from several threads: where it may stop early, that which comes first decides."""
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.5, 0.5, (1500, 2)), rng.normal(0.0, 0.006, 1500)])
    points = np.vstack([table, rng.uniform(-0.5, 0.5, (3000, 3)) * [1, 1, 0.2]])
    away, eye = np.full(len(points), 1.5), np.array([[0.0, 0.0, 1.5]])
    found = [find_planes(points, away, eye, SegmentationConfig()) for _ in range(8)]
    assert len({tuple(part.plane.offset for part in parts) for parts in found}) == 1
