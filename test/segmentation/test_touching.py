"""Two things that touch are told where a camera sees the seam between them; one thing is not told to be two."""

import re
from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest
from expected import some

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import TabletopScene, moved, on_table, ring_poses, tabletop, views_of
from graspd_core import PinholeCamera, PointCloud, Target, TriangleMesh, scene_from_views
from graspd_core.config import SceneConfig, SegmentationConfig
from graspd_core.mesh.shapes import SHAPES, make_shape
from graspd_core.perception.segment.segment import find_things, segment
from graspd_core.types import Plane

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
    assert doubt.startswith("cloud: the object may be 2 objects that touch, with centres at (")
    said = np.array(re.findall(r"-?\d+\.\d+", doubt), dtype=float).reshape(2, 3)
    for mesh in (CYLINDER_BESIDE.truth, CYLINDER_BESIDE.obstacles[0]):
        assert np.linalg.norm(said - 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0)), axis=1).min() < 0.04
    # Who says what is meant is not asked.
    bounds = (CYLINDER_BESIDE.truth.vertices.min(0), CYLINDER_BESIDE.truth.vertices.max(0))
    assert segment([view], target=Target(box=bounds)).warnings == ()


@pytest.mark.parametrize("azimuth", [-2.2, -1.2, -0.9])
def test_a_target_on_one_side_of_the_seam_means_that_side(azimuth):
    view = view_of(CYLINDER_BESIDE, azimuth)
    border = CYLINDER_BESIDE.truth.vertices[:, 0].max()
    for mesh, side in ((CYLINDER_BESIDE.truth, -1.0), (CYLINDER_BESIDE.obstacles[0], 1.0)):
        # As pose estimators give it: the middle of the thing, which no camera sees.
        middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
        seen = segment([view], target=Target(point=middle))
        beyond = side * (seen.views[0].points[:, 0] - border)
        assert np.mean(beyond > -0.004) > 0.98
        assert len(seen.views[0].points) > 500
        # What is on the other side of the seam is in the way.
        assert any(np.mean(side * (thing[:, 0] - border) < 0.004) > 0.95 for thing in seen.obstacles)
        assert any("the target touches another object" in doubt for doubt in seen.warnings)
        box = (mesh.vertices.min(0) - 0.002, mesh.vertices.max(0) + 0.002)
        assert np.mean(side * (segment([view], target=Target(box=box)).views[0].points[:, 0] - border) > -0.006) > 0.97


def test_two_that_are_too_large_together_are_parted_by_the_target():
    stage = tabletop("hammer", obstacles=[("hammer", 0.0, 0.112), ("bottle", 0.11, 0.02)])
    view = view_of(stage, -1.2, 0.9, 0.7)
    seen = segment([view], target=Target(point=np.array([0.11, 0.02, 0.08])))
    assert np.abs(seen.views[0].points[:, :2] - [0.11, 0.02]).max() < 0.06


def side_by_side(one: str, other: str) -> TabletopScene:
    """Two shapes that touch where both are widest along x."""
    widths = [tabletop(name).truth.vertices[:, 0] for name in (one, other)]
    return tabletop(one, obstacles=[(other, float(widths[0].max() - widths[1].min()), 0.0)])


def middle_of(stage: TabletopScene) -> Target:
    return Target(point=0.5 * (stage.truth.vertices.min(0) + stage.truth.vertices.max(0)))


@pytest.mark.parametrize("azimuth", [-2.2, -1.5, -0.8])
def test_a_target_in_the_middle_of_one_of_two_that_stand_flush_is_doubted(azimuth):
    stage = side_by_side("box", "box")
    seen = segment([view_of(stage, azimuth)], target=middle_of(stage))
    assert np.mean(seen.views[0].points[:, 0] > stage.truth.vertices[:, 0].max()) > 0.2
    assert "from the middle of the segment" in seen.beside
    scene = scene_from_views([view_of(stage, azimuth)], target=middle_of(stage), resolution=16)
    assert some(scene.evidence).doubts == (seen.beside,)
    assert any("no grasp counts as verified" in warning for warning in scene.object.warnings)
    # A point on the surface may be anywhere on a thing.
    on_it = Target(point=seen.views[0].points[100])
    assert not segment([view_of(stage, azimuth)], target=on_it).beside


@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_a_target_in_the_middle_of_one_thing_is_not_doubted(shape):
    stage = tabletop(shape, yaw=0.3)
    assert not segment([view_of(stage, 1.2, 0.8)], target=middle_of(stage)).beside


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
                told.setdefault(pair, []).append(any("2 objects that touch" in doubt for doubt in seen.warnings))
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


def test_things_that_touch_are_found_apart_even_where_together_they_are_too_large_for_a_thing():
    view = view_of(CYLINDER_BESIDE, -1.2)
    meshes = (CYLINDER_BESIDE.truth, *CYLINDER_BESIDE.obstacles)
    middles = [0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0)) for mesh in meshes]
    # The two together are 0.16 m long, each of them less than 0.13 m.
    for most in (0.35, 0.14):
        found = find_things([view], SegmentationConfig(largest_object=most, piled=True))
        assert len(found) == 2
        nearest = [min(range(2), key=lambda k: np.linalg.norm(points.mean(0) - middles[k])) for points in found]
        assert sorted(nearest) == [0, 1]


def test_a_small_thing_of_a_heap_is_found_beside_large_ones():
    # The small ball has too few points for a part of all three, but not for a part of two.
    balls, end = list[TriangleMesh](), 0.0
    for radius in (0.05, 0.05, 0.02):
        ball = make_shape("sphere")
        scale = radius / ball.vertices[:, 0].max()
        balls.append(TriangleMesh(ball.vertices * scale + np.array([end + radius, 0.0, radius]), ball.faces))
        end += 2 * radius
    view = view_of(on_table(balls[0], balls[1:]), -1.5)
    found = find_things([view], SegmentationConfig(piled=True))
    for ball in balls:
        middle, radius = ball.vertices.mean(0), float(np.ptp(ball.vertices[:, 0])) / 2
        away = [np.linalg.norm(points - middle, axis=1) for points in found]
        assert sum(np.mean(distance < radius + 0.006) > 0.9 for distance in away) == 1
    # A hull about the two large balls would fill the gap between them.
    small = min(found, key=len)
    seen = segment([view], target=Target(point=small[0]), settings=SegmentationConfig(piled=True))
    assert sum(np.ptp(points[:, 0]) > 0.08 for points in seen.obstacles) == 2


def test_a_thing_that_stands_on_nothing_seen_is_a_thing_where_things_are_piled():
    up = np.eye(4)
    up[:3, 3] = 0.15, 0.0, 0.12
    view = view_of(on_table(tabletop("box").truth, [moved(make_shape("sphere"), up)]), -1.5, elevation=0.5)
    assert [len(find_things([view], SegmentationConfig(piled=piled))) for piled in (False, True)] == [1, 2]


def nine_balls() -> tuple[list[np.ndarray], PointCloud]:
    """The middles of nine balls that touch in a square, and a view of them from above."""
    ball = make_shape("sphere")
    scale = 0.03 / ball.vertices[:, 0].max()
    middles = [np.array([0.06 * x, 0.06 * y, 0.03]) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    balls = [TriangleMesh(ball.vertices * scale + middle, ball.faces) for middle in middles]
    return middles, view_of(on_table(balls[0], balls[1:]), -1.5, elevation=1.2)


def test_many_things_of_a_heap_are_found_though_each_is_a_small_part_of_it():
    # Each of the nine balls has a ninth of the heap's points.
    middles, view = nine_balls()
    found = find_things([view], SegmentationConfig(piled=True))
    assert len(found) == 9
    nearest = [min(range(9), key=lambda k: np.linalg.norm(points.mean(0) - middles[k])) for points in found]
    assert sorted(nearest) == list(range(9))


def test_a_known_floor_is_the_support_where_the_views_show_too_little_of_it():
    middles, view = nine_balls()
    # As in a bin: the floor is seen between the balls only.
    inside = (view.points[:, 2] > 0.008) | (np.abs(view.points[:, :2]) < 0.04).all(1)
    full = PointCloud(view.points[inside], view.viewpoint)
    floor, piled = Plane(np.array([0.0, 0.0, 1.0]), 0.0), SceneConfig(segmentation=SegmentationConfig(piled=True))
    assert segment([full], target=Target(point=middles[4]), settings=piled.segmentation).support is None
    found = find_things([full], piled.segmentation, floor)
    assert len(found) == 9
    assert min(points[:, 2].min() for points in found) > 0.004
    scene = scene_from_views([full], target=Target(point=middles[4]), settings=piled, surface=floor)
    assert some(scene.support).offset == 0.0
    np.testing.assert_allclose(scene.object.mesh.vertices[:, 2].min(), 0.0, atol=0.004)
    # The floor that a camera sees is known better.
    near = replace(floor, offset=0.003)
    assert some(segment([view], target=Target(point=middles[4]), surface=near).support).offset < 0.002


@pytest.mark.parametrize("height", [0.0, 0.12])
def test_one_that_may_lie_on_what_is_hidden_is_doubted_where_things_are_piled(height):
    up, sphere = np.eye(4), make_shape("sphere")
    up[:3, 3] = 0.15, 0.0, height - sphere.vertices[:, 2].min()
    thing = moved(sphere, up)
    view = view_of(on_table(tabletop("box").truth, [thing]), -1.5, elevation=0.5)
    piled = SceneConfig(segmentation=SegmentationConfig(piled=True))
    scene = scene_from_views([view], target=Target(point=thing.vertices.mean(0)), settings=piled)
    told = [doubt for doubt in some(scene.evidence).doubts if "may lie on others" in doubt]
    assert len(told) == (height > 0)


def test_one_that_lies_on_another_is_a_thing_where_things_are_piled():
    # A ball on a box: it does not come down to the table.
    stage = tabletop("box")
    top = stage.truth.vertices[:, 2].max()
    ball = moved(make_shape("sphere"), np.eye(4))
    up = np.eye(4)
    up[2, 3] = top - ball.vertices[:, 2].min()
    view = view_of(on_table(stage.truth, [moved(ball, up)]), -1.0, elevation=0.5)
    assert len(find_things([view])) == 1
    found = find_things([view], SegmentationConfig(piled=True))
    assert len(found) == 2
    assert max(points[:, 2].min() for points in found) > 0.5 * top
    # Without a floor, as in a full bin, the seam is found too.
    bare = PointCloud(view.points[view.points[:, 2] > 0.01], view.viewpoint)
    assert len(find_things([bare], SegmentationConfig(piled=True))) == 2
    assert len(find_things([bare])) == 1
    # The seam may also be one within an object, as between a drill and its handle, so the part is doubted.
    point = max(found, key=lambda points: points[:, 2].min()).mean(0)
    seen = segment([view], target=Target(point=point), settings=SegmentationConfig(piled=True))
    assert "both may be one object" in seen.beside
    alone = view_of(tabletop("box"), -1.0, elevation=0.5)
    assert not segment([alone], target=middle_of(tabletop("box")), settings=SegmentationConfig(piled=True)).beside


def test_a_part_that_a_nearer_one_hides_is_doubted_where_things_are_piled():
    # The cylinder stands 3 cm from the box. Seen over the cylinder, the box may continue behind it.
    stage = tabletop("box", obstacles=[("cylinder", 0.1, 0.0)])
    told = {}
    for azimuth in (0.0, np.pi / 2, np.pi):
        view = view_of(stage, azimuth, elevation=0.5)
        targets = [Target(point=mesh.vertices.mean(0)) for mesh in (stage.truth, *stage.obstacles)]
        told[azimuth] = [segment([view], target=one, settings=SegmentationConfig(piled=True)).beside for one in targets]
        assert not any(segment([view], target=one).beside for one in targets)
    hides = "a nearer object hides a part of the target"
    assert list(told.values()) == [[hides, ""], ["", ""], ["", hides]]
    # A second camera that does not show the box clears no doubt. One that sees the box unhidden does.
    hidden, free = (view_of(stage, azimuth, elevation=0.5) for azimuth in (0.0, np.pi))
    box, piled = Target(point=stage.truth.vertices.mean(0)), SegmentationConfig(piled=True)
    away = np.linalg.norm(free.points - stage.truth.vertices.mean(0), axis=1) > 0.2
    blind = PointCloud(free.points[away], free.viewpoint)
    assert segment([hidden, blind], target=box, settings=piled).beside == hides
    assert segment([hidden, free], target=box, settings=piled).beside == ""
