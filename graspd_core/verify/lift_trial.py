"""Run the lift trial: approach an object on its support, close the hand, lift the object, and hold the object.

The hand starts at the retreat, 10 cm before the pregrasp, and moves over the pregrasp to the grasp. First, MuJoCo's
distances show whether these commanded postures penetrate the support or a neighbour. The simulation cannot show such
penetration, because a mocap body, such as the hand's base, passes through fixed bodies. Then the trial simulates under
gravity, and checks that the object rises with the hand and stays in the hand. The lift is simulated in the hand's
frame: the base stands still, support and neighbours move down, and an inertial force acts on the object. MuJoCo gives
mocap bodies no velocity, so a rising base would not carry the object by friction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.hands.kinematics import RETREAT, retreat_posture
from graspd_core.hands.model import HandModel
from graspd_core.types import Grasp, Posture, TrialResult
from graspd_core.verify.early_stop import CHECK_EVERY
from graspd_core.verify.hold_trial import (
    STOPPED,
    breach,
    gave_up,
    posture_fault,
    self_fault,
    set_hand_pose,
    set_targets,
    step_until_known,
    straight_path,
)
from graspd_core.verify.world import Protocol, World, advance, trial_data

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false


_COMING, _CLOSING, _SQUEEZING, _LIFTING = "while approaching", "while closing", "while squeezing", "while lifting"
# Fractions of each path at which the hand's commanded postures are checked for collisions. The path's end is added.
_SHARES = (0.0, 0.25, 0.5, 0.75)


@dataclass(frozen=True)
class LiftSettings:
    """Settings of a lift trial, in addition to the physics and limits of `world.Protocol`.

    Attributes:
        retreat: distance from the pregrasp back to the start pose, against the hand's approach direction [m].
        approach_time: duration of the motion from the start pose to the pregrasp [s].
        lift_height: height of the lift [m].
        lift_time: duration of the lift [s].
        hold_time: duration of the hold after the lift [s].
        max_reach_through: greatest allowed penetration of the support or a neighbour by a commanded posture [m].
    """

    retreat: float = RETREAT
    approach_time: float = 0.4
    lift_height: float = 0.2
    lift_time: float = 1.0
    hold_time: float = 3.0
    max_reach_through: float = 0.002


def lift_trial(
    world: World,
    hand: HandModel,
    grasp: Grasp,
    protocol: Protocol,
    *,
    settings: LiftSettings = LiftSettings(),
    stop: Callable[[], bool] = lambda: False,
) -> TrialResult:
    """Run one lift trial in a simulation with support or neighbours. It ends once the object exceeds a limit.

    The object is fixed until the first touch, so that it cannot fall over on a badly reconstructed bottom. In the
    rising hand's frame, the object must stay within the protocol's limits (5 cm, 15°) of its start pose. Without a
    support there is no gravity. Then the hand moves back against the approach direction instead of up.
    """
    import mujoco

    begin, worst = retreat_posture(hand, grasp.pregrasp, settings.retreat), np.zeros(2)
    try:
        with trial_data(world) as data:
            reason = posture_fault(world, data, grasp, protocol)
            commanded = (begin, grasp.pregrasp, grasp.grasp)
            reason = reason or reach_through(world, data, commanded, settings.max_reach_through)
            if not reason:
                set_hand_pose(world, data, begin)
                reason = _raise(world, data, begin, grasp, protocol, settings, worst=worst, stop=stop)
            if not reason:
                steps = round(settings.hold_time / protocol.timestep)
                reason = _said(step_until_known(world, data, protocol, worst, steps, stop=stop), "while held up")
    except mujoco.FatalError as error:
        return TrialResult("lift", False, 0.0, 0.0, gave_up(error))
    return TrialResult("lift", not reason, float(worst[0]), float(worst[1]), reason)


def _raise(
    world: World,
    data: Any,
    begin: Posture,
    grasp: Grasp,
    protocol: Protocol,
    settings: LiftSettings,
    *,
    worst: np.ndarray,
    stop: Callable[[], bool],
) -> str:
    """Approach, close, squeeze, lift. Return why the trial failed, "" if it did not. Update `worst` (see `breach`)."""
    away, touched = (begin.position - grasp.pregrasp.position) / settings.retreat, False
    stages = (
        (_COMING, begin, grasp.pregrasp, settings.approach_time),
        (_CLOSING, grasp.pregrasp, grasp.grasp, protocol.stage_time),
        (_SQUEEZING, grasp.grasp, grasp.squeeze, protocol.stage_time),
        (_LIFTING, grasp.squeeze, grasp.squeeze, settings.lift_time),
    )
    for name, start, end, duration in stages:
        steps = round(duration / protocol.timestep)
        for step, posture in enumerate(straight_path(start, end, np.arange(1, steps + 1) / steps), 1):
            set_targets(data, posture)
            if name == _LIFTING:
                _sink(world, data, away if world.up is None else world.up, step / steps, settings)
            advance(world, data)
            if not touched and name in (_COMING, _CLOSING):
                touched = _touches(world, data)
                _rest(world, data)
            if step % CHECK_EVERY == 0 or step == steps:
                reason = breach(world, data, protocol, worst)
                if reason or stop():
                    return _said(reason or STOPPED, name)
        if name == _SQUEEZING and (fault := self_fault(world, data, protocol)):
            return f"the squeeze {fault}"
    return ""


def _said(reason: str, stage: str) -> str:
    return f"{reason} {stage}" if reason and reason != STOPPED else reason


def _touches(world: World, data: Any) -> bool:
    bodies = world.model.geom_bodyid
    first, second = data.contact.geom1, data.contact.geom2
    hand = np.isin(first, world.hand_geoms) | np.isin(second, world.hand_geoms)
    return bool((hand & ((bodies[first] == world.object_body) | (bodies[second] == world.object_body))).any())


def _rest(world: World, data: Any) -> None:
    data.qpos[world.object_address : world.object_address + 7] = [0, 0, 0, 1, 0, 0, 0]
    data.qvel[world.object_velocity : world.object_velocity + 6] = 0


def _sink(world: World, data: Any, up: Float[np.ndarray, "3"], a: float, settings: LiftSettings) -> None:
    data.mocap_pos[1:] = -settings.lift_height * a * a * (3 - 2 * a) * up
    acceleration = settings.lift_height * (6 - 12 * a) / settings.lift_time**2 if a < 1 else 0.0
    body = world.object_body
    data.xfrc_applied[body, :3] = -acceleration * world.model.body_mass[body] * up


def reach_through(world: World, data: Any, postures: tuple[Posture, ...], limit: float) -> str:
    """Return where on the path through `postures` the hand is deepest in an obstacle. "" if below `limit` [m]."""
    import mujoco

    worst, reason = 0.0, ""
    for (start, end), name in zip(pairwise(postures), (_COMING, _CLOSING), strict=True):
        for posture in straight_path(start, end, np.array([*_SHARES, 1.0])):
            set_hand_pose(world, data, posture)
            mujoco.mj_kinematics(world.model, data)
            for geom, said in world.obstacles:
                depth = max(-mujoco.mj_geomDistance(world.model, data, geom, g, 0.0, None) for g in world.hand_geoms)
                if depth > worst:
                    worst = depth
                    reason = f"the hand reaches {depth * 1e3:.1f} mm into {said} {name}" if depth > limit else ""
    return reason
