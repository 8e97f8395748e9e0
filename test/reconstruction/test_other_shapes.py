"""Other shapes that one view allows, and the view that would tell them apart."""

import numpy as np
import pytest

from graspd_core.config import ReconstructionConfig
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import BOX_HALF, make_shape
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.mesh.topology import is_closed
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.reconstruct.hidden_side import next_view, other_rules, other_shape
from graspd_core.perception.reconstruct.reconstruct import Reconstruction, reconstruct
from graspd_core.types import Plane, TriangleMesh

EYE = np.array([0.3, 0.15, 0.35])
TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


def standing_box() -> tuple[TriangleMesh, PointCloud]:
    """A box on the table, and the part of it that a camera sees."""
    box = make_shape("box")
    box = TriangleMesh(box.vertices + np.array([0.0, 0.0, BOX_HALF[2]]), box.faces)
    points, normals = surface_samples(box, 24_000, 0)
    return box, PointCloud(points[((EYE - points) * normals).sum(1) > 0], EYE)


@pytest.fixture(scope="module")
def half_seen() -> Reconstruction:
    return reconstruct([standing_box()[1]], support=TABLE)


def test_other_rules_give_other_closed_shapes_through_what_was_seen(half_seen):
    evidence, view = half_seen.evidence, standing_box()[1]
    rules = other_rules(evidence)
    assert evidence.chosen not in rules
    shapes = [mesh for rule in rules if (mesh := other_shape(evidence, rule, half_seen.mesh)) is not None]
    assert len(shapes) >= 2
    for mesh in shapes:
        assert is_closed(mesh)
        surface = make_surface(mesh)
        seen = surface_distance(surface, view.points)
        assert (seen < ReconstructionConfig.fit_distance).mean() > 0.85
        assert surface_distance(surface, surface_samples(half_seen.mesh, 2000, 0)[0]).mean() > 2e-4


def test_the_shape_that_was_chosen_is_no_other(half_seen):
    assert half_seen.evidence.hidden
    assert other_shape(half_seen.evidence, half_seen.evidence.chosen, half_seen.mesh) is None


def test_nothing_else_may_be_true_of_what_was_seen_all_round():
    box, _ = standing_box()
    points, normals = surface_samples(box, 24_000, 0)
    eyes = 0.5 * np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]]) + np.array([0.0, 0.0, 0.05])
    views = [PointCloud(points[((eye - points) * normals).sum(1) > 0], eye) for eye in eyes]
    whole = reconstruct(views, support=TABLE)
    assert not whole.evidence.hidden
    assert other_rules(whole.evidence) == ()


def test_the_next_view_looks_at_the_far_side_from_above_the_table(half_seen):
    assert half_seen.evidence.hidden
    pose = next_view(half_seen.evidence, half_seen.mesh, np.zeros(3))
    assert pose is not None
    eye, forward = pose[:3, 3], pose[:3, 2]
    centre = np.array([0.0, 0.0, BOX_HALF[2]])
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.norm(eye - centre) == pytest.approx(np.linalg.norm(EYE - centre), rel=0.05)
    assert forward @ (centre - eye) > 0.99 * np.linalg.norm(centre - eye)
    assert eye[2] > 0
    assert eye[:2] @ EYE[:2] < 0
    points, normals = surface_samples(standing_box()[0], 24_000, 0)
    sides = points[:, 2] > 1e-4  # not the one that it stands on
    hidden = sides & (((EYE - points) * normals).sum(1) <= 0)
    shown = hidden & (((eye - points) * normals).sum(1) > 0)
    assert shown.sum() > 0.95 * hidden.sum()


def test_the_next_view_goes_where_the_object_goes(half_seen):
    shift = np.array([1.0, -2.0, 3.0])
    assert half_seen.evidence.hidden
    here, there = (next_view(half_seen.evidence, half_seen.mesh, s) for s in (np.zeros(3), shift))
    assert here is not None
    assert there is not None
    assert there[:3, 3] - here[:3, 3] == pytest.approx(shift)
