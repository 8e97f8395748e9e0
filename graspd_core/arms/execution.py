"""Convert a grasp to a timed trajectory of arm and hand, for an executor that knows no geometry.

The trajectory has gates, at which all joints are at rest. An executor sends the rows up to a gate, checks that the gate
is reached, and sends the next rows. Between two gates the joints follow the grasp's path with a cubic time law from
rest to rest. The greatest speed is 1.5 times the mean speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline

from graspd_core.arms.arm_paths import LIFT
from graspd_core.config.planning_config import GraspStagesConfig
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import RETREAT
from graspd_core.hands.model import HandModel
from graspd_core.types import Grasp

# Gates in their order. The trajectory begins at the retreat, before the first gate.
GATES = ("pregrasp", "closed", "squeezed", "lifted")
# A cubic from rest to rest has these ratios: greatest speed / mean speed, greatest acceleration / (travel / time²).
PEAK_SPEED, PEAK_ACCELERATION = 1.5, 6.0
# Number of trajectory rows of the squeeze.
_SQUEEZE_ROWS = 4
# Number of points in time at which the speed of a stage is checked.
_SAMPLES = 200
_GRAVITY = 9.81


@dataclass(frozen=True)
class ExecutionPace:
    """Speed limits for the execution of a grasp.

    Attributes:
        finger_speed: greatest speed of the hand's revolute joints [rad/s].
        base_speed: greatest speed of the hand's base in approach and lift, and of prismatic hand joints [m/s].
        closing_speed: greatest speed of the hand's base from the pregrasp to the grasp [m/s].
        shortest: least duration of a stage [s].
        payload_share: fraction of the grasp's payload that weight and acceleration of the object may use in the lift.
        gentlest, strongest: least and greatest acceleration of the lift [m/s²].
    """

    finger_speed: float = 1.0
    base_speed: float = 0.15
    closing_speed: float = 0.05
    shortest: float = 0.5
    payload_share: float = 0.8
    gentlest: float = 0.3
    strongest: float = 2.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name}: {value}; valid: a positive, finite number")


@dataclass(frozen=True, eq=False)
class Execution:
    """The trajectory of one grasp, from the retreat to the end of the lift.

    Attributes:
        arm_joints, hand_joints: joint names in column order, without coupled joints.
        times: time of each row from the start [s]. The first time is zero.
        arm: joint values of the arm at each row [rad] or [m].
        arm_speed: joint speeds of the arm at each row [rad/s] or [m/s].
        hand: joint targets of the hand at each row [rad] or [m].
        hand_speed: joint speeds of the hand at each row [rad/s] or [m/s].
        efforts: joint efforts of the hand at each row [N·m] or [N]. Zero before the squeeze.
        gates: row index of each gate, in the order of `GATES`.
    """

    arm_joints: tuple[str, ...]
    hand_joints: tuple[str, ...]
    times: Float[np.ndarray, "rows"]
    arm: Float[np.ndarray, "rows arm_joints"]
    arm_speed: Float[np.ndarray, "rows arm_joints"]
    hand: Float[np.ndarray, "rows hand_joints"]
    hand_speed: Float[np.ndarray, "rows hand_joints"]
    efforts: Float[np.ndarray, "rows hand_joints"]
    gates: tuple[int, ...]

    def rows_to(self, gate: str) -> slice:
        """Return the rows from the previous gate to `gate`, including the rows of both gates."""
        place = GATES.index(gate)
        return slice(self.gates[place - 1] if place else 0, self.gates[place] + 1)


def execution_of(
    grasp: Grasp,
    hand: HandModel,
    *,
    arm_speeds: Float[np.ndarray, "joints"],
    mass: float | None = None,
    pace: ExecutionPace | None = None,
) -> Execution:
    """Return the timed trajectory of a grasp with an arm path.

    Args:
        grasp: grasp with an arm path (`Grasp.arm`).
        hand: hand of the grasp.
        arm_speeds: greatest speed of each arm joint [rad/s] or [m/s].
        mass: mass of the object [kg]. If it is None, the lift has the acceleration `pace.gentlest`.
        pace: limits of speed and acceleration. None for the defaults.

    Raises:
        ConfigError: the grasp has no arm path, or `arm_speeds` is not one positive number for each joint of the path,
            or `mass` is below 0 or NaN.
    """
    if grasp.arm is None:
        raise ConfigError("execution: the grasp has no arm path; plan the grasp with the restriction Reach")
    if len(arm_speeds) != len(grasp.arm.joint_names) or not (np.asarray(arm_speeds) > 0).all():
        wanted = f"one positive number for each of {', '.join(grasp.arm.joint_names)}"
        raise ConfigError(f"arm_speeds: {np.asarray(arm_speeds).tolist()}; valid: {wanted}")
    if mass is not None and not mass >= 0.0:
        raise ConfigError(f"mass: {mass} kg; valid: a number from 0, or None")
    pace, path, (retreat, before, closed, lifted) = pace or ExecutionPace(), grasp.arm.positions, grasp.arm.stages
    limits = np.concatenate([arm_speeds, hand.joint_speeds(pace.finger_speed, pace.base_speed)])
    low, high = hand.lower, hand.upper
    open_, touch, press = (np.clip(p.joint_positions, low, high) for p in (grasp.pregrasp, grasp.grasp, grasp.squeeze))
    shares = np.linspace(0.0, 1.0, closed - before + 1)[:, None]
    still, steps = path[closed], np.linspace(0.0, 1.0, _SQUEEZE_ROWS + 1)[:, None]
    approach = float(np.linalg.norm(grasp.grasp.position - grasp.pregrasp.position))
    moves = (
        (_both(path[retreat : before + 1], open_), RETREAT / pace.base_speed, 0.0),
        (_both(path[before : closed + 1], open_ + shares * (touch - open_)), approach / pace.closing_speed, 0.0),
        (_both(np.repeat(still[None], len(steps), 0), touch + steps * (press - touch)), 0.0, 0.0),
        (_both(path[closed : lifted + 1], press), LIFT / pace.base_speed, lift_time(grasp, mass, pace)),
    )
    times, rows, speeds, gates = [np.zeros(1)], [moves[0][0][:1]], [np.zeros((1, len(limits)))], [0]
    for move, seconds, least in moves:
        time, speed = _from_rest_to_rest(move, limits, max(PEAK_SPEED * seconds, least, pace.shortest))
        times.append(times[-1][-1] + time[1:])
        rows.append(move[1:])
        speeds.append(speed[1:])
        gates.append(gates[-1] + len(move) - 1)
    rows, speeds, count = np.concatenate(rows), np.concatenate(speeds), len(grasp.arm.joint_names)
    efforts = np.zeros((len(rows), hand.num_joints))
    efforts[gates[3] :] = squeeze_efforts(grasp, hand)
    efforts[gates[2] : gates[3] + 1] = steps * efforts[gates[3]]
    return Execution(
        grasp.arm.joint_names, hand.joint_names, np.concatenate(times), rows[:, :count], speeds[:, :count],
        rows[:, count:], speeds[:, count:], efforts, tuple(gates[1:]),
    )  # fmt: skip


def lift_time(grasp: Grasp, mass: float | None, pace: ExecutionPace) -> float:
    """Return the duration of the lift [s]. A greater ratio of the grasp's payload to `mass` [kg] shortens the lift."""
    payload = (grasp.metrics or {}).get("payload")
    spare = 0.0 if not payload or not mass else _GRAVITY * (pace.payload_share * payload / mass - 1.0)
    return math.sqrt(PEAK_ACCELERATION * LIFT / min(max(spare, pace.gentlest), pace.strongest))


def squeeze_efforts(grasp: Grasp, hand: HandModel) -> Float[np.ndarray, "joints"]:
    """Return the joint efforts [N·m, N], within limits, for joints at the grasp with targets at the squeeze."""
    gain = np.where(hand.slides, GraspStagesConfig.slide_stiffness, GraspStagesConfig.stiffness)
    return np.clip(gain * (grasp.squeeze.joint_positions - grasp.grasp.joint_positions), -hand.effort, hand.effort)


def _both(arm: np.ndarray, hand: np.ndarray) -> np.ndarray:
    return np.concatenate([arm, np.broadcast_to(hand, (len(arm), hand.shape[-1]))], 1)


def _from_rest_to_rest(
    rows: np.ndarray, limits: np.ndarray, shortest: float
) -> tuple[Float[np.ndarray, "rows"], Float[np.ndarray, "rows joints"]]:
    """Return times and speeds of evenly spaced `rows` within `limits`, over at least `shortest` [s]."""
    share = np.linspace(0.0, 1.0, len(rows))
    # At time t from 0 to 1, the cubic covers the fraction 3t² − 2t³ of the path. Solve for t.
    time = 0.5 - np.sin(np.arcsin(1.0 - 2.0 * share) / 3.0)
    speed = np.gradient(rows, share, axis=0) * (6.0 * time * (1.0 - time))[:, None]
    # A controller's cubic may be faster between the rows than at the rows.
    checked = np.concatenate([time, np.linspace(0.0, 1.0, _SAMPLES)])
    fastest = np.abs(CubicHermiteSpline(time, rows, speed)(checked, 1)).max(0)
    span = max(shortest, float((fastest / limits).max()))
    return span * time, speed / span
