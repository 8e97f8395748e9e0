"""Find a grasp's limits: the greatest mass at the object's friction, and the least friction at the object's mass.

Bisection over hold trials finds both limits. The trials may stop early (`early_stop`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from graspd_core.types import Grasp, StopHook
from graspd_core.verify.hold_trial import CHECK_EVERY, DIRECTIONS, breach, close_hand, hold_trial, step_until_known
from graspd_core.verify.world import Protocol, World, advance, altered, at_friction, trial_data

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

# Range of the payload search [kg].
LEAST_PAYLOAD, MOST_PAYLOAD = 0.01, 16.0
# Smallest friction that `least_friction` tries, as a fraction of the protocol's friction.
_LEAST_SHARE = 0.02
# A bisection ends when its upper bound is at most this factor times its lower bound.
FINENESS = 1.1
# Numbers for the estimate of a payload: steps in which the pull doubles, steps over which the hand's force is averaged,
# and the fraction of this force that also resists a sudden pull. Most estimates are within a factor of 2.
_DOUBLING, _WINDOW, _SHARE = 2, 8, 0.5
# Greatest factor between two masses that the payload search tries in turn, beginning at the estimate.
_STRIDE = 1.2


def payload(
    world: World,
    grasp: Grasp,
    protocol: Protocol,
    *,
    least: float = LEAST_PAYLOAD,
    most: float = MOST_PAYLOAD,
    held: bool = False,
    stop: StopHook = lambda: False,
) -> float:
    """Return the payload [kg]: the greatest mass up to `most` at which the grasp withstands every pull of the protocol.

    The result is 0 if the grasp does not hold the mass `least` [kg]. The hand closes once, with the object's own mass.
    If a hold trial has already closed the hand, the state of that trial is reused. Each pull starts from this state,
    with a force proportional to the tried mass. Set `held` if the grasp has already passed a hold trial at `least`.
    """
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    steps = CHECK_EVERY * round(protocol.hold_time / protocol.timestep / CHECK_EVERY)
    most = max(least, most)
    try:
        with trial_data(world) as data:
            closed = next((s for at, by, s in tuple(world.closed) if at is grasp.squeeze and by == protocol), None)
            if closed is None:
                if close_hand(world, data, grasp, protocol, np.zeros(2), stop=stop):
                    return 0.0
                closed = np.empty(mujoco.mj_stateSize(world.model, kind))
                mujoco.mj_getState(world.model, data, closed, kind)

            def holds(direction: np.ndarray, mass: float) -> bool:
                mujoco.mj_setState(world.model, data, closed, kind)
                data.xfrc_applied[world.object_body, :3] = protocol.pull * mass * direction
                # The object keeps its own mass. If this mass exceeds the tried one, it drifts too slowly for `rough`.
                return not step_until_known(world, data, protocol, np.zeros(2), steps, stop=stop, rough=held)

            pulls = []
            for direction in DIRECTIONS[list(protocol.pulls)]:
                mujoco.mj_setState(world.model, data, closed, kind)
                pulls.append((_estimated(world, data, protocol, direction, least), direction))
            # Start with the direction of the lowest estimate. In the others, search only if `most` is not held there.
            for estimate, direction in sorted(pulls, key=lambda pull: pull[0]):
                resists = partial(holds, direction)
                if not held and not resists(least):
                    return 0.0
                if not resists(most):
                    most = _greatest(resists, least, most, max(min(estimate, most / _STRIDE), least))
    except mujoco.FatalError:
        return 0.0
    return most


def least_friction(world: World, grasp: Grasp, protocol: Protocol) -> float:
    """Return the least sliding friction at which the grasp passes the hold trial. At most the protocol's friction."""

    def holds(fraction: float) -> bool:
        slippery = at_friction(protocol, Protocol.friction[0] / fraction)
        return hold_trial(altered(world, friction=slippery.friction), grasp, slippery).passed

    return protocol.friction[0] / _greatest(holds, 1.0, 1 / _LEAST_SHARE)


def _estimated(world: World, data: Any, protocol: Protocol, direction: np.ndarray, least: float) -> float:
    """Estimate the payload [kg]: pull ever harder along `direction` until the hand fails. Begin at 2 · `least` [kg]."""
    force, resisted = slice(world.object_velocity, world.object_velocity + 3), list[float]()
    for step in range(max(math.ceil(_DOUBLING * math.log2(MOST_PAYLOAD / least)), _WINDOW)):
        data.xfrc_applied[world.object_body, :3] = 2 * protocol.pull * least * 2 ** (step / _DOUBLING) * direction
        advance(world, data)
        resisted.append(-float(data.qfrc_constraint[force] @ direction))
        if breach(world, data, protocol, np.zeros(2)):
            break
    count = min(_WINDOW, len(resisted))
    return _SHARE * float(np.convolve(resisted, np.full(count, 1 / count), "valid").max()) / protocol.pull


def _greatest(holds: Callable[[float], bool], low: float, high: float, start: float | None = None) -> float:
    """Find by bisection the greatest value that `holds` accepts. `holds` must accept `low` and refuse `high`.

    The search begins at `start`, if given. Successive tried values then differ at most by the factor `_STRIDE`.
    """
    middle, stride = (math.sqrt(low * high), math.inf) if start is None else (start, _STRIDE)
    while high > FINENESS * low:
        low, high = (middle, high) if holds(middle) else (low, middle)
        middle = min(max(math.sqrt(low * high), middle / stride), middle * stride)
    return low
