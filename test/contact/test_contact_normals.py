"""Contacts of results lie on the mesh, and their normals are the surface's: of a face, or between those of an edge."""

import numpy as np
import pytest
import trimesh
from scipy.optimize import nnls

from graspd_core import TriangleMesh, load_hand, load_scene, make_shape, plan_grasps
from graspd_core.mesh.surface_queries import Surface, make_surface, pressed_points


def off_cone(surface: Surface, point: np.ndarray, normal: np.ndarray, about: float) -> float:
    """Angle between a normal and the nearest one that faces within `about` [m] of a point have between them [deg]."""
    corners = surface.mesh.vertices[surface.mesh.faces]
    nearest = trimesh.triangles.closest_point(corners, np.repeat(point[None], len(corners), 0))
    near = np.linalg.norm(nearest - point, axis=1) < about
    between = surface.normals[near].T
    found = between @ nnls(between, normal)[0]
    return float(np.degrees(np.arccos(np.clip(found @ normal / max(np.linalg.norm(found), 1e-12), -1, 1))))


def tilted(normals: np.ndarray, angle: float, seed: int = 0) -> np.ndarray:
    """Normals turned by an angle [deg] to random sides, as a coarse grid has them."""
    side = np.cross(normals, np.random.default_rng(seed).normal(size=normals.shape))
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    return np.cos(np.radians(angle)) * normals + np.sin(np.radians(angle)) * side


def test_on_a_cylinder_normals_are_radial():
    """Of a wall of 64 flat sides none is more than 2.8 degrees off. Within 0.3 mm of the next side that one counts."""
    solid = trimesh.creation.cylinder(radius=0.03, height=0.1, sections=64)
    surface = make_surface(TriangleMesh(np.asarray(solid.vertices), np.asarray(solid.faces)))
    angle = np.linspace(0, 6, 40)
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(40)], 1)
    points = 0.0305 * radial + np.linspace(-0.04, 0.04, 40)[:, None] * [0, 0, 1]
    places, normals = pressed_points(surface, points, tilted(radial, 30))
    assert np.allclose(np.linalg.norm(places[:, :2], axis=1), 0.03, atol=4e-5)
    assert (np.degrees(np.arccos((normals * radial).sum(1).clip(-1, 1))) < 3.5).all()


def test_on_a_bowls_rim_normals_are_those_of_the_rim():
    """Pressed straight down, and from aside: never a direction that no face of the rim has, nor one into the wall."""
    mesh = make_shape("bowl")
    surface, top = make_surface(mesh), mesh.vertices[:, 2].max()
    rim = mesh.vertices[mesh.vertices[:, 2] > top - 1e-6][::3]
    up = np.repeat([[0.0, 0.0, 1.0]], len(rim), 0)
    for wanted in (up, tilted(up, 30)):
        places, normals = pressed_points(surface, rim + 2e-4 * up, wanted)
        assert np.allclose(places, rim, atol=4e-4)
        off = [off_cone(surface, place, normal, 6e-4) for place, normal in zip(places, normals, strict=True)]
        assert max(off) < 0.1
    # The rim is highest there: straight up is one of its normals.
    assert (pressed_points(surface, rim + 2e-4 * up, up)[1][:, 2] > np.cos(np.radians(15))).all()


def test_between_the_faces_of_an_edge_a_normal_stays_and_beyond_them_it_is_a_faces():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    surface = make_surface(TriangleMesh(np.asarray(box.vertices), np.asarray(box.faces)))
    edge = np.array([[0.05, 0.01, 0.05]] * 3)
    between = np.array([[0.6, 0.0, 0.8], [-0.5, 0.0, np.sqrt(0.75)], [0.0, 0.6, 0.8]])
    found = pressed_points(surface, edge, between)[1]
    assert np.allclose(found, [[0.6, 0, 0.8], [0, 0, 1], [0, 0, 1]], atol=1e-9)
    # A grid's normal that points into the solid says nothing.
    assert np.allclose(pressed_points(surface, np.array([[0.0, 0.0, 0.051]]), -up_only())[1], up_only())


def up_only() -> np.ndarray:
    return np.array([[0.0, 0.0, 1.0]])


@pytest.mark.parametrize("shape", ["shape:mug", "shape:cylinder"])
def test_contacts_of_a_result_are_the_meshs(shape: str):
    """A third of a mug's were more than ten degrees off, and up to 0.6 mm beside the surface."""
    scene = load_scene(shape)
    found = plan_grasps(scene, load_hand("allegro_right"), count=4, preset="fast", verify="none", measure=False)
    contacts = [contact for grasp in found.tried for contact in grasp.contacts]
    surface = make_surface(scene.object.mesh)
    points, normals = (np.array([getattr(c, key) for c in contacts]) for key in ("position", "normal"))
    assert np.allclose(pressed_points(surface, points, normals)[0], points, atol=1e-6)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    off = [off_cone(surface, point, normal, 6e-4) for point, normal in zip(points, normals, strict=True)]
    assert max(off) < 0.5
