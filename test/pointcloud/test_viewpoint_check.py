"""Whether clouds tell that their camera stood elsewhere, and whether an object reaches the border of a picture."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays, reaches_image_border
from graspd_core.perception.cloud.viewpoint_check import check_viewpoint

CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)

# Where robots have their base: on the table, above it, on the floor; and right under the object.
BASES = {"on the table": (-0.5, 0.0, 0.0), "above": (-0.5, 0.1, 0.4), "floor": (-0.5, 0.2, -0.7), "under": (0, 0, -0.5)}


def seen(shape: str, elevation: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, finite points and the camera's place of a view of a shape on a table, in the world frame."""
    scene = tabletop(shape, yaw=0.4, obstacles=[("box", 0.15, 0.05)])
    T = ring_poses(1, elevation=elevation, azimuth=0.3)[0]
    depth = depth_views(scene, CAMERA, [T], DEFAULT, seed=3)[0][0]
    rays = camera_rays(CAMERA) * np.where(depth > 0, depth, np.nan)[..., None]
    grid = rays @ T[:3, :3].T + T[:3, 3]
    flat = grid.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(1)]
    # Thinned clouds come sorted by place.
    return grid, flat[np.unique(np.floor(flat / 0.004), axis=0, return_index=True)[1]], T[:3, 3]


@pytest.mark.parametrize(("shape", "elevation"), [("mug", 0.35), ("mug", 0.8), ("mug", 1.2), ("box", 0.8)])
def test_the_true_place_is_taken_and_the_places_of_robots_are_refused(shape, elevation):
    grid, points, place = seen(shape, elevation)
    check_viewpoint(points, place, grid=grid)
    check_viewpoint(points, place)
    for base in BASES.values():
        with pytest.raises(CloudError, match="its pixels show it at") as refused:
            check_viewpoint(points, np.array(base), grid=grid)
        told = str(refused.value).split("show it at (")[1].split(")")[0]
        # The fit is to a pixel or so; the frame of the figure is the cloud's.
        np.testing.assert_allclose([float(x) for x in told.split(",")], place, atol=0.005)
        with pytest.raises(CloudError, match=r"hidden from there by others|far side of the table"):
            check_viewpoint(points, np.array(base))


def test_an_object_alone_from_all_round_needs_no_camera():
    ball = surface_samples(make_shape("sphere"), 3000, seed=0)[0] + [0.0, 0.0, 0.5]
    check_viewpoint(ball, np.zeros(3), alone=True)
    with pytest.raises(CloudError, match=r"did not stand at the origin of its frame: .*sensor_frame or view_point"):
        check_viewpoint(ball, np.zeros(3))


def test_clouds_too_small_or_too_flat_to_tell_are_taken():
    rng = np.random.default_rng(0)
    check_viewpoint(np.ones((3, 3)), np.zeros(3), grid=np.ones((1, 3, 3)))
    check_viewpoint(np.ones((100, 3)), np.zeros(3), grid=np.ones((10, 10, 3)))
    flat = np.c_[rng.uniform(-0.3, 0.3, (5000, 2)), np.full(5000, 0.6)]
    check_viewpoint(flat, np.zeros(3))
    check_viewpoint(np.zeros((500, 3)), np.zeros(3))


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
