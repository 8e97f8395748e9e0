"""How much a grasp holds: the greatest mass at its friction, and the least friction at its mass.

Both are found by bisection over trials whose pulls end when their answer is known (`early_stop`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from graspd_core.types import Grasp, StopHook
from graspd_core.verify.hold_trial import CHECK_EVERY, DIRECTIONS, close_hand, hold_trial, step_until_known
from graspd_core.verify.world import Protocol, World, altered, at_friction, trial_data

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

# The least and the greatest mass that are asked about [kg].
LEAST_PAYLOAD, MOST_PAYLOAD = 0.01, 16.0
# The least share of its friction that is asked about.
_LEAST_SHARE = 0.02
# Limits are found to this factor.
FINENESS = 1.1


def payload(
    world: World,
    grasp: Grasp,
    protocol: Protocol,
    *,
    least: float = LEAST_PAYLOAD,
    held: bool = False,
    stop: StopHook = lambda: False,
) -> float:
    """Return the greatest mass [kg] whose pulls the grasp holds, zero where it does not hold the `least`.

    The hand closes once on the object's own mass, unless a hold trial has just closed it. Each direction is then pulled
    as hard as the trial pulls the mass that is asked about, from the same state. `held` says that a hold trial has
    shown that the grasp holds the `least`.
    """
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    steps = CHECK_EVERY * round(protocol.hold_time / protocol.timestep / CHECK_EVERY)
    most = math.inf
    try:
        with trial_data(world) as data:
            closed = next((s for at, by, s in tuple(world.closed) if at is grasp.squeeze and by == protocol), None)
            if closed is None:
                if close_hand(world, data, grasp, protocol, np.zeros(2), stop=stop):
                    return 0.0
                closed = np.empty(mujoco.mj_stateSize(world.model, kind))
                mujoco.mj_getState(world.model, data, closed, kind)
            # Hands are weakest against what pulls the object out of them, the way they came.
            way = grasp.grasp.position - grasp.pregrasp.position
            directions = DIRECTIONS[list(protocol.pulls)]
            for direction in directions[np.argsort(-directions @ way, kind="stable")]:

                def holds(mass: float, direction: np.ndarray = direction) -> bool:
                    mujoco.mj_setState(world.model, data, closed, kind)
                    data.xfrc_applied[world.object_body, :3] = protocol.pull * mass * direction
                    return not step_until_known(world, data, protocol, np.zeros(2), steps, stop=stop)

                if not held and not holds(least):
                    return 0.0
                if math.isinf(most):
                    low = high = least
                    while high < MOST_PAYLOAD and holds(high := min(2 * low, MOST_PAYLOAD)):
                        low = high
                    most = _greatest(holds, low, high) if low < high else high
                # Only a direction that is weaker than those before it is looked at closely.
                elif not holds(most):
                    most = _greatest(holds, least, most)
    except mujoco.FatalError:
        return 0.0
    return most


def least_friction(world: World, grasp: Grasp, protocol: Protocol, *, stop: StopHook = lambda: False) -> float:
    """Return the least sliding friction at which the grasp passes the hold trial, that of the protocol at most."""

    def holds(fraction: float) -> bool:
        slippery = at_friction(protocol, Protocol.friction[0] / fraction)
        return hold_trial(altered(world, friction=slippery.friction), grasp, slippery, stop=stop).passed

    return protocol.friction[0] / _greatest(holds, 1.0, 1 / _LEAST_SHARE)


def _greatest(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return the greatest value known to hold, between `low` that does and `high` that does not."""
    while high > FINENESS * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
