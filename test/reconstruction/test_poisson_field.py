"""The Poisson field of oriented points: its zero is their surface, and it grows outwards like a distance."""

import numpy as np
import pytest

from graspd_core.reconstruction.merge_views import Surfels
from graspd_core.reconstruction.poisson_field import poisson_field

CELL, RADIUS = 0.002, 0.03


def sphere_field(finest: float) -> tuple[np.ndarray, np.ndarray]:
    """The field of a sphere of 3 cm, and the true distance from it [m]."""
    directions = np.random.default_rng(0).normal(size=(6000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = [np.arange(-0.037, 0.037, CELL) for _ in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    field = poisson_field(Surfels(RADIUS * directions, directions), axes, finest)
    return field, np.linalg.norm(nodes, axis=-1) - RADIUS


@pytest.mark.parametrize("finest", [0.001, 0.005])
def test_its_sign_says_what_is_inside_wherever_that_is(finest):
    field, distance = sphere_field(finest)
    clear = np.abs(distance) > 0.3 * CELL
    assert (np.sign(field) == np.sign(distance))[clear].mean() > 0.999


def test_next_to_the_surface_it_is_the_distance():
    field, distance = sphere_field(CELL)
    near = np.abs(distance) < 0.5 * CELL
    assert np.abs(field - distance)[near].mean() < 0.2 * CELL
