"""Joint trajectory controller like that of ros2_control: tolerances, abort, and replacement of a running motion."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float

from graspd_cell.robot import JointMotion
from graspd_core.errors import ConfigError

# Rounding errors allowed beyond the limits: of positions [rad] or [m], and of speeds as a factor.
_SLACK, _SPEED_SLACK = 1e-3, 1.05


class MotionState(Enum):
    """State of a motion."""

    RUNNING = "running"
    REACHED = "reached"
    LEFT_PATH = "left its path"
    MISSED_GOAL = "missed its goal"


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits of the joints of one controller.

    Attributes:
        names: joint names.
        lower, upper: position limits [rad] or [m].
        velocity: speed limits [rad/s] or [m/s].
    """

    names: tuple[str, ...]
    lower: Float[np.ndarray, "joints"]
    upper: Float[np.ndarray, "joints"]
    velocity: Float[np.ndarray, "joints"]


@dataclass(frozen=True)
class Tolerances:
    """Default tolerances of a controller, for motions that give none.

    Attributes:
        path: greatest error of a joint during the motion [rad] or [m].
        goal: greatest error of a joint at the end of the motion [rad] or [m].
        goal_time: time allowed after the last waypoint to reach the goal [s].
    """

    path: float = np.inf
    goal: float = np.inf
    goal_time: float = 1.0


class TrajectoryController:
    """Controller that computes joint targets over time.

    Args:
        limits: joint limits.
        tolerances: defaults for motions without tolerances.
        targets: initial joint targets [rad] or [m].
    """

    def __init__(self, limits: JointLimits, tolerances: Tolerances, targets: Float[np.ndarray, "joints"]) -> None:
        self.limits, self.tolerances = limits, tolerances
        self.targets = np.array(targets, dtype=float)
        self.motion: JointMotion | None = None
        self._begun, self._from = 0.0, self.targets

    def begin(self, motion: JointMotion, now: float) -> None:
        """Start a motion at time `now` [s]. It replaces the running motion.

        Raises ConfigError: the motion names other joints, or exceeds a position or speed limit.
        """
        motion = self._ordered(motion)
        self._refuse(motion)
        self.motion, self._begun, self._from = motion, now, self.targets.copy()

    def hold(self, positions: Float[np.ndarray, "joints"]) -> None:
        """End the motion and set the targets to `positions` [rad] or [m], clipped to the limits."""
        self.motion, self.targets = None, np.clip(positions, self.limits.lower, self.limits.upper)

    def advance(self, now: float, step: float) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "joints"]]:
        """Return the joint targets at `now` [s], and their mean speeds since the last call, `step` [s] ago."""
        if self.motion is None:
            return self.targets, np.zeros_like(self.targets)
        before = self.targets
        self.targets = self.motion.at(now - self._begun, self._from)
        return self.targets, (self.targets - before) / step

    def state(self, now: float, positions: Float[np.ndarray, "joints"]) -> tuple[MotionState, str]:
        """Return the state of the motion at measured positions [rad] or [m], and the reason if the motion failed."""
        motion = self.motion
        if motion is None:
            return MotionState.REACHED, ""
        over = now - self._begun - motion.duration
        error = np.abs(positions - self.targets)
        if over < 0:
            allowed = self.tolerances.path if motion.path_tolerance is None else motion.path_tolerance
            if (error > allowed).any():
                return MotionState.LEFT_PATH, self._told(error, allowed, "left its path")
            return MotionState.RUNNING, ""
        allowed = self.tolerances.goal if motion.goal_tolerance is None else motion.goal_tolerance
        if (error <= allowed).all():
            return MotionState.REACHED, ""
        if over > (self.tolerances.goal_time if motion.goal_time is None else motion.goal_time):
            return MotionState.MISSED_GOAL, self._told(error, allowed, "missed its goal")
        return MotionState.RUNNING, ""

    def _told(self, error: np.ndarray, allowed: float | np.ndarray, what: str) -> str:
        joint, most = int((error - allowed).argmax()), np.broadcast_to(allowed, error.shape)
        return f"joint {self.limits.names[joint]!r} {what} by {error[joint]:.3f}; its tolerance is {most[joint]:g}"

    def _ordered(self, motion: JointMotion) -> JointMotion:
        names = self.limits.names
        if sorted(motion.names) != sorted(names):
            raise ConfigError(f"the motion has joints {', '.join(motion.names)}; valid: all of {', '.join(names)}")
        return motion.part(names)

    def _refuse(self, motion: JointMotion) -> None:
        low, high, names = self.limits.lower, self.limits.upper, self.limits.names
        beyond = np.maximum(low - motion.positions, motion.positions - high).max(0)
        if (beyond > _SLACK).any():
            joint = int(beyond.argmax())
            valid = f"[{low[joint]:g}, {high[joint]:g}]"
            raise ConfigError(f"joint {names[joint]!r} would go {beyond[joint]:.3f} beyond its limits; valid: {valid}")
        times, ways = np.append(0.0, motion.times), np.vstack([self.targets, motion.positions])
        first = 1 if motion.times[0] == 0 else 0
        speed = np.abs(np.diff(ways[first:], axis=0)) / np.diff(times[first:])[:, None]
        fast = speed.max(0, initial=0.0) / self.limits.velocity
        if (fast > _SPEED_SLACK).any():
            joint = int(fast.argmax())
            told = f"would move at {fast[joint] * self.limits.velocity[joint]:.2f} rad/s or m/s"
            raise ConfigError(f"joint {names[joint]!r} {told}; valid: at most {self.limits.velocity[joint]:.2f}")
