"""Guesses about unseen sides: symmetries, axes, what cameras say of guessed points; other shapes, and the next view."""

from dataclasses import replace

import numpy as np
import pytest
from expected import some
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.config import ReconstructionConfig
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import BOX_HALF, CYLINDER_HALF, CYLINDER_RADIUS, SPHERE_RADIUS, make_shape
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.mesh.topology import is_closed
from graspd_core.perception.cloud.free_space import FreeSpace, empty_depth, make_view_depths, weigh
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.reconstruct.extrusion import extrude, stand
from graspd_core.perception.reconstruct.hidden_side import next_view, other_rules, other_shape
from graspd_core.perception.reconstruct.merge_views import Surfels, join, merge_views, point_step
from graspd_core.perception.reconstruct.reconstruct import Reconstruction, reconstruct
from graspd_core.perception.reconstruct.revolution import find_revolution, fit_axis, half_plane, settle_axis
from graspd_core.perception.reconstruct.shape_completion import complete_shape, openness, plausible
from graspd_core.perception.reconstruct.symmetry import find_centre, find_mirrors, image
from graspd_core.types import Plane

EYE = np.array([0.3, 0.15, 0.35])


def front(name: str, height: float, eye: np.ndarray = EYE) -> PointCloud:
    """The points of a convex shape, its centre at `height` [m], that an eye sees."""
    mesh = make_shape(name)
    points, normals = surface_samples(mesh, 24_000, 0)
    points = points + np.array([0.0, 0.0, height])
    return PointCloud(points[((eye - points) * normals).sum(1) > 0], eye)


def looked_at(view: PointCloud) -> tuple[Surfels, FreeSpace, float]:
    step = point_step([view])
    return merge_views([view], step, ReconstructionConfig()), FreeSpace(make_view_depths([view]), standing=True), step


BOX, CYLINDER, BALL = front("box", BOX_HALF[2]), front("cylinder", CYLINDER_HALF), front("sphere", SPHERE_RADIUS)


@given(st.floats(0.01, 0.9), st.floats(0.002, 0.1))
def test_before_the_surface_it_is_empty_and_behind_it_is_not(along, behind):
    """A wall at z = 0 seen from a metre above its middle."""
    ticks = np.linspace(-0.1, 0.1, 60)
    wall = np.stack(np.meshgrid(ticks, ticks, [0.0], indexing="ij"), -1).reshape(-1, 3)
    free_space = FreeSpace(make_view_depths([PointCloud(wall, np.array([0.0, 0.0, 1.0]))]), standing=False)
    before = np.array([[0.01, 0.0, along]])
    assert empty_depth(free_space, before)[0] == pytest.approx(along, abs=1e-6)
    assert empty_depth(free_space, np.array([[0.01, 0.0, -behind]]))[0] == 0
    # Beside the outline, by how far: cells are 5 mm wide.
    assert empty_depth(free_space, np.array([[0.13, 0.0, 0.0]]))[0] == pytest.approx(0.03, abs=0.006)
    up = np.array([[0.0, 0.0, 1.0]])
    on = np.array([[0.01, 0.0, 0.001]])
    assert weigh(free_space, on, up)[0][0]
    assert not weigh(free_space, on, -up)[0][0], "a surface that faces away was not seen"


def test_the_support_is_no_place_for_an_object():
    free_space = FreeSpace((), standing=True)
    assert empty_depth(free_space, np.array([[0, 0, -0.02], [0, 0, 0.02]])) == pytest.approx([0.02, 0.0])


@pytest.mark.parametrize("view", [CYLINDER, BALL], ids=["cylinder", "ball"])
def test_a_revolution_is_found_and_lies_on_the_body(view):
    seen, free_space, step = looked_at(view)
    turned = some(find_revolution(seen, free_space, step))
    assert turned.wrong < 0.01
    assert turned.share > 0.9
    height = SPHERE_RADIUS if view is BALL else CYLINDER_HALF
    points = turned.surfels.points - [0, 0, height]
    if view is BALL:
        off = np.abs(np.linalg.norm(points, axis=1) - SPHERE_RADIUS)
    else:
        across = np.linalg.norm(points[:, :2], axis=1)
        off = np.abs(np.maximum(across - CYLINDER_RADIUS, np.abs(points[:, 2]) - CYLINDER_HALF))
    # Points are 1.6 mm apart, and smoothing rounds edges over some 4 mm.
    assert np.median(off) < 0.001
    assert np.percentile(off, 95) < 0.004


@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-1, 1), st.floats(-1, 1))
def test_the_axis_is_where_the_normals_meet(x, y, tilt, turn):
    direction = np.array([tilt, turn, 1.5]) / np.linalg.norm([tilt, turn, 1.5])
    first = np.cross(direction, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    angle, height = np.linspace(0, 2.5, 40), np.linspace(-0.04, 0.04, 20)
    outward = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(direction, first)
    place = np.array([x, y, 0.0])
    points = place + 0.03 * outward[None] + height[:, None, None] * direction
    normals = np.broadcast_to(outward, points.shape)
    axis = fit_axis(Surfels(points.reshape(-1, 3), normals.reshape(-1, 3).copy()), direction)
    offset = axis.point - place
    assert np.linalg.norm(offset - (offset @ direction) * direction) < 2e-4


def test_the_mirrors_of_a_box_are_its_own():
    seen, free_space, _ = looked_at(BOX)
    mirrors = find_mirrors(seen, free_space)
    assert mirrors
    images = image(mirrors[0], seen)
    off = np.abs((np.abs(images.points - [0, 0, BOX_HALF[2]]) - BOX_HALF).max(1))
    assert np.percentile(off, 90) < 0.004


def test_the_half_turn_of_a_box_is_found():
    seen, free_space, _ = looked_at(BOX)
    centre = find_centre(seen, free_space)
    assert centre.wrong < 0.02
    # p ↦ 2c − p across: the centre is half the shift.
    assert centre.shift[:2] / 2 == pytest.approx([0, 0], abs=0.004)


def test_a_box_is_extruded_to_its_unseen_walls_and_closed_below():
    seen, free_space, step = looked_at(BOX)
    walls = extrude(seen, free_space, step)
    off = np.abs(np.abs(walls.points[:, :2]) - BOX_HALF[:2]).min(1)
    assert np.percentile(off, 90) < 0.003
    whole = join(seen, plausible(walls, seen, free_space, step))
    closed = join(whole, stand(whole, free_space, step))
    assert openness(closed, step) < 0.15 < openness(seen, step)
    base = closed.points[closed.normals[:, 2] < -0.9]
    assert np.abs(base[:, 2]).max() < 1e-9
    assert (np.abs(base[:, :2]) < np.array(BOX_HALF[:2]) + 0.004).all()


def test_a_ball_has_no_base_and_is_not_extruded():
    seen, free_space, step = looked_at(BALL)
    assert len(stand(seen, free_space, step).points) == 0
    walls = plausible(extrude(seen, free_space, step), seen, free_space, step)
    assert len(walls.points) < 0.05 * len(seen.points)


@pytest.mark.parametrize(("view", "method"), [(BOX, "extrusion"), (CYLINDER, "revolution"), (BALL, "revolution")])
def test_the_evidence_chooses(view, method):
    guess = complete_shape(*looked_at(view), ReconstructionConfig())
    assert method in guess.method
    free_space = looked_at(view)[1]
    assert empty_depth(free_space, guess.surfels.points).max() < 0.004


def test_guesses_in_empty_space_or_on_what_is_seen_are_dropped():
    seen, free_space, step = looked_at(BOX)
    towards = EYE - seen.points
    before = Surfels(seen.points + 0.1 * towards, seen.normals)
    assert len(plausible(before, seen, free_space, step).points) == 0
    assert len(plausible(seen, seen, free_space, step).points) == 0
    whole, normals = surface_samples(make_shape("box"), 5000, 0)
    whole = whole + np.array([0.0, 0.0, BOX_HALF[2]])
    hidden = (normals @ np.array([-1.0, 0.0, 0.0])) > 0.9
    assert len(plausible(Surfels(whole[hidden], normals[hidden]), seen, free_space, step).points) > 100


def half_cone(seed: int, noise: float) -> tuple[Surfels, np.ndarray]:
    """The half of a cup's wall, 30 mm wide below and 42 above, that one camera sees, and its axis."""
    rng = np.random.default_rng(seed)
    turn, height = rng.uniform(-1.3, 1.3, 3000), rng.uniform(0, 0.09, 3000)
    outward = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(3000)])
    up = np.array([0.0, 0.0, 1.0])
    points = (0.03 + 0.012 * height / 0.09)[:, None] * outward + height[:, None] * up
    points += noise * rng.standard_normal((3000, 1)) * np.array([1.0, 0.0, 0.0])
    normals = outward - 0.012 / 0.09 * up
    turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return Surfels(points @ turned.T, normals / np.linalg.norm(normals, axis=1)[:, None] @ turned.T), turned @ up


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("tilt", [0.04, 0.12])
def test_the_points_settle_a_tilted_axis(seed: int, tilt: float):
    surfels, true = half_cone(seed, 1e-3)
    side = np.cross(true, np.eye(3)[int(np.argmin(np.abs(true)))])
    start = fit_axis(surfels, (true + tilt * side / np.linalg.norm(side)) / np.hypot(1, tilt))
    settled = settle_axis(surfels, start, 1.5e-3)
    assert np.linalg.norm(np.cross(settled.direction, true)) < 0.01
    assert np.linalg.norm(settled.direction) == pytest.approx(1.0)


def test_the_half_plane_keeps_heights_and_distances():
    surfels, true = half_cone(3, 0.0)
    outward, rows = half_plane(surfels, fit_axis(surfels, true))
    assert np.allclose(np.linalg.norm(outward, axis=1), 1.0)
    assert np.allclose(outward @ true, 0.0, atol=1e-9)
    assert np.ptp(rows[:, 0]) == pytest.approx(0.09, abs=1e-3)
    assert 0.029 < rows[:, 1].min() < rows[:, 1].max() < 0.043


def test_half_a_ball_seen_from_any_side_has_its_back():
    """All its axes are as good; the one that shows the back is taken."""
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((6000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals = normals[normals[:, 2] > 0.15]
    found = some(find_revolution(Surfels(0.03 * normals, normals), FreeSpace((), standing=False), 1.2e-3))
    assert found.surfels.points[:, 2].min() < -0.025


TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


@pytest.fixture(scope="module")
def half_seen() -> Reconstruction:
    return reconstruct([BOX], support=TABLE)


def test_other_rules_give_other_closed_shapes_through_what_was_seen(half_seen):
    evidence = half_seen.evidence
    rules = other_rules(evidence)
    assert rules == ("mirror", "revolution")
    assert [other_rules(replace(evidence, chosen=rule)) for rule in rules] == [("revolution",), ("mirror",)]
    shapes = [mesh for rule in rules if (mesh := other_shape(evidence, rule, half_seen.mesh)) is not None]
    assert shapes
    for mesh in shapes:
        assert is_closed(mesh)
        surface = make_surface(mesh)
        seen = surface_distance(surface, BOX.points)
        assert (seen < ReconstructionConfig.fit_distance).mean() > 0.85
        assert surface_distance(surface, surface_samples(half_seen.mesh, 2000, 0)[0]).mean() > 2e-4


def test_an_equal_shape_is_no_other(half_seen):
    turned = some(other_shape(half_seen.evidence, "revolution", half_seen.mesh))
    assert other_shape(half_seen.evidence, "revolution", turned) is None
    mirrored = some(other_shape(half_seen.evidence, "mirror", turned))
    surface = make_surface(half_seen.mesh)
    apart = [surface_distance(surface, surface_samples(mesh, 2000, 0)[0]).mean() for mesh in (mirrored, turned)]
    # The box is its own mirror image, but no body of revolution.
    assert apart[0] < 0.5 * apart[1]


def test_nothing_else_may_be_true_of_what_was_seen_all_round():
    eyes = 0.5 * np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]]) + np.array([0.0, 0.0, 0.05])
    whole = reconstruct([front("box", BOX_HALF[2], eye) for eye in eyes], support=TABLE)
    assert not whole.evidence.hidden
    assert other_rules(whole.evidence) == ()


def test_the_next_view_looks_at_the_far_side_from_above_the_table(half_seen):
    assert half_seen.evidence.hidden
    pose = some(next_view(half_seen.evidence, half_seen.mesh, np.zeros(3)))
    eye, forward = pose[:3, 3], pose[:3, 2]
    centre = np.array([0.0, 0.0, BOX_HALF[2]])
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.norm(eye - centre) == pytest.approx(np.linalg.norm(EYE - centre), rel=0.05)
    assert forward @ (centre - eye) > 0.99 * np.linalg.norm(centre - eye)
    assert eye[2] > 0
    assert eye[:2] @ EYE[:2] < 0
    points, normals = surface_samples(make_shape("box"), 24_000, 0)
    points = points + centre
    sides = points[:, 2] > 1e-4  # not the one that it stands on
    hidden = sides & (((EYE - points) * normals).sum(1) <= 0)
    shown = hidden & (((eye - points) * normals).sum(1) > 0)
    assert shown.sum() > 0.95 * hidden.sum()


def test_the_next_view_goes_where_the_object_goes(half_seen):
    shift = np.array([1.0, -2.0, 3.0])
    assert half_seen.evidence.hidden
    here, there = (next_view(half_seen.evidence, half_seen.mesh, s) for s in (np.zeros(3), shift))
    assert some(there)[:3, 3] - some(here)[:3, 3] == pytest.approx(shift)
