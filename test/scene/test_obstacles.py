"""What stands about the object, seen or known: hulls that hold it and leave the object room; and the grid of trust."""

import numpy as np
import pytest
import torch
import trimesh
from expected import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from made_meshes import box_between, taken

from graspd_core import Scene, TriangleMesh, load_scene, make_shape, with_neighbours
from graspd_core.config import ObstacleConfig
from graspd_core.errors import ConfigError, MeshError
from graspd_core.mesh.mesh_files import mass_properties
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.perception.obstacles import make_obstacles, padded_hull
from graspd_core.perception.scene import build_scene, sample_confidence
from graspd_core.types import Plane

TARGET = make_shape("box")
PADDING = ObstacleConfig().padding
TABLE = Plane(np.array([0.0, 0.0, 1.0]), -0.045)


def face(x: float, low: float) -> np.ndarray:
    """A seen face 100 mm wide and 100 mm high, across x, from a height on [m]."""
    y, z = np.meshgrid(np.linspace(-0.05, 0.05, 15), np.linspace(low, low + 0.1, 15))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def test_a_face_is_carried_down_to_the_table_and_stays_thin():
    (neighbour,) = make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.3)
    low, high = neighbour.mesh.vertices.min(0), neighbour.mesh.vertices.max(0)
    # The skin reaches as far along every axis.
    assert low == pytest.approx([0.15 - PADDING, -0.05 - PADDING, -0.045 - PADDING])
    assert high == pytest.approx([0.15 + PADDING, 0.05 + PADDING, 0.1 + PADDING])
    floating = padded_hull(face(0.15, 0.0), None, PADDING)
    assert floating.vertices[:, 2].min() == pytest.approx(-PADDING)


def test_the_distance_is_that_of_the_hull():
    (neighbour,) = make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.3)
    x = torch.tensor([[0.15, 0.0, 0.05], [0.15, 0.0, -0.02], [0.1, 0.0, 0.05], [0.2, 0.0, 0.05]])
    distance = sample_sdf(neighbour.sdf, x)[0].numpy()
    # Outside the grid is exact but for the blur of its cells; a slab of 10 mm between cells of 6 mm is less deep in it.
    assert distance[2:] == pytest.approx([0.045, 0.045], abs=5e-4)
    assert (distance[:2] >= -0.005).all()
    assert (distance[:2] < -0.001).all()


def test_things_out_of_reach_and_specks_are_left_out():
    # The box's side is at 30 mm.
    assert len(make_obstacles([face(0.15, 0.0), face(0.35, 0.0)], TABLE, TARGET, 0.2)) == 1
    assert make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.119) == ()
    assert len(make_obstacles([face(0.15, 0.0)], TABLE, TARGET, 0.125)) == 1
    holes = np.full((400, 3), np.nan)
    holes[:9] = face(0.15, 0.0)[:9]
    assert make_obstacles([holes, np.zeros((0, 3))], TABLE, TARGET, 1.0) == ()
    assert make_obstacles([], None, TARGET, 1.0) == ()


@pytest.mark.parametrize("support", [TABLE, None])
def test_a_tray_about_the_object_leaves_it_room(support):
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 120), (-0.04, -0.02, 0.0))
    ring = np.column_stack([0.12 * np.cos(turn.ravel()), 0.12 * np.sin(turn.ravel()), height.ravel()])
    found = make_obstacles([ring], support, TARGET, 0.3)
    distance = np.stack([sample_sdf(n.sdf, torch.as_tensor(TARGET.vertices).float())[0].numpy() for n in found])
    assert distance.min() > 0.02
    # Each of its points is still in the way.
    held = np.stack([sample_sdf(n.sdf, torch.as_tensor(ring).float())[0].numpy() for n in found])
    assert held.min(0).max() < 0


@settings(max_examples=15)
@given(seed=st.integers(0, 2**31), flat=st.booleans())
def test_every_seen_point_and_its_shadow_lie_within(seed: int, flat: bool):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    points = rng.normal(size=(40, 3)) * 0.05
    if flat:
        points[:, 0] = 0.1
    support = Plane(normal, float((points @ normal).min()) - 0.03)
    hull = padded_hull(points, support, PADDING)
    a, b, c = hull.vertices[hull.faces].transpose(1, 0, 2)
    outward = np.cross(b - a, c - a)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    shadows = points - (points @ normal - support.offset)[:, None] * normal
    depth = ((a[None] - np.vstack([points, shadows])[:, None]) * outward).sum(-1).min(1)
    # The skin is an octahedron, thinnest across its faces.
    assert depth.min() >= PADDING / np.sqrt(3) - 1e-9
    assert mass_properties(hull)[0] > 0


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("shape:box", mass=0.1)


def depth(found: Scene, *point: float) -> float:
    """How deep a point is in the obstacles [m]; below 0 outside."""
    at = torch.tensor([point], dtype=torch.float32)
    return max((-float(sample_sdf(o.sdf, at.to(o.sdf.field))[0]) for o in found.obstacles), default=-np.inf)


def about(scene: Scene, grown: float = 0.0, moved: float = 0.0) -> TriangleMesh:
    """The box about the object, larger and aside [m]."""
    vertices, aside = scene.object.mesh.vertices, np.array([moved, 0, 0])
    return box_between(vertices.min(0) - grown + aside, vertices.max(0) + grown + aside)


def test_a_thing_beside_the_object_is_an_obstacle_and_one_far_away_is_none(scene):
    beside, far = box_between([0.1, -0.1, -0.1], [0.2, 0.1, 0.1]), box_between([5.0, 5.0, 5.0], [6.0, 6.0, 6.0])
    found = with_neighbours(scene, {"wall": [beside], "shed": [far]})
    assert (len(found.obstacles), found.object.warnings) == (1, scene.object.warnings)
    assert depth(found, 0.15, 0.0, 0.0) > 0.03
    assert depth(found, 0.08, 0.0, 0.0) < 0


def test_of_a_large_thing_what_is_near_is_taken_inside_and_all(scene):
    bottom = float(scene.object.mesh.vertices[:, 2].min())
    found = with_neighbours(scene, {"block": [box_between([-4.0, -4.0, bottom - 3.0], [4.0, 4.0, bottom])]})
    (block,) = found.obstacles
    assert np.ptp(block.mesh.vertices, axis=0).max() < 1.0, "what the hand cannot come to is cut off"
    assert depth(found, 0.1, 0.1, bottom - 0.1) > 0.05
    assert depth(found, 0.0, 0.0, bottom + 0.02) < 0
    assert not found.object.warnings, "what the object stands on is not the object"


def test_the_object_as_a_planning_scene_holds_it_is_left_out_and_told(scene):
    for shape in (scene.object.mesh, about(scene), about(scene, grown=0.004), about(scene, moved=0.01)):
        found = with_neighbours(scene, {"the thing": [shape]})
        assert found.obstacles == ()
        assert found.object.warnings[-1].startswith("collision object 'the thing' fills the place of the object")


def test_what_touches_or_holds_the_object_is_not_the_object(scene):
    low, high = scene.object.mesh.vertices.min(0), scene.object.mesh.vertices.max(0)
    size = float((high - low)[0])
    touching = about(scene, moved=size)
    found = with_neighbours(scene, {"another": [touching]})
    assert (len(found.obstacles), found.object.warnings) == (1, ())
    t, low, high = 0.01, low - 0.03, high + 0.03
    walls = [box_between(low - t, [low[0], high[1], high[2]]), box_between([high[0], low[1], low[2] - t], high + t)]
    floor = box_between([low[0] - t, low[1] - t, low[2] - t], [high[0] + t, high[1] + t, low[2]])
    found = with_neighbours(scene, {"bin": [*walls, floor]})
    assert (len(found.obstacles), found.object.warnings) == (3, ())
    assert depth(found, *(0.5 * (low + high))) < -0.02, "the object's own place is free"


def test_a_ring_about_the_middle_of_a_bar_leaves_the_bar_room():
    bar = box_between((-0.02, -0.02, -0.6), (0.02, 0.02, 0.6))
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(-0.05, 0.05, 12))
    ring = np.column_stack([0.12 * np.cos(turn.ravel()), 0.12 * np.sin(turn.ravel()), height.ravel()])
    inside = [sample_sdf(n.sdf, torch.zeros(1, 3))[0].item() for n in make_obstacles([ring], None, bar, 0.3)]
    assert min(inside) > 0.05


def test_a_tray_in_one_piece_leaves_the_object_s_place_free(scene):
    low, high = scene.object.mesh.vertices.min(0), scene.object.mesh.vertices.max(0)
    centre, size = 0.5 * (low + high), high - low
    ring = trimesh.creation.annulus(r_min=float(size.max()), r_max=float(size.max()) + 0.01, height=float(size[2]))
    ring.apply_translation(centre)
    found = with_neighbours(scene, {"tray": [taken(ring)]})
    assert len(found.obstacles) > 4
    assert found.object.warnings == ()
    assert depth(found, *centre) < 0
    assert depth(found, *(centre + np.array([size.max() + 0.005, 0, 0]))) > -1e-3


def test_what_does_not_rise_above_the_support_is_the_support(scene):
    bottom = float(scene.object.mesh.vertices[:, 2].min())
    stands = Scene(scene.object, scene.sdf, scene.timing, support=Plane(np.array([0.0, 0.0, 1.0]), bottom))
    table = box_between([-1.0, -1.0, bottom - 0.05], [1.0, 1.0, bottom + 0.002])
    assert with_neighbours(stands, {"table": [table]}).obstacles == ()
    assert len(with_neighbours(scene, {"table": [table]}).obstacles) == 1


@pytest.mark.parametrize(("shape", "deep"), [("table", 0.008), ("table", 0.012), ("board", 0.018), ("cube", 0.03)])
def test_a_shape_that_reaches_deep_into_the_object_is_refused(scene, shape: str, deep: float):
    low, high = scene.object.mesh.vertices.min(0), scene.object.mesh.vertices.max(0)
    middle = 0.5 * (low + high)
    solid = {
        "table": box_between([-1.0, -1.0, low[2] - 0.1], [1.0, 1.0, low[2] + deep]),
        "board": box_between([-0.3, -0.3, middle[2]], [0.3, 0.3, middle[2] + deep]),
        "cube": box_between(middle - deep / 2, middle + deep / 2),
    }[shape]
    if deep < 0.01:
        assert with_neighbours(scene, {shape: [solid]}).obstacles
        return
    with refused(ConfigError, f"collision object '{shape}' reaches", "valid: at most 10 mm"):
        with_neighbours(scene, {shape: [solid]})


def test_a_bin_of_single_walls_has_no_inside(scene):
    low, high = scene.object.mesh.vertices.min(0) - 0.03, scene.object.mesh.vertices.max(0) + 0.03
    box = box_between(low, high)
    lid = (box.vertices[box.faces][..., 2] > high[2] - 1e-9).all(1)
    assert lid.sum() == 2
    assert with_neighbours(scene, {"bin": [TriangleMesh(box.vertices, box.faces[~lid])]}).obstacles


def test_an_object_that_its_support_cuts_is_refused_and_one_in_the_air_is_told(scene):
    bottom, up = float(scene.object.mesh.vertices[:, 2].min()), np.array([0.0, 0.0, 1.0])
    assert build_scene(scene.object.mesh, support=Plane(up, bottom + 0.009)).object.warnings[1:] == ()
    with refused(ConfigError, "the object reaches 20 mm below its support plane; valid: at most 10 mm"):
        build_scene(scene.object.mesh, support=Plane(up, bottom + 0.02))
    above = build_scene(scene.object.mesh, support=Plane(up, bottom - 0.3))
    assert above.object.warnings[-1].endswith("the object is 30 cm above its support plane")


def test_a_flat_or_open_shape_is_taken_as_far_as_it_goes(scene):
    sheet = TriangleMesh(np.array([[0.1, -0.2, -0.2], [0.1, 0.2, -0.2], [0.1, 0.0, 0.3]]), np.array([[0, 1, 2]]))
    assert depth(with_neighbours(scene, {"sheet": [sheet]}), 0.1, 0.0, 0.0) > 0
    mug = make_shape("mug")
    opened = TriangleMesh(mug.vertices + np.array([0.15, 0, 0]), mug.faces[: len(mug.faces) // 2])
    assert with_neighbours(scene, {"half a mug": [opened]}).obstacles


def test_a_scan_of_many_triangles_is_taken_as_its_hull_is(scene):
    """The hull of all of its corners would be 80,000 planes, held against thousands of points."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    ball.apply_translation([0.2, 0.0, 0.0])
    found = with_neighbours(scene, {"ball": [taken(ball)]})
    (obstacle,) = found.obstacles
    assert len(obstacle.mesh.faces) < 20_000
    np.testing.assert_allclose(np.ptp(obstacle.mesh.vertices, axis=0), 0.21, atol=0.003)


SPHERE = make_shape("sphere")


def test_trust_is_that_of_the_nearest_surface():
    seen = (SPHERE.vertices[:, 0] > 0).astype(float)
    table = Plane(np.array([0.0, 0.0, 1.0]), -0.035)
    scene = build_scene(SPHERE, confidence=seen, support=table, resolution=24)
    assert scene.support is table
    assert scene.confidence is not None
    assert scene.confidence.shape == scene.sdf.field.shape[1:]
    assert set(scene.confidence.unique().tolist()) == {0.0, 1.0}
    x = torch.tensor([[[0.035, 0.0, 0.0], [-0.035, 0.01, 0.0], [0.5, 0.0, 0.0], [-0.5, 0.0, 0.1]]])
    assert sample_confidence(scene.confidence, scene.sdf, x).tolist() == [[1.0, 0.0, 1.0, 0.0]]
    # It rises from one to the other within two cells about the border, to the rounding of float32.
    cell = float(scene.sdf.spacing)
    border = torch.stack([torch.linspace(-cell, cell, 21), torch.full((21,), 0.035), torch.zeros(21)], -1)[None]
    values = sample_confidence(scene.confidence, scene.sdf, border)[0]
    assert (values.diff() >= -1e-6).all()
    assert values[0] < values[-1]


def test_a_scene_without_trust_has_no_grid():
    scene = build_scene(SPHERE, resolution=16)
    assert (scene.confidence, scene.support, scene.obstacles) == (None, None, ())


def test_one_trust_for_every_vertex():
    with pytest.raises(MeshError, match=r"3 values of confidence for \d+ vertices"):
        build_scene(SPHERE, source="half a ball", confidence=np.ones(3))
