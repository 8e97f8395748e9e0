"""Compare your own loss weights with those of a preset: python examples/loss_weights.py [OBJECT] [my_preset.yaml].

Every setting of a preset has a dotted name. `override` changes settings. A YAML file of the same form is a preset of
your own. docs/method.md describes the terms of the loss.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from graspd_core import GraspdError, PlanConfig, Verdict, load_hand, load_preset, load_scene, override, plan_grasps

COUNT = 4


def gentle(config: PlanConfig) -> PlanConfig:
    """Return settings that reduce penetration in the last steps (polishing), at the cost of wrench resistance."""
    return override(
        config,
        {
            "closed_form.polish_weights.penetration": 40.0,
            "closed_form.polish_weights.wrench_resistance": 3.0,
            "closed_form.weights.posture": 0.1,
        },
    )


def row(name: str, config: PlanConfig, source: str) -> str:
    """Return a line of the table: how many grasps held, their mean penetration and epsilon, and the time."""
    result = plan_grasps(load_scene(source), load_hand("allegro_right"), count=COUNT, seed=0, preset=config)
    held = [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED]

    def mean(metric: str) -> float:
        values = [grasp.metrics[metric] for grasp in held if grasp.metrics]
        return float(np.mean([value for value in values if value is not None])) if values else float("nan")

    tried = len(result.tried)
    depth, epsilon = mean("penetration") * 1e3, mean("epsilon")
    return f"{name:<12}{len(held):>3} of {tried:<4}{depth:>8.2f} mm{epsilon:>9.3f}{result.timing.total:>8.2f} s"


def main(arguments: Sequence[str]) -> int:
    """Print the comparison. Return 0."""
    source = arguments[0] if arguments else "shape:mug"
    fast = load_preset("fast")
    settings = {"fast": fast, "gentle": gentle(fast)}
    if len(arguments) > 1:
        settings["yours"] = load_preset(arguments[1])
    try:
        override(fast, {"closed_form.weights.speed": 1.0})
    except GraspdError as error:
        print(f"a wrong name is refused: {error}\n")

    print(f"{'preset':<12}{'held':>9}{'depth':>11}{'epsilon':>9}{'time':>10}")
    for name, config in settings.items():
        print(row(name, config, source))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
