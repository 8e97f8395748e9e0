"""The trials that a raw grasp goes through, by the name that `--trials` knows them by; docs/metrics.md defines them.

Lengths are written in the unit of their name, [cm] and [deg].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from graspd_core.bench.bullet.bullet_hold import bullet_hold_trial
from graspd_core.bench.bullet.bullet_world import build_bullet_world, bullet_available, bullet_displacement
from graspd_core.hands.model import HandModel
from graspd_core.scene.scene import ObjectModel
from graspd_core.trials.gravity_trial import gravity_trial
from graspd_core.trials.hold_trial import hold_trial
from graspd_core.trials.noisy_trial import noisy_trial
from graspd_core.trials.world import PROTOCOLS, build_world
from graspd_core.types import Grasp, TrialResult, TriangleMesh

# One trial of one grasp: figures by name.
Trial = Callable[[Grasp], dict[str, Any]]


@dataclass(frozen=True)
class Tried:
    """What a trial needs to know: the hand, the object and its convex parts."""

    hand: HandModel
    target: ObjectModel
    parts: Sequence[TriangleMesh]


def _hold(name: str, tried: Tried) -> Trial:
    protocol = PROTOCOLS[name]
    world = build_world(tried.hand, tried.target, tried.parts, protocol)
    return lambda grasp: _figures(hold_trial(world, grasp, protocol))


def _noisy(tried: Tried) -> Trial:
    protocol = PROTOCOLS["standard"]
    world = build_world(tried.hand, tried.target, tried.parts, protocol)
    return lambda grasp: {"share": noisy_trial(world, grasp, protocol)}


def _gravity(tried: Tried) -> Trial:
    protocol = PROTOCOLS["standard"]
    world = build_world(tried.hand, tried.target, tried.parts, protocol)
    return lambda grasp: {"displacement_cm": gravity_trial(world, grasp, protocol) * 100}


def _displacement(tried: Tried) -> Trial:
    if not bullet_available():
        return _nothing
    world = build_bullet_world(tried.hand, tried.target, tried.parts)
    return lambda grasp: {"displacement_cm": bullet_displacement(world, grasp.grasp) * 100}


def _second(tried: Tried) -> Trial:
    if not bullet_available():
        return _nothing
    world = build_bullet_world(tried.hand, tried.target, tried.parts)
    return lambda grasp: _figures(bullet_hold_trial(world, grasp, PROTOCOLS["standard"]))


def _nothing(grasp: Grasp) -> dict[str, Any]:
    """Without PyBullet there is no figure."""
    return {}


def _figures(result: TrialResult) -> dict[str, Any]:
    return {
        "passed": result.passed,
        "displacement_cm": result.displacement * 100,
        "rotation_deg": float(np.rad2deg(result.rotation)),
        "reason": result.reason,
    }


TRIALS: Mapping[str, Callable[[Tried], Trial]] = {
    "standard": partial(_hold, "standard"),
    "hard": partial(_hold, "hard"),
    "sd": _displacement,
    "gravity": _gravity,
    "noisy": _noisy,
    "bullet": _second,
}
# What a raw cell goes through unless told otherwise: the noisy trial takes eight times as long as the others.
USUAL = ("standard", "hard", "sd", "gravity")
