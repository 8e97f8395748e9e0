"""Run the hold trial: close the hand on a free object, pull the object along ±x, ±y, ±z, check that it stays.

The trial re-implements the floating protocol of DexGraspBench from its published parameters. Travel and rotation of the
object are measured from the object's pose at the start of the trial. So they include motion while the hand closes. A
pull may stop early (`early_stop`). If the protocol asks for the full length, no pull stops early.

The noisy hold trial repeats the hold trial with a displaced hand, to simulate errors of the object's estimated pose.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.se3 import quaternion_from_rotation, rotation_from_axis_angle, rotation_from_quaternion
from graspd_core.types import Grasp, Posture, TrialResult
from graspd_core.verify.early_stop import CHECK_EVERY, LOOK_EVERY, ObjectState, answer_known, stop_rule
from graspd_core.verify.world import Protocol, World, advance, trial_data

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false


DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
# Reason of a trial result if the stop hook ended the trial.
STOPPED = "stopped before the trial ended"
# Greatest distance of a posture beyond a joint limit [rad] or [m]. Files round their numbers.
_BEYOND = 1e-3


def hold_trial(
    world: World, grasp: Grasp, protocol: Protocol, *, stop: Callable[[], bool] = lambda: False
) -> TrialResult:
    """Run one hold trial. It ends when the object exceeds a limit, or when the stop hook `stop()` returns true.

    Returns:
        The result, with the greatest displacement [m] of the object's centre of mass and the greatest rotation [rad]
        until the trial ended. If the simulation diverges or runs out of contact memory, the trial fails.
    """
    import mujoco

    worst = np.zeros(2)
    try:
        reason = _hold(world, grasp, protocol, worst, stop)
    except mujoco.FatalError as error:
        reason = gave_up(error)
    return TrialResult("hold", not reason, float(worst[0]), float(worst[1]), reason)


def gave_up(error: Exception) -> str:
    """Return the reason of a trial that failed because MuJoCo raised `error`."""
    return f"the simulation gave up: {str(error).splitlines()[0]}"


def _hold(world: World, grasp: Grasp, protocol: Protocol, worst: np.ndarray, stop: Callable[[], bool]) -> str:
    """Return why the grasp fails, "" if it holds. Update `worst`, the greatest travel [m] and rotation [rad]."""
    import mujoco

    with trial_data(world) as data:
        reason = close_hand(world, data, grasp, protocol, worst, stop=stop)
        if reason:
            return reason
        held = np.empty(mujoco.mj_stateSize(world.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(world.model, data, held, mujoco.mjtState.mjSTATE_INTEGRATION)
        mass = float(world.model.body_mass[world.object_body])
        steps = CHECK_EVERY * round(protocol.hold_time / protocol.timestep / CHECK_EVERY)
        for direction in DIRECTIONS[list(protocol.pulls)]:
            mujoco.mj_setState(world.model, data, held, mujoco.mjtState.mjSTATE_INTEGRATION)
            data.xfrc_applied[world.object_body, :3] = protocol.pull * mass * direction
            reason = step_until_known(world, data, protocol, worst, steps, stop=stop)
            if reason:
                return reason if reason == STOPPED else f"{reason} under a pull along {axis_name(direction)}"
        world.closed.append((grasp.squeeze, protocol, held))
        return ""


def step_until_known(
    world: World,
    data: Any,
    protocol: Protocol,
    worst: np.ndarray,
    steps: int,
    *,
    stop: Callable[[], bool],
    rough: bool = False,
) -> str:
    """Simulate `steps` steps. Stop earlier if the stop rule finds that the object will stay within the limits.

    Return why the trial failed, "" if it did not. Update `worst`, the greatest travel [m] and rotation [rad]. If
    `rough` is set, the pull may stop earlier (`stop_rule`), and the limits are checked more often.
    """
    rule, done = stop_rule(protocol, world.fingers, rough=rough), 0
    recent = deque[ObjectState](maxlen=1 + max(rule.windows) // LOOK_EVERY if rule else 0)
    while done < steps:
        if done % CHECK_EVERY == 0 and stop():
            return STOPPED
        count = min(LOOK_EVERY, steps - done)
        advance(world, data, count)
        done += count
        state = object_state(world, data)
        so_far = moved(world, state)
        if done % CHECK_EVERY == 0 or done == steps or (rough and broken_limit(protocol, *so_far)):
            reason = breach(world, data, protocol, worst)
            if reason:
                return reason
        if rule is None:
            continue
        recent.append(state)
        if done >= rule.first and answer_known(rule, protocol, [*recent], so_far, steps - done):
            return breach(world, data, protocol, worst)
    return ""


def object_state(world: World, data: Any) -> ObjectState:
    """Return the current pose and speed of the object."""
    turn = world.object_address + 3
    x, y, z, *spin = data.qvel[world.object_velocity : world.object_velocity + 6].tolist()
    return ObjectState(
        center=tuple(data.xipos[world.object_body].tolist()),
        quaternion_wxyz=tuple(data.qpos[turn : turn + 4].tolist()),
        speed=math.hypot(x, y, z),
        spin=math.hypot(*spin),
    )


def moved(world: World, state: ObjectState) -> tuple[float, float]:
    """Return travel of the object's centre of mass [m] and rotation of the object [rad] since the trial began."""
    w, x, y, z = state.quaternion_wxyz
    return math.dist(state.center, world.center_of_mass), 2 * math.atan2(math.hypot(x, y, z), abs(w))


def close_hand(
    world: World,
    data: Any,
    grasp: Grasp,
    protocol: Protocol,
    worst: np.ndarray,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> str:
    """Move the hand from the pregrasp over the grasp to the squeeze.

    Return why the trial failed, "" if it did not. Update `worst`, the greatest travel [m] and rotation [rad].
    """
    import mujoco

    if reason := posture_fault(world, data, grasp, protocol):
        return reason
    set_hand_pose(world, data, grasp.pregrasp)
    mujoco.mj_forward(world.model, data)
    for stage, (start, end) in {
        "closing": (grasp.pregrasp, grasp.grasp),
        "squeezing": (grasp.grasp, grasp.squeeze),
    }.items():
        reason = _move(world, data, start, end, protocol, worst)
        if not reason and stop():
            return STOPPED
        if reason:
            return f"{reason} while {stage}"
    fault = self_fault(world, data, protocol)
    return f"the squeeze {fault}" if fault else ""


def posture_fault(world: World, data: Any, grasp: Grasp, protocol: Protocol) -> str:
    """Return why pregrasp or grasp is invalid: joint limits or penetration. Return "" if both are valid."""
    deepest = {"pregrasp": protocol.max_start_penetration, "grasp": protocol.max_grasp_penetration}
    for name, limit in deepest.items():
        if fault := limit_fault(world, getattr(grasp, name)):
            return f"the {name} {fault}"
        place_hand(world, data, getattr(grasp, name))
        if (depth := start_penetration(world, data)) > limit:
            return f"the {name} penetrates the object by {depth * 1e3:.1f} mm"
        if fault := self_fault(world, data, protocol):
            return f"the {name} {fault}"
    return ""


def limit_fault(world: World, posture: Posture) -> str:
    """Return a text about the joint that is farthest beyond its limits. Return "" if no joint is beyond them."""
    # MuJoCo lists joints by ascending address.
    joints = np.searchsorted(world.model.jnt_qposadr, world.joint_addresses)
    low, high = world.model.jnt_range[joints].T
    beyond = np.maximum(low - posture.joint_positions, posture.joint_positions - high)
    worst = int(beyond.argmax())
    if beyond[worst] <= _BEYOND:
        return ""
    name = world.model.joint(int(joints[worst])).name.removeprefix("joint:")
    return f"puts joint {name!r} {beyond[worst]:.3g} rad or m beyond its limit"


def start_penetration(world: World, data: Any) -> float:
    """Return the greatest penetration of the hand into the object in the simulation's current state [m]."""
    bodies = world.model.geom_bodyid
    contact = data.contact
    on_object = (bodies[contact.geom1] == world.object_body) != (bodies[contact.geom2] == world.object_body)
    return float(-min(contact.dist[on_object], default=0.0)) if data.ncon else 0.0


def self_fault(world: World, data: Any, protocol: Protocol) -> str:
    """Return which two links penetrate each other most in the current state, "" if no depth exceeds the limit."""
    first, second, distance = data.contact.geom1, data.contact.geom2, data.contact.dist
    deep = np.flatnonzero(distance < -protocol.max_self_penetration)
    own = deep[np.isin(first[deep], world.hand_geoms) & np.isin(second[deep], world.hand_geoms)]
    if not len(own):
        return ""
    worst = own[distance[own].argmin()]
    bodies = (world.model.geom_bodyid[geoms[worst]] for geoms in (first, second))
    one, other = sorted(world.model.body(int(body)).name.removeprefix("link:") for body in bodies)
    return f"puts {one} {-1e3 * distance[worst]:.1f} mm into {other}"


def axis_name(direction: np.ndarray) -> str:
    return f"{'-' if direction.min() < 0 else '+'}{'xyz'[int(np.abs(direction).argmax())]}"


def set_hand_pose(world: World, data: Any, posture: Posture) -> None:
    """Set base pose, joint values and joint targets to a posture. The caller must run `mj_forward`."""
    set_joints(world, data, posture.joint_positions)
    set_targets(data, posture)


def place_hand(world: World, data: Any, posture: Posture) -> None:
    """Set the hand to a posture and compute its contacts."""
    import mujoco

    set_hand_pose(world, data, posture)
    mujoco.mj_kinematics(world.model, data)
    mujoco.mj_collision(world.model, data)


def set_joints(world: World, data: Any, values: np.ndarray) -> None:
    """Set the actuated joints to `values` [rad] or [m]. Each coupled joint follows its leader."""
    data.qpos[world.joint_addresses] = values
    for address, mimic in zip(world.coupled_addresses, world.mimics, strict=True):
        data.qpos[address] = mimic.multiplier * values[mimic.joint] + mimic.offset


def _move(world: World, data: Any, start: Posture, end: Posture, protocol: Protocol, worst: np.ndarray) -> str:
    """Move the hand's targets linearly from start to end. Return why the trial failed, "" if it did not."""
    steps = round(protocol.stage_time / protocol.timestep)
    for step, posture in enumerate(straight_path(start, end, np.arange(1, steps + 1) / steps), 1):
        set_targets(data, posture)
        advance(world, data)
        if step % CHECK_EVERY == 0:
            reason = breach(world, data, protocol, worst)
            if reason:
                return reason
    return ""


def straight_path(start: Posture, end: Posture, shares: Float[np.ndarray, "n"]) -> list[Posture]:
    """Return the postures at the fractions `shares` of the straight path from start to end."""
    a = shares[:, None]
    # Take the shorter rotation of the base. A quaternion and its negative are the same rotation.
    sign = 1.0 if start.quaternion_wxyz @ end.quaternion_wxyz >= 0 else -1.0
    positions = (1 - a) * start.position + a * end.position
    quaternions = (1 - a) * start.quaternion_wxyz + a * sign * end.quaternion_wxyz
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    joints = (1 - a) * start.joint_positions + a * end.joint_positions
    return [Posture(*at) for at in zip(positions, quaternions, joints, strict=True)]


def set_targets(data: Any, posture: Posture) -> None:
    """Set base pose and joint targets to a posture."""
    data.mocap_pos[0] = posture.position
    data.mocap_quat[0] = posture.quaternion_wxyz
    data.ctrl[:] = posture.joint_positions


def diverged(data: Any) -> bool:
    """Return True if MuJoCo warned of a bad state. Other MuJoCo warnings, e.g. a full contact buffer, are harmless."""
    import mujoco

    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(data.warning[int(warning)].number for warning in bad)


def breach(world: World, data: Any, protocol: Protocol, worst: np.ndarray) -> str:
    """Update `worst`, the greatest travel [m] and rotation [rad]. Return which limit is exceeded, "" if none is."""
    travel, turn = moved(world, object_state(world, data))
    if diverged(data) or not np.isfinite(data.qpos[world.object_address : world.object_address + 7]).all():
        worst[:] = np.inf
        return "the simulation diverged"
    worst[:] = np.maximum(worst, [travel, turn])
    return broken_limit(protocol, travel, turn)


def broken_limit(protocol: Protocol, travel: float, turn: float) -> str:
    """Return a text about the limit that the travel [m] or the rotation [rad] exceeds, "" if both are within limits."""
    if travel > protocol.max_displacement:
        return f"the object moved {travel * 100:.1f} cm"
    if turn > protocol.max_rotation:
        return f"the object turned {np.rad2deg(turn):.0f}°"
    return ""


def out_of_place(protocol: Protocol) -> Protocol:
    """Return the protocol without limit on penetration at the grasp, for trials of displaced hands and other shapes."""
    return replace(protocol, max_grasp_penetration=math.inf)


# Number of pose errors, each with one hold trial, in the noisy hold trial.
TRIALS = 8
# Pose error: rotation and offset [m] of the hand.
PoseError = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
# Greatest offset along each axis [m] and greatest rotation about a random axis [rad]. Errors are drawn uniformly.
OFFSET, TURN = 0.005, float(np.deg2rad(5.0))


def noisy_share(
    world: World,
    grasp: Grasp,
    protocol: Protocol,
    errors: Sequence[PoseError],
    *,
    stop: Callable[[], bool] = lambda: False,
) -> float | None:
    """Return the fraction of hold trials that the grasp passes, with one trial per pose error.

    Each error displaces pregrasp, grasp and squeeze alike, as a wrong estimate of the object's pose would. A trial
    fails if the pregrasp penetrates the object too deeply. Return None if `stop` ended a trial or `errors` is empty.
    """
    held, protocol = 0, out_of_place(protocol)
    for error in errors:
        held += hold_trial(world, displaced(grasp, *error, world.center_of_mass), protocol, stop=stop).passed
        if stop():
            return None
    return held / len(errors) if errors else None


def pose_errors(seed: int | Sequence[int], count: int) -> list[PoseError]:
    """Return `count` random pose errors. Equal seeds give equal errors."""
    rng = np.random.default_rng(seed)
    return [pose_error(rng) for _ in range(count)]


def pose_error(rng: np.random.Generator) -> PoseError:
    """Draw one random pose error: a rotation up to 5° (`TURN`), an offset up to 5 mm (`OFFSET`) along each axis."""
    axis = rng.normal(size=3)
    angle = torch.tensor(rng.uniform(-TURN, TURN), dtype=torch.float64)
    rotation = rotation_from_axis_angle(torch.as_tensor(axis / np.linalg.norm(axis)), angle).numpy()
    return rotation, rng.uniform(-OFFSET, OFFSET, 3)


def displaced(
    grasp: Grasp,
    rotation: Float[np.ndarray, "3 3"],
    offset: Float[np.ndarray, "3"],
    center: Float[np.ndarray, "3"],
) -> Grasp:
    """Return the grasp with its postures rotated about `center` [m], then shifted by `offset` [m], object frame."""

    def move(posture: Posture) -> Posture:
        base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
        return replace(
            posture,
            position=rotation @ (posture.position - center) + center + offset,
            quaternion_wxyz=quaternion_from_rotation(torch.as_tensor(rotation @ base)).numpy(),
        )

    return replace(grasp, pregrasp=move(grasp.pregrasp), grasp=move(grasp.grasp), squeeze=move(grasp.squeeze))
