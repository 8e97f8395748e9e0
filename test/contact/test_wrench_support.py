"""The closed-form support of soft contacts, against brute force over sampled friction-cone forces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck

from graspd_core.optimize.losses import disturbance_directions, wrench_support
from graspd_core.se3 import random_rotations

FRICTION = 0.6


def contacts(seed: int, points: int = 5) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Arms within the unit ball, unit normals and activations of one posture."""
    generator = torch.Generator().manual_seed(seed)
    arms = torch.rand(1, points, 3, generator=generator, dtype=torch.float64) * 1.2 - 0.6
    normals = torch.randn(1, points, 3, generator=generator, dtype=torch.float64)
    activation = torch.rand(1, points, generator=generator, dtype=torch.float64)
    return arms, normals / normals.norm(dim=-1, keepdim=True), activation


def cone_forces(normal: np.ndarray, count: int) -> np.ndarray:
    """Forces on the object with a normal part of one on the rim of a friction cone, and none at all."""
    across = np.linalg.svd(normal[None])[2][1:]
    angles = np.arange(count) * 2 * np.pi / count
    rim = -normal + FRICTION * (np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1])
    return np.vstack([rim, np.zeros((1, 3))])


@given(seed=st.integers(0, 2**31))
def test_the_support_is_the_best_that_sampled_cone_forces_do(seed):
    arms, normals, activation = contacts(seed)
    directions = disturbance_directions(24, seed % 1000)
    closed = wrench_support(arms, normals, activation, directions, FRICTION)[0].numpy()
    # Each contact on its own picks the force of its cone, up to its activation, that does most work along the wrench.
    best = np.zeros(len(directions))
    for arm, normal, weight in zip(arms[0].numpy(), normals[0].numpy(), activation[0].numpy(), strict=True):
        forces = cone_forces(normal, 720)
        wrenches = np.hstack([forces, np.cross(arm, forces)])
        best += weight * (directions.numpy() @ wrenches.T).max(1)
    # 720 forces miss the best by 1 − cos(π/720) = 1e-5 of friction's part; the floor of the tangential speed adds up to
    # 1e-3 · μ at a contact that hardly moves.
    assert closed == pytest.approx(best, abs=5 * (FRICTION * 1e-3 + 2e-5))
    assert (closed >= best - 1e-9).all()


def test_one_push_on_a_plane():
    up = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64)
    arms, activation = torch.zeros(1, 1, 3, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    directions = torch.eye(6, dtype=torch.float64)[[0, 2]]
    down = -torch.eye(6, dtype=torch.float64)[[2]]
    support = wrench_support(arms, up, activation, torch.cat([directions, down]), FRICTION)[0]
    # Sideways friction only, no pull upwards, the whole push downwards; the floor adds 1e-3 · μ where nothing slides.
    assert support.tolist() == pytest.approx([FRICTION, 0.0, 1.0], abs=1e-3 * FRICTION + 1e-12)


@given(seed=st.integers(0, 2**31))
def test_turning_everything_changes_nothing(seed):
    arms, normals, activation = contacts(seed)
    directions = disturbance_directions(16, 0)
    turn = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0]
    turned = torch.cat([directions[:, :3] @ turn.T, directions[:, 3:] @ turn.T], -1)
    here = wrench_support(arms, normals, activation, directions, FRICTION)
    there = wrench_support(arms @ turn.T, normals @ turn.T, activation, turned, FRICTION)
    # Where the tangential speed is near its floor of 1e-3 rounding shows most: 1e-16 / 1e-3.
    assert there.numpy() == pytest.approx(here.numpy(), abs=1e-12)


@given(seed=st.integers(0, 2**31), factor=st.floats(0.1, 10.0))
def test_the_support_is_linear_in_the_activation_and_grows_with_friction(seed, factor):
    arms, normals, activation = contacts(seed)
    directions = disturbance_directions(16, 0)
    support = wrench_support(arms, normals, activation, directions, FRICTION)
    scaled = wrench_support(arms, normals, factor * activation, directions, FRICTION)
    assert scaled.numpy() == pytest.approx(factor * support.numpy(), rel=1e-12)
    assert (wrench_support(arms, normals, activation, directions, 2 * FRICTION) >= support).all()
    assert not wrench_support(arms, normals, 0 * activation, directions, FRICTION).any()


def test_antipodal_contacts_resist_all_but_the_turn_about_their_axis():
    arms = torch.tensor([[[1.0, 0, 0], [-1.0, 0, 0]]], dtype=torch.float64)
    activation = torch.ones(1, 2, dtype=torch.float64)
    support = wrench_support(arms, arms, activation, disturbance_directions(12, 0), FRICTION)[0]
    # Along x the squeeze; along y and z, and about them, friction at both; about x only the floor.
    one_way = [1.0, 2 * FRICTION, 2 * FRICTION, 0.0, 2 * FRICTION, 2 * FRICTION]
    assert support.tolist() == pytest.approx(one_way * 2, abs=2 * FRICTION * 1e-3 + 1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_gradients_against_finite_differences(seed):
    arms, normals, activation = (x.requires_grad_(True) for x in contacts(seed))
    directions = disturbance_directions(20, 0)
    assert gradcheck(lambda a, n, s: wrench_support(a, n, s, directions, FRICTION), (arms, normals, activation))


def test_gradients_are_finite_where_nothing_slides():
    # A contact at the centre of mass, pushed along its normal: the tangential speed is zero.
    arms = torch.zeros(1, 1, 3, dtype=torch.float64, requires_grad=True)
    normals = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64, requires_grad=True)
    activation = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
    support = wrench_support(arms, normals, activation, disturbance_directions(12, 0), FRICTION)
    gradients = torch.autograd.grad(support.sum(), (arms, normals, activation))
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_single_and_double_precision_agree():
    arms, normals, activation = contacts(1, points=60)
    directions = disturbance_directions(24, 0)
    double = wrench_support(arms, normals, activation, directions, FRICTION)
    single = wrench_support(arms.float(), normals.float(), activation.float(), directions.float(), FRICTION)
    # Sums of 60 terms of order one, 1e-7 each; squares lose half the digits near the floor.
    assert single.double().numpy() == pytest.approx(double.numpy(), rel=2e-4)


@pytest.mark.parametrize("count", [6, 12, 24, 48])
def test_directions_are_unit_spread_and_reproducible(count):
    directions = disturbance_directions(count, seed=3)
    assert directions.shape == (count, 6)
    assert directions.norm(dim=1).numpy() == pytest.approx(np.ones(count), abs=1e-12)
    assert torch.equal(directions, disturbance_directions(count, seed=3))
    nearest = (directions @ directions.T).fill_diagonal_(-1.0).max()
    # No two within 45° of each other up to 48: random draws would come within 25°.
    assert nearest < np.cos(np.pi / 4)
