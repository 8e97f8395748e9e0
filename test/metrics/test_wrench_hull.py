"""The wrench hull against values worked by hand and against its own definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from graspd_core.se3 import random_rotations
from graspd_core.verify.prepared_grasp import cone_wrenches, wrench_hull

FRICTION = 0.6
# Every edge of a cone is a unit force: its normal part, and its tangential part.
NORMAL, TANGENT = 1 / np.sqrt(1 + FRICTION**2), FRICTION / np.sqrt(1 + FRICTION**2)


def disc(radius: float = 1.0) -> np.ndarray:
    angles = 2 * np.pi * np.arange(3) / 3
    return radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])


def plates() -> tuple[np.ndarray, np.ndarray]:
    """Four corners on either side of a cube of side 2, across y."""
    corners = np.array([[x, y, z] for y in (-1.0, 1.0) for x in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return corners, np.array([0.0, 1.0, 0.0]) * corners


def support(wrenches: np.ndarray, direction: np.ndarray) -> float:
    return float((wrenches @ direction).max())


def test_two_antipodal_contacts_cannot_resist_a_turn_about_their_axis():
    arms = np.array([[0.03, 0, 0], [-0.03, 0, 0]])
    assert np.abs(cone_wrenches(arms, arms / 0.03, FRICTION, 0.03)[:, 3]).max() == pytest.approx(0.0, abs=1e-15)
    assert wrench_hull(arms, arms / 0.03, FRICTION, 0.03) == (0.0, 0.0)


def test_one_contact_and_none_close_nothing():
    one = np.array([[0.03, 0, 0]])
    assert wrench_hull(one, one / 0.03, FRICTION, 0.03) == (0.0, 0.0)
    assert wrench_hull(one[:0], one[:0], FRICTION, 0.03) == (0.0, 0.0)


def test_three_contacts_on_a_disc():
    wrenches = cone_wrenches(disc(), disc(), FRICTION, 1.0)
    axes = np.eye(6)
    # Along the disc's axis, and about it, there is friction at arm 1 only. About an axis in its plane too, at the arm
    # of the contact farthest from that axis: 1, or sin 60° where a contact lies on it.
    assert support(wrenches, axes[2]) == support(wrenches, axes[5]) == pytest.approx(TANGENT)
    assert support(wrenches, axes[4]) == pytest.approx(TANGENT)
    assert support(wrenches, axes[3]) == pytest.approx(TANGENT * np.sin(np.pi / 3))
    # Away from a contact (−x) there is its normal force; towards it (+x) the other two give half of theirs and their
    # friction's sin 60°.
    assert support(wrenches, -axes[0]) == pytest.approx(NORMAL)
    assert support(wrenches, axes[0]) == pytest.approx(0.5 * NORMAL + TANGENT * np.sin(np.pi / 3))
    # Against (force z; torque x, y) contact i has only its vertical edges, TANGENT · ±v_i with v_i = (1, y_i, −x_i).
    # The v have Gram matrix 2 on and 1/2 off its diagonal, so the octahedron of the ±v_i has faces at √(9/17): ε is no
    # more than that.
    epsilon, volume = wrench_hull(disc(), disc(), FRICTION, 1.0)
    assert 0 < epsilon <= TANGENT * np.sqrt(9 / 17)
    assert volume > 0


def test_six_contacts_on_the_axes_of_a_sphere():
    # Worst is a turn about a diagonal, (1, 1, 1)/√3: each contact gives friction times the part of it across its own
    # normal, √(2/3), which lies along an edge of the cone. All six are equal there, and any push mixed in adds.
    arms = np.vstack([np.eye(3), -np.eye(3)])
    assert wrench_hull(arms, arms, FRICTION, 1.0)[0] == pytest.approx(TANGENT * np.sqrt(2 / 3), rel=1e-6)


def test_a_box_between_two_plates():
    arms, normals = plates()
    wrenches = cone_wrenches(arms, normals, FRICTION, 1.0)
    axes = np.eye(6)
    # Pushes: the plates with their normal force, the other axes with friction.
    assert support(wrenches, axes[1]) == pytest.approx(NORMAL)
    assert support(wrenches, axes[0]) == support(wrenches, axes[2]) == pytest.approx(TANGENT)
    # Turns about y: a corner at (1, 1) gives the most along the diagonal, √2 · TANGENT.
    assert support(wrenches, axes[4]) == pytest.approx(np.sqrt(2) * TANGENT)
    # About x and z: the normal force at arm 1, helped by friction at arm 1.
    assert support(wrenches, axes[3]) == support(wrenches, axes[5]) == pytest.approx(NORMAL + TANGENT)
    epsilon, _ = wrench_hull(arms, normals, FRICTION, 1.0)
    assert 0 < epsilon <= TANGENT


def test_contacts_on_one_side_only_hold_nothing():
    arms, normals = plates()
    # Every edge has the same part along the common normal, so that the hull is flat too.
    assert wrench_hull(arms[:4], normals[:4], FRICTION, 1.0) == (0.0, 0.0)
    tilted = normals[:4] + 0.1 * arms[:4] * [1, 0, 1]
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    epsilon, volume = wrench_hull(arms[:4], tilted, FRICTION, 1.0)
    assert epsilon == 0.0
    assert volume > 0


@given(seed=st.integers(0, 2**31))
def test_no_direction_is_supported_less_than_epsilon_and_one_no_more(seed):
    rng = np.random.default_rng(seed)
    arms = rng.normal(size=(6, 3))
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    epsilon, _ = wrench_hull(arms, arms, FRICTION, 1.0)
    wrenches = cone_wrenches(arms, arms, FRICTION, 1.0)
    directions = rng.normal(size=(4000, 6))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    supports = (directions @ wrenches.T).max(1)
    # Where the origin is outside the hull, some support is negative and ε is zero.
    assert max(0.0, supports.min()) >= epsilon - 1e-9
    # Merged facets, not joggled ones: the nearest one's normal is supported by just ε.
    facets = ConvexHull(wrenches).equations
    nearest = facets[facets[:, -1].argmax(), :-1]
    assert max(0.0, support(wrenches, nearest)) == pytest.approx(epsilon, abs=1e-6)


@given(seed=st.integers(0, 2**31))
def test_turning_everything_changes_nothing_but_the_edges_places(seed):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    arms, normals = plates()
    epsilon, volume = wrench_hull(arms, normals, FRICTION, 1.0)
    turned = wrench_hull(arms @ rotation.T, normals @ rotation.T, FRICTION, 1.0)
    # The eight edges stand for a circle and start elsewhere: cos(π/8) = 0.92 of its radius at worst.
    assert turned[0] == pytest.approx(epsilon, rel=0.09)
    assert turned[1] == pytest.approx(volume, rel=0.2)


def test_the_torque_scale_divides_the_volume_by_its_cube():
    arms, normals = plates()
    _, volume = wrench_hull(arms, normals, FRICTION, 1.0)
    assert wrench_hull(arms, normals, FRICTION, 2.0)[1] == pytest.approx(volume / 8, rel=1e-6)
    assert wrench_hull(2 * arms, normals, FRICTION, 2.0)[1] == pytest.approx(volume, rel=1e-6)
