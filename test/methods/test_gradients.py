"""Every differentiable term against central differences in float64, and the terms in single precision."""

from collections.abc import Callable

import pytest
import torch
from expected import some
from torch import Tensor

from graspd_core.optimize import losses
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Poses, pack, unpack
from graspd_core.optimize.problem import Terms, evaluate

RADIUS, DELTA = 0.002, 0.01
# These scenes have no obstacles; their term has its own test in test_obstacles.py.
TERMS = Terms._fields[:-1]


def draw(*shape: int, low: float = 0.0, high: float = 1.0, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def limits() -> tuple[Tensor, Tensor]:
    return draw(5, low=-2.0, high=-1.0), draw(5, low=0.5, high=1.5)


def spheres() -> tuple[Tensor, Tensor]:
    """Radii of six spheres of 15 mm, and 1 / 2R of all pairs but neighbours."""
    weight = torch.triu(torch.full((6, 6), 0.5 / 0.03, dtype=torch.float64), 2)
    return torch.full((6,), 0.015, dtype=torch.float64), weight


# Per term: a function of (batch, n) and where to look. Lengths are drawn at least 0.1 mm from the kink of their term.
LOSSES: dict[str, tuple[Callable[[Tensor], Tensor], Tensor]] = {
    "task": (lambda x: losses.wrench_resistance(x, 0.5), draw(4, 12, low=0.01, high=2.0)),
    "touch outside": (lambda x: losses.touch(x, draw(6, low=0.004, high=0.1)), draw(4, 6, low=1e-4, high=0.05)),
    "touch inside": (lambda x: losses.touch(x, draw(6, low=0.004, high=0.1)), draw(4, 6, low=-0.05, high=-1e-4)),
    "penetration": (lambda x: losses.penetration(x, x.new_full((4,), 2e-3)), draw(4, 9, low=-0.01, high=1.9e-3)),
    "penetration by radius": (lambda x: losses.penetration(x - 1.0, x[:, 0]), draw(4, 9, low=0.01, high=0.02)),
    # Spheres of 15 mm within a box of 20 mm: every checked pair overlaps.
    "self_collision": (lambda x: losses.self_collision(x.unflatten(1, (6, 3)), *spheres()), draw(4, 18, high=0.015)),
    "posture": (lambda x: losses.posture(x, *limits()), draw(4, 5, low=-0.9, high=0.4)),
    "soft_contact": (
        lambda x: losses.soft_contact(x, x.new_full((4,), RADIUS), DELTA).sum(-1),
        draw(4, 9, low=RADIUS + 1e-4, high=0.05),
    ),
    "soft_contact below": (
        lambda x: losses.soft_contact(x, x.new_full((4,), RADIUS), DELTA).sum(-1),
        draw(4, 9, low=-0.05, high=RADIUS - 1e-4),
    ),
}


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_of_the_losses(name: str, slope_errors: Callable[..., Tensor]):
    function, x = LOSSES[name]
    assert (function(x) > 0).all() or name == "task"
    # With a step of 1e-6 (on lengths of millimetres) truncation is about (1e-6 / 1e-3)² and rounding 1e-16 / 1e-6.
    assert slope_errors(function, x, step=1e-6).max() < 1e-5


def random_poses(hand, scene, count: int) -> Poses:
    """Starts pushed 2 cm towards the object, with joints anywhere in their limits, so that every term is at work."""
    starts = draw_starts(scene, hand, count, 3, "cpu", torch.float64)
    lower, upper = torch.as_tensor(hand.lower), torch.as_tensor(hand.upper)
    joints = lower + (upper - lower) * draw(count, len(lower), seed=1)
    inward = -starts.translation / starts.translation.norm(dim=-1, keepdim=True)
    return Poses(starts.translation + 0.02 * inward, starts.quaternion, joints)


def terms_at(problem, x: Tensor, fine: bool) -> Terms:
    return evaluate(problem, unpack(x), x.new_full((len(x),), RADIUS), DELTA, fine=fine, sharp=fine)


@pytest.mark.parametrize(
    "variables", [slice(0, 3), slice(3, 7), slice(7, None)], ids=["translation", "quaternion", "joints"]
)
@pytest.mark.parametrize(("name", "fine"), [("sphere", False), ("sphere", True), ("box", False), ("box", True)])
def test_gradients_of_the_whole_evaluation(hand, scenes, problem_of, slope_errors, name, fine, variables):
    problem = problem_of(name)
    assert not fine or name != "box" or len(problem.object.features)
    x = pack(random_poses(hand, scenes[name], 4))
    for number, term in enumerate(TERMS):
        if term in ("self_collision", "posture") and variables != slice(7, None):
            continue
        value = some(terms_at(problem, x, fine)[number])
        assert (value.abs() > 0).any(), term
        errors = slope_errors(
            lambda y, n=number: terms_at(problem, y, fine)[n], x, step=1e-8, directions=6, variables=variables
        )
        # Interpolated distance and normal have kinks at the borders of 2 mm cells. A step of 1e-8 leaves rounding of
        # values up to 1e3 (1e-13 / 1e-8 over slopes of 1e2 and more), and a crossing of one of some hundred coordinates
        # in one of a thousand cases; of 24 a second one would be a fault.
        assert (errors > 1e-4).sum() <= 1, f"{term}: {errors}"


def test_self_collision_is_the_overlap_of_two_spheres():
    radii, weight = torch.tensor([0.01, 0.02]), torch.tensor([[0.0, 0.5 / 0.03], [0.0, 0.0]])
    centers = torch.tensor([[[0.0, 0, 0], [0.027, 0, 0]], [[0.0, 0, 0], [0.0, 0.031, 0]]])
    # 3 mm deep: (30² − 27²) / 60 = 2.85 mm, squared, over ten; apart: nothing. Single precision: 1e-7 over 1e-2.
    assert losses.self_collision(centers, radii, weight).tolist() == pytest.approx([2.85**2 / 10, 0.0], rel=1e-4)


@pytest.mark.parametrize(("name", "fine"), [("sphere", False), ("box", True)])
def test_single_and_double_precision_agree(hand, scenes, problem_of, name, fine):
    x = pack(random_poses(hand, scenes[name], 4))
    double = terms_at(problem_of(name), x, fine)
    single = terms_at(problem_of(name, torch.float32), x.float(), fine)
    # Positions of 0.1 m round to 1e-8 m, which is 1e-5 of the millimetre that penetration counts in; the squared
    # distances of self-collision cancel once more.
    for term, a, b in zip(TERMS, single[:-1], double[:-1], strict=True):
        assert a.double().numpy() == pytest.approx(b.numpy(), rel=1e-3, abs=1e-4), term
