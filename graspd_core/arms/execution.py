"""A grasp for an executor: one timed trajectory of arm and hand with gates, so that it needs no geometry.

All joints rest at every gate. An executor sends the rows up to a gate, checks that it is reached, and sends the next.
Between two gates the joints follow the grasp's own path by a cubic from rest to rest. Its greatest speed is 1.5 times
the mean one.
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

# Where all joints rest, in this order: the arm stands at the retreat before the first.
GATES = ("pregrasp", "closed", "squeezed", "lifted")
# Greatest over mean speed of a cubic that starts and ends at rest, and its greatest acceleration over travel by time².
PEAK_SPEED, PEAK_ACCELERATION = 1.5, 6.0
# Rows of a squeeze.
_SQUEEZE_ROWS = 4
# Times at which a stage's speed is looked at.
_SAMPLES = 200
_GRAVITY = 9.81


@dataclass(frozen=True)
class ExecutionPace:
    """How fast a grasp is executed.

    Attributes:
        finger_speed: greatest of the hand's turning joints [rad/s].
        base_speed: greatest of the hand on its way to the object and up, and of its sliding joints [m/s].
        closing_speed: greatest of the hand from the pregrasp to the grasp [m/s].
        shortest: least time of a stage [s].
        payload_share: of the greatest mass that the grasp holds, which weight and the lift's acceleration may ask for.
        gentlest, strongest: bounds of the lift's acceleration [m/s²].
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
                raise ConfigError(f"{name}: {value}; it must be positive and finite")


@dataclass(frozen=True, eq=False)
class Execution:
    """One grasp, from the retreat to the end of the lift.

    Attributes:
        arm_joints, hand_joints: names, in the order of the columns. Joints that follow others are left out.
        times: of each row from the start [s]. The first is zero.
        arm: joint values of each row [rad] or [m].
        arm_speed: of the arm's joints there [rad/s] or [m/s].
        hand: joint targets of each row [rad] or [m].
        hand_speed: of the hand's joints there [rad/s] or [m/s].
        efforts: of the hand's joints at each row, zero until they squeeze [N·m] or [N].
        gates: the rows of `GATES`.
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
        """Return the rows that lead from the gate before to this one, both included."""
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
    """Return the timed trajectory of a grasp that an arm reaches.

    Args:
        grasp: with `Grasp.arm`.
        hand: that it was planned for.
        arm_speeds: greatest of the arm's joints [rad/s] or [m/s].
        mass: of the object [kg]. None: unknown, so that the lift is gentle.
        pace: how fast all else moves.

    Raises:
        ConfigError: the grasp has no path of the arm.
    """
    if grasp.arm is None:
        raise ConfigError("execution: the grasp has no path of an arm; plan it with the restriction Reach")
    pace, path, (retreat, before, closed, lifted) = pace or ExecutionPace(), grasp.arm.positions, grasp.arm.stages
    fingers = np.minimum(np.where(hand.slides, pace.base_speed, pace.finger_speed), hand.velocity)
    limits = np.concatenate([arm_speeds, fingers])
    low, high = hand.lower, hand.upper
    open_, touch, press = (np.clip(p.joint_positions, low, high) for p in (grasp.pregrasp, grasp.grasp, grasp.squeeze))
    shares = np.linspace(0.0, 1.0, closed - before + 1)[:, None]
    still, steps = path[closed], np.linspace(0.0, 1.0, _SQUEEZE_ROWS + 1)[:, None]
    way = float(np.linalg.norm(grasp.grasp.position - grasp.pregrasp.position))
    stages = (
        (_both(path[retreat : before + 1], open_), RETREAT / pace.base_speed, 0.0),
        (_both(path[before : closed + 1], open_ + shares * (touch - open_)), way / pace.closing_speed, 0.0),
        (_both(np.repeat(still[None], len(steps), 0), touch + steps * (press - touch)), 0.0, 0.0),
        (_both(path[closed : lifted + 1], press), LIFT / pace.base_speed, lift_time(grasp, mass, pace)),
    )
    times, rows, speeds, gates = [np.zeros(1)], [stages[0][0][:1]], [np.zeros((1, len(limits)))], [0]
    for stage, seconds, least in stages:
        time, speed = _from_rest_to_rest(stage, limits, PEAK_SPEED * seconds, max(least, pace.shortest))
        times.append(times[-1][-1] + time[1:])
        rows.append(stage[1:])
        speeds.append(speed[1:])
        gates.append(gates[-1] + len(stage) - 1)
    rows, speeds, count = np.concatenate(rows), np.concatenate(speeds), len(grasp.arm.joint_names)
    efforts = np.zeros((len(rows), hand.num_joints))
    efforts[gates[3] :] = squeeze_efforts(grasp, hand)
    efforts[gates[2] : gates[3] + 1] = steps * efforts[gates[3]]
    return Execution(
        grasp.arm.joint_names, hand.joint_names, np.concatenate(times), rows[:, :count], speeds[:, :count],
        rows[:, count:], speeds[:, count:], efforts, tuple(gates[1:]),
    )  # fmt: skip


def lift_time(grasp: Grasp, mass: float | None, pace: ExecutionPace) -> float:
    """Return how long the lift takes [s]: the faster, the more than its mass the grasp would hold."""
    payload = (grasp.metrics or {}).get("payload")
    spare = 0.0 if not payload or not mass else _GRAVITY * (pace.payload_share * payload / mass - 1.0)
    return math.sqrt(PEAK_ACCELERATION * LIFT / min(max(spare, pace.gentlest), pace.strongest))


def squeeze_efforts(
    grasp: Grasp, hand: HandModel, stages: GraspStagesConfig | None = None
) -> Float[np.ndarray, "joints"]:
    """Return the joint efforts when the object stops the squeeze at the grasp, within their limits [N·m] or [N]."""
    stages = stages or GraspStagesConfig()
    gain = np.where(hand.slides, stages.slide_stiffness, stages.stiffness)
    return np.clip(gain * (grasp.squeeze.joint_positions - grasp.grasp.joint_positions), -hand.effort, hand.effort)


def _both(arm: np.ndarray, hand: np.ndarray) -> np.ndarray:
    return np.concatenate([arm, np.broadcast_to(hand, (len(arm), hand.shape[-1]))], 1)


def _from_rest_to_rest(
    rows: np.ndarray, limits: np.ndarray, least: float, shortest: float
) -> tuple[Float[np.ndarray, "rows"], Float[np.ndarray, "rows joints"]]:
    """Return times [s] of rows evenly spaced along their path, and speeds, zero at both ends."""
    share = np.linspace(0.0, 1.0, len(rows))
    # The share that a cubic covers, 3t² − 2t³, solved for t.
    time = 0.5 - np.sin(np.arcsin(1.0 - 2.0 * share) / 3.0)
    speed = np.gradient(rows, share, axis=0) * (6.0 * time * (1.0 - time))[:, None]
    # Between rows a controller's cubic may be faster than at them.
    fastest = np.abs(CubicHermiteSpline(time, rows, speed)(np.linspace(0.0, 1.0, _SAMPLES), 1)).max(0)
    span = max(shortest, least, float((fastest / limits).max()))
    return span * time, speed / span
