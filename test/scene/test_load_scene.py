"""Scenes from every kind of source."""

import dataclasses

import numpy as np
import pytest
import torch

from graspd_core.errors import CloudError, MeshError
from graspd_core.mesh.mesh_files import save_mesh, surface_samples
from graspd_core.mesh.shapes import make_shape, shape_volume
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.load_scene import load_scene, scene_from_views


def test_file_scale_and_value_agree(tmp_path):
    box = make_shape("box")
    millimetres = dataclasses.replace(box, vertices=box.vertices * 1000)
    save_mesh(millimetres, tmp_path / "box.ply")
    from_file = load_scene(tmp_path / "box.ply", scale=1e-3, resolution=16)
    from_value = load_scene(millimetres, scale=1e-3, resolution=16)
    assert from_file.object.volume == pytest.approx(from_value.object.volume, rel=1e-5)
    assert torch.allclose(from_file.sdf.field[0], from_value.sdf.field[0], atol=1e-6)


def test_a_cloud_becomes_a_scene_in_its_own_frame():
    """The side of a sphere that a camera at the origin sees, a third of a metre ahead."""
    ball, normals = surface_samples(make_shape("sphere"), 6000, 0)
    ball = ball + np.array([0.0, 0.0, 0.33])
    points = ball[(normals * ball).sum(1) < 0]
    view = PointCloud(np.vstack([points, np.full((9, 3), np.nan)]), np.zeros(3))
    scene = scene_from_views([view], mass=0.2, friction=0.9, resolution=16)
    thing = scene.object
    assert (thing.source, thing.mass, thing.friction, thing.scale) == ("cloud", 0.2, 0.9, 1.0)
    # The unseen half is guessed: some millimetres.
    assert thing.center_of_mass == pytest.approx([0.0, 0.0, 0.33], abs=0.006)
    assert thing.volume == pytest.approx(shape_volume("sphere"), rel=0.2)
    assert any("guess" in warning for warning in thing.warnings)
    assert scene.sdf.field.shape == (4, 16, 16, 16)


def test_a_cloud_that_shows_nothing_is_refused_and_so_is_a_bad_mass():
    with pytest.raises(CloudError, match="empty"):
        scene_from_views([PointCloud(np.zeros((0, 3)), np.zeros(3))])
    with pytest.raises(MeshError, match="mass"):
        scene_from_views([PointCloud(np.random.default_rng(0).random((100, 3)), np.zeros(3))], mass=-1.0)


def test_a_cloud_file_is_reconstructed(tmp_path):
    points, _ = surface_samples(make_shape("sphere"), 3000, 0)
    np.savez(tmp_path / "ball.npz", points=points, viewpoint=np.array([0.0, 0.0, 1.0]))
    scene = load_scene(tmp_path / "ball.npz", resolution=16)
    assert scene.object.volume == pytest.approx(shape_volume("sphere"), rel=0.05)


@pytest.mark.parametrize(
    ("source", "error", "complaint"),
    [
        ("shape:teapot", MeshError, "unknown shape 'teapot'"),
        ("nothing.obj", MeshError, "nothing.obj: no such mesh file"),
        ("nothing.npy", CloudError, "nothing.npy: no such cloud file"),
    ],
)
def test_bad_sources_are_named(source, error, complaint):
    with pytest.raises(error, match=complaint):
        load_scene(source)


def test_unknown_endings_list_meshes_and_clouds(tmp_path):
    (tmp_path / "a.docx").write_text("x")
    with pytest.raises(MeshError, match=r"docx'; valid endings: dae, .*npy.*stl"):
        load_scene(tmp_path / "a.docx")
