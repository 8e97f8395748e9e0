"""What a picker sees of a robot: joint readings, depth images and motions, whether simulated or behind ROS topics.

The base frame is that of the arm's base link, z up. The table's top is the plane z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32

from graspd_core.errors import ConfigError, GraspdError


class MotionAborted(GraspdError):
    """A controller gave up on a motion. The message names the joint, its error and its tolerance."""


@dataclass(frozen=True, eq=False)
class JointReading:
    """What the joints of arm and hand tell at one time.

    Attributes:
        time: of the robot's clock [s].
        names: of the joints.
        positions: of the joints, in the order of `names` [rad] or [m].
        efforts: of the motors, in the order of `names` [N·m] or [N].
    """

    time: float
    names: tuple[str, ...]
    positions: Float[np.ndarray, "joints"]
    efforts: Float[np.ndarray, "joints"]

    def of(self, names: tuple[str, ...]) -> JointReading:
        """Return the reading of some joints, in the order of `names`. Raises GraspdError: a joint is missing."""
        rows = _rows(self.names, names)
        return JointReading(self.time, names, self.positions[rows], self.efforts[rows])


@dataclass(frozen=True, eq=False)
class DepthView:
    """One depth image, and where it was taken from.

    Attributes:
        time: of the robot's clock [s].
        depth: along the optical axis [m], zero where none was measured.
        intrinsics: the pinhole camera's matrix K [pixels].
        T_base_camera: pose of the camera's optical frame (z forward, y down) in the base frame [m].
    """

    time: float
    depth: Float32[np.ndarray, "height width"]
    intrinsics: Float[np.ndarray, "3 3"]
    T_base_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class JointMotion:
    """A timed trajectory of the joints of the arm, of those of the hand, or of both.

    A tolerance of None is the controller's own: an arm has one, a hand has none because fingers stop at what they hold.

    Attributes:
        names: of the joints.
        times: of the waypoints from the start of the motion [s], increasing.
        positions: of the joints, a row a waypoint [rad] or [m].
        velocities: of the joints, likewise [rad/s] or [m/s]. None: straight lines from waypoint to waypoint.
        path_tolerance: greatest distance of a joint from its target on the path, of all or of each [rad] or [m].
        goal_tolerance: greatest distance of a joint from its last target at the end, likewise [rad] or [m].
        goal_time: so long after the last waypoint the goal has to be reached [s].
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
        """Return the motion of some of the joints, in the order of `names`. Raises ConfigError: a joint is missing."""
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
        """Return the targets at `time` [s] of a motion that begins with the targets `start`.

        Cubic splines between waypoints with velocities, straight lines else, as ros2_control interpolates.
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
        if velocities is None:
            return (1 - a) * positions[after - 1] + a * positions[after]
        # The cubic Hermite basis.
        first, second = (1 + 2 * a) * (1 - a) ** 2, a**2 * (3 - 2 * a)
        rise, fall = a * (1 - a) ** 2 * span, -(a**2) * (1 - a) * span
        return (
            first * positions[after - 1]
            + second * positions[after]
            + rise * velocities[after - 1]
            + fall * velocities[after]
        )

    def _with_start(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        if self.times[0] == 0:
            return self.times, self.positions, self.velocities
        velocities = None if self.velocities is None else np.vstack([np.zeros_like(start), self.velocities])
        return np.append(0.0, self.times), np.vstack([start, self.positions]), velocities


def never() -> bool:
    """Return False: the `stop` of a motion that nobody stops."""
    return False


class Robot(Protocol):
    """An arm with a hand and a depth camera."""

    def joints(self) -> JointReading:
        """Return the latest reading of all joints."""
        ...

    def look(self) -> DepthView:
        """Return a depth image that was taken after this call."""
        ...

    def follow(self, motion: JointMotion, timeout: float, stop: Callable[[], bool] = never) -> JointReading:
        """Run a motion to its end and return the reading there.

        Joints that are not part of it keep their targets. Once `stop` returns True the joints stay where they are.

        Args:
            motion: of the arm's joints, of the hand's, or of both.
            timeout: for the whole motion, in seconds of the robot's clock.
            stop: polled while the robot moves.

        Raises:
            MotionAborted: a joint left its tolerance, time ran out, or `stop` asked.
        """
        ...

    def wait(self, seconds: float) -> None:
        """Let so much time of the robot's clock pass."""
        ...


def _rows(names: tuple[str, ...], wanted: tuple[str, ...]) -> list[int]:
    places = {name: row for row, name in enumerate(names)}
    unknown = [name for name in wanted if name not in places]
    if unknown:
        raise ConfigError(f"no joint {unknown[0]!r}; valid: {', '.join(names)}")
    return [places[name] for name in wanted]
