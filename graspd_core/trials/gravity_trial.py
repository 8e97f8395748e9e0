"""The drop trial: how far gravity moves an object in a hand that squeezes it, after 2 s in MuJoCo.

Stands beside the papers' displacement (`displacement`), which knows neither motors nor effort limits: its hand is
frozen, and 0.15 s are over before a slow slip shows. Same hand, object and physics as the hold trial.
"""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.scene.far_objects import moved_grasp
from graspd_core.trials.early_stop import CHECK_EVERY, CREEPING, ObjectState
from graspd_core.trials.hold_trial import DIRECTIONS, close_hand, diverged, moved, object_state
from graspd_core.trials.world import Protocol, World, trial_data
from graspd_core.types import Grasp

GRAVITY, DURATION = 9.8, 2.0
# A trial along one direction ends here, and what never was in the hand counts as this too [m].
LOST = 0.1
# A direction ends when its displacement is known to this [m].
TOLERANCE = 1e-4
# Checks that a speed is taken over; how many times the change of what it foretells has to fit into the tolerance.
_WINDOW, _SAFETY = 2, 4


def gravity_trial(world: World, grasp: Grasp, protocol: Protocol, *, stop: Callable[[], bool] = lambda: False) -> float:
    """Displacement [m] of the object's centre of mass from the start of the trial, mean over six gravity directions.

    The hand closes and squeezes as in the hold trial; then gravity acts on the object along ±x, ±y, ±z in turn for 2 s.
    At most 10 cm: an object that moved so far is lost, and one that the hold trial would refuse is lost from the start.
    A direction ends when what its speed foretells for 2 s no longer changes, to 0.1 mm, and the figure is what it
    foretells, unless the protocol asks for the full length.
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

    checks, states = round(DURATION / protocol.timestep / CHECK_EVERY), list[ObjectState]()
    travel = 0.0
    for _ in range(checks):
        if stop():
            break
        mujoco.mj_step(world.model, data, CHECK_EVERY)
        states.append(object_state(world, data))
        travel = moved(world, states[-1])[0]
        if diverged(data) or not travel < LOST:
            return LOST
        if not protocol.full_length and (end := _end(states, checks)) is not None:
            return min(math.dist(end, world.center_of_mass), LOST)
    return travel


def _end(states: list[ObjectState], checks: int) -> Float[np.ndarray, "3"] | None:
    """Where the centre of mass will be at the end, as soft contacts creep evenly; None where that is not known."""
    recent = states[-2 * _WINDOW - 1 :]
    if len(recent) <= 2 * _WINDOW or not all(s.speed < CREEPING.speed and s.spin < CREEPING.spin for s in recent):
        return None
    first, middle, last = (np.asarray(state.center) for state in (recent[0], recent[_WINDOW], recent[-1]))
    left = (checks - len(states)) / _WINDOW
    end, before = last + left * (last - middle), middle + (left + 1) * (middle - first)
    return end if _SAFETY * np.linalg.norm(end - before) < TOLERANCE else None
