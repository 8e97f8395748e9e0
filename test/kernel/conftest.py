"""Problems that use every part of the kernel."""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from graspd_core import HandModel, Problem, Scene, build_problem, draw_starts, load_hand, load_scene
from graspd_core.config import ProblemConfig
from graspd_core.optimize.kernel.builds import kernel
from graspd_core.optimize.loop import moved_along, pack
from graspd_core.perception.obstacles import make_obstacles
from graspd_core.types import Plane


@pytest.fixture(scope="session", autouse=True)
def _built() -> None:
    if os.environ.get("GRASPD_KERNEL") == "off":
        pytest.skip("GRASPD_KERNEL is off")
    assert kernel().library is not None, kernel().reason


@pytest.fixture(scope="session")
def scenes() -> dict[str, Scene]:
    """Free objects, one of them thin, one partly guessed, and one on a table between two walls."""
    found = {name: load_scene(f"shape:{name}") for name in ("box", "mug")}
    box = found["box"]
    seen = np.random.default_rng(0).random(box.sdf.field.shape[1:])
    found["guessed"] = replace(box, confidence=torch.as_tensor(seen, dtype=torch.float32))
    table = Plane(np.array([0.0, 0.0, 1.0]), float(box.object.mesh.vertices[:, 2].min()))
    y, z = np.meshgrid(np.linspace(-0.05, 0.05, 15), np.linspace(-0.045, 0.055, 15))
    walls = [np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()]) for x in (-0.07, 0.07)]
    obstacles = make_obstacles(walls, table, box.object.mesh, 10.0)
    assert len(obstacles) == 2
    found["crowded"] = replace(box, support=table, obstacles=obstacles)
    return found


@pytest.fixture(scope="session")
def hands() -> Callable[[str], HandModel]:
    return cache(lambda name: load_hand(name, candidates=240))


@pytest.fixture(scope="session")
def problem_of(hands, scenes):
    """The problem of a hand and a scene by name, built once."""

    @cache
    def problem_of(hand: str, scene: str) -> Problem:
        settings = ProblemConfig(candidates=120, features=24, directions=12, friction=0.5)
        return build_problem(scenes[scene], hands(hand), settings, seed=0)

    return problem_of


@pytest.fixture(scope="session")
def rows_of(hands, scenes):
    """Starts on their way to the object: rows of `AdamState.x`."""

    def rows_of(hand: str, scene: str, problem: Problem) -> torch.Tensor:
        starts = draw_starts(scenes[scene], hands(hand), 12, 3, "cpu", torch.float32)
        x = pack(moved_along(starts, problem.hand.pivot))
        # Some before the surface, some across it.
        share = torch.linspace(1.0, 0.4, 12)[:, None]
        x[:, :3] = share * x[:, :3] + (1 - share) * problem.object.center
        return x

    return rows_of
