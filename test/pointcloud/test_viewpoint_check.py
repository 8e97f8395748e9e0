"""Whether clouds tell that their camera stood elsewhere, and whether an object reaches the border of a picture."""

import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from expected import some

from graspd_bench.rendering.depth_noise import DEFAULT, LOW, DepthNoise
from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core import PointCloud, Target, load_scene, make_shape, scene_from_views
from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError
from graspd_core.mesh.mesh_files import mass_properties, surface_samples
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays, cloud_from_depth, reaches_image_border
from graspd_core.perception.cloud.viewpoint_check import check_scene, check_viewpoint, fits_nowhere, seen_from
from graspd_core.perception.reconstruct.merge_views import is_all_round

CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)

# Where robots have their base: on the table, above it, on the floor; and right under the object.
BASES = {
    "on the table": (-0.5, 0.0, 0.0),
    "a centimetre over it": (-0.5, 0.1, 0.01),
    "above": (-0.5, 0.1, 0.4),
    "floor": (-0.5, 0.2, -0.7),
    "under": (0, 0, -0.5),
}


def seen(
    shape: str, elevation: float, yaw: float = 0.4, noise: DepthNoise = DEFAULT
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, finite points and the camera's place of a view of a shape on a table, in the world frame."""
    scene = tabletop(shape, yaw=yaw, obstacles=[("box", 0.15, 0.05)])
    T = ring_poses(1, elevation=elevation, azimuth=0.3)[0]
    depth = depth_views(scene, CAMERA, [T], noise, seed=3)[0][0]
    rays = camera_rays(CAMERA) * np.where(depth > 0, depth, np.nan)[..., None]
    grid = rays @ T[:3, :3].T + T[:3, 3]
    flat = grid.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(1)]
    # Thinned clouds come sorted by place.
    return grid, flat[np.unique(np.floor(flat / 0.004), axis=0, return_index=True)[1]], T[:3, 3]


def is_refused(thing: PointCloud, cloud: PointCloud) -> bool:
    try:
        check_scene([cloud])
        check_viewpoint(thing, cloud)
    except CloudError as error:
        return re.search("hidden from there|table's plane|the inside of the surface", str(error)) is not None
    return False


@pytest.mark.parametrize(("shape", "elevation"), [("mug", 0.35), ("mug", 0.8), ("mug", 1.2), ("box", 0.8)])
def test_the_true_place_is_taken_and_the_places_of_robots_are_refused(shape, elevation):
    grid, points, place = seen(shape, elevation)
    assert seen_from(grid, place).posed
    cloud = PointCloud(points, place)
    check_scene([cloud])
    thing = points[(np.abs(points[:, :2]) < 0.08).all(1) & (points[:, 2] > 0.008)]
    assert check_viewpoint(PointCloud(thing, place), cloud, np.array([0.0, 0.0, 1.0])) == ""
    for base in BASES.values():
        with pytest.raises(CloudError, match="its pixels show the camera at") as refused:
            seen_from(grid, np.array(base))
        told = str(refused.value).split("show the camera at (")[1].split(")")[0]
        # The fit is to a pixel or so; the frame of the figure is the cloud's.
        np.testing.assert_allclose([float(x) for x in told.split(",")], place, atol=0.005)
        assert is_refused(PointCloud(thing, np.array(base)), replace(cloud, viewpoint=np.array(base)))


@pytest.mark.parametrize(("yaw", "elevation"), [(0.4, 0.5), (0.4, 1.1), (1.4, 1.1), (2.4, 0.8)])
def test_inside_and_outside_of_a_thin_wall_are_two_surfaces(yaw: float, elevation: float):
    grid, _, place = seen("mug", elevation, yaw, LOW)
    points = grid.reshape(-1, 3)[np.isfinite(grid).all(-1).ravel()]
    thing = points[(np.abs(points[:, :2]) < 0.1).all(1) & (points[:, 2] > 0.008)]
    assert check_viewpoint(PointCloud(thing, place), PointCloud(points, place), np.array([0.0, 0.0, 1.0])) == ""


def test_another_cloud_from_the_same_place_does_not_hide_that_the_camera_was_elsewhere():
    _, points, _ = seen("box", 0.8)
    rest = points[np.linalg.norm(points[:, :2], axis=1) > 0.2]
    views = [PointCloud(part, np.array(BASES["above"])) for part in (points, rest)]
    for given in (views, views[::-1]):
        with pytest.raises(CloudError, match="around the object are hidden from there"):
            scene_from_views(given, target=Target(point=np.array([0.0, 0.0, 0.05])))


def test_an_object_alone_from_all_round_needs_no_camera():
    ball = surface_samples(make_shape("sphere"), 3000, seed=0)[0] + [0.0, 0.0, 0.5]
    cloud = PointCloud(ball, np.zeros(3))
    assert fits_nowhere(cloud)
    evidence = some(scene_from_views([cloud], alone=True).evidence)
    assert evidence.doubts == ()
    with pytest.raises(CloudError, match=r"did not stand at the origin of its frame: .*sensor_frame or view_point"):
        check_viewpoint(cloud, cloud)


@pytest.mark.parametrize("shape", ["box", "bowl", "mug", "bottle"])
@pytest.mark.parametrize(
    ("place", "alone"), [((0.0, 0.0, 0.0), True), ((0.0, 0.0, 0.0), False), ((0.3, 0.2, 0.5), True)]
)
def test_a_whole_object_is_taken_with_its_walls_and_without_a_doubt(shape: str, place, alone: bool):
    mesh = make_shape(shape)
    points = surface_samples(mesh, 3000, seed=0)[0] + place
    whole = scene_from_views([PointCloud(points, np.zeros(3))], alone=alone)
    assert some(whole.evidence).doubts == ()
    # The mug's walls are 4 mm thick, as far as its points are apart.
    assert mass_properties(whole.object.mesh)[0] == pytest.approx(mass_properties(mesh)[0], rel=0.1)


def test_a_ball_whose_camera_is_exactly_its_middle_is_taken():
    half = np.random.default_rng(0).normal(size=(1500, 3))
    half *= 0.04 / np.linalg.norm(half, axis=1, keepdims=True)
    evidence = some(scene_from_views([PointCloud(np.concatenate([half, -half]), np.zeros(3))]).evidence)
    assert evidence.doubts == ()


def test_one_side_of_an_object_about_its_own_middle_is_refused_by_that_reason():
    """As a view of which the mean was subtracted."""
    _, points, place = seen("mug", 0.8)
    thing = points[(np.abs(points[:, :2]) < 0.08).all(1) & (points[:, 2] > 0.008)]
    assert is_all_round(PointCloud(surface_samples(make_shape("mug"), 3000, seed=0)[0], place))
    assert not is_all_round(PointCloud(thing, place))
    assert not is_all_round(PointCloud(points, place))
    with pytest.raises(CloudError, match="did not stand at the origin of its frame: this place lies within the object"):
        scene_from_views([PointCloud(thing - thing.mean(0), np.zeros(3))], alone=True)


@pytest.mark.parametrize(("factor", "doubt"), [(4.0, "coordinates in metres"), (0.1, "nearer than depth"), (10.0, "")])
def test_a_scene_in_another_unit_is_refused_or_doubted(factor, doubt):
    """Depth of 0.25 mm a unit that is read as millimetres, and its like."""
    scene = tabletop("mug", yaw=0.4, obstacles=[("box", 0.15, 0.05)])
    T = ring_poses(1, elevation=0.6, azimuth=0.3)[0]
    depth = depth_views(scene, CAMERA, [T], DEFAULT, seed=3)[0][0]
    with nullcontext() if doubt else pytest.raises(CloudError, match="are the coordinates in metres"):
        seen = scene_from_views([cloud_from_depth(factor * depth, CAMERA)])
        assert doubt in " ".join(some(seen.evidence).doubts)
        assert any(doubt in told and "no grasp counts as verified" in told for told in seen.object.warnings)


def test_a_cloud_that_many_places_fit_is_doubted_unless_its_pixels_tell():
    """A flat thing alone looks the same from anywhere above."""
    rng = np.random.default_rng(0)
    plate = np.c_[rng.uniform(-0.06, 0.06, (4000, 2)), rng.normal(0.0, 0.0005, 4000)]
    cloud = PointCloud(plate, np.array([0.1, 0.0, 0.5]))
    up = np.array([0.0, 0.0, 1.0])
    assert "of all places for the camera fit the cloud as well as (0.1, 0, 0.5)" in check_viewpoint(cloud, cloud, up)
    assert check_viewpoint(cloud, replace(cloud, posed=True)) == ""


def test_a_thing_without_its_table_is_doubted_from_right_behind():
    _, points, place = seen("cylinder", 0.8)
    thing = points[(np.abs(points[:, :2]) < 0.06).all(1) & (points[:, 2] > 0.008)]
    assert check_viewpoint(PointCloud(thing, place), PointCloud(thing, place)) == ""
    mirrored = PointCloud(thing, 2 * thing.mean(0) - place)
    assert "the object is hollow, or seen from the back of its surface" in check_viewpoint(mirrored, mirrored)
    # A second cloud of the same camera confirms nothing.
    evidence = some(scene_from_views([mirrored, mirrored], alone=True).evidence)
    assert "the object is hollow" in " ".join(evidence.doubts)


def test_numbers_of_32_and_of_64_bits_are_the_same_scene():
    points, place = seen("mug", 0.8)[1:]
    few = points.astype(np.float32).astype(float)
    assert (few != points).any()
    asked = {"target": Target(np.array([0.0, 0.0, 0.05])), "mass": 0.1}
    one, other = (scene_from_views([PointCloud(some, place)], **asked) for some in (points, few))
    assert one.object.sha256 == other.object.sha256


def test_clouds_too_small_or_too_flat_to_tell_are_taken():
    rng = np.random.default_rng(0)
    assert not seen_from(np.ones((1, 3, 3)), np.zeros(3)).posed
    seen_from(np.ones((10, 10, 3)), np.zeros(3))
    flat = np.c_[rng.uniform(-0.3, 0.3, (5000, 2)), np.full(5000, 0.6)]
    check_scene([PointCloud(flat, np.zeros(3)), PointCloud(np.zeros((500, 3)), np.zeros(3))])


EYE = np.array([0.0, 0.0, 1.0])
WIDTH = SegmentationConfig().border_width


def picture(rows: int = 120) -> np.ndarray:
    """A plane seen by a camera above, half a metre wide."""
    row, column = np.mgrid[-0.25 : 0.25 : rows * 1j, -0.25 : 0.25 : rows * 1j]
    return np.column_stack([row.ravel(), column.ravel(), np.zeros(row.size)])


@pytest.mark.parametrize(("middle", "reaches"), [((0.0, 0.0), False), ((0.24, 0.0), True), ((0.1, -0.24), True)])
def test_what_lies_on_the_border_reaches_it(middle: tuple[float, float], reaches: bool):
    points = picture()
    mine = np.hypot(points[:, 0] - middle[0], points[:, 1] - middle[1]) < 0.05
    assert reaches_image_border(points, EYE, mine, WIDTH) is reaches


@pytest.mark.parametrize("away", [0.5, 0.8, 1.3, 2.0])
def test_what_is_almost_on_the_border_is_told_from_what_is(away: float):
    """The hull of a few points, which is asked first, is smaller than that of all."""
    points = picture(rows=300)
    mine = (points[:, 0] < 0.25 - away * WIDTH) & (points[:, 0] > 0.15) & (np.abs(points[:, 1]) < 0.05)
    assert reaches_image_border(points, EYE, mine, WIDTH) is (away < 1)


def test_what_stands_out_over_the_end_of_the_table_does_not():
    """The sides of the outline go from its top to the corners of the table, and there is nothing along them."""
    points = picture(rows=300)
    out = points[(np.abs(points[:, 0]) < 0.05) & (points[:, 1] > 0.15)] + [0.0, 0.1, 0.0]
    both = np.concatenate([points, out])
    assert not reaches_image_border(both, EYE, np.arange(len(both)) >= len(points), WIDTH)
    assert not reaches_image_border(np.zeros((0, 3)), EYE, np.zeros(0, dtype=bool), WIDTH)
    assert not reaches_image_border(np.zeros((5, 3)), EYE, np.ones(5, dtype=bool), WIDTH)


@pytest.mark.parametrize("place", [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]])
def test_a_place_that_is_not_finite_is_named(place, tmp_path: Path):
    points = surface_samples(make_shape("box"), 500, seed=0)[0] + np.array([0.0, 0.0, 0.6])
    np.savetxt(tmp_path / "a.xyz", points)
    with pytest.raises(CloudError, match=r"viewpoint is \[.*\]; valid: 3 finite numbers"):
        load_scene(tmp_path / "a.xyz", view_point=place)
    with pytest.raises(CloudError, match=r"viewpoint is \[.*\]; valid: 3 finite numbers"):
        scene_from_views([PointCloud(points, np.array(place))])


@pytest.mark.parametrize(
    ("shift", "doubt"),
    [
        ((0.0, 0.0, 0.0), ""),
        ((0.0, 0.0, 0.02), "of the points near the object"),
        ((0.15, 0.0, 0.0), r"view 3 saw empty space where other views show \d+ % of the object: is the pose of each"),
    ],
)
def test_views_of_which_one_has_a_wrong_pose_are_doubted(shift, doubt):
    poses = ring_poses(3, elevation=0.6, azimuth=-1.2)
    depths = [depth for depth, _ in depth_views(tabletop("bottle"), CAMERA, poses, DEFAULT)]
    poses[2][:3, 3] += shift
    views = [cloud_from_depth(depth, CAMERA, pose) for depth, pose in zip(depths, poses, strict=True)]
    evidence = some(scene_from_views(views).evidence)
    told = " ".join(evidence.doubts)
    assert re.search(doubt, told) if doubt else not told
