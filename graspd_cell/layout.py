"""Poses of table, bins and camera relative to an arm. The base frame is the frame of the arm's base link, z up."""

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
    """Fixed solid with edges along the axes of the base frame.

    Attributes:
        name: name of the solid.
        center: centre in the base frame [m].
        half: half edge lengths [m].
    """

    name: str
    center: tuple[float, float, float]
    half: tuple[float, float, float]


@dataclass(frozen=True)
class Bin:
    """Four walls on the table.

    Attributes:
        name: name of the bin.
        center: centre of the floor, x and y in the base frame [m].
        half: half of the inner side length [m].
        height: height of the walls [m].
        wall: thickness of the walls [m].
    """

    name: str
    center: tuple[float, float]
    half: float = 0.17
    height: float = 0.06
    wall: float = 0.01

    def holds(self, point: Float[np.ndarray, "3"]) -> bool:
        """Return True if the x and y of a point [m] lie within the bin, walls included."""
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
    """Table, bins and camera around the robot. Measure these values in a real cell.

    Attributes:
        table: the table, whose top is the plane z = 0.
        pick: the bin to empty.
        place: the bin to fill.
        camera: intrinsics of the depth camera.
        T_base_camera: pose of the camera's optical frame in the base frame [m].
        start: joint values at which the arm does not occlude the pick bin [rad].
    """

    table: Box
    pick: Bin
    place: Bin
    camera: PinholeCamera
    T_base_camera: Float[np.ndarray, "4 4"]
    start: Float[np.ndarray, "joints"]

    @property
    def solids(self) -> tuple[Box, ...]:
        """Table and the walls of both bins."""
        return (self.table, *self.pick.walls, *self.place.walls)


# Table and bins for a robot that faces along x [m].
_TABLE = Box("table", (0.32, 0.02, -0.025), (0.55, 0.6, 0.025))
_PICK, _PLACE = (0.44, -0.19), (0.42, 0.21)
# At the start the arm points this angle beyond the place bin, so that it does not occlude the pick bin [rad].
_ASIDE = 0.5
# The camera's elevation [rad] and distance [m] from the middle of the bin that it looks at.
_ELEVATION, _DISTANCE = np.deg2rad(62.0), 0.75


def layout_of(arm: Arm) -> CellLayout:
    """Return the cell of an arm. The bins lie in the direction (rounded to 90°) of the tip in the arm's `seed` posture.

    The first joint must rotate about the vertical. In `CellLayout.start`, it has turned the arm past the place bin.
    """
    tip = arm_links(arm, torch.as_tensor(arm.seed)[None]).translation[0, arm.tip].numpy()
    # Rotate by a multiple of 90°, so that the table's edges stay along the axes.
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
    # The shorter way round.
    start[0] += (wanted - np.arctan2(tip[1], tip[0]) + np.pi) % (2 * np.pi) - np.pi
    return CellLayout(table, pick, place, CAMERAS["d415"].lens, look_at(eye, target), start)
