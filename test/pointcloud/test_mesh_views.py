"""A camera viewer's mesh is a view; open, thin and cut meshes of objects are not."""

import numpy as np
import pytest
from expected import some
from situations import sheet

from graspd_core import TriangleMesh, load_scene
from graspd_core.errors import MeshError
from graspd_core.mesh.shapes import SHAPES, make_shape
from graspd_core.perception.cloud.mesh_views import view_in_mesh


@pytest.mark.parametrize("turn", [np.array(turn) for turn in ((1, 1, 1), (1, -1, -1), (-1, 1, 1))])
def test_a_sheet_of_pixels_is_a_view_however_it_is_wound(turn):
    mesh = TriangleMesh(sheet().vertices * turn, sheet().faces)
    for wound in (mesh, TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])):
        view = some(view_in_mesh(wound, "a.ply"))
        assert not view.viewpoint.any()
        np.testing.assert_array_equal(view.points, wound.vertices)


def test_the_camera_of_a_sheet_has_no_other_place():
    with pytest.raises(MeshError, match="view_point: given with mesh, a mesh; valid with clouds"):
        load_scene(sheet(), view_point=(0.0, 0.0, 1.0))


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_an_object_is_none_whether_closed_or_cut_open(name):
    mesh = make_shape(name)
    assert view_in_mesh(mesh, name) is None
    for axis in range(3):
        place = mesh.vertices[:, axis]
        for kept in (place < np.quantile(place, 0.8), place > np.median(place)):
            assert view_in_mesh(TriangleMesh(mesh.vertices, mesh.faces[kept[mesh.faces].all(1)]), name) is None


def test_one_curved_sheet_of_a_fine_grid_is_an_object():
    """As a bowl of one surface, which all of it faces a place above."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 80, endpoint=False), np.linspace(0.05, 1.4, 40))
    points = 0.08 * np.stack([np.cos(angle) * np.sin(height), np.sin(angle) * np.sin(height), -np.cos(height)], -1)
    index = np.arange(angle.size).reshape(angle.shape)
    a, b, c, d = index[:-1], np.roll(index, -1, 1)[:-1], index[1:], np.roll(index, -1, 1)[1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, c, b), (b, c, d))])
    for shift in (0.0, 0.3):
        assert view_in_mesh(TriangleMesh(points.reshape(-1, 3) + np.array([0, 0, shift]), faces), "bowl.obj") is None
