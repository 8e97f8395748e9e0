"""Meshes and clouds that no scanner and no modeller would make: a scene of finite numbers, or one clear error."""

from __future__ import annotations

import os
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.errors import CloudError, MeshError
from graspd_core.mesh.mesh_files import check_mesh
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.load_scene import load_scene, scene_from_views
from graspd_core.perception.scene import Scene
from graspd_core.types import TriangleMesh

# GRASPD_FUZZ=50 tries fifty times as many examples, others each time; without it they are the same on every machine.
LONGER = int(os.environ.get("GRASPD_FUZZ", "1"))


@pytest.fixture(autouse=True, scope="module")
def forgetful() -> Iterator[None]:
    """Nothing is kept on disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GRASPD_CACHE", "off")
        yield


# Lengths as objects have them, on a coarse lattice so that corners coincide and faces lie in one plane, and wild ones.
lengths = st.one_of(st.integers(-4, 4).map(lambda n: n * 0.01), st.floats(-0.1, 0.1))
wild = st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 1e9, 50.0, 1e-300, 5e-324])


@st.composite
def meshes(draw: st.DrawFn) -> TriangleMesh:
    """Triangles at random among few corners, or a shape with corners and faces changed."""
    if draw(st.booleans()):
        count = draw(st.integers(0, 10))
        vertices = np.array(draw(st.lists(st.tuples(lengths, lengths, lengths), min_size=count, max_size=count)))
        index = st.integers(0, max(count - 1, 0))
        faces = np.array(draw(st.lists(st.tuples(index, index, index), max_size=20)), dtype=np.int64)
    else:
        shape = make_shape(draw(st.sampled_from(["box", "l_block", "plate"])))
        vertices, faces = shape.vertices.copy(), shape.faces.copy()
        for _ in range(draw(st.integers(0, 3))):
            a, b = draw(st.integers(0, len(faces) - 1)), draw(st.integers(0, len(faces) - 1))
            action = draw(st.sampled_from(["flip", "drop", "repeat", "join", "move"]))
            if action == "flip":
                faces[a] = faces[a, ::-1]
            elif action == "drop" and len(faces) > 2:
                faces = np.delete(faces, a, axis=0)
            elif action == "repeat":
                faces = np.concatenate([faces, faces[[b]]])
            elif action == "join":
                faces[a, 0] = faces[b, 1]
            else:
                vertices[faces[a, 0]] += [draw(lengths), draw(lengths), draw(lengths)]
        if draw(st.booleans()):
            vertices = np.concatenate([vertices, vertices[:3]])
    vertices, faces = vertices.reshape(-1, 3).astype(float), faces.reshape(-1, 3)
    for _ in range(draw(st.sampled_from([0, 0, 0, 1, 2]))):
        if len(vertices) and draw(st.booleans()):
            vertices[draw(st.integers(0, len(vertices) - 1)), draw(st.integers(0, 2))] = draw(wild)
        elif len(faces):
            faces[draw(st.integers(0, len(faces) - 1)), 0] = draw(st.sampled_from([-1, 10**6, 2**62]))
    return TriangleMesh(vertices, faces)


def assert_finite(scene: Scene) -> None:
    """Mass, centre, distances and normals are numbers, and normals have length one."""
    target = scene.object
    assert np.isfinite([target.volume, target.mass, target.radius, *target.center_of_mass, *target.inertia.flat]).all()
    assert target.volume > 0
    assert scene.sdf.field.isfinite().all()
    low, high = target.mesh.vertices.min(0), target.mesh.vertices.max(0)
    points = np.random.default_rng(0).uniform(low - 0.05, high + 0.05, (64, 3))
    distance, normal = sample_sdf(scene.sdf, scene.sdf.origin.new_tensor(points))
    assert distance.isfinite().all()
    assert normal.norm(dim=-1).numpy() == pytest.approx(1.0, abs=1e-3)


@settings(max_examples=80 * LONGER, derandomize=LONGER == 1)
@given(mesh=meshes())
def test_a_mesh_is_cleaned_or_refused_by_name(fuzz: ModuleType, mesh: TriangleMesh) -> None:
    made, refusal = fuzz.outcome(lambda: check_mesh(mesh, "thing.obj"), MeshError)
    if refusal is not None:
        assert refusal.startswith("thing.obj: ")
        return
    clean, warnings = made
    assert np.isfinite(clean.vertices).all()
    assert 0 <= clean.faces.min() <= clean.faces.max() < len(clean.vertices)
    assert all(text.startswith("thing.obj: ") for text in warnings)
    again, _ = check_mesh(clean, "thing.obj")
    assert len(again.faces) == len(clean.faces)


@settings(max_examples=10 * LONGER, derandomize=LONGER == 1)
@given(mesh=meshes())
def test_a_mesh_makes_a_scene_of_finite_numbers_or_is_refused(fuzz: ModuleType, mesh: TriangleMesh) -> None:
    scene, refusal = fuzz.outcome(lambda: load_scene(mesh, resolution=12), MeshError)
    if refusal is None:
        assert_finite(scene)


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    """Few points, a plane, a line, one point many times, a bump on a plane; some of them spoilt."""
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    count = draw(st.sampled_from([0, 1, 3, 10, 300]))
    kind = draw(st.sampled_from(["noise", "plane", "line", "point", "bump"]))
    points = rng.uniform(-0.05, 0.05, (count, 3))
    points[:, 2] += 0.5
    if kind in ("plane", "bump"):
        points[:, 2] = 0.5 - 0.03 * (kind == "bump") * (np.linalg.norm(points[:, :2], axis=1) < 0.02)
    elif kind == "line":
        points[:, :2] = points[:, [2]] * 0.1
    elif kind == "point":
        points[:] = [0, 0, 0.5]
    if count and draw(st.booleans()):
        points[rng.random(count) < draw(st.sampled_from([0.1, 1.0])), draw(st.integers(0, 2))] = draw(wild)
    return PointCloud(points, np.zeros(3), draw(st.sampled_from([None, np.array([0.0, 0.0, 1.0])])))


@settings(max_examples=8 * LONGER, derandomize=LONGER == 1)
@given(views=st.lists(clouds(), min_size=0, max_size=2), alone=st.booleans())
def test_views_make_a_scene_of_finite_numbers_or_are_refused(
    fuzz: ModuleType, views: list[PointCloud], alone: bool
) -> None:
    scene, refusal = fuzz.outcome(
        lambda: scene_from_views(views, alone=alone, source="views", resolution=12), CloudError, MeshError
    )
    if refusal is None:
        assert_finite(scene)
