"""Segmentation: the right object out of scenes whose truth is known, and named failures out of the others."""

import numpy as np
import pytest
from expected import some
from hypothesis import given, settings
from hypothesis import strategies as st
from made_meshes import box_between
from scipy.spatial.transform import Rotation

from graspd_bench.rendering.depth_noise import LEVELS, NONE, DepthNoise, add_noise
from graspd_bench.rendering.render import look_at, render_scene
from graspd_bench.rendering.tabletop import ring_poses, tabletop, views_of
from graspd_core import PinholeCamera, PointCloud, Target, TriangleMesh, cloud_from_depth
from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError, NoObjectError
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import SHAPES, make_shape
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.perception.segment.segment import Segmentation, find_things, segment

# As a D415 with half its pixels each way.
CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)
POSE = ring_poses(1, elevation=0.7, azimuth=0.4)[0]
THREE = tabletop("box", obstacles=[("cylinder", 0.02, 0.14), ("mug", -0.02, -0.15)])


def seen(meshes, pose=POSE, noise: DepthNoise = NONE) -> tuple[PointCloud, np.ndarray]:
    """A view of meshes in the world frame, and which of them each of its points shows."""
    depth, label = render_scene(meshes, CAMERA, pose)
    noisy = add_noise(depth, CAMERA, noise, 0)
    return cloud_from_depth(noisy, CAMERA, pose), label[noisy > 0]


def share_near(points: np.ndarray, mesh: TriangleMesh, limit: float) -> float:
    return float((surface_distance(make_surface(mesh), points) < limit).mean())


def share_found(found: Segmentation, wanted: np.ndarray) -> float:
    got = {tuple(point) for view in found.views for point in view.points}
    return float(np.mean([tuple(point) in got for point in wanted]))


def centre(mesh: TriangleMesh) -> np.ndarray:
    return 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))


@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_the_object_is_cut_out_of_a_table_scene(shape):
    views = ((0.4, 0.0, "high"), (0.8, 2.0, "default"), (1.2, 4.0, "default"), (1.2, 1.0, "none"))
    # Every other shape from every other view: each view shows six shapes, each shape twice.
    for elevation, turn, level in views[sorted(SHAPES).index(shape) % 2 :: 2]:
        scene = tabletop(shape, yaw=turn)
        pose = ring_poses(1, elevation=elevation, azimuth=turn)[0]
        view, label = seen(scene.meshes, pose, LEVELS[level])
        found = segment([view])
        assert found.support is not None
        # No more tilt than raises the table's edge, 0.4 m away, by 4 mm, the least tolerance.
        assert found.support.normal == pytest.approx([0, 0, 1], abs=0.01)
        assert found.support.offset == pytest.approx(0, abs=1e-3)
        # The margin is one standard deviation of the noise, at least 1 mm.
        assert 0.001 <= found.support.margin < 0.003
        # Four standard deviations of the greatest noise at 0.6 m.
        assert share_near(found.views[0].points, scene.truth, 0.009) > 0.99
        clear = view.points[(label == 0) & (view.points[:, 2] > 0.008)]
        clear = clear[surface_distance(make_surface(scene.truth), clear) < 0.005]
        assert share_found(found, clear) > (0.98 if level == "none" else 0.95)
        assert not found.obstacles
        assert not found.warnings


@pytest.mark.parametrize("wanted", [0, 1, 2])
@pytest.mark.parametrize("kind", ["point", "box", "mask", "axis"])
def test_the_one_that_was_asked_for_is_picked(kind, wanted):
    mesh = THREE.meshes[wanted]
    eye = np.array([0.5, 0.1, 0.4])
    pose = look_at(eye, centre(mesh) if kind == "axis" else (0, 0, 0.03))
    view, label = seen(THREE.meshes, pose, LEVELS["default"])
    target = {
        "point": Target(point=mesh.vertices[mesh.vertices[:, 2].argmax()]),
        "box": Target(box=(mesh.vertices.max(0) + 0.01, mesh.vertices.min(0) - 0.01)),
        "mask": Target(mask=label == wanted),
        "axis": None,
    }[kind]
    found = segment([view], target=target)
    assert share_near(found.views[0].points, mesh, 0.009) > 0.99
    assert share_found(found, view.points[(label == wanted) & (view.points[:, 2] > 0.01)]) > 0.9
    others = [THREE.meshes[k] for k in range(3) if k != wanted]
    assert len(found.obstacles) == 2
    for other in others:
        assert max(share_near(points, other, 0.009) for points in found.obstacles) > 0.95


@pytest.fixture(scope="module")
def three() -> tuple[PointCloud, Segmentation]:
    """A view of three things, and what is made of it."""
    view, _ = seen(THREE.meshes, noise=LEVELS["low"])
    return view, segment([view])


@settings(max_examples=6)
@given(st.integers(0, 10**6), st.floats(-1, 1), st.floats(-1, 1))
def test_moving_the_whole_scene_moves_the_answer(three, seed, x, y):
    view, first = three
    turn, shift = Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), np.array([x, y, 0.3])
    moved = PointCloud(view.points @ turn.T + shift, turn @ view.viewpoint + shift, turn @ some(view.forward))
    second = segment([moved])
    back = (second.views[0].points - shift) @ turn
    assert some(second.support).normal @ turn == pytest.approx(some(first.support).normal, abs=2e-3)
    # Voxels lie elsewhere, so that a few points at edges and near the support change sides.
    one, other = ({tuple(np.round(p, 6)) for p in points} for points in (first.views[0].points, back))
    assert len(one & other) > 0.98 * len(one | other)


@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_an_object_alone_passes_unharmed(shape):
    mesh = make_shape(shape)
    for direction in ((1, 0, 0.3), (0, 1, 0.7), (0.3, 0.3, 1), (0, 0, -1)):
        for noise, least in ((NONE, 0.94), (LEVELS["default"], 0.92)):
            view, _ = seen([mesh], look_at(0.4 * np.array(direction) / np.linalg.norm(direction), (0, 0, 0)), noise)
            found = segment([view])
            assert found.support is None
            assert (found.obstacles, found.warnings) == ((), ())
            assert len(found.views[0].points) > least * len(view.points)


@pytest.mark.parametrize("viewpoint", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.5)])
@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_an_object_sampled_all_round_passes_unharmed(shape, viewpoint):
    for count in (500, 5000):
        points = surface_samples(make_shape(shape), count, 0)[0]
        found = segment([PointCloud(points, np.array(viewpoint))])
        assert found.support is None
        assert len(found.views[0].points) > 0.97 * count


def test_walls_and_floors_are_not_what_it_stands_on():
    scene = tabletop("mug")
    walls = [box_between((-0.35, -0.6, -0.02), (-0.33, 0.6, 0.6)), box_between((-0.4, -0.35, -0.02), (0.4, -0.33, 0.6))]
    floor = box_between((-2, -2, -0.75), (2, 2, -0.72))
    for meshes in ([*scene.meshes, walls[0]], [*scene.meshes, *walls], [*scene.meshes, floor]):
        view, _ = seen(meshes, noise=LEVELS["default"])
        found = segment([view])
        assert some(found.support).normal == pytest.approx([0, 0, 1], abs=0.01)
        assert share_near(found.views[0].points, scene.truth, 0.009) > 0.99


@pytest.mark.parametrize("shape", ["cylinder", "bottle"])
@pytest.mark.parametrize("noise", ["none", "default"])
def test_what_is_seen_from_straight_above_stands_on_the_table(shape, noise):
    stage = tabletop(shape)
    views = views_of(stage, CAMERA, ring_poses(1, elevation=np.deg2rad(88.0)), LEVELS[noise])
    found = segment(views)
    assert some(found.support).offset == pytest.approx(0, abs=0.002)
    assert found.obstacles == ()


def test_before_a_wall_without_a_table_nothing_supports_it():
    mug = tabletop("mug").truth
    view, label = seen([mug, box_between((-0.35, -0.6, -0.2), (-0.33, 0.6, 0.6))])
    found = segment([view])
    assert found.support is None
    assert share_found(found, view.points[label == 0]) > 0.98
    assert share_near(found.views[0].points, mug, 1e-3) == 1
    assert "no support" in found.warnings[0]
    assert len(found.obstacles) == 1


@pytest.mark.parametrize(("gap", "level"), [(0.008, "none"), (0.012, "default"), (0.012, "high")])
def test_neighbours_with_a_gap_are_not_merged(gap, level):
    scene = tabletop("box", obstacles=[("box", 0.06 + gap, 0.0)])
    camera = PinholeCamera(640, 480, 616.0, 616.0, 319.5, 239.5)
    view = views_of(scene, camera, ring_poses(1, elevation=0.6, azimuth=-1.2), LEVELS[level])[0]
    found = segment([view], target=Target(point=np.array([0.0, 0.0, 0.05])))
    assert share_near(found.views[0].points, scene.truth, 0.009) > 0.98
    assert len(found.obstacles) == 1


@pytest.mark.parametrize("kind", ["mask", "box"])
def test_a_mask_or_box_parts_two_that_touch(kind):
    scene = tabletop("box", obstacles=[("box", 0.06, 0.0)])
    view, label = seen(scene.meshes, ring_poses(1, elevation=0.6, azimuth=-1.2)[0])
    mesh = scene.truth
    target = Target(mask=label == 0) if kind == "mask" else Target(box=(mesh.vertices.min(0), mesh.vertices.max(0)))
    found = segment([view], target=target)
    # The voxels at the seam hold points of both.
    assert share_near(found.views[0].points, scene.truth, 1e-3) > 0.97
    assert len(found.obstacles) == 1
    assert share_near(found.obstacles[0], scene.obstacles[0], 2e-3) > 0.95


def test_flying_pixels_are_left_out():
    scene = tabletop("box")
    depth, label = render_scene(scene.meshes, CAMERA, POSE)
    rng = np.random.default_rng(0)
    edge = (label == 0) & (np.roll(label, 1, 1) != 0)
    ahead = np.roll(depth, 2, 1)
    flying = edge & (ahead > depth + 0.02)
    assert flying.sum() > 20
    depth[flying] += (rng.uniform(0.2, 0.8, depth.shape) * (ahead - depth))[flying]
    found = segment([cloud_from_depth(depth, CAMERA, POSE)])
    away = surface_distance(make_surface(scene.truth), found.views[0].points)
    assert (away > 0.01).sum() <= 0.1 * flying.sum()


def test_every_view_keeps_its_camera_and_those_that_do_not_show_it_are_left_out():
    scene = tabletop("mug")
    views = list(views_of(scene, CAMERA, ring_poses(3, elevation=0.7), LEVELS["default"]))
    turned_away = PointCloud(views[1].points[views[1].points[:, 0] > 0.2], views[1].viewpoint, views[1].forward)
    found = segment([views[0], turned_away, views[2]])
    assert [tuple(view.viewpoint) for view in found.views] == [tuple(views[k].viewpoint) for k in (0, 2)]
    assert found.views[1].forward is views[2].forward
    for part, whole in zip(found.views, (views[0], views[2]), strict=True):
        assert {tuple(point) for point in part.points} <= {tuple(point) for point in whole.points}
        assert share_near(part.points, scene.truth, 0.009) > 0.99


def test_a_workspace_hides_what_is_outside():
    view, _ = seen(THREE.meshes)
    with pytest.raises(NoObjectError, match="nothing on it that is higher than 4 mm"):
        segment([view], settings=SegmentationConfig(roi_high=(1.0, 1.0, 0.006)))
    found = segment([view], settings=SegmentationConfig(roi_low=(-1.0, 0.09, -1.0), roi_high=(1.0, 0.3, 1.0)))
    assert share_near(found.views[0].points, THREE.obstacles[0], 1e-3) > 0.99
    half = segment([view], settings=SegmentationConfig(roi_low=(-1.0, -0.1, -1.0), roi_high=(1.0, 0.0, 1.0)))
    assert "border of the workspace" in half.cut
    # A whole object that leans on the wall of a bin is not cut, although the region ends before the wall.
    wall, pose = box_between((-0.2, 0.031, 0.0), (0.2, 0.04, 0.06)), look_at(np.array([0.3, -0.1, 0.7]), np.zeros(3))
    walled, _ = seen((THREE.meshes[0], THREE.meshes[-1], wall), pose, LEVELS["default"])
    for side in (0.027, 0.035):
        inside = SegmentationConfig(roi_low=(-0.3, -0.3, -1.0), roi_high=(0.3, side, 1.0))
        assert not segment([walled], settings=inside).cut
    with pytest.raises(CloudError, match=r"only 0 of \d+ points are within 0.1 m of the camera; at least 50"):
        segment([view], settings=SegmentationConfig(max_range=0.1))


def test_an_empty_table_says_what_was_seen():
    view, _ = seen(tabletop("mug").meshes[1:], noise=LEVELS["default"])
    with pytest.raises(NoObjectError, match=r"a plane of 0\.\d+ by 0\.\d+ m at 0\.\d+ m from the camera, and nothing"):
        segment([view])


@pytest.mark.parametrize(
    ("target", "largest", "complaint"),
    [
        (Target(np.array([0.0, 0.0, 0.5])), 0.35, r"no object within 0.05 m of the point .* 3 objects are seen, the l"),
        (Target(box=(np.full(3, 0.2), np.full(3, 0.3))), 0.35, r"nothing in the box .* 3 objects"),
        (None, 0.03, r"3 objects are seen, .* longer than largest_object=0.03 m"),
    ],
)
def test_nothing_at_the_target_or_small_enough_lists_what_there_is(target, largest, complaint):
    view, _ = seen(THREE.meshes)
    with pytest.raises(NoObjectError, match=complaint):
        segment([view], target=target, settings=SegmentationConfig(largest_object=largest))


@pytest.mark.parametrize("blind", [np.zeros((0, 3)), np.full((40, 3), np.nan)], ids=["empty", "all NaN"])
@pytest.mark.parametrize("forward", [None, np.array([0.0, 0.0, 1.0])])
def test_a_first_view_that_shows_nothing_does_not_choose(blind, forward):
    view, _ = seen(THREE.meshes)
    expected = segment([view])
    found = segment([PointCloud(blind, np.array([5.0, 5.0, 5.0]), forward), view])
    assert share_found(found, expected.views[0].points) == 1.0
    assert share_near(found.views[0].points, THREE.truth, 1e-3) > 0.99


def test_a_mask_of_background_finds_nothing():
    view, label = seen(THREE.meshes)
    with pytest.raises(NoObjectError, match="nothing but background under the mask; 3 objects"):
        segment([view], target=Target(mask=(label == 3) & (np.abs(view.points[:, 0]) > 0.25)))


@pytest.mark.parametrize(
    ("target", "complaint"),
    [
        (Target(point=np.zeros(3), mask=np.ones(3, dtype=bool)), "point and mask given; valid: only one of point"),
        (Target(point=np.array([0.0, np.nan, 0.0])), "valid: finite numbers"),
        (Target(box=(np.zeros(3), np.array([1.0, 1.0, 0.0]))), "valid: finite, with a volume above 0"),
        (Target(mask=np.ones(3, dtype=bool)), r"mask of length 3; valid: \d+, the number of points in the first view"),
        (Target(mask=np.zeros(len(seen(THREE.meshes)[0].points), dtype=bool)), "mask selects no point"),
    ],
)
def test_targets_that_cannot_be_meant_are_refused(target, complaint):
    with pytest.raises(CloudError, match=complaint):
        segment([seen(THREE.meshes)[0]], target=target)


def test_a_mask_of_numbers_is_refused():
    target, (view, label) = Target(), seen(THREE.meshes)
    # Outside the tests, nothing checks the type of an attribute.
    object.__setattr__(target, "mask", np.where(label == 0, 255, 0).astype(np.uint8))
    with pytest.raises(CloudError, match="target: mask of uint8; valid: bool, True where a point shows the object"):
        segment([view], target=target)


def test_points_without_any_surface_are_no_object():
    points = np.random.default_rng(0).random((2000, 3))
    with pytest.raises(NoObjectError, match="no graspable object among 2000 points"):
        segment([PointCloud(points, np.zeros(3))])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scene", "noise"])
def test_ten_million_points(kind):
    view, _ = seen(THREE.meshes)
    rng = np.random.default_rng(0)
    many = 10_000_000
    points = rng.random((many, 3))
    if kind == "scene":
        points = view.points[rng.integers(0, len(view.points), many)] + rng.normal(0, 5e-4, (many, 3))
    if kind == "noise":
        with pytest.raises(NoObjectError):
            segment([PointCloud(points, view.viewpoint, view.forward)])
    else:
        found = segment([PointCloud(points, view.viewpoint, view.forward)])
        assert share_near(found.views[0].points, THREE.truth, 4e-3) > 0.99


def test_things_that_are_found_are_those_that_a_point_of_theirs_means():
    views = views_of(THREE, CAMERA, [POSE])
    things = find_things(views)
    assert len(things) == 3
    for points in things:
        (cut,) = segment(views, target=Target(point=points[0])).views
        # What is cut out leaves out the lowest millimetres, which may be the table's.
        known = {tuple(point) for point in points}
        assert all(tuple(point) in known for point in cut.points)
        assert len(cut.points) > 0.9 * len(points)


def test_a_cloud_that_changes_in_place_is_divided_anew():
    (view,) = views_of(THREE, CAMERA, [POSE])
    gone, *left = find_things([view])
    view.points[((view.points >= gone.min(0)) & (view.points <= gone.max(0))).all(1)] = np.nan
    assert len(find_things([view])) == len(left)
