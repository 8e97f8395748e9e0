"""What a picker knows of its cell beforehand: which arm and hand, where bins and table stand, where the arm waits."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from graspd_cell.motion import Box
from graspd_core.arms.arm import Arm
from graspd_core.config import SceneConfig, SegmentationConfig
from graspd_core.hands.model import HandModel
from graspd_core.types import Plane, TriangleMesh

Corner = tuple[float, float, float]
# Measured surfaces stray so far [m].
_STRAY = 0.006
# Things rise at most so far above a bin's rim [m].
_ABOVE_RIM = 0.25


@dataclass(frozen=True)
class Bin:
    """An open box whose sides lie along the axes of the base frame.

    Attributes:
        low, high: opposite corners of its inside, from the floor to the rim, base frame [m].
        wall: thickness of floor and walls [m].
    """

    low: Corner
    high: Corner
    wall: float = 0.006

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """The middle of its floor, base frame [m]."""
        return np.array([*(0.5 * (np.asarray(self.low) + np.asarray(self.high)))[:2], self.low[2]])

    @property
    def walls(self) -> tuple[Box, ...]:
        """Its four walls, with the floor beneath them."""
        (x, y, z), (right, back, rim), w = self.low, self.high, self.wall
        return (
            Box((x - w, y - w, z - w), (x, back + w, rim)),
            Box((right, y - w, z - w), (right + w, back + w, rim)),
            Box((x, y - w, z - w), (right, y, rim)),
            Box((x, back, z - w), (right, back + w, rim)),
        )

    def holds(self, points: Float[np.ndarray, "_ 3"], inset: float = 0.0) -> Bool[np.ndarray, "_"]:
        """Return which points are above its floor, and so far from its walls [m]."""
        low, high = np.array(self.low[:2]) + inset, np.array(self.high[:2]) - inset
        return ((points[:, :2] > low) & (points[:, :2] < high)).all(1)

    @property
    def surface(self) -> Plane:
        """Its floor as what things stand on."""
        return Plane(np.array([0.0, 0.0, 1.0]), self.low[2])

    def scene_config(self) -> SceneConfig:
        """Return settings under which clouds are cut down to what lies in this bin."""
        low = (self.low[0] + _STRAY, self.low[1] + _STRAY, self.low[2] - 0.02)
        high = (self.high[0] - _STRAY, self.high[1] - _STRAY, self.high[2] + _ABOVE_RIM)
        return SceneConfig(segmentation=SegmentationConfig(roi_low=low, roi_high=high))


def box_mesh(box: Box) -> TriangleMesh:
    """Return the closed surface of a box."""
    from trimesh.creation import box as made

    low, high = np.asarray(box.low), np.asarray(box.high)
    solid = made(extents=high - low)
    return TriangleMesh(np.array(solid.vertices) + 0.5 * (low + high), np.array(solid.faces, dtype=np.int64))


@dataclass(frozen=True, eq=False)
class Workplace:
    """A cell as its picker knows it.

    Attributes:
        arm: by its own base frame.
        hand: on the arm's tip.
        source, target: the bins that things are taken from and brought to.
        home: joint values at which the arm is out of the camera's sight [rad].
        table: height of the table's top, base frame [m].
        solids: what else is known to stand there.
    """

    arm: Arm
    hand: HandModel
    source: Bin
    target: Bin
    home: Float[np.ndarray, "joints"]
    table: float = 0.0
    solids: tuple[Box, ...] = field(default=())

    @property
    def known(self) -> tuple[Box, ...]:
        """All solids that are known beforehand."""
        return (*self.source.walls, *self.target.walls, *self.solids)
