"""The winding number's inside, and exact distances, for surfaces of every kind."""

from __future__ import annotations

import dataclasses
from typing import Any

import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.hands.link_distance import box_sdf
from graspd_core.mesh.shapes import BOX_HALF, MUG_HALF, make_shape
from graspd_core.mesh.surface_queries import (
    inside,
    is_inside,
    make_distance_query,
    make_winding_tree,
    signed_distance,
    unsigned_distance,
    winding_inside,
)
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


def test_inverted_and_doubled_surfaces_have_the_same_inside():
    mesh = make_shape("bottle")
    points = about(mesh, 400, seed=2)
    plain = winding_inside(mesh, points)
    assert np.array_equal(winding_inside(TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]), points), plain)
    assert np.array_equal(winding_inside(TriangleMesh(mesh.vertices, np.vstack([mesh.faces] * 2)), points), plain)


def test_winding_ignores_long_faces_and_distance_from_the_origin():
    offset = np.array([100.0, -50.0, 20.0])
    hammer = make_shape("hammer")
    far = dataclasses.replace(hammer, vertices=hammer.vertices + offset)
    probes = np.array([[0, 0, 0.0], [0, 0, 0.06], [0.04, 0, 0.065], [0.02, 0, 0.0], [0, 0, 0.085], [0.5, 0, 0]])
    assert winding_inside(far, probes + offset).tolist() == [True, True, True, False, False, False]


def test_no_points_give_no_answers():
    query = make_distance_query(make_shape("box"))
    empty = np.zeros((0, 3))
    for answer in (inside, unsigned_distance, signed_distance):
        assert len(answer(query, empty)) == 0


@given(seed=st.integers(0, 2**31), shift=st.floats(-50.0, 50.0))
def test_the_exact_distance_of_a_box_is_the_closed_form(seed, shift):
    box = make_shape("box")
    query = make_distance_query(TriangleMesh(box.vertices + shift, box.faces))
    points = about(box, 200, seed)
    expected = box_sdf(torch.as_tensor(points), torch.tensor(BOX_HALF, dtype=torch.float64)).numpy()
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
