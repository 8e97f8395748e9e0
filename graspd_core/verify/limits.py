"""Limits of a grasp: the greatest mass that it holds at the object's friction, and the least friction at its mass.

Both are found by bisection over hold trials with early stop (`early_stop`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from graspd_core.types import Grasp, StopHook
from graspd_core.verify.early_stop import LOOK_EVERY
from graspd_core.verify.hold_trial import CHECK_EVERY, DIRECTIONS, close_hand, hold_trial, step_until_known
from graspd_core.verify.world import Protocol, World, altered, at_friction, trial_data

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

# Range of the payload search [kg].
LEAST_PAYLOAD, MOST_PAYLOAD = 0.01, 16.0
# Smallest tried friction, as a fraction of the protocol's.
_LEAST_SHARE = 0.02
# The bisections end when the bounds differ by less than this factor.
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
    """Return the payload [kg]: the greatest mass at which the grasp withstands every pull of the protocol.

    The result is 0 if the grasp does not hold the mass `least` [kg]. The hand closes once, with the object's own mass.
    If a hold trial has already closed the hand, its state is reused. Each pull starts from this state, with the force
    for the tried mass. Set `held` if a hold trial has already passed at `least`.
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
            # Hands are weakest against pulls along the approach, out of the hand. These directions come first.
            way = grasp.grasp.position - grasp.pregrasp.position
            directions = DIRECTIONS[list(protocol.pulls)]
            for direction in directions[np.argsort(-directions @ way, kind="stable")]:

                def holds(mass: float, direction: np.ndarray = direction) -> bool:
                    mujoco.mj_setState(world.model, data, closed, kind)
                    data.xfrc_applied[world.object_body, :3] = protocol.pull * mass * direction
                    # Half of the pulls end at a limit, which a look finds before the trial's own check.
                    worst, often = np.zeros(2), LOOK_EVERY
                    return not step_until_known(world, data, protocol, worst, steps, stop=stop, check_every=often)

                if not held and not holds(least):
                    return 0.0
                if math.isinf(most):
                    low = high = least
                    while high < MOST_PAYLOAD and holds(high := min(2 * low, MOST_PAYLOAD)):
                        low = high
                    most = _greatest(holds, low, high) if low < high else high
                # Bisect again only in a direction that is weaker than all earlier ones.
                elif not holds(most):
                    most = _greatest(holds, least, most)
    except mujoco.FatalError:
        return 0.0
    return most


def least_friction(world: World, grasp: Grasp, protocol: Protocol, *, stop: StopHook = lambda: False) -> float:
    """Return the least sliding friction, at most the protocol's, at which the grasp passes the hold trial."""

    def holds(fraction: float) -> bool:
        slippery = at_friction(protocol, Protocol.friction[0] / fraction)
        return hold_trial(altered(world, friction=slippery.friction), grasp, slippery, stop=stop).passed

    return protocol.friction[0] / _greatest(holds, 1.0, 1 / _LEAST_SHARE)


def _greatest(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return by bisection the greatest value that holds. `low` must hold and `high` must not."""
    while high > FINENESS * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
