"""The methods: a row each. To add one, write its folder and its row; nothing else is edited."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from graspd_core.methods.annealing.annealing_config import AnnealingConfig
from graspd_core.methods.closed_form.closed_form_config import ClosedFormConfig, at_budget
from graspd_core.methods.graspd2022.graspd2022_config import Graspd2022Config
from graspd_core.methods.random_closure.random_closure_config import RandomClosureConfig

if TYPE_CHECKING:
    from graspd_core.methods.planner import PlannerInput, PlannerOutput


def _unchanged(settings: Any, budget: float) -> Any:
    return settings


def _one(settings: Any) -> int:
    return 1


@dataclass(frozen=True)
class Method:
    """One way to find grasps.

    Attributes:
        module: has `plan(PlannerInput) -> PlannerOutput`; imported when the method is first used, since it needs torch.
        config: dataclass of its settings; a preset's section of the method's name fills it.
        label: its name in charts.
        colour, marker: of its points in charts, as Matplotlib takes them.
        benchmark_count: grasps of one unfiltered batch in the benchmark.
        at_budget: its settings at a share of the usual budget; a method without one keeps its settings.
        searches: of a round at most, by its settings: again only where too few grasps are expected to hold.
    """

    module: str
    config: type
    label: str
    colour: str
    marker: str
    benchmark_count: int
    at_budget: Callable[[Any, float], Any] = _unchanged
    searches: Callable[[Any], int] = _one

    def plan(self, task: PlannerInput) -> PlannerOutput:
        """Find poses. Numerical trouble is a pose that is not there, never an exception."""
        return importlib.import_module(self.module).plan(task)


METHODS: dict[str, Method] = {
    "closed_form": Method(
        "graspd_core.methods.closed_form.closed_form",
        ClosedFormConfig,
        "closed form",
        "#0072B2",
        "o",
        16,
        at_budget,
        attrgetter("searches"),
    ),
    "graspd2022": Method(
        "graspd_core.methods.graspd2022.graspd2022", Graspd2022Config, "Grasp'D (2022)", "#D55E00", "s", 8
    ),
    "annealing": Method("graspd_core.methods.annealing.annealing", AnnealingConfig, "annealing", "#009E73", "^", 8),
    "random_closure": Method(
        "graspd_core.methods.random_closure.random_closure",
        RandomClosureConfig,
        "random closure",
        "#7F7F7F",
        "D",
        16,
    ),
}
