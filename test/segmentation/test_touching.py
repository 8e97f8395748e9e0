"""Two things that touch are told where a camera sees the seam between them; one thing is not told to be two."""

import re

import numpy as np
import pytest

from graspd_core.mesh.shapes import SHAPES
from graspd_core.pointcloud.camera import PinholeCamera
from graspd_core.pointcloud.point_cloud import PointCloud
from graspd_core.rendering.depth_noise import DEFAULT
from graspd_core.rendering.tabletop import TabletopScene, ring_poses, tabletop, views_of
from graspd_core.segmentation.segment import segment
from graspd_core.segmentation.target_selection import Target

# As a D415 with half its pixels each way.
CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)


def view_of(stage: TabletopScene, azimuth: float, elevation: float = 0.6, distance: float = 0.55) -> PointCloud:
    pose = ring_poses(1, elevation=elevation, azimuth=azimuth, distance=distance)
    return views_of(stage, CAMERA, pose, DEFAULT)[0]


CYLINDER_BESIDE = tabletop("box", obstacles=[("cylinder", 0.064, 0.0)])


@pytest.mark.parametrize("azimuth", [-2.2, -1.2, -0.9])
def test_two_that_touch_are_told_where_the_seam_is_seen(azimuth):
    view = view_of(CYLINDER_BESIDE, azimuth)
    (doubt,) = segment([view]).warnings
    assert doubt.startswith("cloud: the object may be 2 things that touch, about (")
    said = np.array(re.findall(r"-?\d+\.\d+", doubt), dtype=float).reshape(2, 3)
    for mesh in (CYLINDER_BESIDE.truth, CYLINDER_BESIDE.obstacles[0]):
        assert np.linalg.norm(said - 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0)), axis=1).min() < 0.04
    # Who says what is meant is not asked.
    bounds = (CYLINDER_BESIDE.truth.vertices.min(0), CYLINDER_BESIDE.truth.vertices.max(0))
    assert segment([view], target=Target(box=bounds)).warnings == ()


@pytest.mark.parametrize("distance", [0.5, 1.0])
@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_one_thing_is_not_told_to_be_two(shape, distance):
    view = view_of(tabletop(shape, yaw=0.3), 1.2, 0.8, distance)
    assert not [warning for warning in segment([view]).warnings if "touch" in warning]
