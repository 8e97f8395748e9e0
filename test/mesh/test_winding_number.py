"""The winding number's inside, closest points and exact distances, for surfaces of every kind; rows as numbers."""

import dataclasses
from typing import Any

import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from graspd_core.hands.link_distance import primitive_sdf
from graspd_core.hands.model import Primitive
from graspd_core.mesh.shapes import BOX_HALF, MUG_HALF, make_shape
from graspd_core.mesh.surface_queries import (
    closest_points,
    is_inside,
    make_distance_query,
    make_surface,
    make_winding_tree,
    signed_distance,
    surface_distance,
    winding_inside,
)
from graspd_core.mesh.topology import packed_rows
from graspd_core.types import TriangleMesh


def about(mesh: TriangleMesh, count: int, seed: int) -> np.ndarray:
    """Points in a box 20 % larger than the mesh."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    share = np.random.default_rng(seed).uniform(-0.1, 1.1, (count, 3))
    return low + share * (high - low)


@pytest.mark.parametrize("name", ["mug", "hammer", "torus", "l_block"])
def test_the_two_passes_agree_with_the_exact_winding_number(name):
    mesh = make_shape(name)
    points = about(mesh, 600, seed=1)
    # The sum over every face, no tree: closed bodies have whole numbers, overlaps count twice.
    exact = np.abs(igl.winding_number(mesh.vertices, mesh.faces, points))
    assert np.array_equal(is_inside(make_winding_tree(mesh), points), exact > 0.5)
    assert 0.01 < (exact > 0.5).mean() < 0.99


def test_an_open_cup_is_empty_and_its_holes_leak_only_near_the_rim():
    mug = make_shape("mug")
    lid = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, MUG_HALF - 0.01]])
    assert not winding_inside(mug, lid).any()
    sphere = make_shape("sphere")
    holed = TriangleMesh(sphere.vertices, sphere.faces[sphere.vertices[sphere.faces].mean(1)[:, 2] < 0.03])
    # A cap of height h is a share h/2R of the solid angle: 1 − 5/70 is still well inside.
    assert winding_inside(holed, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.03]])).all()


def test_winding_ignores_long_faces_and_distance_from_the_origin():
    offset = np.array([100.0, -50.0, 20.0])
    hammer = make_shape("hammer")
    far = dataclasses.replace(hammer, vertices=hammer.vertices + offset)
    probes = np.array([[0, 0, 0.0], [0, 0, 0.06], [0.04, 0, 0.065], [0.02, 0, 0.0], [0, 0, 0.085], [0.5, 0, 0]])
    assert winding_inside(far, probes + offset).tolist() == [True, True, True, False, False, False]


@given(seed=st.integers(0, 2**31), shift=st.floats(-50.0, 50.0))
def test_the_exact_distance_of_a_box_is_the_closed_form(seed, shift):
    box = make_shape("box")
    query = make_distance_query(TriangleMesh(box.vertices + shift, box.faces))
    points = about(box, 200, seed)
    solid = Primitive(0, "box", np.eye(3), np.zeros(3), tuple(BOX_HALF))
    expected = primitive_sdf(solid, torch.as_tensor(points)).numpy()
    # Embree counts in float32 about the centre: 1e-8 m at 10 cm.
    assert signed_distance(query, points + shift) == pytest.approx(expected, abs=5e-8)


def test_beyond_the_reach_a_lower_bound_stands_for_the_distance():
    query = make_distance_query(make_shape("sphere"))
    points = about(make_shape("sphere"), 2000, seed=3) * 3
    exact, bounded = signed_distance(query, points), signed_distance(query, points, reach=0.015)
    near = bounded <= 0.015
    assert bounded[near] == pytest.approx(exact[near], abs=1e-12)
    assert (bounded[~near] <= exact[~near] + 1e-7).all()
    assert (exact[~near] > 0.015).all()
    assert 0 < near.sum() < len(points)


class Counting:
    """A tree that answers, and keeps how many points it was asked for at a time."""

    def __init__(self, tree: Any) -> None:
        self.asked: list[int] = []
        self._tree = tree

    def winding_number(self, points: np.ndarray, accuracy: float) -> np.ndarray:
        self.asked.append(len(points))
        return self._tree.winding_number(points, accuracy)


def test_many_points_are_asked_in_pieces_between_which_other_threads_run():
    """igl holds Python's lock during a call, and takes some 10 µs a point."""
    tree, points = make_winding_tree(make_shape("mug")), about(make_shape("mug"), 4000, seed=4)
    counting = Counting(tree.tree)
    assert np.array_equal(is_inside(dataclasses.replace(tree, tree=counting), points), is_inside(tree, points))
    assert sum(counting.asked) > 2000
    assert max(counting.asked) <= 500


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_a_boxs_distance_is_exact_far_from_the_origin_too(shift):
    box, half = make_shape("box"), np.array(BOX_HALF)
    points = np.random.default_rng(0).uniform(-3, 3, (1000, 3)) * half
    points = points[(np.abs(points) > half).any(1)]
    surface = make_surface(TriangleMesh(box.vertices + shift, box.faces))
    closest, normals = closest_points(surface, points + shift)
    exact = np.clip(points, -half, half)
    # Ten roundings of a float64 of the coordinates' size.
    assert np.abs(closest - shift - exact).max() < 1e-15 * (1 + 10 * shift)
    assert np.abs(surface_distance(surface, points + shift) - np.linalg.norm(points - exact, axis=1)).max() < 2e-12
    over_a_face = (np.abs(points) > half).sum(1) == 1
    assert np.abs(normals - np.sign(points - exact))[over_a_face].max() < 1e-12


def test_points_that_are_not_finite_have_no_closest_one():
    surface = make_surface(make_shape("torus"))
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 1e200], [0.035, 0, 0.1]])
    closest, normals = closest_points(surface, points)
    assert np.isnan(np.concatenate([closest[:3], normals[:3]])).all()
    assert surface_distance(surface, points)[:3].tolist() == [np.inf] * 3
    assert np.allclose(normals[3], [0, 0, 1], atol=0.1)


def test_no_points_have_no_answers_and_faces_without_an_area_are_borne():
    query, empty = make_distance_query(make_shape("box")), np.zeros((0, 3))
    assert [part.shape for part in closest_points(query.surface, empty)] == [(0, 3), (0, 3)]
    answers = is_inside(query.tree, empty), surface_distance(query.surface, empty), signed_distance(query, empty)
    assert [answer.shape for answer in answers] == [(0,)] * 3
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    surface = make_surface(TriangleMesh(triangle, np.array([[0, 1, 2], [0, 0, 0], [1, 1, 2]])))
    assert surface_distance(surface, np.array([[0.2, 0.2, 0.5], [2.0, 0, 0]])).tolist() == [0.5, 1.0]


_SHAPES = array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12).map(lambda shape: (shape[0], 1 + shape[1] % 3))

# Few values, so that rows repeat; or up to where three of them have no room in one number.
_VALUES = st.integers(-3, 3) | st.integers(-(2**40), 2**40)


@given(arrays(np.int64, _SHAPES, elements=_VALUES))
def test_rows_and_their_numbers_sort_and_group_alike(rows: np.ndarray):
    by_rows = np.unique(rows, axis=0, return_index=True, return_inverse=True, return_counts=True)
    by_numbers = np.unique(packed_rows(rows), return_index=True, return_inverse=True, return_counts=True)
    for expected, found in zip(by_rows[1:], by_numbers[1:], strict=True):
        np.testing.assert_array_equal(expected.reshape(-1), found)
    np.testing.assert_array_equal(by_rows[0], rows[by_numbers[1]])


@pytest.mark.parametrize("columns", [1, 3])
def test_no_rows_give_no_numbers(columns: int):
    assert packed_rows(np.zeros((0, columns), dtype=np.int64)).shape == (0,)
