"""A trajectory controller, as ros2_control has: targets in time, tolerances, abort, and a new motion at any time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float

from graspd_cell.robot import JointMotion
from graspd_core.errors import ConfigError

# Limits of position and speed are held to this, since numbers are rounded on their way [rad] or [m], and a factor.
_SLACK, _SPEED_SLACK = 1e-3, 1.05


class MotionState(Enum):
    """How a motion is getting on."""

    RUNNING = "running"
    REACHED = "reached"
    LEFT_PATH = "left its path"
    MISSED_GOAL = "missed its goal"


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Of the joints of one controller.

    Attributes:
        names: of the joints.
        lower, upper: limits of the positions [rad] or [m].
        velocity: greatest speeds [rad/s] or [m/s].
    """

    names: tuple[str, ...]
    lower: Float[np.ndarray, "joints"]
    upper: Float[np.ndarray, "joints"]
    velocity: Float[np.ndarray, "joints"]


@dataclass(frozen=True)
class Tolerances:
    """What a controller allows where a motion asks for nothing else.

    Attributes:
        path: greatest distance of a joint from its target on the path [rad] or [m].
        goal: greatest distance from the last target at the end [rad] or [m].
        goal_time: so long after the end of the motion the goal has to be reached [s].
    """

    path: float = np.inf
    goal: float = np.inf
    goal_time: float = 1.0


class TrajectoryController:
    """Targets of some joints over time.

    Args:
        limits: of the joints.
        tolerances: that hold where a motion asks for none.
        targets: that the joints begin with [rad] or [m].
    """

    def __init__(self, limits: JointLimits, tolerances: Tolerances, targets: Float[np.ndarray, "joints"]) -> None:
        self.limits, self.tolerances = limits, tolerances
        self.targets = np.array(targets, dtype=float)
        self.motion: JointMotion | None = None
        self._begun, self._from = 0.0, self.targets

    def begin(self, motion: JointMotion, now: float) -> None:
        """Follow a motion from `now` on [s], in place of the one before.

        Raises ConfigError: the motion is for other joints, or beyond the limits of position or speed.
        """
        motion = self._ordered(motion)
        self._refuse(motion)
        self.motion, self._begun, self._from = motion, now, self.targets.copy()

    def hold(self, positions: Float[np.ndarray, "joints"]) -> None:
        """Drop the motion and stay at some positions."""
        self.motion, self.targets = None, np.clip(positions, self.limits.lower, self.limits.upper)

    def advance(self, now: float, step: float) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "joints"]]:
        """Return the targets at `now` and their speeds over the `step` before [s]."""
        if self.motion is None:
            return self.targets, np.zeros_like(self.targets)
        before = self.targets
        self.targets = self.motion.at(now - self._begun, self._from)
        return self.targets, (self.targets - before) / step

    def state(self, now: float, positions: Float[np.ndarray, "joints"]) -> tuple[MotionState, str]:
        """Return how the motion is getting on at some measured positions, and of an abort why."""
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
        if motion.names == names:
            return motion
        if sorted(motion.names) != sorted(names):
            raise ConfigError(f"a motion of joints {', '.join(motion.names)}; valid: all of {', '.join(names)}")
        return motion.part(names)

    def _refuse(self, motion: JointMotion) -> None:
        low, high, names = self.limits.lower, self.limits.upper, self.limits.names
        beyond = np.maximum(low - motion.positions, motion.positions - high).max(0)
        if (beyond > _SLACK).any():
            joint = int(beyond.argmax())
            valid = f"[{low[joint]:g}, {high[joint]:g}]"
            raise ConfigError(f"joint {names[joint]!r} is sent {beyond[joint]:.3f} beyond its limits; valid: {valid}")
        times, ways = np.append(0.0, motion.times), np.vstack([self.targets, motion.positions])
        first = 1 if motion.times[0] == 0 else 0
        speed = np.abs(np.diff(ways[first:], axis=0)) / np.diff(times[first:])[:, None]
        fast = speed.max(0, initial=0.0) / self.limits.velocity
        if (fast > _SPEED_SLACK).any():
            joint = int(fast.argmax())
            told = f"is sent at {fast[joint] * self.limits.velocity[joint]:.2f} a second"
            raise ConfigError(f"joint {names[joint]!r} {told}; valid: at most {self.limits.velocity[joint]:.2f}")
