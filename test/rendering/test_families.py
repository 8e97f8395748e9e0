"""Irregular things are closed, of a hand's size and heavy as such things are. Cameras err as their makers say."""

import numpy as np
import pytest

from graspd_bench.rendering.depth_noise import CAMERAS, add_noise
from graspd_bench.rendering.families import FAMILIES, OTHERS, draw_object
from graspd_bench.rendering.tabletop import crowded, moved, resting_pose
from graspd_core.errors import MeshError
from graspd_core.mesh.mesh_files import mass_properties, surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.mesh.topology import is_closed
from graspd_core.perception.scene import heavy_mass


@pytest.mark.parametrize("family", FAMILIES | OTHERS)
def test_things_are_closed_turned_outwards_and_of_a_hand_s_size(family: str):
    thing, other = draw_object(family, 100), draw_object(family, 101)
    assert is_closed(thing.mesh)
    a, b, c = thing.mesh.vertices[thing.mesh.faces].transpose(1, 0, 2)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    assert 0.05 < np.ptp(thing.mesh.vertices, axis=0).max() < 0.36
    assert 0.003 < thing.mass < 2.0 * heavy_mass(mass_properties(thing.mesh)[0])
    draw_object.cache_clear()
    assert np.array_equal(draw_object(family, 100).mesh.vertices, thing.mesh.vertices)
    assert abs(other.mass - thing.mass) > 1e-6


def test_an_unknown_family_is_named_with_the_valid_ones():
    with pytest.raises(MeshError, match="unknown family 'teapot'; valid: pear"):
        draw_object("teapot", 0)


@pytest.mark.parametrize("seed", range(4))
def test_what_rests_stands_on_what_lies_below_its_centre(seed: int):
    rng = np.random.default_rng(seed)
    mesh = draw_object("spray", seed).mesh
    resting = moved(mesh, resting_pose(mesh, rng))
    assert resting.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    from scipy.spatial import ConvexHull

    centre = mass_properties(resting)[1]
    foot = resting.vertices[resting.vertices[:, 2] < 0.002, :2]
    corners = foot[ConvexHull(foot).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    ways = centre[:2] - corners
    # Counter-clockwise: the centre is on the left of every edge, to within the millimetre that counts as foot.
    left = (edges[:, 0] * ways[:, 1] - edges[:, 1] * ways[:, 0]) / np.linalg.norm(edges, axis=1)
    assert left.min() > -0.003


def test_neighbours_stand_apart_and_near():
    rng = np.random.default_rng(3)
    target = moved(make_shape("mug"), resting_pose(make_shape("mug"), rng))
    others = crowded(target, [draw_object("pear", 1).mesh, make_shape("box")], rng)
    for other in others:
        gap = surface_distance(make_surface(target), surface_samples(other, 2000, 0)[0]).min()
        assert 0.015 < gap < 0.08
        assert other.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("name", "error"), [("d415", 1.8e-3), ("d435", 3.0e-3), ("time_of_flight", 2.0e-3)])
def test_a_flat_wall_is_as_rough_as_the_camera_s_error(name: str, error: float):
    camera = CAMERAS[name]
    wall = np.full((camera.lens.height, camera.lens.width), 0.8)
    seen = add_noise(wall, camera.lens, camera.noise, 0)
    assert np.std(seen[seen > 0]) == pytest.approx(error, rel=0.25)


def test_structured_light_tells_depth_in_eighths_of_a_pixel():
    camera = CAMERAS["structured_light"]
    wall = np.full((camera.lens.height, camera.lens.width), 0.8)
    seen = np.unique(add_noise(wall, camera.lens, camera.noise, 0))
    # dz = z² Δd / (f B), for disparities an eighth of a pixel apart.
    assert np.diff(seen[seen > 0]) == pytest.approx(0.8**2 * 0.125 / (575.0 * 0.075), rel=0.05)
