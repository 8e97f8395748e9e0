"""Depth images and pictures, the sensor's faults one by one, and authored scenes on a table."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter

from graspd_bench.rendering.depth_noise import DEFAULT, HIGH, LEVELS, LOW, NONE, DepthNoise, add_noise
from graspd_bench.rendering.render import (
    BACKGROUND,
    camera_of_view,
    draw_labels,
    draw_points,
    look_at,
    render_depth,
    render_scene,
    render_shaded,
    save_png,
)
from graspd_bench.rendering.tabletop import CAMERA as D415
from graspd_bench.rendering.tabletop import TABLE_HALF, depth_views, lowest_pose, moved, ring_poses, tabletop, views_of
from graspd_core.errors import CloudError
from graspd_core.mesh.shapes import CAPSULE_RADIUS, HEAD_HALF, PLATE_HALF, SHAPES, SPHERE_RADIUS, make_shape
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays, cloud_from_depth, distort
from graspd_core.types import TriangleMesh

CAMERA = PinholeCamera(81, 61, 100.0, 100.0, 40.0, 30.0)
coordinate = st.floats(-1, 1)


@given(eye=st.tuples(coordinate, coordinate, coordinate).filter(lambda e: np.linalg.norm(e) > 0.1))
def test_looking_is_a_rigid_motion_that_puts_the_target_ahead(eye):
    pose = look_at(eye, (0, 0, 0))
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert pose[:3, :3] @ [0, 0, np.linalg.norm(eye)] + pose[:3, 3] == pytest.approx(np.zeros(3), abs=1e-9)
    # Up is up in the image, whose y axis points down.
    assert pose[2, 1] < 1e-9
    assert pose[2, 0] == pytest.approx(0, abs=1e-9)


def test_depth_of_a_sphere_is_the_closed_form():
    depth = render_depth(make_shape("sphere"), CAMERA, look_at((0.5, 0, 0), (0, 0, 0)))
    assert depth[30, 40] == pytest.approx(0.5 - SPHERE_RADIUS, abs=1e-4)
    assert depth[0, 0] == 0
    # The outline lies where the line of sight is tangent: tan = r / √(d² − r²).
    radius = np.sqrt((depth > 0).sum() / np.pi)
    assert radius == pytest.approx(100 * SPHERE_RADIUS / np.sqrt(0.25 - SPHERE_RADIUS**2), rel=0.05)


def test_a_scene_is_seen_with_the_name_of_what_each_pixel_shows():
    sphere = make_shape("sphere")
    wall = TriangleMesh(
        np.array([[-1.0, -5, -5], [-1, 5, -5], [-1, 5, 5], [-1, -5, 5]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    pose = look_at((0.5, 0, 0), (0, 0, 0))
    depth, label = render_scene([wall, sphere], CAMERA, pose)
    assert set(np.unique(label)) == {0, 1}
    assert depth[label == 0] == pytest.approx(np.full((label == 0).sum(), 1.5), abs=1e-5)
    # Of a ray through x, y at unit depth: the nearer root of |z (x, y, 1) - (0, 0, 0.5)| = radius.
    ray = camera_rays(CAMERA)[label == 1]
    length = (ray**2).sum(1)
    z = (0.5 - np.sqrt((0.25 - length * (0.25 - SPHERE_RADIUS**2)).clip(0))) / length
    steep = (length - 1) < 0.8 * SPHERE_RADIUS**2 / 0.25
    assert depth[label == 1][steep] == pytest.approx(z[steep], abs=3e-4)
    alone, nothing = render_scene([sphere], CAMERA, pose)
    assert (alone[nothing < 0] == 0).all()
    assert (nothing == label - 1).all()


@pytest.mark.parametrize("name", ["sphere", "box", "mug", "torus"])
def test_a_picture_shows_what_rays_hit_but_for_half_a_pixel_at_outlines(name: str):
    """Points cover every face: no pixel inside the outline stays empty, and depths are those of rays."""
    mesh, camera = make_shape(name), camera_of_view(161, 121)
    pose = look_at((0.21, 0.1, 0.15), (0, 0, 0))
    depth, face, normal = draw_points(mesh, camera, pose)
    label = draw_labels([mesh], camera, pose)
    true = render_depth(mesh, camera, pose)
    assert (label[true > 0] == 0).all()
    assert (np.isfinite(depth) == (label == 0)).all()
    assert (label[maximum_filter(true, 3) == 0] == -1).all()
    # Where depth jumps, a point may belong to the neighbouring pixel's surface.
    inner = maximum_filter(true, 3) - minimum_filter(true, 3) < 0.008
    inner &= true > 0
    assert inner.sum() > 300
    assert depth[inner] == pytest.approx(true[inner], abs=0.004)
    assert np.linalg.norm(normal, axis=-1)[inner] == pytest.approx(1.0)
    assert (face[inner] < len(mesh.faces)).all()


def test_a_scene_appears_where_the_lens_puts_it():
    lens = PinholeCamera(161, 121, 150.0, 150.0, 80.0, 60.0, (-0.2, 0.05, 0.002, -0.001, 0.0))
    pose = look_at((0.3, 0.2, 0.25), (0, 0, 0))
    balls = [make_shape("sphere"), make_shape("box")]
    balls[1] = TriangleMesh(balls[1].vertices + np.array([0.0, 0.12, 0.0]), balls[1].faces)
    depth, label = render_scene(balls, lens, pose)
    points = cloud_from_depth(depth, lens).points
    row, column = np.nonzero(depth)
    pixels = distort(points[:, :2] / points[:, 2:], lens.distortion)[0] * 150.0 + [80.0, 60.0]
    assert pixels == pytest.approx(np.stack([column, row], -1), abs=1e-6)
    world = points @ pose[:3, :3].T + pose[:3, 3]
    on_ball = label[row, column] == 0
    assert np.linalg.norm(world[on_ball], axis=1) == pytest.approx(np.full(on_ball.sum(), SPHERE_RADIUS), abs=2e-4)


def test_pixels_beyond_the_lens_see_nothing():
    # Strong barrel distortion folds back before the corners of the image.
    lens = PinholeCamera(81, 61, 30.0, 30.0, 40.0, 30.0, (-0.3,))
    blind = np.isnan(camera_rays(lens)[..., 0])
    assert blind.any()
    assert not blind.all()
    ball = make_shape("sphere")
    depth, label = render_scene([TriangleMesh(ball.vertices * 10, ball.faces)], lens, np.eye(4))
    assert (label[blind] == -1).all()
    assert (depth[blind] == 0).all()
    assert (label[~blind] == 0).all()


def test_pictures_show_every_mesh_in_its_colour(tmp_path):
    sphere, box = make_shape("sphere"), make_shape("box")
    left = TriangleMesh(box.vertices + np.array([0, -0.1, 0]), box.faces)
    scene = [(sphere, (1.0, 0.0, 0.0)), (left, (0.0, 0.0, 1.0))]
    image = render_shaded(scene, T_world_camera=look_at((0.6, 0, 0.2), (0, 0, 0)), width=160, height=120)
    assert image.shape == (120, 160, 3)
    assert (image[0, 0] == BACKGROUND).all()
    red = (image[..., 0] > 60) & (image[..., 2] == 0)
    blue = (image[..., 2] > 60) & (image[..., 0] == 0)
    assert red.sum() > 200
    assert blue.sum() > 200
    # Seen from +x with z up, −y is on the left.
    assert np.nonzero(blue)[1].mean() < np.nonzero(red)[1].mean()
    save_png(tmp_path / "picture.png", image)
    import open3d as o3d

    assert np.array_equal(np.asarray(o3d.io.read_image(tmp_path / "picture.png")), image)


SMALL = PinholeCamera(160, 120, 154.0, 154.0, 79.5, 59.5)


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_stands_on_the_table_above_the_origin(name):
    scene = tabletop(name, yaw=0.4)
    low, high = scene.truth.vertices.min(0), scene.truth.vertices.max(0)
    assert low[2] == pytest.approx(0, abs=1e-9)
    assert (low[:2] < 0).all()
    assert (high > 0).all()
    assert moved(make_shape(name), scene.T_world_object).vertices == pytest.approx(scene.truth.vertices)
    assert np.linalg.det(scene.T_world_object[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("name", "height"), [("capsule", 2 * CAPSULE_RADIUS), ("plate", 2 * PLATE_HALF[2]), ("hammer", 2 * HEAD_HALF[1])]
)
def test_lowest_is_lying(name, height):
    resting = moved(make_shape(name), lowest_pose(make_shape(name)))
    # A capsule of 64 sides rests on one of them; a hammer leans from its head to the thinner end of its shaft.
    assert np.ptp(resting.vertices[:, 2]) == pytest.approx(height, abs=5e-4)


def test_turning_a_shape_turns_it_about_the_vertical():
    straight, turned = tabletop("box"), tabletop("box", yaw=0.5)
    assert turned.truth.vertices[:, 2] == pytest.approx(straight.truth.vertices[:, 2])
    assert turned.T_world_object[:2, 0] == pytest.approx([np.cos(0.5), np.sin(0.5)])


def test_cameras_stand_on_a_ring_and_look_at_the_object():
    poses = ring_poses(3, elevation=0.6, distance=0.5, azimuth=0.2, target=(0.1, 0.0, 0.05))
    eyes = np.array([pose[:3, 3] for pose in poses]) - [0.1, 0.0, 0.05]
    assert np.linalg.norm(eyes, axis=1) == pytest.approx(np.full(3, 0.5))
    assert eyes[:, 2] == pytest.approx(np.full(3, 0.5 * np.sin(0.6)))
    assert np.arctan2(eyes[0, 1], eyes[0, 0]) == pytest.approx(0.2)
    for pose, eye in zip(poses, eyes, strict=True):
        assert pose[:3, 2] == pytest.approx(-eye / 0.5)


def test_without_noise_points_lie_on_what_their_pixel_shows():
    scene = tabletop("box", obstacles=[("sphere", 0.12, 0.0)])
    pose = ring_poses(1, elevation=0.7, azimuth=1.2)
    ((depth, label),) = depth_views(scene, SMALL, pose)
    (cloud,) = views_of(scene, SMALL, pose)
    assert set(np.unique(label)) == {-1, 0, 1, 2}
    label = label[depth > 0]
    box, sphere, table = (cloud.points[label == index] for index in range(3))
    half = np.array([0.03, 0.03, 0.045])
    outside = np.abs(box - [0, 0, 0.045]) - half
    assert outside.max(1) == pytest.approx(np.zeros(len(box)), abs=1e-5)
    # The ball's faces lie up to 0.1 mm inside.
    assert np.linalg.norm(sphere - [0.12, 0, 0.035], axis=1) == pytest.approx(0.035, abs=2e-4)
    on_top = np.abs(table[:, :2]).max(1) < TABLE_HALF - 1e-3
    assert table[on_top, 2] == pytest.approx(np.zeros(on_top.sum()), abs=1e-5)
    assert scene.support.normal @ table[on_top].T == pytest.approx(
        np.full(on_top.sum(), scene.support.offset), abs=1e-5
    )


def test_views_carry_their_camera_and_their_own_noise():
    scene = tabletop("mug")
    poses = ring_poses(2, elevation=0.6)
    views = views_of(scene, D415, poses, DEFAULT, seed=3)
    for view, pose in zip(views, poses, strict=True):
        assert view.viewpoint == pytest.approx(pose[:3, 3])
        assert view.forward == pytest.approx(pose[:3, 2])
        assert np.isfinite(view.points).all()
    again = views_of(scene, D415, poses, DEFAULT, seed=3)
    other = views_of(scene, D415, poses, DEFAULT, seed=4)
    assert all(np.array_equal(a.points, b.points) for a, b in zip(views, again, strict=True))
    assert len(views[0].points) != len(other[0].points)


SENSOR = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
NEAR, FAR = 0.5, 0.8


def wall(z: float = 0.6) -> np.ndarray:
    return np.full((SENSOR.height, SENSOR.width), z)


def block() -> np.ndarray:
    """A square in front of a wall."""
    depth = wall(FAR)
    depth[40:80, 60:100] = NEAR
    return depth


def test_no_noise_changes_nothing_and_seeds_differ():
    assert np.array_equal(add_noise(block(), SENSOR, NONE, 0), block())
    assert not np.array_equal(add_noise(block(), SENSOR, DEFAULT, 0), add_noise(block(), SENSOR, DEFAULT, 1))


@pytest.mark.parametrize("z", [0.3, 0.6, 1.2])
def test_the_error_grows_with_the_square_of_depth(z):
    noise = DepthNoise(floor=3e-4, quadratic=2.4e-3, correlation=1.0)
    error = np.concatenate([(add_noise(wall(z), SENSOR, noise, seed) - z).ravel() for seed in range(4)])
    # Some 10⁴ errors that are independent to within a few pixels: 5 % is more than four standard errors.
    assert error.std() == pytest.approx(3e-4 + 2.4e-3 * z**2, rel=0.05)
    assert abs(error.mean()) < 0.1 * error.std()


def test_neighbouring_errors_are_alike():
    error = add_noise(wall(), SENSOR, DepthNoise(quadratic=0.002, correlation=3.0, white=0.1), 0) - 0.6

    def correlation(pixels: int) -> float:
        return float(np.corrcoef(error[:, :-pixels].ravel(), error[:, pixels:].ravel())[0, 1])

    # A Gaussian of width s convolved with itself: exp(-d² / 4 s²), on all the variance but the white part.
    for pixels in (1, 4):
        assert correlation(pixels) == pytest.approx(0.9 * np.exp(-(pixels**2) / 36), abs=0.06)
    assert abs(correlation(20)) < 0.15


def test_flying_pixels_lie_between_the_block_and_the_wall_and_only_at_its_edge():
    seen = add_noise(block(), SENSOR, DepthNoise(flying=0.5), 0)
    off = seen != block()
    assert ((seen[off] > NEAR) & (seen[off] < FAR)).all()
    row, column = np.nonzero(off)
    inside = (row > 40) & (row < 79) & (column > 60) & (column < 99)
    outside = (row < 39) | (row > 80) | (column < 59) | (column > 100)
    assert not (inside | outside).any()
    # The outlines of 40 x 40 and of 42 x 42 pixels, half of them.
    assert off.sum() == pytest.approx(0.5 * (4 * 39 + 4 * 41), rel=0.2)


def test_what_the_other_eye_does_not_see_is_lost():
    noise = DepthNoise(baseline=0.05)
    lost = add_noise(block(), SENSOR, noise, 0) == 0
    # Width of the shadow in pixels: f B (1 / near - 1 / far).
    width = 150 * 0.05 * (1 / NEAR - 1 / FAR)
    columns = np.nonzero(lost[60])[0]
    assert abs(len(columns) - width) <= 1
    assert columns.max() == 59
    assert not lost[:40].any()


def test_edges_lose_their_share():
    lost = add_noise(block(), SENSOR, DepthNoise(edge_loss=0.4), 0) == 0
    assert lost.sum() == pytest.approx(0.4 * (4 * 39 + 4 * 41), rel=0.25)


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_holes_take_their_share_of_the_image(share):
    lost = np.mean([(add_noise(wall(), SENSOR, DepthNoise(loss=share), seed) == 0).mean() for seed in range(8)])
    assert lost == pytest.approx(share, rel=0.25)


def test_flatly_seen_surfaces_are_lost_and_steeply_seen_ones_are_not():
    column = np.arange(SENSOR.width)
    x = (column - SENSOR.cx) / SENSOR.fx
    noise = DepthNoise(grazing=np.deg2rad(20))

    def lost(angle: float) -> float:
        """Share lost of a plane through (0, 0, 0.2), turned about the vertical until `angle` from the optical axis."""
        depth = 0.2 * np.sin(angle) / (np.sin(angle) - x * np.cos(angle))
        narrow = np.abs(x) < 0.03
        return float((add_noise(np.tile(depth, (SENSOR.height, 1)), SENSOR, noise, 0) == 0)[:, narrow].mean())

    assert lost(np.deg2rad(40)) == 0
    # Half of the limit: half of the pixels. The view differs from the axis by up to 1.7°.
    assert lost(np.deg2rad(10)) == pytest.approx(0.5, abs=0.08)


def test_depth_comes_in_steps_and_within_range():
    ramp = np.tile(np.linspace(0.1, 1.0, SENSOR.width), (SENSOR.height, 1))
    noise = DepthNoise(quadratic=0.002, step=0.001, nearest=0.3, farthest=0.9)
    seen = add_noise(ramp, SENSOR, noise, 0)
    assert seen[seen > 0] * 1000 == pytest.approx(np.round(seen[seen > 0] * 1000))
    assert seen[seen > 0].min() >= 0.3
    assert seen.max() <= 0.9
    assert (seen[:, ramp[0] < 0.29] == 0).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32), level=st.sampled_from(sorted(LEVELS)))
def test_the_same_seed_gives_the_same_finite_image(seed, level):
    holed = block()
    holed[:5] = 0
    holed[5:10] = np.nan
    first = add_noise(holed, SENSOR, LEVELS[level], seed)
    assert np.array_equal(first, add_noise(holed, SENSOR, LEVELS[level], seed))
    assert np.isfinite(first).all()
    assert first.min() >= 0


def test_levels_are_in_order():
    def error(noise: DepthNoise) -> float:
        seen = add_noise(wall(), SENSOR, replace(noise, jitter=0.0), 0)
        return float((seen[seen > 0] - 0.6).std())

    def kept(noise: DepthNoise) -> float:
        return float((add_noise(block(), SENSOR, noise, 0) > 0).mean())

    assert error(NONE) == 0 < error(LOW) < error(DEFAULT) < error(HIGH)
    assert kept(NONE) == 1 > kept(LOW) > kept(DEFAULT) > kept(HIGH) > 0.8


@pytest.mark.parametrize("wrong", [{"quadratic": -1.0}, {"flying": 1.5}, {"floor": float("nan")}])
def test_impossible_settings_are_named(wrong):
    with pytest.raises(CloudError, match=f"noise: {next(iter(wrong))}="):
        DepthNoise(**wrong)
