"""Pieces of one thing are joined, and things that hide each other in part are not."""

import numpy as np
import pytest

from graspd_bench.rendering.depth_noise import LEVELS, NONE, DepthNoise
from graspd_bench.rendering.tabletop import CAMERA, TabletopScene, ring_poses, tabletop, views_of
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.segment.segment import Segmentation, segment
from graspd_core.perception.segment.target_selection import Target


def seen(scene: TabletopScene, elevation: float, turn: float = 0.0, noise: DepthNoise = NONE) -> PointCloud:
    (view,) = views_of(scene, CAMERA, ring_poses(1, elevation=elevation, azimuth=turn), noise)
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
