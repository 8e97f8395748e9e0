"""The penalty contact: worked by hand at one point, against finite differences, and the leak in its exact form."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from graspd_core.optimize.graspd2022.contact_dynamics import contact_forces, leaky_min
from graspd_core.se3 import random_rotations

PUBLISHED = {"stiffness": 1e6, "friction_stiffness": 1e8, "friction": 0.8}
SOFT = {"stiffness": 1e3, "friction_stiffness": 30.0, "friction": 0.8}


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
        **{**PUBLISHED, **constants},
        leak=0.1,
    )
    return force[0, 0, 0].tolist()


def test_one_millimetre_is_a_thousand_newtons_as_published():
    assert one_point(-0.001, [0, 0, 0]) == pytest.approx([0, 0, -1000.0])
    assert one_point(-0.001, [0, 0, 0.01]) == pytest.approx([0, 0, -1000.0])


def test_friction_is_coulombs_where_it_slides():
    # μ times the normal force against the object's motion across the normal; its motion along it does not matter.
    assert one_point(-0.001, [0.003, 0.004, 0.02]) == pytest.approx([-480.0, -640.0, -1000.0])


def test_friction_is_viscous_below_coulombs_bound():
    assert one_point(-0.001, [0.003, 0.004, 0], friction_stiffness=100.0) == pytest.approx([-0.3, -0.4, -1000.0])


def test_out_of_contact_there_is_no_force():
    assert one_point(0.001, [0.01, 0.01, 0.01]) == [0.0, 0.0, 0.0]
    assert one_point(0.0, [0.01, 0.01, 0.01]) == [0.0, 0.0, 0.0]


@given(seed=st.integers(0, 2**31))
def test_forces_only_push_stay_in_the_cone_and_oppose_the_motion(seed):
    height, normals, velocities = draw(seed)
    forces = contact_forces(height, normals, velocities, **PUBLISHED, leak=0.1)
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
    here = contact_forces(height, normals, velocities, **SOFT, leak=0.1) @ turn.T
    there = contact_forces(height, normals @ turn.T, velocities @ turn.T, **SOFT, leak=0.1)
    assert there.numpy() == pytest.approx(here.numpy(), abs=1e-12)


@pytest.mark.parametrize("constants", [PUBLISHED, SOFT], ids=["published", "soft"])
@pytest.mark.parametrize("seed", range(3))
def test_gradients_against_finite_differences(constants, seed):
    height, normals, velocities = draw(seed)
    # Without a leak the gradient is that of the forward pass; 0.1 mm from the surface no difference crosses it.
    height = torch.where(height.abs() < 1e-4, 1e-3, height).requires_grad_(True)
    inputs = height, normals.requires_grad_(True), velocities[1:].requires_grad_(True)
    scale = 1 / constants["stiffness"]
    assert gradcheck(lambda h, n, v: scale * contact_forces(h, n, v, **constants, leak=0.0), inputs, eps=1e-8)


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
        forces = contact_forces(at, up, velocities, **PUBLISHED, leak=0.1)[0, 0, 0]
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
    forces = contact_forces(height, normals, velocities, **PUBLISHED, leak=0.1)
    gradients = torch.autograd.grad(forces.sum(), (height, normals, velocities))
    assert forces.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_single_and_double_precision_agree():
    height, normals, velocities = draw(1, points=60)
    double = contact_forces(height, normals, velocities, **PUBLISHED, leak=0.1)
    single = contact_forces(height.float(), normals.float(), velocities.float(), **PUBLISHED, leak=0.1)
    # Forces up to 1e4 N; the tangential speed loses half the digits where the motion is along the normal.
    assert single.double().numpy() == pytest.approx(double.numpy(), rel=2e-4, abs=1e-2)
