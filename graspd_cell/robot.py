"""Robot interface of the picker: joint readings, depth images and motions, simulated or over ROS.

The base frame is the frame of the arm's base link, z up. The table's top is the plane z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32

from graspd_core.errors import ConfigError, GraspdError


class MotionAborted(GraspdError):
    """A motion did not end as commanded. If a joint left its tolerance, the message names joint, error, tolerance."""


@dataclass(frozen=True, eq=False)
class JointReading:
    """Reading of the joints of arm and hand at one time.

    Attributes:
        time: robot time [s].
        names: joint names.
        positions: joint positions in the order of `names` [rad] or [m].
        efforts: motor efforts in the order of `names` [N·m] or [N].
    """

    time: float
    names: tuple[str, ...]
    positions: Float[np.ndarray, "joints"]
    efforts: Float[np.ndarray, "joints"]

    def of(self, names: tuple[str, ...]) -> JointReading:
        """Return the reading of the joints `names`, in this order. Raises ConfigError: a joint is missing."""
        rows = _rows(self.names, names)
        return JointReading(self.time, names, self.positions[rows], self.efforts[rows])


@dataclass(frozen=True, eq=False)
class DepthView:
    """One depth image with intrinsics and camera pose.

    Attributes:
        time: robot time [s].
        depth: depth along the optical axis [m]. Zero means no measurement.
        intrinsics: matrix K of the pinhole camera [pixels].
        T_base_camera: pose of the camera's optical frame (z forward, y down) in the base frame [m].
    """

    time: float
    depth: Float32[np.ndarray, "height width"]
    intrinsics: Float[np.ndarray, "3 3"]
    T_base_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Timed trajectory of the joints of the arm, the hand, or both.

    If a tolerance is None, the controller's default applies. Hand controllers allow any error, as objects stop fingers.

    Attributes:
        names: joint names.
        times: increasing times of the waypoints from the start of the motion [s].
        positions: joint positions, one row per waypoint [rad] or [m].
        velocities: joint velocities, one row per waypoint [rad/s] or [m/s]. If None, waypoints are joined linearly.
        path_tolerance: greatest joint error during the motion, for all or for each joint [rad] or [m].
        goal_tolerance: greatest joint error at the end of the motion, for all or for each joint [rad] or [m].
        goal_time: time allowed after the last waypoint to reach the goal [s]. None takes the controller's default.
    """

    names: tuple[str, ...]
    times: Float[np.ndarray, "waypoints"]
    positions: Float[np.ndarray, "waypoints joints"]
    velocities: Float[np.ndarray, "waypoints joints"] | None = None
    path_tolerance: float | Float[np.ndarray, "joints"] | None = None
    goal_tolerance: float | Float[np.ndarray, "joints"] | None = None
    goal_time: float | None = None

    def __post_init__(self) -> None:
        rows, times = len(self.times), np.asarray(self.times)
        if rows < 1 or not np.isfinite(times).all() or times[0] < 0 or bool((np.diff(times) <= 0).any()):
            raise ConfigError(f"a motion's times are {times[:6].tolist()}; valid: from zero on, strictly increasing")
        tables = {"positions": self.positions, "velocities": self.velocities}
        for name, table in tables.items():
            if table is not None and (table.shape != (rows, len(self.names)) or not np.isfinite(table).all()):
                shape = f"{rows} rows of {len(self.names)}"
                raise ConfigError(f"a motion's {name} have shape {table.shape}; valid: {shape} finite numbers")

    def part(self, names: tuple[str, ...]) -> JointMotion:
        """Return the motion of the joints `names`, in this order. Raises ConfigError: a joint is missing."""
        rows = _rows(self.names, names)
        path, goal = (
            allowed[rows] if isinstance(allowed, np.ndarray) else allowed
            for allowed in (self.path_tolerance, self.goal_tolerance)
        )
        velocities = None if self.velocities is None else self.velocities[:, rows]
        return JointMotion(names, self.times, self.positions[:, rows], velocities, path, goal, self.goal_time)

    @property
    def duration(self) -> float:
        """Seconds from the start to the last waypoint."""
        return float(self.times[-1])

    def at(self, time: float, start: Float[np.ndarray, "joints"]) -> Float[np.ndarray, "joints"]:
        """Return the joint targets at `time` [s] if the motion begins with the targets `start`.

        Like ros2_control, interpolate cubically if the waypoints have velocities, and linearly if not.
        """
        times, positions, velocities = self._with_start(start)
        last = len(times) - 1
        after = int(np.searchsorted(times, time, side="right"))
        if after > last:
            return positions[-1]
        if after == 0:
            return positions[0]
        span = times[after] - times[after - 1]
        a = (time - times[after - 1]) / span
        here, there = positions[after - 1 : after + 1]
        if velocities is None:
            return (1 - a) * here + a * there
        # Values of the cubic Hermite basis.
        first, second = (1 + 2 * a) * (1 - a) ** 2, a**2 * (3 - 2 * a)
        rise, fall = a * (1 - a) ** 2 * span, -(a**2) * (1 - a) * span
        return first * here + second * there + rise * velocities[after - 1] + fall * velocities[after]

    def _with_start(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        if self.times[0] == 0:
            return self.times, self.positions, self.velocities
        velocities = None if self.velocities is None else np.vstack([np.zeros_like(start), self.velocities])
        return np.append(0.0, self.times), np.vstack([start, self.positions]), velocities


def never() -> bool:
    """Return False. This is the default of `stop`."""
    return False


class Robot(Protocol):
    """Interface of an arm with a hand and a depth camera."""

    def joints(self) -> JointReading:
        """Return the latest reading of all joints."""
        ...

    def look(self) -> DepthView:
        """Return a depth image that was taken after this call."""
        ...

    def follow(self, motion: JointMotion, timeout: float, stop: Callable[[], bool] = never) -> JointReading:
        """Execute a motion and return the joint reading at its end.

        Other joints keep their targets. If `stop` returns True, the joints hold their current positions.

        Args:
            motion: motion of all joints of the arm, the hand, or both.
            timeout: limit for the whole motion in robot time [s].
            stop: polled while the robot moves.

        Raises:
            MotionAborted: a joint left its tolerance, the timeout passed, or `stop` returned True.
        """
        ...

    def wait(self, seconds: float) -> None:
        """Wait for `seconds` of robot time."""
        ...


def _rows(names: tuple[str, ...], wanted: tuple[str, ...]) -> list[int]:
    places = {name: row for row, name in enumerate(names)}
    unknown = [name for name in wanted if name not in places]
    if unknown:
        raise ConfigError(f"no joint {unknown[0]!r}; valid: {', '.join(names)}")
    return [places[name] for name in wanted]
