"""Small components go, and nothing else does: loose triangles, overlapping bodies and bumps stay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.mesh.components import drop_small_components, face_components
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.scene import build_scene
from graspd_core.types import TriangleMesh, joined

BOX = make_shape("box")


def cube(half: float, centre) -> TriangleMesh:
    return TriangleMesh(BOX.vertices / np.abs(BOX.vertices).max(0) * half + np.asarray(centre, float), BOX.faces)


def soup(mesh: TriangleMesh, jitter: float) -> TriangleMesh:
    corners = mesh.vertices[mesh.faces] + np.random.default_rng(0).normal(0, jitter, (len(mesh.faces), 1, 3))
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), count=st.integers(1, 40))
def test_small_components_go_and_the_body_stays_as_it_was(seed, count):
    rng = np.random.default_rng(seed)
    small = [cube(0.0007, rng.choice([-1, 1], 3) * rng.uniform(0.05, 0.09, 3)) for _ in range(count)]
    clean, dropped = drop_small_components(joined(BOX, *small))
    assert dropped == count
    assert np.array_equal(clean.vertices[clean.faces], BOX.vertices[BOX.faces])


@pytest.mark.parametrize(
    "mesh",
    [
        BOX,
        soup(make_shape("cylinder"), 5e-4),
        soup(make_shape("sphere"), 5e-4),
        make_shape("mug"),
        make_shape("hammer"),
        joined(cube(0.03, (0, 0, 0)), cube(0.03, (0.1, 0, 0))),
        # A bump on the surface, one just off it, and many that hold more than 2 % of the area.
        joined(BOX, cube(0.001, (0.03, 0, 0))),
        joined(BOX, cube(0.001, (0.0325, 0, 0))),
        joined(BOX, *(cube(0.0025, (0.05 + 0.01 * i, 0, 0)) for i in range(6))),
    ],
    ids=["box", "soup", "fine-soup", "mug", "hammer", "pair", "bump", "near", "gravel"],
)
def test_what_is_no_small_component_stays(mesh):
    clean, dropped = drop_small_components(mesh)
    assert dropped == 0
    assert np.array_equal(clean.vertices[clean.faces], mesh.vertices[mesh.faces])


def test_a_scene_names_its_small_components_and_is_as_large_as_the_body():
    scene = build_scene(joined(BOX, cube(0.0007, (0.2, 0.0, 0.0)), cube(0.0007, (0.0, 0.1, 0.0))), resolution=16)
    assert any("dropped 2 tiny pieces" in warning for warning in scene.object.warnings)
    assert np.ptp(scene.object.mesh.vertices, axis=0) == pytest.approx(np.ptp(BOX.vertices, axis=0))


def test_what_small_components_look_like_is_not_said_of_the_body():
    speck = TriangleMesh(np.array([[1.0, 0, 0], [1.0, 0.001, 0], [1.0, 0, 0.001]]), np.array([[0, 1, 2]]))
    scene = build_scene(joined(BOX, speck), resolution=16)
    assert scene.object.warnings == ("mesh: dropped 1 tiny pieces that float clear of the rest",)


def test_a_reconstruction_is_left_alone():
    dusty = joined(BOX, cube(0.0007, (0.2, 0.0, 0.0)))
    scene = build_scene(dusty, confidence=np.ones(len(dusty.vertices)), resolution=16)
    assert len(scene.object.mesh.faces) == len(dusty.faces)


def test_pieces_are_numbered_by_the_vertices_they_share():
    pieces = face_components(joined(BOX, cube(0.01, (0.1, 0, 0)), BOX))
    assert pieces.tolist() == np.repeat([0, 1, 2], len(BOX.faces)).tolist()
