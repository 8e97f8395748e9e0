"""Grasps from anywhere, another planner's or a file's: tried and measured as those of `plan_grasps` are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graspd_core.config import VERIFICATIONS
from graspd_core.errors import ConfigError
from graspd_core.hands.model import HandModel
from graspd_core.metrics import measure as metrics
from graspd_core.metrics.metrics_context import make_metrics_context
from graspd_core.scene.scene import Scene, object_parts
from graspd_core.trials.trial_registry import build_worlds, grasp_trials
from graspd_core.trials.world import PROTOCOLS, at_friction
from graspd_core.types import Grasp

# Farther from one than this, the length of a quaternion is no rounding error.
_UNIT_TOLERANCE = 0.01


def verify_grasps(
    scene: Scene, hand: HandModel, grasps: Sequence[Grasp], *, verify: str = "standard", measure: bool = True
) -> tuple[Grasp, ...]:
    """Run the trials and measure the metrics of grasps that are given, in their order; none is dropped.

    Args:
        scene: what is grasped; with a support or obstacles the lift trial runs too.
        hand: whose joints the postures name, in the order of `hand.joint_names`.
        grasps: `pregrasp`, `grasp` and `squeeze` count; earlier metrics and trials are replaced.
        verify: "standard" or "hard" trials, which "full" and "hard_full" run to the end, or "none".
        measure: whether metrics are measured, of failed grasps too.

    Raises:
        ConfigError: `verify` is unknown, or a posture does not fit the hand or is not finite.
    """
    if verify not in VERIFICATIONS:
        raise ConfigError(f"verify: {verify!r}; valid: {', '.join(VERIFICATIONS)}")
    for index, grasp in enumerate(grasps):
        _refuse_posture(grasp, hand, f"grasp {index}")
    verified = tuple(replace(grasp, metrics=None, trials=()) for grasp in grasps)
    if verify != "none":
        protocol = at_friction(PROTOCOLS[verify], scene.object.friction)
        worlds = build_worlds(scene, hand, object_parts(scene.object), protocol)
        verified = tuple(replace(grasp, trials=grasp_trials(worlds, grasp)) for grasp in verified)
    if measure:
        context = make_metrics_context(scene.object, hand)
        verified = tuple(replace(grasp, metrics=metrics.measure(context, grasp.grasp)) for grasp in verified)
    return verified


def _refuse_posture(grasp: Grasp, hand: HandModel, name: str) -> None:
    for stage in ("pregrasp", "grasp", "squeeze"):
        posture = getattr(grasp, stage)
        joints = len(hand.joint_names)
        for key, size in (("position", 3), ("quaternion_wxyz", 4), ("joint_positions", joints)):
            values = np.asarray(getattr(posture, key))
            if values.shape != (size,) or not np.isfinite(values).all():
                raise ConfigError(f"{name}: {stage}.{key} is {values.tolist()}; valid: {size} finite numbers")
        length = float(np.linalg.norm(posture.quaternion_wxyz))
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise ConfigError(f"{name}: {stage}.quaternion_wxyz has length {length:.3g}; valid: 1")
