"""One small hand and small problems for the whole folder, and the one finite-difference checker."""

from collections.abc import Callable

import pytest
import torch
from small_problem import small_problem
from torch import Tensor

from graspd_core import HandModel, Poses, Problem, Scene, load_hand, load_scene
from graspd_core.optimize.graspd2022.graspd2022 import Graspd2022, make_body, published_starts
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config


@pytest.fixture(scope="session")
def hand() -> HandModel:
    return load_hand("allegro_right", candidates=120)


@pytest.fixture(scope="session")
def scenes() -> dict[str, Scene]:
    return {name: load_scene(f"shape:{name}", resolution=48) for name in ("sphere", "box", "cylinder")}


@pytest.fixture(scope="session")
def problem_of(hand: HandModel, scenes: dict[str, Scene]) -> Callable[[str, torch.dtype], Problem]:
    """The problem of an object by name and precision, with 60 coarse candidates; built once."""
    built: dict[tuple[str, torch.dtype], Problem] = {}

    def problem_of(name: str, dtype: torch.dtype = torch.float64) -> Problem:
        if (name, dtype) not in built:
            built[name, dtype] = small_problem(scenes[name], hand, dtype)
        return built[name, dtype]

    return problem_of


@pytest.fixture(scope="session")
def solver_of(scenes: dict[str, Scene]) -> Callable[[Graspd2022Config], Graspd2022]:
    """The solver of Grasp'D for the box, with given settings."""
    box = scenes["box"].object
    body = make_body(box.mass, box.inertia, box.center_of_mass, box.radius, "cpu", torch.float64)
    return lambda config: Graspd2022(config, body)


@pytest.fixture(scope="session")
def slope_errors() -> Callable[..., Tensor]:
    """Autograd against central differences along seeded random directions.

    The error is relative to the length of the gradient, so that directions across the gradient count for little.
    """

    def slope_errors(
        function: Callable[[Tensor], Tensor],
        x: Tensor,
        *,
        step: float,
        directions: int = 4,
        variables: slice = slice(None),
    ) -> Tensor:
        """Errors of the slopes of `function`, (batch, n) to (batch,), as (directions, batch)."""
        x = x.detach().requires_grad_(True)
        (gradient,) = torch.autograd.grad(function(x).sum(), x)
        length = gradient[:, variables].norm(dim=-1)
        generator = torch.Generator().manual_seed(0)
        errors = []
        for _ in range(directions):
            along = torch.zeros_like(x)
            along[:, variables] = torch.randn(x[:, variables].shape, generator=generator, dtype=x.dtype)
            along = along / along.norm(dim=-1, keepdim=True)
            with torch.no_grad():
                slope = (function(x + step * along) - function(x - step * along)) / (2 * step)
            errors.append((slope - (gradient * along).sum(-1)).abs() / length.clamp_min(1e-9))
        return torch.stack(errors)

    return slope_errors


@pytest.fixture(scope="module")
def problem(problem_of: Callable[..., Problem]) -> Problem:
    """The box in float64, where a test has no other."""
    return problem_of("box", torch.float64)


@pytest.fixture(scope="module")
def starts(problem: Problem, scenes: dict[str, Scene], hand: HandModel) -> Poses:
    """Three starts as published, where a test has no other."""
    return published_starts(problem, scenes["box"], hand, 3, 0, 0.1)
