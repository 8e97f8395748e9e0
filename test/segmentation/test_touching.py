"""Two things that touch are told where a camera sees the seam between them; one thing is not told to be two."""

import re
from itertools import combinations_with_replacement

import numpy as np
import pytest

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import TabletopScene, ring_poses, tabletop, views_of
from graspd_core.mesh.shapes import SHAPES
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.segment.segment import segment
from graspd_core.perception.segment.target_selection import Target

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


def side_by_side(one: str, other: str) -> TabletopScene:
    """Two shapes that touch where both are widest along x."""
    widths = [tabletop(name).truth.vertices[:, 0] for name in (one, other)]
    return tabletop(one, obstacles=[(other, float(widths[0].max() - widths[1].min()), 0.0)])


@pytest.mark.slow
def test_most_that_touch_are_told_where_both_were_taken():
    told: dict[tuple[str, str], list[bool]] = {}
    for pair in combinations_with_replacement(("sphere", "cylinder", "bottle", "box"), 2):
        stage = side_by_side(*pair)
        border = stage.truth.vertices[:, 0].max()
        for azimuth in (-2.2, -1.5, -0.8):
            seen = segment([view_of(stage, azimuth)])
            beyond = np.mean(seen.views[0].points[:, 0] > border)
            if 0.1 < beyond < 0.9:
                told.setdefault(pair, []).append(any("2 things that touch" in doubt for doubt in seen.warnings))
    # Boxes that stand flush show neither seam nor waist.
    assert not any(told.pop(("box", "box")))
    assert len(told) == 9
    assert all(map(any, told.values())), told
    assert np.mean([each for views in told.values() for each in views]) > 0.8, told


@pytest.mark.parametrize("distance", [0.5, 1.0])
@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_one_thing_is_not_told_to_be_two(shape, distance):
    view = view_of(tabletop(shape, yaw=0.3), 1.2, 0.8, distance)
    assert not [warning for warning in segment([view]).warnings if "touch" in warning]
