"""Figures of a hand that is one surface, against bodies whose shared volume and area are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd_bench.studies.human_hand import CONTACT_DISTANCES, measure_skin
from graspd_core.mesh.surface_queries import make_distance_query
from graspd_core.types import TriangleMesh


def mesh_of(made: trimesh.Trimesh, shift: np.ndarray) -> TriangleMesh:
    return TriangleMesh(np.asarray(made.vertices) + shift, np.asarray(made.faces, dtype=np.int64))


def box(size: float, shift: np.ndarray) -> TriangleMesh:
    return mesh_of(trimesh.creation.box(extents=np.full(3, size)), shift)


@pytest.mark.parametrize("depth", [0.0, 0.001, 0.006])
def test_a_box_that_sinks_into_a_box(depth: float) -> None:
    """A cube of 40 mm whose face lies `depth` below that of one of 60 mm."""
    shift = np.array([0.0, 0.0, 0.05 - depth])
    found = measure_skin(make_distance_query(box(0.06, np.zeros(3))), box(0.04, shift))
    assert found.intersection_volume == pytest.approx(0.04**2 * depth, abs=1e-9)
    assert found.penetration == pytest.approx(depth, abs=1e-6)
    # Near the object's face: the skin's own face, and of its sides the strips within reach on either side of it.
    for within, area in zip(CONTACT_DISTANCES, found.contact_area, strict=True):
        expected = 0.04**2 * (depth <= within) + 4 * 0.04 * (within + min(depth, within))
        # A strip of 2 mm has 1300 of the samples: 6 % are two standard deviations of their number.
        assert area == pytest.approx(expected, rel=0.06)


def test_spheres_share_a_lens() -> None:
    """Two balls of 30 mm whose centres are 50 mm apart share π (4r + d)(2r − d)² / 12 (MathWorld)."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    query = make_distance_query(mesh_of(ball, np.zeros(3)))
    found = measure_skin(query, mesh_of(ball, np.array([0.05, 0.0, 0.0])))
    expected = np.pi * (4 * 0.03 + 0.05) * (2 * 0.03 - 0.05) ** 2 / 12
    # Facets lie up to 0.04 mm inside the ball, of a lens 10 mm deep; the rest is the voxels' edge.
    assert found.intersection_volume == pytest.approx(expected, rel=0.03)
    assert found.penetration == pytest.approx(0.01, abs=1e-4)


def test_figures_do_not_depend_on_the_frame() -> None:
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.7, 0.4]))
    turn[:3, 3] = [0.3, -0.2, 0.1]
    figures = []
    for transform in (np.eye(4), turn):
        target = trimesh.creation.box(extents=[0.05, 0.06, 0.07]).apply_transform(transform)
        skin = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
        skin.apply_translation([0.035, 0.0, 0.0]).apply_transform(transform)
        query = make_distance_query(mesh_of(target, np.zeros(3)))
        figures.append(measure_skin(query, mesh_of(skin, np.zeros(3))))
    assert figures[0].contact_area == pytest.approx(figures[1].contact_area, rel=0.06)
    assert figures[0].intersection_volume == pytest.approx(figures[1].intersection_volume, rel=0.02)


def test_bodies_far_apart_share_nothing() -> None:
    found = measure_skin(make_distance_query(box(0.06, np.zeros(3))), box(0.04, np.full(3, 0.5)))
    assert found.contact_area == (0.0, 0.0, 0.0)
    assert (found.intersection_volume, found.penetration) == (0.0, 0.0)
