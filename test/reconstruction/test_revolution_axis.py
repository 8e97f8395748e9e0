"""The axis of a body of revolution, from half of its surface with the noise of a depth camera."""

import numpy as np
import pytest

from graspd_core.perception.cloud.free_space import FreeSpace
from graspd_core.perception.reconstruct.merge_views import Surfels
from graspd_core.perception.reconstruct.revolution import find_revolution, fit_axis, half_plane, settle_axis


def half_cone(seed: int, noise: float) -> tuple[Surfels, np.ndarray]:
    """The half of a cup's wall, 30 mm wide below and 42 above, that one camera sees, and its axis."""
    rng = np.random.default_rng(seed)
    turn, height = rng.uniform(-1.3, 1.3, 3000), rng.uniform(0, 0.09, 3000)
    outward = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(3000)])
    up = np.array([0.0, 0.0, 1.0])
    points = (0.03 + 0.012 * height / 0.09)[:, None] * outward + height[:, None] * up
    points += noise * rng.standard_normal((3000, 1)) * np.array([1.0, 0.0, 0.0])
    normals = outward - 0.012 / 0.09 * up
    turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return Surfels(points @ turned.T, normals / np.linalg.norm(normals, axis=1)[:, None] @ turned.T), turned @ up


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("tilt", [0.04, 0.12])
def test_the_points_settle_a_tilted_axis(seed: int, tilt: float):
    surfels, true = half_cone(seed, 1e-3)
    side = np.cross(true, np.eye(3)[int(np.argmin(np.abs(true)))])
    start = fit_axis(surfels, (true + tilt * side / np.linalg.norm(side)) / np.hypot(1, tilt))
    settled = settle_axis(surfels, start, 1.5e-3)
    assert np.linalg.norm(np.cross(settled.direction, true)) < 0.01
    assert np.linalg.norm(settled.direction) == pytest.approx(1.0)


def test_the_half_plane_keeps_heights_and_distances():
    surfels, true = half_cone(3, 0.0)
    outward, rows = half_plane(surfels, fit_axis(surfels, true))
    assert np.allclose(np.linalg.norm(outward, axis=1), 1.0)
    assert np.allclose(outward @ true, 0.0, atol=1e-9)
    assert np.ptp(rows[:, 0]) == pytest.approx(0.09, abs=1e-3)
    assert 0.029 < rows[:, 1].min() < rows[:, 1].max() < 0.043


def test_half_a_ball_seen_from_any_side_has_its_back():
    """All its axes are as good; the one that shows the back is taken."""
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((6000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals = normals[normals[:, 2] > 0.15]
    found = find_revolution(Surfels(0.03 * normals, normals), FreeSpace((), standing=False), 1.2e-3)
    assert found is not None
    assert found.surfels.points[:, 2].min() < -0.025
