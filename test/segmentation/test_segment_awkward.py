"""Scenes that are awkward: units, cameras far apart, gaps filled with zeros, steps, pictures that end too soon."""

import numpy as np
import pytest

from graspd_bench.rendering.depth_noise import NONE
from graspd_bench.rendering.tabletop import ring_poses, tabletop, views_of
from graspd_bench.stress.broken_clouds import beside_a_step, half_out_of_view, zero_filled
from graspd_core.config import ReconstructionConfig, SegmentationConfig
from graspd_core.errors import CloudError, NoObjectError
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.perception.cloud.point_cloud import PointCloud, measured
from graspd_core.perception.cloud.voxel_downsample import voxel_downsample
from graspd_core.perception.reconstruct.reconstruct import _clean
from graspd_core.perception.segment import support_plane as support
from graspd_core.perception.segment.clusters import merge_occluded
from graspd_core.perception.segment.planes import find_planes
from graspd_core.perception.segment.segment import segment
from graspd_core.perception.segment.target_selection import Target

CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)
STAGE = tabletop("box", yaw=0.3)
POSE = ring_poses(1, elevation=0.7, azimuth=0.5)


def view_of_box() -> PointCloud:
    return views_of(STAGE, CAMERA, POSE, NONE)[0]


def scaled(view: PointCloud, factor: float) -> PointCloud:
    return PointCloud(factor * view.points, factor * view.viewpoint, view.forward)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "millimetres, divide them by 1000"), (1e2, "centimetres.* by 100")])
def test_a_cloud_in_another_unit_is_refused_by_its_unit(factor: float, unit: str):
    with pytest.raises(CloudError, match=f"only 0 of .* if they are in {unit}"):
        segment([scaled(view_of_box(), factor)])


def test_a_scene_of_half_a_millimetre_is_asked_for_its_unit():
    with pytest.raises(CloudError, match=r"in one place, .* are they in metres"):
        segment([scaled(view_of_box(), 1e-3)])


def test_cameras_that_share_nothing_are_refused():
    view = view_of_box()
    away = np.array([1000.0, 0.0, 0.0])
    far = PointCloud(view.points + away, view.viewpoint + away, view.forward)
    with pytest.raises(CloudError, match=r"views 1 and 2 are 1e.03 m apart, .* max_range=2 m"):
        segment([view, far])


def test_what_a_driver_fills_gaps_with_is_no_point():
    eye = np.array([0.3, 0.0, 0.4])
    points = np.array([[0.0, 0, 0], eye, [np.nan, 0, 0], [0.0, 0, 0.1]])
    assert measured(points, eye).tolist() == [False, False, False, True]
    for value in (np.zeros(3), eye):
        with pytest.raises(CloudError, match="zero or at the camera, as a driver fills in"):
            segment([PointCloud(np.tile(value, (500, 1)), eye)])


def test_gaps_filled_with_the_cameras_place_change_nothing():
    (view,) = zero_filled("box")
    kept = view.points[(view.points != view.viewpoint).any(1)]
    (filled,), (bare,) = segment([view]).views, segment([PointCloud(kept, view.viewpoint, view.forward)]).views
    assert np.array_equal(filled.points, bare.points)


def test_an_object_alone_among_zeros_is_cleaned_as_without_them():
    view = view_of_box()
    mine = PointCloud(view.points[view.points[:, 2] > 0.005], view.viewpoint)
    filled = PointCloud(np.vstack([mine.points, np.zeros((len(mine.points), 3))]), view.viewpoint)
    (bare,), (among,) = (_clean([view], ReconstructionConfig()) for view in (mine, filled))
    assert np.array_equal(among.points, bare.points)


def test_the_lower_level_of_a_stepped_table_is_what_the_object_stands_on():
    found = segment(beside_a_step("box"))
    assert found.support is not None
    assert found.support.offset == pytest.approx(0.0, abs=0.002)
    assert found.views[0].points[:, 2].min() < 0.01


def test_an_object_at_the_border_of_the_picture_is_told():
    assert any("reaches the border of what view 1 shows" in w for w in segment(half_out_of_view("box")).warnings)
    assert segment([view_of_box()]).warnings == ()


def test_a_view_that_shows_nothing_is_told():
    blind = PointCloud(np.full((50, 3), np.nan), np.array([0.5, 0.0, 0.5]))
    assert any("of 2 views these show nothing near enough: 2" in w for w in segment([view_of_box(), blind]).warnings)


def test_what_is_too_large_is_said_to_be_so_and_a_box_says_which_part_is_meant():
    small = SegmentationConfig(largest_object=0.03)
    with pytest.raises(NoObjectError, match=r"one thing is seen, .*, 0\.1\d m long: larger than .*=0.03 m; a box"):
        segment([view_of_box()], settings=small)
    meant = Target(box=(np.array([-0.03, -0.03, 0.0]), np.array([0.03, 0.03, 0.2])))
    assert np.abs(segment([view_of_box()], target=meant, settings=small).views[0].points[:, :2]).max() < 0.04


def test_pieces_are_joined_no_further_than_the_largest_object():
    """Each pair is short enough, all three are not."""
    step = np.arange(0.0, 0.1, 0.002)
    bars = [np.column_stack([start + step, 0 * step, 0 * step]) for start in (0.0, 0.104, 0.208)]
    points, label = np.vstack(bars), np.repeat([0, 1, 2], len(step))
    eyes, distance = np.array([[0.15, 0.0, 0.6]]), np.full(len(points), 0.6)
    for largest, last in ((0.4, 0), (0.25, 1)):
        settings = SegmentationConfig(largest_object=largest)
        joined = merge_occluded(points, distance, label, eyes, link=0.006, settings=settings, support=None)
        assert joined.max() == last


def test_where_noise_makes_the_look_around_wide_some_points_stand_for_all(monkeypatch: pytest.MonkeyPatch):
    """A noisy table and a board that rises through it, seen from 1.6 m: the tolerance is six voxels."""
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.3, 0.3, (40_000, 2)), np.zeros(40_000)])
    board = np.column_stack([rng.uniform(-0.1, 0.1, 8000), np.full(8000, 0.345), rng.uniform(-0.1, 0.1, 8000)])
    points, eye = np.concatenate([table, board]), np.array([0.0, 0.0, 1.6])
    rays = points - eye
    points += rays * rng.normal(0, 0.003, (len(points), 1)) / np.linalg.norm(rays, axis=1)[:, None]
    scene = voxel_downsample([PointCloud(points, eye)], SegmentationConfig())
    part = find_planes(scene.mean, scene.mean_distance, eye[None], SegmentationConfig())[0]
    some = support._covered(scene, part, 0.05)
    monkeypatch.setattr(support, "NEIGHBOUR_SAMPLES", 1e9)
    every = support._covered(scene, part, 0.05)
    assert part.tolerance(scene.mean_distance).max() > 0.012
    assert (some == every).mean() > 0.99
    assert some[part.inliers].mean() == pytest.approx(every[part.inliers].mean(), abs=0.002)
    rises = np.abs(scene.mean[:, 1] - 0.345) < 0.003
    assert some[rises].mean() < 0.2
