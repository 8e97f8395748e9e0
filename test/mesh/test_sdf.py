"""The grid against exact distances and differences; sharp points, and walls thinner than a cell."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from expected import some
from hypothesis import given, settings
from hypothesis import strategies as st
from made_meshes import box_of

from graspd_bench.stress.broken_meshes import thin_cup
from graspd_bench.stress.run_stress_case import GRASP, faults, run_case
from graspd_bench.stress.stress_cases import CASES
from graspd_core import TriangleMesh, load_hand, load_scene, plan_grasps
from graspd_core.hands.link_distance import primitive_sdf
from graspd_core.hands.model import Primitive, PrimitiveKind
from graspd_core.mesh.mesh_files import check_mesh, save_mesh, surface_samples
from graspd_core.mesh.sdf import BAND, PADDING, GridSDF, build_sdf, grid_layout, is_solid, sample_sdf
from graspd_core.mesh.shapes import (
    BOX_HALF,
    CAPSULE_HALF,
    CAPSULE_RADIUS,
    CYLINDER_HALF,
    CYLINDER_RADIUS,
    PLATE_HALF,
    SHAPES,
    SPHERE_RADIUS,
    make_shape,
)
from graspd_core.mesh.sharp_features import farthest_points, neighbours_together, sharp_points
from graspd_core.mesh.surface_queries import closest_points, make_surface, winding_inside
from graspd_core.se3 import random_rotations


def exact(kind: PrimitiveKind, *size: float):
    return partial(primitive_sdf, Primitive(0, kind, np.eye(3), np.zeros(3), size))


EXACT = {
    "sphere": exact("sphere", SPHERE_RADIUS),
    "box": exact("box", *BOX_HALF),
    "plate": exact("box", *PLATE_HALF),
    "cylinder": exact("cylinder", CYLINDER_RADIUS, CYLINDER_HALF),
    "capsule": exact("capsule", CAPSULE_RADIUS, CAPSULE_HALF),
}


def phi(sdf: GridSDF, points) -> np.ndarray:
    return sample_sdf(sdf, torch.as_tensor(points, dtype=sdf.field.dtype))[0].numpy()


@pytest.fixture(scope="module")
def box() -> GridSDF:
    return build_sdf(make_shape("box"), resolution=32, dtype=torch.float64)


@pytest.mark.parametrize("name", EXACT)
@settings(max_examples=6)
@given(seed=st.integers(0, 10_000))
def test_grid_is_the_exact_distance_to_a_fraction_of_a_cell(name, seed):
    generator = torch.Generator().manual_seed(seed)
    rotation = random_rotations(1, generator, torch.float64)[0]
    shift = torch.randn(3, generator=generator, dtype=torch.float64)
    mesh = make_shape(name)
    posed = TriangleMesh(mesh.vertices @ rotation.numpy().T + shift.numpy(), mesh.faces)
    sdf = build_sdf(posed, resolution=32, dtype=torch.float64)
    points = 0.2 * (torch.rand(2000, 3, generator=generator, dtype=torch.float64) - 0.5)
    inner = points[((points @ rotation.T + shift - sdf.origin - sdf.half).abs() < sdf.half).all(-1)]
    found, normal = sample_sdf(sdf, inner @ rotation.T + shift)
    exact = EXACT[name](inner)
    # At a kink of the distance (crease, axis) all nodes may err by their way to it: half a cell's diagonal.
    assert (found - exact).abs().max() < 0.87 * sdf.spacing
    assert (found - exact).abs().mean() < 0.06 * sdf.spacing
    assert torch.allclose(normal.norm(dim=-1), torch.ones_like(exact), atol=1e-6)


def open_mug() -> TriangleMesh:
    mug = make_shape("mug")
    bottom = mug.vertices[mug.faces][:, :, 2].max(1) < mug.vertices[:, 2].min() + 1e-6
    return TriangleMesh(mug.vertices, mug.faces[~bottom])


@pytest.mark.parametrize("resolution", [9, 30])
@pytest.mark.parametrize("name", [*SHAPES, "open mug"])
def test_nodes_are_exact_near_the_surface_and_off_by_half_a_cell_at_most(name, resolution):
    mesh = open_mug() if name == "open mug" else make_shape(name)
    sdf = build_sdf(mesh, resolution=resolution, dtype=torch.float64)
    counts, cell = sdf.field.shape[1:], float(sdf.spacing)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1).reshape(-1, 3)
    nodes = sdf.origin.numpy() + cell * index
    closest, _ = closest_points(make_surface(mesh), nodes)
    exact = np.linalg.norm(nodes - closest, axis=1)
    found = sdf.field[0].numpy().ravel()
    assert ((found < 0) == (winding_inside(mesh, nodes) & (exact > 0))).all()
    # Both count in float64, but about different origins.
    error = np.abs(found) - exact
    assert np.abs(error[exact <= BAND * cell]).max() < 1e-12
    assert error.min() > -1e-12
    assert error.max() < 0.5 * cell
    assert error.mean() < 0.03 * cell


@pytest.mark.parametrize("name", EXACT)
def test_normals_near_the_surface_point_outwards(name):
    sdf = build_sdf(make_shape(name), dtype=torch.float64)
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).sub(0.5).mul(0.16)
    points = points[EXACT[name](points).abs() < 0.01].requires_grad_()
    (exact,) = torch.autograd.grad(EXACT[name](points).sum(), points)
    _, normal = sample_sdf(sdf, points)
    # Median within 3 degrees: at creases the direction jumps, and there only the side counts.
    cosine = (normal * exact).sum(-1)
    assert cosine.median() > 0.9985
    assert (cosine > 0).double().mean() > 0.98


@given(seed=st.integers(0, 10_000), reach=st.sampled_from([0.05, 0.4]))
def test_derivative_is_the_finite_difference(box, seed, reach):
    generator = torch.Generator().manual_seed(seed)
    points = (2 * torch.rand(16, 3, generator=generator, dtype=torch.float64) - 1) * reach
    # Keep 1 % of a cell clear of cell walls, where the interpolant's slope jumps.
    cell = (points - box.origin) / box.spacing
    points = box.origin + box.spacing * (cell.floor() + (cell - cell.floor()).clamp(0.01, 0.99))
    weights = torch.randn(16, 4, generator=generator, dtype=torch.float64)

    def value(p):
        distance, normal = sample_sdf(box, p)
        return (weights[:, 0] * distance + (weights[:, 1:] * normal).sum(-1) * 0.01).reshape(-1)

    points.requires_grad_()
    (gradient,) = torch.autograd.grad(value(points).sum(), points)
    step = 1e-7
    shifts = step * torch.eye(3, dtype=torch.float64)
    numeric = torch.stack([(value(points.detach() + d) - value(points.detach() - d)) / (2 * step) for d in shifts], -1)
    # Where the interpolated directions cancel, on the box's middle planes, the normal turns within a rounding error.
    assert torch.isfinite(gradient).all()
    close = torch.isclose(gradient, numeric, rtol=1e-4, atol=1e-4).all(-1)
    assert close.double().mean() > 0.9


@given(seed=st.integers(0, 10_000))
def test_continuous_across_the_border(box, seed):
    generator = torch.Generator().manual_seed(seed)
    size = 2 * box.half
    points = box.origin + size * torch.rand(64, 3, generator=generator, dtype=torch.float64)
    face = torch.randint(3, (64,), generator=generator)
    points[torch.arange(64), face] = (box.origin + size)[face]
    outwards = torch.nn.functional.one_hot(face, 3).double() * 1e-9
    inside, outside = sample_sdf(box, points - outwards), sample_sdf(box, points + outwards)
    assert torch.allclose(inside[0], outside[0], atol=1e-7)
    assert torch.allclose(inside[1], outside[1], atol=1e-5)


@pytest.mark.parametrize("name", EXACT)
def test_far_outside_the_error_is_a_few_percent(name):
    sdf = build_sdf(make_shape(name), dtype=torch.float64)
    points = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = points / points.norm(dim=-1, keepdim=True) * 0.3
    found, _ = sample_sdf(sdf, points)
    error = (found - EXACT[name](points)).abs() / EXACT[name](points)
    # One surface point stands for the closest one; worst is a ball seen along the grid's diagonal.
    assert error.max() < 0.04


def test_precisions_agree_and_nothing_is_nan_at_nodes_centre_and_border(box):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).sub(0.5).mul(0.3)
    single = sample_sdf(box.to("cpu", torch.float32), points.float())
    double = sample_sdf(box, points)
    assert torch.allclose(single[0].double(), double[0], atol=1e-6)
    nodes = torch.stack([box.origin, box.origin + 2 * box.half, torch.zeros(3).double()]).requires_grad_()
    distance, normal = sample_sdf(box, nodes)
    (distance.sum() + normal.sum()).backward()
    assert torch.isfinite(some(nodes.grad)).all()


@pytest.mark.parametrize("change", ["invert", "double", "mix"])
def test_damaged_surfaces_have_the_same_inside(change):
    sphere = make_shape("sphere")
    flipped = sphere.faces[:, ::-1]
    odd = (np.arange(len(sphere.faces)) % 3 == 0)[:, None]
    faces = {
        "invert": flipped,
        "double": np.vstack([sphere.faces, sphere.faces]),
        "mix": np.where(odd, flipped, sphere.faces),
    }[change]
    damaged = TriangleMesh(sphere.vertices, np.ascontiguousarray(faces))
    if change == "mix":
        damaged, _ = check_mesh(damaged, "sphere")
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)).sub(0.5).mul(0.12)
    good = sample_sdf(build_sdf(sphere, resolution=24), points)
    bad = sample_sdf(build_sdf(damaged, resolution=24), points)
    assert torch.allclose(good[0], bad[0], atol=1e-5)
    # One direction in 13824 may lie on the surface, and an inverted face's normal must not leak through it.
    assert torch.allclose(good[1], bad[1], atol=1e-3)


def test_a_sheet_has_no_inside():
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
    sheet = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    sdf = build_sdf(sheet, resolution=16)
    assert not is_solid(sdf)
    assert phi(sdf, [(0.05, 0.05, 0.02)])[0] == pytest.approx(0.02, abs=0.002)
    assert is_solid(build_sdf(make_shape("sphere"), resolution=16))


@given(sides=st.tuples(*[st.floats(0.001, 2.0)] * 3), resolution=st.integers(8, 96))
def test_cells_are_the_finest_that_cover_any_box(sides, resolution):
    corners = np.array([(0, 0, 0), sides]) + 5.0
    mesh = TriangleMesh(np.vstack([corners, corners[:1]]), np.array([[0, 1, 2]]))
    counts, origin, spacing = grid_layout(mesh, resolution)
    padding = min(PADDING, max(sides) / 2)
    reach = (np.array(counts) - 1) * spacing
    assert np.prod(counts) <= resolution**3
    assert (origin <= corners[0] - padding + 1e-6).all()
    assert (origin + reach >= corners[1] + padding - 1e-6).all()
    assert origin + reach / 2 == pytest.approx(corners.mean(0))
    finer = np.ceil((np.array(sides) + 2 * padding) / (spacing * (1 - 1e-6))) + 1
    assert finer.prod() > resolution**3


def test_a_rod_is_seen_by_a_grid_of_as_many_nodes():
    sdf = build_sdf(box_of((0.012, 0.012, 0.6)))
    # Cells of a cube about it would be 26 mm wide.
    assert float(sdf.spacing) < 0.005
    assert is_solid(sdf)
    # Halfway along, at its end, and beside it as far as the grid does not reach.
    assert phi(sdf, [(0.012, 0, 0.1), (0, 0, 0.6)]) == pytest.approx(0.0, abs=0.002)
    assert phi(sdf, [(0.1, 0.0, 0.3)]) == pytest.approx(0.088, abs=0.001)


@pytest.mark.parametrize("wall", [5e-4, 9e-4, 1.5e-3])
def test_a_wall_thinner_than_a_cell_is_blurred_within_and_right_beside(wall):
    cup = thin_cup(wall)
    sdf = build_sdf(cup)
    cell = float(sdf.spacing)
    points, normals = surface_samples(cup, 3000, 0)
    beside, direction = sample_sdf(sdf, torch.as_tensor(points + 0.002 * normals).float())
    within, _ = sample_sdf(sdf, torch.as_tensor(points).float())
    # Beside the wall a finger is told its distance and the way out, though near edges both are rounded off.
    assert beside.mean().item() == pytest.approx(0.002, abs=5e-5)
    assert ((direction * torch.as_tensor(normals).float()).sum(-1) > 0.5).float().mean() > 0.97
    # On it the distance is too large, never by half a cell: grasps sink in by less than that.
    assert 0 < within.mean().item() < 0.3 * cell
    assert within.max().item() < 0.5 * cell


@pytest.mark.parametrize("wall", [5e-4, 3e-3])
def test_points_all_over_a_thin_wall_feel_what_the_grid_misses(wall):
    cup = thin_cup(wall)
    assert sharp_points(cup, 128)[1] > 0.95
    points, _ = sharp_points(cup, 256)
    # Of 0.04 m², both sides of the wall together.
    assert 750 < len(points) < 800
    gaps = np.linalg.norm(surface_samples(cup, 500, 1)[0][:, None] - points, axis=-1).min(1)
    assert gaps.max() < 0.007


def large_cup() -> TriangleMesh:
    """A cup of 11 cm across and 28 cm high, with walls of 2.4 mm."""
    cup = thin_cup(1.4e-3)
    return TriangleMesh(cup.vertices * np.array([1.7, 1.7, 3.5]), cup.faces)


def test_a_large_thin_wall_has_more_points_and_they_are_as_dense():
    cup = large_cup()
    points, _ = sharp_points(cup, 256)
    # Of 0.21 m², both sides of the wall together.
    assert 4000 < len(points) <= 4096
    gaps = np.linalg.norm(surface_samples(cup, 500, 1)[0][:, None] - points, axis=-1).min(1)
    assert gaps.max() < 0.007
    # Never without bound: a sheet of two metres does not slow every step down.
    wide = TriangleMesh(20 * cup.vertices * np.array([1.0, 1.0, 1e-3]), cup.faces)
    assert len(sharp_points(wide, 16)[0]) == 16 * 16


@pytest.mark.parametrize("count", [1, 5, 16, 33, 700])
def test_neighbours_come_together_sixteen_by_sixteen(count):
    points = surface_samples(large_cup(), count, 0)[0]
    order = neighbours_together(points)
    assert sorted(order) == list(range(count))
    if count == 700:
        # Not wider than a square of their share of 0.21 m²; sixteen at random are four times as wide.
        blocks = [points[order[first : first + 16]] for first in range(0, count - 15, 16)]
        assert np.median([np.ptp(block, axis=0).max() for block in blocks]) < np.sqrt(0.21 * 16 / count)


def test_the_first_points_do_not_depend_on_how_many_follow():
    few, many = (sharp_points(large_cup(), count)[0] for count in (8, 512))
    assert np.array_equal(few, many[: len(few)])


def test_no_finger_goes_through_a_large_thin_wall(tmp_path):
    cup = large_cup()
    save_mesh(tmp_path / "cup.obj", cup)
    scene, hand = load_scene(tmp_path / "cup.obj"), load_hand("allegro_right")
    shared = [
        grasp.metrics["intersection_volume"]
        for grasp in plan_grasps(scene, hand, count=8, preset="fast", verify="none").grasps
        if grasp.metrics
    ]
    # A finger that is through the wall shares 2 cm³ with it, a palm 10; with 256 points the median was 8 cm³.
    assert len(shared) == 8
    assert np.median(np.array(shared, dtype=float)) < 3e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["thin-wall-cup", "long-rod", "debris"])
def test_what_a_coarse_grid_or_small_components_once_hid_is_grasped(name):
    ending = replace(run_case(CASES[name], "fast"), loading=0.0, planning=0.0, memory=0.0)
    assert ending.ending == GRASP
    assert faults(CASES[name], ending) == ()


def test_a_sphere_has_no_sharp_points():
    # 3 mm below a sphere of 35 mm the surface is 3 mm away; its facets change that by hundredths of a millimetre.
    assert sharp_points(make_shape("sphere"), 50)[0].shape == (0, 3)


@pytest.mark.parametrize("count", [8, 60])
def test_the_sharp_points_of_a_box_lie_on_its_edges(count: int):
    points, _ = sharp_points(make_shape("box"), count)
    assert len(points) == count
    inside = np.sort(np.array(BOX_HALF) - np.abs(points), axis=1)
    # On the surface to float32 rounding; the second nearest face is within the 3 mm that the probe looks down.
    assert np.abs(inside[:, 0]) == pytest.approx(0.0, abs=1e-6)
    assert (np.abs(inside[:, 1]) < 0.003).all()


def test_the_sharp_points_of_a_box_cover_all_its_edges():
    points, _ = sharp_points(make_shape("box"), 60)
    for axis in range(3):
        a, b = np.delete(np.arange(3), axis)
        for sign in [(-1, -1), (-1, 1), (1, -1), (1, 1)]:
            edge = np.array([sign[0] * BOX_HALF[a], sign[1] * BOX_HALF[b]])
            near = np.linalg.norm(points[:, [a, b]] - edge, axis=1) < 0.005
            assert near.sum() >= 2
    box = make_shape("box")
    assert np.array_equal(sharp_points(box, 20)[0], sharp_points(box, 20)[0])


@pytest.mark.parametrize(("name", "thin"), [("mug", True), ("bowl", True), ("box", False), ("sphere", False)])
def test_only_walls_are_thin(name: str, thin: bool):
    assert (sharp_points(make_shape(name), 8)[1] > 0.6) == thin


def test_farthest_points_of_a_line():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [10, 0, 0]])
    assert farthest_points(line, 3).tolist() == [0, 4, 3]
    assert sorted(farthest_points(line, 99)) == [0, 1, 2, 3, 4]
    assert len(farthest_points(np.zeros((0, 3)), 3)) == 0
