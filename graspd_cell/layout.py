"""Where table, bins and camera stand about an arm. The base frame is that of the arm's base link, z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from graspd_bench.rendering.depth_noise import CAMERAS
from graspd_bench.rendering.render import look_at
from graspd_core.arms.arm import Arm, arm_links
from graspd_core.perception.cloud.camera import PinholeCamera


@dataclass(frozen=True)
class Box:
    """A solid with edges along the base frame's axes, fixed in the cell.

    Attributes:
        name: of the solid.
        center: [m].
        half: half edges [m].
    """

    name: str
    center: tuple[float, float, float]
    half: tuple[float, float, float]


@dataclass(frozen=True)
class Bin:
    """Four walls on the table.

    Attributes:
        name: of the bin.
        center: of its floor, x and y [m].
        half: half its inner side [m].
        height: of its walls [m].
        wall: their thickness [m].
    """

    name: str
    center: tuple[float, float]
    half: float = 0.17
    height: float = 0.06
    wall: float = 0.01

    def holds(self, point: Float[np.ndarray, "3"]) -> bool:
        """Whether a point is above the bin's floor, within its walls [m]."""
        return bool(np.abs(point[:2] - self.center).max() < self.half + self.wall)

    @property
    def walls(self) -> tuple[Box, ...]:
        """The four walls as solids."""
        (x, y), half, up, thick = self.center, self.half, 0.5 * self.height, 0.5 * self.wall
        off, long = half + thick, half + self.wall
        return (
            Box(self.name, (x - off, y, up), (thick, long, up)),
            Box(self.name, (x + off, y, up), (thick, long, up)),
            Box(self.name, (x, y - off, up), (half, thick, up)),
            Box(self.name, (x, y + off, up), (half, thick, up)),
        )


@dataclass(frozen=True, eq=False)
class CellLayout:
    """What stands in the cell beside the robot, as a team measures it in its own.

    Attributes:
        table: its top is the plane z = 0.
        pick: the bin that is emptied.
        place: the bin that is filled.
        camera: the depth camera's lens.
        T_base_camera: pose of its optical frame [m].
        start: joint values at which the arm hides nothing from the camera [rad].
    """

    table: Box
    pick: Bin
    place: Bin
    camera: PinholeCamera
    T_base_camera: Float[np.ndarray, "4 4"]
    start: Float[np.ndarray, "joints"]

    @property
    def solids(self) -> tuple[Box, ...]:
        """Table and walls."""
        return (self.table, *self.pick.walls, *self.place.walls)


# Of a robot that looks along x [m].
_TABLE = Box("table", (0.32, 0.02, -0.025), (0.55, 0.6, 0.025))
_PICK, _PLACE = (0.44, -0.19), (0.42, 0.21)
# At the start the arm points so far beyond the second bin, so that its shadow leaves the first one alone [rad].
_ASIDE = 0.5
# The camera's elevation [rad] and distance [m] from the middle of the bin that it looks at.
_ELEVATION, _DISTANCE = np.deg2rad(62.0), 0.75


def layout_of(arm: Arm) -> CellLayout:
    """Return the cell of an arm. Both bins lie where the arm's `seed` posture reaches to.

    The arm's first joint turns about the vertical: at the start it is turned beyond the second bin.
    """
    tip = arm_links(arm, torch.as_tensor(arm.seed)[None]).translation[0, arm.tip].numpy()
    # The table's edges stay along the axes.
    turn = 0.5 * np.pi * float(np.round(np.arctan2(tip[1], tip[0]) / (0.5 * np.pi)))
    cos, sin = float(np.round(np.cos(turn))), float(np.round(np.sin(turn)))

    def turned(x: float, y: float) -> tuple[float, float]:
        return cos * x - sin * y, sin * x + cos * y

    x, y, z = _TABLE.half
    half = (x, y, z) if sin == 0 else (y, x, z)
    table = Box("table", (*turned(*_TABLE.center[:2]), _TABLE.center[2]), half)
    pick, place = Bin("pick bin", turned(*_PICK)), Bin("place bin", turned(*_PLACE))
    flat = turned(_DISTANCE * np.cos(_ELEVATION), 0.0)
    target = np.array([*pick.center, 0.03])
    eye = target + np.array([*flat, _DISTANCE * np.sin(_ELEVATION)])
    start = arm.seed.copy()
    wanted = np.arctan2(place.center[1], place.center[0]) + _ASIDE
    start[0] = arm.seed[0] + _wrapped(wanted - np.arctan2(tip[1], tip[0]))
    return CellLayout(table, pick, place, CAMERAS["d415"].lens, look_at(eye, target), start)


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
