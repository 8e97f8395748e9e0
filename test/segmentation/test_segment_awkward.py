"""Scenes that are awkward: units, cameras far apart, gaps filled with zeros, steps, pictures that end too soon."""

import numpy as np
import pytest
from expected import some

from graspd_bench.rendering.depth_noise import LEVELS, NONE, DepthNoise
from graspd_bench.rendering.tabletop import CAMERA as D415
from graspd_bench.rendering.tabletop import TabletopScene, ring_poses, tabletop, views_of
from graspd_bench.stress.broken_clouds import beside_a_step, half_out_of_view, zero_filled
from graspd_core import PinholeCamera, Target, TriangleMesh, make_shape, scene_from_views
from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError, NoObjectError
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.perception.cloud.point_cloud import PointCloud, measured
from graspd_core.perception.reconstruct.reconstruct import reconstruct
from graspd_core.perception.segment.clusters import merge_occluded
from graspd_core.perception.segment.segment import Segmentation, segment

CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)
STAGE = tabletop("box", yaw=0.3)
POSE = ring_poses(1, elevation=0.7, azimuth=0.5)


def view_of_box() -> PointCloud:
    return views_of(STAGE, CAMERA, POSE, NONE)[0]


def test_a_scene_of_half_a_millimetre_is_asked_for_its_unit():
    view = view_of_box()
    with pytest.raises(CloudError, match=r"in one place, .* are they in metres"):
        segment([PointCloud(1e-3 * view.points, 1e-3 * view.viewpoint, view.forward)])


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
        with pytest.raises(CloudError, match="zero or at the camera, as drivers mark missing depth"):
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
    bare, among = (reconstruct([view]).mesh for view in (mine, filled))
    assert np.array_equal(among.vertices, bare.vertices)


def test_the_lower_level_of_a_stepped_table_is_what_the_object_stands_on():
    found = segment(beside_a_step("box"))
    assert some(found.support).offset == pytest.approx(0.0, abs=0.002)
    assert found.views[0].points[:, 2].min() < 0.01


def test_an_object_at_the_border_of_the_picture_is_doubted():
    scene = scene_from_views(half_out_of_view("box"))
    told = "the object reaches the border of the image, and may extend beyond it"
    assert some(scene.evidence).doubts == (told,)
    assert f"cloud: {told}; no grasp counts as verified" in scene.object.warnings
    # The second view shows the whole outline.
    assert segment([*half_out_of_view("box"), view_of_box()]).cut == ""
    found = segment([view_of_box()])
    assert (found.cut, found.warnings) == ("", ())


def test_a_view_that_shows_nothing_is_told():
    blind = PointCloud(np.full((50, 3), np.nan), np.array([0.5, 0.0, 0.5]))
    assert any("of 2 views these show nothing within range: 2" in w for w in segment([view_of_box(), blind]).warnings)


def test_what_is_too_large_is_said_to_be_so_and_a_box_says_which_part_is_meant():
    small = SegmentationConfig(largest_object=0.03)
    with pytest.raises(
        NoObjectError,
        match=r"one object is seen, .* longer than .*=0.03 m \(the shortest 0\.1\d m\); give the wanted part as a box",
    ):
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


def seen(scene: TabletopScene, elevation: float, turn: float = 0.0, noise: DepthNoise = NONE) -> PointCloud:
    (view,) = views_of(scene, D415, ring_poses(1, elevation=elevation, azimuth=turn), noise)
    return view


def share_of_truth(found: Segmentation, scene: TabletopScene) -> float:
    """Share of what was found that is on the object, noise considered."""
    return float(np.mean(surface_distance(make_surface(scene.truth), found.views[0].points) < 0.009))


def test_a_cup_is_one_thing_though_its_near_wall_hides_how_it_goes_on():
    scene = tabletop("mug")
    surface = make_surface(scene.truth)
    for elevation in (0.3, 0.6, 0.9, 1.2, 1.5):
        view = seen(scene, elevation)
        clear = view.points[(view.points[:, 2] > 0.005) & (surface_distance(surface, view.points) < 1e-3)]
        found = segment([view])
        assert len(found.views[0].points) > 0.98 * len(clear), elevation
        assert not found.obstacles


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.0, 3.0])
def test_a_bowl_that_overhangs_its_foot_does_not_join_what_is_beside_it(turn):
    scene = tabletop("bowl", obstacles=[("box", 0.115, 0.0)])
    found = segment([seen(scene, 0.9, turn, LEVELS["default"])], target=Target(point=np.array([0.0, 0.0, 0.01])))
    assert share_of_truth(found, scene) > 0.99
    assert len(found.obstacles) == 1


@pytest.mark.parametrize(
    ("front", "behind", "apart", "elevation"),
    [("bowl", "cylinder", 0.12, 0.4), ("bowl", "mug", 0.13, 0.3), ("box", "cylinder", 0.09, 0.26)],
)
def test_a_thing_whose_foot_another_hides_is_a_thing_of_its_own(front, behind, apart, elevation):
    scene = tabletop(front, obstacles=[(behind, -apart, 0.0)])
    view = seen(scene, elevation, noise=LEVELS["default"])
    found = segment([view], target=Target(point=np.array([0.03, 0.0, 0.04])))
    assert share_of_truth(found, scene) > 0.99
    assert found.obstacles


@pytest.mark.parametrize("elevation", [0.4, 0.9])
def test_a_point_inside_a_large_thing_means_that_thing(elevation):
    """Pose estimators give the middle, which is farther from what is seen than a point on the surface ever is."""
    pitcher = make_shape("cylinder")
    pitcher = TriangleMesh(pitcher.vertices * [2.2, 2.2, 2.0], pitcher.faces)
    stage = tabletop(pitcher, obstacles=[("sphere", 0.13, 0.05)])
    low, high = stage.truth.vertices.min(0), stage.truth.vertices.max(0)
    seen = segment(
        views_of(stage, CAMERA, ring_poses(1, elevation=elevation, distance=0.7)),
        target=Target(point=0.5 * (low + high)),
    )
    points = seen.views[0].points
    assert ((points > low - 0.01) & (points < high + 0.01)).all()
    assert np.ptp(points, axis=0).max() > 0.1
