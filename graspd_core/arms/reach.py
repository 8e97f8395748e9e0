"""Restrict initial hand poses and candidate grasps to poses that an arm with the hand can reach."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from graspd_core.arms.arm import Arm, tip_hand
from graspd_core.arms.arm_collision import hits_of_support
from graspd_core.arms.arm_paths import LIFT, ArmTask, arm_paths, make_task, tip_poses
from graspd_core.arms.inverse_kinematics import start_table, within_reach
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import drawn_back
from graspd_core.hands.model import HandModel
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.restrictions import (
    Allowed,
    BoundRestriction,
    BoundRestrictions,
    JointRows,
    Places,
    Refusal,
    Turns,
)
from graspd_core.perception.scene import Scene
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Grasp, Posture

# Greatest valid coordinate of the arm's base [m]. A larger coordinate is probably in another unit.
_FARTHEST = 100.0
# Upper bound of the distance of a fingertip from the hand's base link, for all hands [m].
_HAND_LENGTH = 0.4
# Number of hand poses around the object that are checked to explain why no start was found.
_PROBES = 64


@dataclass(frozen=True, eq=False)
class Reach:
    """The restriction to grasps that an arm at a given base pose can reach and lift (docs/arms.md).

    Each grasp gets the arm's joint values along its path (`Grasp.arm`).

    Attributes:
        arm: arm from `load_arm`.
        position: origin of the arm's base in the object frame [m].
        quaternion_wxyz: orientation of the arm's base in the object frame, as unit quaternion.
    """

    arm: Arm
    position: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def bind(self, scene: Scene, hand: HandModel) -> BoundReach:
        """Bind the restriction to a scene and a hand. Raises ConfigError: invalid base pose, or hand without mount."""
        position, quaternion = (np.asarray(v, dtype=float) for v in (self.position, self.quaternion_wxyz))
        if position.shape != (3,) or not np.isfinite(position).all() or np.abs(position).max() > _FARTHEST:
            raise ConfigError(f"arm base: position {list(self.position)}; valid: three numbers up to {_FARTHEST:g} m")
        length = float(np.linalg.norm(quaternion)) if quaternion.shape == (4,) else np.nan
        if not abs(length - 1.0) <= 1e-2:
            raise ConfigError(f"arm base: quaternion {list(self.quaternion_wxyz)}; valid: w x y z of length 1")
        tip_hand(self.arm, hand)
        base = SE3(rotation_from_quaternion(torch.as_tensor(quaternion)), torch.as_tensor(position))
        return BoundReach(make_task(self.arm, hand, scene, base))


@dataclass(frozen=True, eq=False)
class BoundReach(BoundRestriction):
    """A `Reach` bound to one hand in one scene."""

    task: ArmTask

    @property
    def description(self) -> str:
        """Name of the restriction: the reach of the arm."""
        return f"the reach of {self.task.arm.name}"

    @property
    def impossible(self) -> str:
        """Why no grasp can exist: all postures collide with the support, or the object is too far. "" otherwise."""
        task, support = self.task, self.task.scene.support
        if support is not None and not task.usable.any():
            table = start_table(task.arm)
            hits = hits_of_support(task.arm, task.scene, task.base, (table.start, table.end))
            above = support.offset - float(support.normal @ task.base.translation.numpy())
            return (
                f"every posture of {task.arm.name} has {hits.what[int((hits.depth > 0).sum(0).argmax())]}; the table "
                f"is {above:.2f} m above the arm's base; raise the base, or correct its pose"
            )
        longest = float(start_table(task.arm).features[:, :3].norm(dim=-1).max())
        longest += float(tip_hand(task.arm, task.hand).translation.norm())
        target = task.scene.object
        away = float(np.linalg.norm(target.center_of_mass - task.base.translation.numpy())) - target.radius
        if away <= longest + _HAND_LENGTH:
            return ""
        return (
            f"the object is {away:.2f} m from the base of {task.arm.name}, whose reach with {task.hand.name} "
            f"is {longest:.2f} m; move the base or the object"
        )

    def why_none(self, others: BoundRestrictions) -> str:
        """Return, as text, how often and why the arm cannot reach hand poses that `others` allow around the object."""
        task = self.task
        starts = draw_starts(task.scene, task.hand, _PROBES, 0, "cpu", torch.float64, restrictions=others)
        rows = zip(*(rows.numpy() for rows in (starts.translation, starts.quaternion, starts.joints)), strict=True)
        postures = [Posture(*row) for row in rows]
        paths = arm_paths(task, [Grasp(posture, posture, posture) for posture in postures])
        reasons = Counter(path for path in paths if isinstance(path, str)).most_common()
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons)
        return f"of {len(paths)} hand poses around the object: {counts}" if counts else ""

    def starts(self, positions: Places, quaternions: Turns, joints: JointRows) -> Allowed:
        """Return for each initial pose whether pose, retreat and lift are all within the arm's reach."""
        task, at = self.task, torch.as_tensor(positions)
        rotation = rotation_from_quaternion(torch.as_tensor(quaternions))
        retreat = drawn_back(at, rotation, torch.as_tensor(task.hand.approach))
        lift = retreat if task.up is None else at + LIFT * torch.as_tensor(task.up)
        allowed = torch.arange(len(at))
        for there in (at, retreat, lift):
            tip = tip_poses(task, SE3(rotation[allowed], there[allowed]))
            allowed = allowed[within_reach(start_table(task.arm), task.bounds, tip)]
        return np.isin(np.arange(len(at)), allowed.numpy())

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        """Return each candidate with its arm path, or the reason why there is no path."""
        paths = arm_paths(self.task, grasps)
        return [
            Refusal(path) if isinstance(path, str) else replace(grasp, arm=path)
            for grasp, path in zip(grasps, paths, strict=True)
        ]
