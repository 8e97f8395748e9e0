"""The primitives against hand-computed distances, and their gradients at the awkward places."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.hands.link_distance import box_sdf, capsule_sdf, cylinder_sdf, sphere_sdf

HALF = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)

KERNELS = {
    "sphere": lambda p: sphere_sdf(p, 0.2),
    "box": lambda p: box_sdf(p, HALF.to(p.dtype)),
    "capsule": lambda p: capsule_sdf(p, 0.1, 0.2),
    "cylinder": lambda p: cylinder_sdf(p, 0.1, 0.2),
}

GOLDEN = [
    ("sphere", (0.0, 0.0, 0.0), -0.2),
    ("sphere", (0.3, 0.0, 0.4), 0.3),
    ("box", (0.0, 0.0, 0.0), -0.1),
    ("box", (0.4, 0.6, 0.0), 0.5),  # 0.3 past x and 0.4 past y
    ("capsule", (0.0, 0.0, 0.35), 0.05),
    ("capsule", (0.3, 0.0, 0.1), 0.2),
    ("cylinder", (0.0, 0.0, 0.0), -0.1),
    ("cylinder", (0.0, 0.4, 0.6), 0.5),  # 0.3 past the side and 0.4 past the end
]


@pytest.mark.parametrize(("name", "point", "expected"), GOLDEN)
def test_golden_distance(name, point, expected):
    distance = KERNELS[name](torch.tensor(point, dtype=torch.float64))
    assert float(distance) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", KERNELS)
def test_gradient_has_no_nan_on_centre_and_axis(name):
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.9]], requires_grad=True)
    KERNELS[name](points).sum().backward()
    assert points.grad is not None
    assert torch.isfinite(points.grad).all()


@pytest.mark.parametrize("name", KERNELS)
@given(seed=st.integers(0, 10_000))
def test_gradient_is_the_finite_difference(name, seed):
    generator = torch.Generator().manual_seed(seed)
    # Irregular offsets keep clear of the creases, where no derivative exists.
    points = torch.rand(4, 3, generator=generator, dtype=torch.float64) - 0.5
    points.requires_grad_()
    (gradient,) = torch.autograd.grad(KERNELS[name](points).sum(), points)
    step = 1e-6
    shifts = step * torch.eye(3, dtype=torch.float64)
    ahead, behind = (torch.stack([KERNELS[name](points.detach() + s * d) for d in shifts], -1) for s in (1, -1))
    smooth = (ahead + behind - 2 * KERNELS[name](points.detach())[:, None]).abs() < 1e-9
    assert torch.allclose(gradient[smooth], ((ahead - behind) / (2 * step))[smooth], atol=1e-5)


@pytest.mark.parametrize("name", KERNELS)
@given(seed=st.integers(0, 10_000))
def test_distance_changes_no_faster_than_one_moves(name, seed):
    generator = torch.Generator().manual_seed(seed)
    a, b = (torch.rand(16, 3, generator=generator, dtype=torch.float64) - 0.5 for _ in range(2))
    change = (KERNELS[name](a) - KERNELS[name](b)).abs()
    assert (change <= (a - b).norm(dim=-1) + 1e-12).all()
