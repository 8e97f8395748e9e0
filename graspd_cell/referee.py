"""What truly happens in a simulated cell: where things are, what the hand holds, and how hard the robot hits something.

Only the referee knows. A picker never asks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_cell.world import ARM, HAND, PARTS, PICK_BIN, PLACE_BIN, TABLE, THING, CellWorld, Pose

# A thing that is so low fell off the table [m].
_LOST = -0.1
# A hand that presses on a thing this hard touches it [N].
_TOUCH = 0.05
# Of a contact's force [N]: what is beyond is a collision with something hard.
HARD = 50.0
# Whom the robot touches, and how hard: the key is a part of `PARTS` and a part or a thing.
Forces = dict[tuple[int, int], float]


@dataclass(frozen=True)
class Report:
    """What the referee says at one time.

    Attributes:
        time: simulated [s].
        places: of each thing, by name: `pick bin`, `place bin`, `table` or `lost`.
        in_hand: the thing that hangs in the hand, empty without one.
        hardest: the greatest force of each pair since the last `clear` [N], as `arm on table` or `hand on pear 0`.
    """

    time: float
    places: Mapping[str, str]
    in_hand: str
    hardest: Mapping[str, float]

    def hard(self, target: str = "") -> dict[str, float]:
        """Return the pairs beyond `HARD`, but for the hand on the thing that it is to take."""
        return {pair: force for pair, force in self.hardest.items() if force > HARD and pair != f"hand on {target}"}


class Referee:
    """Watches a simulated cell. `watch` is called after the steps of the simulation."""

    def __init__(self, world: CellWorld) -> None:
        self._world = world
        self._peaks: Forces = {}

    def watch(self, data: Any) -> None:
        """Note the forces of this moment."""
        for pair, force in robot_forces(self._world, data).items():
            if force > self._peaks.get(pair, 0.0):
                self._peaks[pair] = force

    def clear(self) -> None:
        """Forget the forces up to now."""
        self._peaks = {}

    def report(self, data: Any) -> Report:
        """Return what is true now."""
        world = self._world
        places = {thing.name: place_of(world, data, index) for index, thing in enumerate(world.things)}
        held = thing_in_hand(world, data)
        hardest = {f"{self._name(a)} on {self._name(b)}": round(force, 2) for (a, b), force in self._peaks.items()}
        return Report(float(data.time), places, "" if held is None else world.things[held].name, hardest)

    def _name(self, part: int) -> str:
        return self._world.things[part - THING].name if part >= THING else PARTS[part]


def robot_forces(world: CellWorld, data: Any) -> Forces:
    """Return the sum of the normal forces of arm and hand on everything that is not the robot [N]."""
    return {(a, b): force for (a, b), force in _pair_forces(world, data).items() if a in (ARM, HAND) and b >= TABLE}


def _pair_forces(world: CellWorld, data: Any) -> Forces:
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
    """Return where a thing is, by its centre of mass."""
    center = data.xipos[world.thing_bodies[index]]
    if center[2] < _LOST:
        return "lost"
    for place in (world.layout.pick, world.layout.place):
        if place.holds(center):
            return place.name
    return PARTS[TABLE]


def thing_in_hand(world: CellWorld, data: Any) -> int | None:
    """Return the number of the thing that hangs in the hand: pressed by the hand, and touched by nothing that is fixed.

    Of several that one which is pressed hardest.
    """
    forces = _pair_forces(world, data)
    pressed = {b - THING: force for (a, b), force in forces.items() if a == HAND and b >= THING and force > _TOUCH}
    resting = {b - THING for a, b in forces if a in (TABLE, PICK_BIN, PLACE_BIN) and b >= THING}
    return max((k for k in pressed if k not in resting), key=lambda k: pressed[k], default=None)


def thing_poses(world: CellWorld, data: Any) -> list[Pose]:
    """Return the poses of the things' frames in the base frame [m]."""
    return [body_pose(data, int(body)) for body in world.thing_bodies]


def body_pose(data: Any, body: int) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a body in the base frame [m]."""
    pose = np.eye(4)
    pose[:3, :3] = data.xmat[body].reshape(3, 3)
    pose[:3, 3] = data.xpos[body]
    return pose
