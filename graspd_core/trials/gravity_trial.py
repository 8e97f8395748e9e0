"""The drop trial: how far gravity moves an object in a hand that squeezes it, after 2 s in MuJoCo.

Stands beside the papers' displacement (`displacement`), which knows neither motors nor effort limits: its hand is
frozen, and 0.15 s are over before a slow slip shows. Same hand, object and physics as the hold trial.
"""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from graspd_core.scene.far_objects import moved_grasp
from graspd_core.trials.early_stop import CHECK_EVERY, CREEPING, drift
from graspd_core.trials.hold_trial import DIRECTIONS, close_hand, diverged, moved, object_pose
from graspd_core.trials.world import Protocol, World, trial_data
from graspd_core.types import Grasp

GRAVITY, DURATION = 9.8, 2.0
# A trial along one direction ends here, and what never was in the hand counts as this too [m].
LOST = 0.1
# Displacements are known to this [m]: a direction ends where the object cannot go farther any more.
TOLERANCE = 1e-4


def gravity_trial(world: World, grasp: Grasp, protocol: Protocol, *, stop: Callable[[], bool] = lambda: False) -> float:
    """Displacement [m] of the object's centre of mass from the start of the trial, mean over six gravity directions.

    The hand closes and squeezes as in the hold trial; then gravity acts on the object along ±x, ±y, ±z in turn for 2 s.
    At most 10 cm: an object that moved so far is lost, and one that the hold trial would refuse is lost from the start.
    A direction ends when its figure is known to 0.1 mm (`early_stop`), unless the protocol asks for the full length.
    Directions that `stop` cut short count with what they came to.
    """
    import mujoco

    grasp = moved_grasp(grasp, -world.origin)
    with trial_data(world) as data:
        if close_hand(world, data, grasp, protocol, np.zeros(2)):
            return LOST
        held = np.empty(mujoco.mj_stateSize(world.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(world.model, data, held, mujoco.mjtState.mjSTATE_INTEGRATION)
        weight = GRAVITY * float(world.model.body_mass[world.object_body])
        displaced = np.empty(len(DIRECTIONS))
        for index, direction in enumerate(DIRECTIONS):
            mujoco.mj_setState(world.model, data, held, mujoco.mjtState.mjSTATE_INTEGRATION)
            data.xfrc_applied[world.object_body, :3] = weight * direction
            displaced[index] = _fall(world, data, protocol, stop)
        return float(displaced.mean())


def _fall(world: World, data: Any, protocol: Protocol, stop: Callable[[], bool]) -> float:
    """Simulate 2 s, or until the displacement is known or the object lost; returns the displacement then [m]."""
    import mujoco

    # A figure asks for more than a verdict: swings have to die away, whatever the friction.
    rule = None if protocol.full_length else CREEPING
    steps, poses, travel = CHECK_EVERY * round(DURATION / protocol.timestep / CHECK_EVERY), {}, 0.0
    for done in range(CHECK_EVERY, steps + 1, CHECK_EVERY):
        if stop():
            break
        mujoco.mj_step(world.model, data, CHECK_EVERY)
        now = poses[done] = object_pose(world, data)
        travel, _ = moved(world, now)
        if diverged(data) or not travel < LOST:
            return LOST
        if rule and done >= rule.first and drift(rule, poses[done - rule.window], now, steps - done)[0] < TOLERANCE:
            break
    return travel
