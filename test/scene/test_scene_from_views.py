"""From what a camera saw of a crowded table to a scene."""

import numpy as np
import pytest

from graspd_bench.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.perception.cloud.free_space import FreeSpace, empty_depth, make_view_depths
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.load_scene import scene_from_views
from graspd_core.perception.reconstruct.reconstruct import reconstruct
from graspd_core.perception.segment.segment import segment
from graspd_core.perception.segment.target_selection import Target

# A box that hides the lower part of a ball from the camera.
CROWDED = tabletop("sphere", obstacles=(("box", 0.115, 0.02),))
VIEWS = views_of(CROWDED, CAMERA, ring_poses(1, elevation=np.deg2rad(40.0), azimuth=np.deg2rad(10.0)))
TARGET = Target(point=np.array([0.0, 0.0, 0.035]))


def test_what_something_hides_may_be_there():
    seen = segment(VIEWS, target=TARGET)
    whole = reconstruct(seen.views, seen.support, whole=VIEWS)
    truth = CROWDED.truth.vertices
    assert seen.views[0].points[:, 2].min() > 0.015
    assert whole.mesh.vertices.min(0) == pytest.approx(truth.min(0), abs=0.006)
    assert whole.mesh.vertices.max(0) == pytest.approx(truth.max(0), abs=0.006)
    points, _ = surface_samples(CROWDED.truth, 4000, 0)
    knowing, blind = (FreeSpace(make_view_depths(seen.views, around), True) for around in (VIEWS, ()))
    assert (empty_depth(knowing, points) > 0.005).mean() < 0.01
    assert (empty_depth(blind, points) > 0.005).mean() > 0.1, "what is hidden counted as empty"


def test_a_scene_knows_what_its_views_hide():
    scene = scene_from_views(VIEWS, target=TARGET)
    assert scene.object.mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=0.006)
    assert len(scene.obstacles) == 1


def test_before_an_occluder_it_is_empty_and_behind_it_nobody_knows():
    """A wall a metre away, and a strip that hides its right half, half a metre away."""
    ticks = np.linspace(-0.1, 0.1, 80)
    x, y = (axis.ravel() for axis in np.meshgrid(ticks, ticks))
    wall = np.column_stack([x, y, np.ones_like(x)])[x < 0]
    strip = np.column_stack([0.5 * x, 0.5 * y, np.full_like(x, 0.5)])[x > 0]
    eye = np.zeros(3)
    alone, whole = PointCloud(wall, eye), PointCloud(np.concatenate([wall, strip]), eye)
    (depth,) = make_view_depths([alone], [whole])
    hidden, before = np.array([[0.05, 0.0, 1.0], [0.05, 0.0, 0.8]]), np.array([[0.02, 0.0, 0.4]])
    known = FreeSpace((depth,), standing=False)
    assert empty_depth(known, hidden) == pytest.approx(0.0)
    assert empty_depth(known, before)[0] == pytest.approx(0.1, abs=0.01)
    assert (empty_depth(FreeSpace(make_view_depths([alone]), standing=False), hidden) > 0.03).all()
