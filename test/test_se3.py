"""Rigid transforms: round trips, and gradients where norms and angles vanish."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from graspd_core.se3 import (
    SE3,
    normalize,
    quaternion_from_rotation,
    random_rotations,
    rotation_from_axis_angle,
    rotation_from_quaternion,
    safe_norm,
)

IDENTITY = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)
vectors = arrays(np.float64, 3, elements=st.floats(-1, 1))


def unit(q: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(q / np.linalg.norm(q))


@given(q=quaternions)
def test_a_quaternion_comes_back_with_its_real_part_positive(q):
    there = rotation_from_quaternion(torch.as_tensor(q))
    back = quaternion_from_rotation(there)
    assert back[0] >= 0
    # q and −q are the same rotation.
    assert abs(float(back @ unit(q))) == pytest.approx(1.0, abs=1e-12)
    assert rotation_from_quaternion(back).numpy() == pytest.approx(there.numpy(), abs=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("short", [0.0, 1e-9, 1e-5])
def test_half_turns_come_back_too(axis, short):
    direction = torch.eye(3, dtype=torch.float64)[axis]
    rotation = rotation_from_axis_angle(direction, torch.tensor(math.pi - short, dtype=torch.float64))
    back = rotation_from_quaternion(quaternion_from_rotation(rotation))
    assert back.numpy() == pytest.approx(rotation.numpy(), abs=1e-12)


@given(q=quaternions, scale=st.floats(0.01, 100.0))
def test_rotations_are_orthonormal_whatever_the_quaternions_length(q, scale):
    rotation = rotation_from_quaternion(scale * torch.as_tensor(q))
    assert (rotation @ rotation.T).numpy() == pytest.approx(np.eye(3), abs=1e-12)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-12)
    assert rotation.numpy() == pytest.approx(rotation_from_quaternion(torch.as_tensor(q)).numpy(), abs=1e-12)


@given(a=quaternions, b=quaternions, x=vectors, t=vectors)
def test_transforms_compose_and_keep_distances(a, b, x, t):
    first, second = (rotation_from_quaternion(torch.as_tensor(q)) for q in (a, b))
    point, shift = torch.as_tensor(x)[None], torch.as_tensor(t)
    outer, inner = SE3(first, shift), SE3(second, torch.ones(3, dtype=torch.float64))
    once, twice = outer.compose(inner).apply(point), outer.apply(inner.apply(point))
    assert once.numpy() == pytest.approx(twice.numpy(), abs=1e-12)
    assert outer.apply_inverse(outer.apply(point)).numpy() == pytest.approx(point.numpy(), abs=1e-12)
    assert float((outer.apply(point) - shift).norm()) == pytest.approx(float(point.norm()), abs=1e-12)


@given(axis=vectors.filter(lambda v: np.linalg.norm(v) > 1e-3), angle=st.floats(-3.0, 3.0))
def test_axis_and_angle_agree_with_scipys_rotation_vectors(axis, angle):
    n = axis / np.linalg.norm(axis)
    rotation = rotation_from_axis_angle(torch.as_tensor(n), torch.tensor(angle, dtype=torch.float64))
    # Not torch's matrix exponential, which is itself only good to 1e-11 for small angles.
    assert rotation.numpy() == pytest.approx(Rotation.from_rotvec(angle * n).as_matrix(), abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-13])
def test_the_norm_has_a_finite_gradient_at_and_about_zero(size, dtype):
    x = torch.full((3,), size, dtype=dtype, requires_grad=True)
    safe_norm(x).backward()
    assert x.grad is not None
    assert x.grad.tolist() == [0.0, 0.0, 0.0]
    assert float(safe_norm(x).detach()) == 0.0


def test_the_norm_away_from_zero_is_the_norm():
    x = torch.tensor([[3.0, 4.0, 0.0], [1e-9, 0, 0], [-1e3, 0, 0]], dtype=torch.float64, requires_grad=True)
    assert safe_norm(x).tolist() == pytest.approx([5.0, 1e-9, 1e3])
    (gradient,) = torch.autograd.grad(safe_norm(x).sum(), x)
    assert gradient.numpy() == pytest.approx(np.array([[0.6, 0.8, 0], [1, 0, 0], [-1, 0, 0]]), abs=1e-12)


def test_zero_stays_zero_when_normalised_and_passes_no_nan_back():
    x = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    normalize(x).sum().backward()
    assert normalize(x).detach().tolist() == [[0.0] * 3] * 2
    assert x.grad is not None
    assert x.grad.isfinite().all()


@given(offset=arrays(np.float64, 4, elements=st.sampled_from([0.0, 1e-12, -1e-8, 1e-4])))
def test_gradients_near_the_identity(offset):
    q = (IDENTITY + torch.as_tensor(offset)).requires_grad_(True)
    assert gradcheck(rotation_from_quaternion, (q,))
    # Turning by 2·offset: ∂R/∂x at the identity is twice the generator of a turn about x.
    (gradient,) = torch.autograd.grad(rotation_from_quaternion(q)[2, 1], q)
    assert gradient.numpy() == pytest.approx([0, 2, 0, 0], abs=1e-3)


def there_and_back(q: torch.Tensor) -> torch.Tensor:
    return quaternion_from_rotation(rotation_from_quaternion(q))


@given(seed=st.integers(0, 2**31))
def test_gradients_of_both_conversions_at_random_rotations(seed):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0]
    q = quaternion_from_rotation(rotation).requires_grad_(True)
    assert gradcheck(rotation_from_quaternion, (q,))
    jacobian = torch.autograd.functional.jacobian(there_and_back, q.detach())
    # There and back is the projection onto unit quaternions.
    q = q.detach().numpy()
    assert np.asarray(jacobian) == pytest.approx(np.eye(4) - np.outer(q, q), abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, math.pi])
def test_gradients_of_the_angle(angle):
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    value = torch.tensor(angle, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda a: rotation_from_axis_angle(axis, a), (value,))


def test_random_rotations_are_uniform_and_reproducible():
    drawn = random_rotations(4000, torch.Generator().manual_seed(0), torch.float64)
    assert torch.equal(drawn, random_rotations(4000, torch.Generator().manual_seed(0), torch.float64))
    # Of uniform rotations every entry has mean 0 and variance 1/3: ±3 standard errors.
    assert drawn.mean(0).abs().max() < 3.5 * math.sqrt(1 / 3 / 4000)
    assert (drawn.square().mean(0) - 1 / 3).abs().max() < 3.5 * 0.3 / math.sqrt(4000)
