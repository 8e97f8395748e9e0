"""Sharp points, and walls thinner than a cell: what the grid makes of them, and what the points make good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_bench.stress.broken_meshes import thin_cup
from graspd_bench.stress.run_stress_case import GRASP, faults, run_case
from graspd_bench.stress.stress_cases import CASES
from graspd_core.hands.library import load_hand
from graspd_core.mesh.mesh_files import save_mesh, surface_samples
from graspd_core.mesh.sdf import build_sdf, sample_sdf
from graspd_core.mesh.shapes import BOX_HALF, make_shape
from graspd_core.mesh.sharp_features import farthest_points, neighbours_together, sharp_points
from graspd_core.perception.load_scene import load_scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import TriangleMesh

RADIUS, HEIGHT = 0.033, 0.08


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
    save_mesh(cup, tmp_path / "cup.obj")
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
    assert np.array_equal(sharp_points(box, 20, seed=1)[0], sharp_points(box, 20, seed=1)[0])


@pytest.mark.parametrize(("name", "thin"), [("mug", True), ("bowl", True), ("box", False), ("sphere", False)])
def test_only_walls_are_thin(name: str, thin: bool):
    assert (sharp_points(make_shape(name), 8)[1] > 0.6) == thin


def test_farthest_points_of_a_line():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [10, 0, 0]])
    assert farthest_points(line, 3).tolist() == [0, 4, 3]
    assert sorted(farthest_points(line, 99)) == [0, 1, 2, 3, 4]
    assert len(farthest_points(np.zeros((0, 3)), 3)) == 0
