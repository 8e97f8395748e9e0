"""Add your own planning method, and use and measure it like the built-in methods:

    graspd synthesize shape:box --plugin examples/your_own_method.py --method draws -n 1 --out grasps.json
    graspd bench --plugin examples/your_own_method.py --presets draws.yaml --objects shape:box

`draws.yaml` has the line `method: draws` and settings as `draws: {per_grasp: 64}`. A method returns hand poses in the
object's frame. From each pose, graspd makes a candidate with pregrasp, grasp and squeeze. It tries the best in
simulation. An installed package adds its method by an entry point of the group `graspd.methods`, without `--plugin`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from graspd_core import METHODS, Method, PlannerInput, PlannerOutput, draw_starts


@dataclass(frozen=True)
class DrawsConfig:
    """Settings of a method that draws hands around the object and optimises nothing.

    Attributes:
        per_grasp: number of hands drawn for each requested grasp.
        closing: how far the hands close, from 0 (open posture) to 1 (closed posture).
    """

    per_grasp: int = 32
    closing: float = 0.5


def plan(task: PlannerInput) -> PlannerOutput:
    """Return drawn hands, each closed a little. `task.problem` has scene and hand as tensors for an optimiser."""
    settings, hand = task.config.settings, task.hand
    count = task.count * settings.per_grasp
    starts = task.allowed(draw_starts(task.scene, hand, count, task.seed, task.device, task.dtype))
    opened, closed = (torch.as_tensor(values).to(starts.joints) for values in (hand.open_posture, hand.closed_posture))
    joints = opened + settings.closing * (closed - opened)
    return PlannerOutput(replace(starts, joints=joints.expand_as(starts.joints)))


METHODS["draws"] = Method(
    module=__name__,
    config=DrawsConfig,
    label="draws",
    colour="#009E73",
    marker="^",
    benchmark_count=8,
)
