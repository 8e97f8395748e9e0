"""Things of known shape about the object: hulls where they are, none where the object itself is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from graspd_core import Scene, TriangleMesh, load_scene, with_neighbours
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import make_shape
from graspd_core.types import Plane


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("shape:box")


def box(low, high) -> TriangleMesh:
    low, high = np.array(low), np.array(high)
    import trimesh

    solid = trimesh.creation.box(bounds=[low, high])
    return TriangleMesh(np.array(solid.vertices), np.array(solid.faces, dtype=np.int64))


def depth(found: Scene, *point: float) -> float:
    """How deep a point is in the obstacles [m]; below 0 outside."""
    at = torch.tensor([point], dtype=torch.float32)
    return max((-float(sample_sdf(o.sdf, at.to(o.sdf.field))[0]) for o in found.obstacles), default=-np.inf)


def about(scene: Scene, grown: float = 0.0, moved: float = 0.0) -> TriangleMesh:
    """The box about the object, larger and aside [m]."""
    vertices, aside = scene.object.mesh.vertices, np.array([moved, 0, 0])
    return box(vertices.min(0) - grown + aside, vertices.max(0) + grown + aside)


def test_a_thing_beside_the_object_is_an_obstacle_and_one_far_away_is_none(scene):
    beside, far = box([0.1, -0.1, -0.1], [0.2, 0.1, 0.1]), box([5.0, 5.0, 5.0], [6.0, 6.0, 6.0])
    found = with_neighbours(scene, {"wall": [beside], "shed": [far]})
    assert (len(found.obstacles), found.object.warnings) == (1, scene.object.warnings)
    assert depth(found, 0.15, 0.0, 0.0) > 0.03
    assert depth(found, 0.08, 0.0, 0.0) < 0


def test_of_a_large_thing_what_is_near_is_taken_inside_and_all(scene):
    bottom = float(scene.object.mesh.vertices[:, 2].min())
    found = with_neighbours(scene, {"block": [box([-4.0, -4.0, bottom - 3.0], [4.0, 4.0, bottom])]})
    (block,) = found.obstacles
    assert np.ptp(block.mesh.vertices, axis=0).max() < 1.0, "what the hand cannot come to is cut off"
    assert depth(found, 0.1, 0.1, bottom - 0.1) > 0.05
    assert depth(found, 0.0, 0.0, bottom + 0.02) < 0
    assert not found.object.warnings, "what the object stands on is not the object"


def test_the_object_as_a_planning_scene_holds_it_is_left_out_and_told(scene):
    for shape in (scene.object.mesh, about(scene), about(scene, grown=0.004), about(scene, moved=0.01)):
        found = with_neighbours(scene, {"the thing": [shape]})
        assert found.obstacles == ()
        assert found.object.warnings[-1].startswith("collision object 'the thing' fills the object's own place")


def test_what_touches_or_holds_the_object_is_not_the_object(scene):
    low, high = scene.object.mesh.vertices.min(0), scene.object.mesh.vertices.max(0)
    size = float((high - low)[0])
    touching = about(scene, moved=size)
    found = with_neighbours(scene, {"another": [touching]})
    assert (len(found.obstacles), found.object.warnings) == (1, ())
    t, low, high = 0.01, low - 0.03, high + 0.03
    walls = [box(low - t, [low[0], high[1], high[2]]), box([high[0], low[1], low[2] - t], high + t)]
    floor = box([low[0] - t, low[1] - t, low[2] - t], [high[0] + t, high[1] + t, low[2]])
    found = with_neighbours(scene, {"bin": [*walls, floor]})
    assert (len(found.obstacles), found.object.warnings) == (3, ())
    assert depth(found, *(0.5 * (low + high))) < -0.02, "the object's own place is free"


def test_a_tray_in_one_piece_leaves_the_object_s_place_free(scene):
    import trimesh

    low, high = scene.object.mesh.vertices.min(0), scene.object.mesh.vertices.max(0)
    centre, size = 0.5 * (low + high), high - low
    ring = trimesh.creation.annulus(r_min=float(size.max()), r_max=float(size.max()) + 0.01, height=float(size[2]))
    ring.apply_translation(centre)
    found = with_neighbours(scene, {"tray": [TriangleMesh(np.array(ring.vertices), np.array(ring.faces))]})
    assert len(found.obstacles) > 4
    assert found.object.warnings == ()
    assert depth(found, *centre) < 0
    assert depth(found, *(centre + np.array([size.max() + 0.005, 0, 0]))) > -1e-3


def test_what_does_not_rise_above_the_support_is_the_support():
    scene = load_scene("shape:box")
    bottom = float(scene.object.mesh.vertices[:, 2].min())
    stands = Scene(scene.object, scene.sdf, scene.timing, support=Plane(np.array([0.0, 0.0, 1.0]), bottom))
    table = box([-1.0, -1.0, bottom - 0.05], [1.0, 1.0, bottom + 0.002])
    assert with_neighbours(stands, {"table": [table]}).obstacles == ()
    assert len(with_neighbours(scene, {"table": [table]}).obstacles) == 1


def test_a_flat_or_open_shape_is_taken_as_far_as_it_goes(scene):
    sheet = TriangleMesh(np.array([[0.1, -0.2, -0.2], [0.1, 0.2, -0.2], [0.1, 0.0, 0.3]]), np.array([[0, 1, 2]]))
    assert depth(with_neighbours(scene, {"sheet": [sheet]}), 0.1, 0.0, 0.0) > 0
    mug = make_shape("mug")
    opened = TriangleMesh(mug.vertices + np.array([0.15, 0, 0]), mug.faces[: len(mug.faces) // 2])
    assert with_neighbours(scene, {"half a mug": [opened]}).obstacles


def test_a_scan_of_many_triangles_is_taken_as_its_hull_is(scene):
    """The hull of all of its corners would be 80,000 planes, held against thousands of points."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    ball.apply_translation([0.2, 0.0, 0.0])
    scan = TriangleMesh(np.array(ball.vertices), np.array(ball.faces, dtype=np.int64))
    found = with_neighbours(scene, {"ball": [scan]})
    (obstacle,) = found.obstacles
    assert len(obstacle.mesh.faces) < 20_000
    np.testing.assert_allclose(np.ptp(obstacle.mesh.vertices, axis=0), 0.21, atol=0.003)
