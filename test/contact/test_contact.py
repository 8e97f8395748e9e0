"""The penalty contact, one step of the free body and the support of soft contacts.

Each is worked by hand and against finite differences; the support also against brute force over sampled cone forces.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from graspd_core.optimize.graspd2022.graspd2022 import (
    FreeBody,
    contact_forces,
    euler_step,
    leaky_min,
    make_body,
    net_wrench,
    speed_left,
)
from graspd_core.optimize.graspd2022.graspd2022_config import ContactConfig
from graspd_core.optimize.losses import disturbance_directions, wrench_support
from graspd_core.se3 import random_rotations

PUBLISHED = ContactConfig(stiffness=1e6, friction_stiffness=1e8, friction=0.8, leak=0.1)
SOFT = replace(PUBLISHED, stiffness=1e3, friction_stiffness=30.0)


def draw(seed: int, points: int = 6) -> tuple[Tensor, Tensor, Tensor]:
    """Heights of a few millimetres on both sides, unit normals, and three velocities, the first of them zero."""
    generator = torch.Generator().manual_seed(seed)
    height = 0.004 * torch.randn(2, points, generator=generator, dtype=torch.float64)
    normals = torch.randn(2, points, 3, generator=generator, dtype=torch.float64)
    velocities = 0.01 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    velocities[0] = 0.0
    return height, normals / normals.norm(dim=-1, keepdim=True), velocities


def one_point(height: float, velocity: list[float], **constants: float) -> list[float]:
    """The force at one point on top of the object (normal z)."""
    force = contact_forces(
        torch.tensor([[height]], dtype=torch.float64),
        torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64),
        torch.tensor([velocity], dtype=torch.float64),
        replace(PUBLISHED, **constants),
    )
    return force[0, 0, 0].tolist()


def test_one_point_by_hand():
    assert one_point(-0.001, [0, 0, 0]) == pytest.approx([0, 0, -1000.0])
    assert one_point(-0.001, [0, 0, 0.01]) == pytest.approx([0, 0, -1000.0])
    # μ times the normal force against the object's motion across the normal; its motion along it does not matter.
    assert one_point(-0.001, [0.003, 0.004, 0.02]) == pytest.approx([-480.0, -640.0, -1000.0])
    # Friction is viscous below Coulomb's bound.
    assert one_point(-0.001, [0.003, 0.004, 0], friction_stiffness=100.0) == pytest.approx([-0.3, -0.4, -1000.0])
    # Out of contact there is no force.
    assert one_point(0.001, [0.01, 0.01, 0.01]) == [0.0, 0.0, 0.0]
    assert one_point(0.0, [0.01, 0.01, 0.01]) == [0.0, 0.0, 0.0]


@given(seed=st.integers(0, 2**31))
def test_forces_only_push_stay_in_the_cone_and_oppose_the_motion(seed):
    height, normals, velocities = draw(seed)
    forces = contact_forces(height, normals, velocities, PUBLISHED)
    along = (forces * normals[:, :, None]).sum(-1)
    side = (forces - along[..., None] * normals[:, :, None]).norm(dim=-1)
    # Forces up to 1e4 N round to 1e-12, more where the motion is nearly along the normal: the square of the slip is
    # what two squares differ by, so its relative error is that of the numbers times the square of their ratio.
    sliding = velocities - (normals @ velocities.T)[..., None] * normals[:, :, None]
    ratio = velocities.norm(dim=-1) / sliding.norm(dim=-1).clamp_min(1e-300)
    assert (along <= 1e-9).all()
    assert (side <= 0.8 * -along * (1 + 1e-15 * ratio**2) + 1e-9).all()
    assert ((forces * sliding).sum(-1) <= 1e-9).all()
    assert not forces[height >= 0].any()


@given(seed=st.integers(0, 2**31))
def test_turning_everything_turns_the_forces(seed):
    height, normals, velocities = draw(seed)
    turn = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0]
    here = contact_forces(height, normals, velocities, SOFT) @ turn.T
    there = contact_forces(height, normals @ turn.T, velocities @ turn.T, SOFT)
    assert there.numpy() == pytest.approx(here.numpy(), abs=1e-12)


@pytest.mark.parametrize("contact", [PUBLISHED, SOFT], ids=["published", "soft"])
@pytest.mark.parametrize("seed", range(3))
def test_gradients_of_the_forces(contact, seed):
    height, normals, velocities = draw(seed)
    # Without a leak the gradient is that of the forward pass; 0.1 mm from the surface no difference crosses it.
    height = torch.where(height.abs() < 1e-4, 1e-3, height).requires_grad_(True)
    inputs = height, normals.requires_grad_(True), velocities[1:].requires_grad_(True)
    scale, exact = 1 / contact.stiffness, replace(contact, leak=0.0)
    assert gradcheck(lambda h, n, v: scale * contact_forces(h, n, v, exact), inputs, eps=1e-8)


@given(leak=st.floats(0.0, 1.0), seed=st.integers(0, 2**31))
def test_the_leak_is_a_slope_and_no_value(leak, seed):
    x = torch.randn(7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    x[0] = 0.0
    x.requires_grad_(True)
    y = leaky_min(x, leak)
    assert torch.equal(y, torch.minimum(x, torch.zeros_like(x)))
    weight = torch.arange(1.0, 8.0, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weight * y).sum(), x)
    assert gradient.tolist() == [w * (1.0 if v < 0 else leak) for w, v in zip(weight.tolist(), x.tolist(), strict=True)]


def test_the_leak_reaches_normal_force_and_friction():
    velocities = torch.tensor([[0.01, 0.0, 0.0]], dtype=torch.float64)
    up = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64)
    slopes = []
    for height in (-0.001, 0.001):
        at = torch.tensor([[height]], dtype=torch.float64, requires_grad=True)
        forces = contact_forces(at, up, velocities, PUBLISHED)[0, 0, 0]
        slopes.append([torch.autograd.grad(f, at, retain_graph=True)[0].item() for f in forces])
    assert slopes[0] == pytest.approx([0.8e6, 0.0, 1e6])
    assert slopes[1] == pytest.approx([0.08e6, 0.0, 0.1e6])


def test_nothing_is_not_a_number_without_motion_or_normal():
    height = torch.tensor([[-0.001, 0.001, 0.0]], dtype=torch.float64, requires_grad=True)
    normals = torch.zeros(1, 3, 3, dtype=torch.float64)
    normals[0, 1] = torch.tensor([1.0, 0.0, 0.0])
    normals.requires_grad_(True)
    # No motion at all, and motion along the normal: nothing slides.
    velocities = torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    forces = contact_forces(height, normals, velocities, PUBLISHED)
    gradients = torch.autograd.grad(forces.sum(), (height, normals, velocities))
    assert forces.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_single_and_double_precision_of_the_forces_agree():
    height, normals, velocities = draw(1, points=60)
    double = contact_forces(height, normals, velocities, PUBLISHED)
    single = contact_forces(height.float(), normals.float(), velocities.float(), PUBLISHED)
    # Forces up to 1e4 N; the tangential speed loses half the digits where the motion is along the normal.
    assert single.double().numpy() == pytest.approx(double.numpy(), rel=2e-4, abs=1e-2)


MASS, RADIUS, STEP = 0.1, 0.03, 1e-5
INERTIA = 0.4 * MASS * RADIUS**2


def ball() -> FreeBody:
    return make_body(MASS, INERTIA * np.eye(3), np.zeros(3), RADIUS, "cpu", torch.float64)


def drawn(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pushed(velocity: list[float], contact: list[float]) -> tuple[list[float], list[float]]:
    """Velocities of the ball after a step in which a point 1 mm below its surface, towards `contact`, pushes it."""
    normal = torch.tensor([[contact]], dtype=torch.float64)
    velocities = torch.tensor([velocity], dtype=torch.float64)
    forces = contact_forces(torch.tensor([[-0.001]], dtype=torch.float64), normal, velocities, PUBLISHED)
    force, torque = net_wrench(forces, (RADIUS - 0.001) * normal)
    linear, angular = euler_step(ball(), velocities, force, torque, STEP)
    return linear[0, 0].tolist(), angular[0, 0].tolist()


def test_a_point_pushes_a_ball_and_friction_brakes_and_turns_it():
    linear, angular = pushed([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    # 1000 N for 10 µs on 100 g.
    assert linear == pytest.approx([-0.1, 0.0, 0.0])
    assert angular == pytest.approx([0.0, 0.0, 0.0])
    linear, angular = pushed([0.0, 0.0, 0.5], [1.0, 0.0, 0.0])
    # 800 N against the motion along z, 29 mm out along x: a torque about y of 23.2 N·m for 10 µs.
    assert linear == pytest.approx([-0.1, 0.0, 0.5 - 0.08])
    assert angular == pytest.approx([0.0, 0.029 * 800 * STEP / INERTIA, 0.0])


@given(seed=st.integers(0, 2**31))
def test_momentum_grows_by_the_impulse(seed):
    a = drawn(seed, 3, 3)
    inertia = MASS * RADIUS**2 * (np.eye(3) + 0.2 * (a @ a.T).numpy())
    body = make_body(MASS, inertia, np.zeros(3), RADIUS, "cpu", torch.float64)
    forces, arms = drawn(seed, 2, 5, 3, 3), RADIUS * drawn(seed + 1, 2, 5, 3)
    before = drawn(seed + 2, 2, 3, 3)
    force, torque = net_wrench(forces, arms)
    after, turning = euler_step(body, before, force, torque, STEP)
    by_hand = torch.linalg.cross(arms[:, :, None], forces).sum(1)
    assert torque.numpy() == pytest.approx(by_hand.numpy(), abs=1e-12)
    assert (MASS * (after - before)).numpy() == pytest.approx((STEP * forces.sum(1)).numpy(), abs=1e-12)
    assert turning.numpy() @ inertia == pytest.approx((STEP * by_hand).numpy(), abs=1e-12)


def test_a_needle_does_not_spin_beyond_bound():
    # A body without thickness has no moment about its axis; a tenth of its length is kept as radius of gyration.
    body = make_body(MASS, np.diag([1e-4, 1e-4, 0.0]), np.zeros(3), 0.1, "cpu", torch.float64)
    assert body.inverse_inertia.numpy() == pytest.approx(np.diag([1e4, 1e4, 1e5]))


def test_speed_counts_turning_at_the_bodys_length():
    linear, angular = torch.tensor([[3.0, 0.0, 4.0]]), torch.tensor([[0.0, 100.0, 0.0]])
    assert speed_left(ball(), linear, angular).tolist() == pytest.approx([25.0 + 9.0])


def test_gradients_of_the_step():
    body = make_body(MASS, INERTIA * np.diag([1.0, 2.0, 3.0]), np.zeros(3), RADIUS, "cpu", torch.float64)

    def motion(forces: Tensor, arms: Tensor, linear: Tensor) -> Tensor:
        return speed_left(body, *euler_step(body, linear, *net_wrench(forces, arms), 1e-3))

    inputs = drawn(0, 2, 4, 3, 3), RADIUS * drawn(1, 2, 4, 3), drawn(2, 3, 3)
    assert gradcheck(motion, tuple(x.requires_grad_(True) for x in inputs))


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
def test_gradients_of_the_support(seed):
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


@pytest.mark.parametrize("count", [6, 12, 24, 48])
def test_directions_are_unit_spread_and_reproducible(count):
    directions = disturbance_directions(count, seed=3)
    assert directions.shape == (count, 6)
    assert directions.norm(dim=1).numpy() == pytest.approx(np.ones(count), abs=1e-12)
    assert torch.equal(directions, disturbance_directions(count, seed=3))
    nearest = (directions @ directions.T).fill_diagonal_(-1.0).max()
    # No two within 45° of each other up to 48: random draws would come within 25°.
    assert nearest < np.cos(np.pi / 4)
