"""Sharp points are where an object is sharp, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_core.mesh.shapes import BOX_HALF, make_shape
from graspd_core.mesh.sharp_features import farthest_points, sharp_points


def test_a_sphere_has_no_sharp_points():
    # 3 mm below a sphere of 35 mm the surface is 3 mm away; its facets change that by hundredths of a millimetre.
    assert sharp_points(make_shape("sphere"), 50)[0].shape == (0, 3)


@pytest.mark.parametrize("count", [8, 60])
def test_the_sharp_points_of_a_box_lie_on_its_edges(count: int):
    points, _ = sharp_points(make_shape("box"), count)
    assert len(points) == count
    inside = np.sort(np.array(BOX_HALF) - np.abs(points), axis=1)
    # On the surface to float32 rounding; the second nearest face is within the 3 mm that the probe looks down.
    assert np.abs(inside[:, 0]) == pytest.approx(0.0, abs=1e-6)
    assert (np.abs(inside[:, 1]) < 0.003).all()


def test_the_sharp_points_of_a_box_cover_all_its_edges():
    points, _ = sharp_points(make_shape("box"), 60)
    for axis in range(3):
        a, b = np.delete(np.arange(3), axis)
        for sign in [(-1, -1), (-1, 1), (1, -1), (1, 1)]:
            edge = np.array([sign[0] * BOX_HALF[a], sign[1] * BOX_HALF[b]])
            near = np.linalg.norm(points[:, [a, b]] - edge, axis=1) < 0.005
            assert near.sum() >= 2


def test_sharp_points_are_seeded():
    box = make_shape("box")
    assert np.array_equal(sharp_points(box, 20, seed=1)[0], sharp_points(box, 20, seed=1)[0])


@pytest.mark.parametrize(("name", "thin"), [("mug", True), ("bowl", True), ("box", False), ("sphere", False)])
def test_only_walls_are_thin(name: str, thin: bool):
    assert (sharp_points(make_shape(name), 8)[1] > 0.6) == thin


def test_farthest_points_of_a_line():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [10, 0, 0]])
    assert farthest_points(line, 3).tolist() == [0, 4, 3]
    assert sorted(farthest_points(line, 99)) == [0, 1, 2, 3, 4]
    assert len(farthest_points(np.zeros((0, 3)), 3)) == 0
