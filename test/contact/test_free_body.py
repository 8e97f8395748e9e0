"""One step of the free body: golden impulses, momentum laws, finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from graspd_core.optimize.graspd2022.contact_dynamics import (
    FreeBody,
    contact_forces,
    euler_step,
    make_body,
    net_wrench,
    speed_left,
)

MASS, RADIUS, STEP = 0.1, 0.03, 1e-5
INERTIA = 0.4 * MASS * RADIUS**2


def ball() -> FreeBody:
    return make_body(MASS, INERTIA * np.eye(3), np.zeros(3), RADIUS, "cpu", torch.float64)


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pushed(velocity: list[float], contact: list[float]) -> tuple[list[float], list[float]]:
    """Velocities of the ball after a step in which a point 1 mm below its surface, towards `contact`, pushes it."""
    normal = torch.tensor([[contact]], dtype=torch.float64)
    velocities = torch.tensor([velocity], dtype=torch.float64)
    forces = contact_forces(
        torch.tensor([[-0.001]], dtype=torch.float64),
        normal, velocities, stiffness=1e6, friction_stiffness=1e8, friction=0.8, leak=0.1,
    )  # fmt: skip
    force, torque = net_wrench(forces, (RADIUS - 0.001) * normal)
    linear, angular = euler_step(ball(), velocities, torch.zeros_like(velocities), force, torque, STEP)
    return linear[0, 0].tolist(), angular[0, 0].tolist()


def test_a_point_pushes_a_ball_by_force_times_time_over_mass():
    linear, angular = pushed([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    # 1000 N for 10 µs on 100 g.
    assert linear == pytest.approx([-0.1, 0.0, 0.0])
    assert angular == pytest.approx([0.0, 0.0, 0.0])


def test_friction_brakes_a_ball_and_turns_it():
    linear, angular = pushed([0.0, 0.0, 0.5], [1.0, 0.0, 0.0])
    # 800 N against the motion along z, 29 mm out along x: a torque about y of 23.2 N·m for 10 µs.
    assert linear == pytest.approx([-0.1, 0.0, 0.5 - 0.08])
    assert angular == pytest.approx([0.0, 0.029 * 800 * STEP / INERTIA, 0.0])


@given(seed=st.integers(0, 2**31))
def test_momentum_grows_by_the_impulse(seed):
    a = draw(seed, 3, 3)
    inertia = MASS * RADIUS**2 * (np.eye(3) + 0.2 * (a @ a.T).numpy())
    body = make_body(MASS, inertia, np.zeros(3), RADIUS, "cpu", torch.float64)
    forces, arms = draw(seed, 2, 5, 3, 3), RADIUS * draw(seed + 1, 2, 5, 3)
    before, rest = draw(seed + 2, 2, 3, 3), torch.zeros(2, 3, 3, dtype=torch.float64)
    force, torque = net_wrench(forces, arms)
    after, turning = euler_step(body, before, rest, force, torque, STEP)
    by_hand = torch.linalg.cross(arms[:, :, None], forces).sum(1)
    assert torque.numpy() == pytest.approx(by_hand.numpy(), abs=1e-12)
    assert (MASS * (after - before)).numpy() == pytest.approx((STEP * forces.sum(1)).numpy(), abs=1e-12)
    assert (turning @ body.inertia).numpy() == pytest.approx((STEP * by_hand).numpy(), abs=1e-12)


@given(seed=st.integers(0, 2**31))
def test_opposite_forces_on_one_line_move_nothing(seed):
    arm, force = RADIUS * draw(seed, 1, 1, 3), draw(seed + 1, 1, 1, 1, 3)
    along = arm + 0.5 * RADIUS * force[:, :, 0]
    net, torque = net_wrench(torch.cat([force, -force], 1), torch.cat([arm, along], 1))
    assert net.abs().max() == 0.0
    assert torque.abs().max() < 1e-12


def test_a_turning_body_keeps_its_angular_momentum_to_first_order():
    body = make_body(MASS, INERTIA * np.diag([1.0, 2.0, 3.0]), np.zeros(3), RADIUS, "cpu", torch.float64)
    still, turning = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[3.0, -2.0, 1.0]], dtype=torch.float64)
    _, after = euler_step(body, still, turning, still, still, STEP)
    change = (after - turning) @ body.inertia / STEP + torch.linalg.cross(turning, turning @ body.inertia)
    assert change.abs().max() < 1e-12


def test_a_needle_does_not_spin_beyond_bound():
    # A body without thickness has no moment about its axis; a tenth of its length is kept as radius of gyration.
    body = make_body(MASS, np.diag([1e-4, 1e-4, 0.0]), np.zeros(3), 0.1, "cpu", torch.float64)
    moments = torch.linalg.eigvalsh(body.inertia)
    assert moments.tolist() == pytest.approx([1e-5, 1e-4, 1e-4])
    assert (body.inertia @ body.inverse_inertia).numpy() == pytest.approx(np.eye(3), abs=1e-12)


def test_speed_counts_turning_at_the_bodys_length():
    linear, angular = torch.tensor([[3.0, 0.0, 4.0]]), torch.tensor([[0.0, 100.0, 0.0]])
    assert speed_left(ball(), linear, angular).tolist() == pytest.approx([25.0 + 9.0])


def test_gradients_against_finite_differences():
    body = make_body(MASS, INERTIA * np.diag([1.0, 2.0, 3.0]), np.zeros(3), RADIUS, "cpu", torch.float64)

    def motion(forces: Tensor, arms: Tensor, linear: Tensor, angular: Tensor) -> Tensor:
        return speed_left(body, *euler_step(body, linear, angular, *net_wrench(forces, arms), 1e-3))

    inputs = draw(0, 2, 4, 3, 3), RADIUS * draw(1, 2, 4, 3), draw(2, 3, 3), draw(3, 3, 3)
    assert gradcheck(motion, tuple(x.requires_grad_(True) for x in inputs))
