"""Ground truth of a simulated cell: where objects are, what the hand holds, and the robot's contact forces.

The picker never uses this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from graspd_cell.world import ARM, HAND, PARTS, PICK_BIN, PLACE_BIN, TABLE, THING, CellWorld, Pose

# An object whose centre of mass is lower than this fell off the table [m].
_LOST = -0.1
# Least normal force that counts as contact between hand and object [N].
_TOUCH = 0.05
# A greater normal force counts as a hard collision [N].
HARD = 50.0
# Normal force [N] of each touching pair. A key has the numbers of both, from `PARTS` or `THING` + index of an object.
Forces = dict[tuple[int, int], float]


@dataclass(frozen=True)
class Report:
    """Ground truth at one time.

    Attributes:
        time: simulated time [s].
        places: place of each object by name: `pick bin`, `place bin`, `table` or `lost`.
        in_hand: name of the object in the hand. Empty if the hand holds none.
        hardest: peak force of each touching pair since the last `clear` [N], by names such as `hand on pear 0`.
    """

    time: float
    places: Mapping[str, str]
    in_hand: str
    hardest: Mapping[str, float]

    def hard(self, *grasped: str) -> dict[str, float]:
        """Return the peak forces above `HARD` by pair [N], without the forces of the hand on the `grasped` objects."""
        own = {f"hand on {name}" for name in grasped}
        return {pair: force for pair, force in self.hardest.items() if force > HARD and pair not in own}


class Referee:
    """Observer of a simulated cell. The simulation calls `watch` after its steps."""

    def __init__(self, world: CellWorld) -> None:
        self._world = world
        self._peaks: Forces = {}

    def watch(self, data: Any) -> None:
        """Update the peak forces of arm and hand on table, bins and objects with the current ones."""
        for (a, b), force in _pair_forces(self._world, data).items():
            if a in (ARM, HAND) and b >= TABLE and force > self._peaks.get((a, b), 0.0):
                self._peaks[a, b] = force

    def clear(self) -> None:
        """Reset the peak forces."""
        self._peaks = {}

    def report(self, data: Any) -> Report:
        """Return the ground truth now."""
        world = self._world
        places = {thing.name: place_of(world, data, index) for index, thing in enumerate(world.things)}
        held = thing_in_hand(world, data)
        hardest = {f"{self._name(a)} on {self._name(b)}": round(force, 2) for (a, b), force in self._peaks.items()}
        return Report(float(data.time), places, "" if held is None else world.things[held].name, hardest)

    def _name(self, part: int) -> str:
        return self._world.things[part - THING].name if part >= THING else PARTS[part]


def _pair_forces(world: CellWorld, data: Any) -> Forces:
    """Return the normal forces between parts and objects, summed for each touching pair [N]."""
    contact = data.contact
    address = contact.efc_address
    acting = address >= 0
    if not acting.any():
        return {}
    owners = np.sort(world.owner[contact.geom[acting]], axis=1)
    # With elliptic cones the first row of a contact is its normal force.
    force, size = data.efc_force[address[acting]], THING + len(world.things)
    sums = np.bincount(owners[:, 0] * size + owners[:, 1], weights=force)
    return {(int(key) // size, int(key) % size): float(sums[key]) for key in np.flatnonzero(sums)}


def place_of(world: CellWorld, data: Any, index: int) -> str:
    """Return which bin has the object's centre of mass, or `table` or `lost` if neither has it."""
    center = data.xipos[world.thing_bodies[index]]
    if center[2] < _LOST:
        return "lost"
    for place in (world.layout.pick, world.layout.place):
        if place.holds(center):
            return place.name
    return PARTS[TABLE]


def thing_in_hand(world: CellWorld, data: Any) -> int | None:
    """Return the index of the held object. None if no object is held.

    A held object touches the hand, but no table or bin. Of several such objects, return the one pressed hardest.
    """
    forces = _pair_forces(world, data)
    pressed = {b - THING: force for (a, b), force in forces.items() if a == HAND and b >= THING and force > _TOUCH}
    resting = {b - THING for a, b in forces if a in (TABLE, PICK_BIN, PLACE_BIN) and b >= THING}
    return max((k for k in pressed if k not in resting), key=lambda k: pressed[k], default=None)


def body_pose(data: Any, body: int) -> Pose:
    """Return the pose of a body in the base frame [m]."""
    pose = np.eye(4)
    pose[:3, :3] = data.xmat[body].reshape(3, 3)
    pose[:3, 3] = data.xpos[body]
    return pose
