"""Paths of an arm through grasps: joint values at every waypoint of the hand, or a reason why there are none.

The hand passes retreat, pregrasp, grasp and lift in closely spaced poses. For each grasp several postures are found,
from starts all over the arm's postures, so that elbow and wrist vary. From each the whole path is solved at once. The
path nearest to the seed posture is taken that keeps the limits, has no jump, and hits nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.arms.arm import Arm, arm_links, placed, tip_hand
from graspd_core.arms.arm_collision import Hits, hits_of_hand, hits_of_scene, hits_of_self, hits_of_support, joined
from graspd_core.arms.inverse_kinematics import nearest_postures, reach_bounds, solve, start_table, why_unreached
from graspd_core.hands.kinematics import drawn_back
from graspd_core.hands.model import HandModel
from graspd_core.perception.scene import Scene
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import ArmPath, Grasp, Posture

# How far up the hand goes after the grasp [m].
LIFT = 0.1
# Steps from retreat to pregrasp, pregrasp to grasp, grasp to lift: about 2 cm each.
STEPS = (5, 2, 5)
# Rows of the way at the ends of these steps.
STAGE_ROWS = (0, STEPS[0], STEPS[0] + STEPS[1], sum(STEPS))
# How much each waypoint, by row, has of each stage: nearest neighbours blend on a line.
_ALONG = np.concatenate([[0.0], *(k + np.arange(1, steps + 1) / steps for k, steps in enumerate(STEPS))])
_SHARES = np.maximum(1.0 - np.abs(_ALONG[:, None] - np.arange(len(STAGE_ROWS))), 0.0)


def hand_ways(grasps: Sequence[Grasp], approach: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> SE3:
    """Return `T_scene_hand` along the path of each grasp: a batch of grasps by waypoints.

    Args:
        grasps: some. Positions between pregrasp and grasp are on a line, turns between them the shortest.
        approach: unit direction in which the hand moves towards an object, hand frame.
        up: unit direction of the lift, scene frame.
    """
    before, there = (_stacked([getattr(grasp, stage) for grasp in grasps]) for stage in ("pregrasp", "grasp"))
    begun = drawn_back(before[0], rotation_from_quaternion(before[1]), torch.as_tensor(approach))
    # Both signs of a quaternion are one rotation: the nearer is turned to.
    sign = torch.where((before[1] * there[1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    raised = there[0] + LIFT * torch.as_tensor(up)
    corners = torch.stack([begun, before[0], there[0], raised], 1)
    turns = torch.stack([before[1], before[1], sign * there[1], sign * there[1]], 1)
    shares = torch.as_tensor(_SHARES)
    return SE3(rotation_from_quaternion(shares @ turns), shares @ corners)


def _stacked(postures: Sequence[Posture]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    position, quaternion = (
        torch.as_tensor(np.stack([getattr(posture, key) for posture in postures]), dtype=torch.float64)
        for key in ("position", "quaternion_wxyz")
    )
    return position, quaternion


# No joint moves farther between two waypoints [rad].
LARGEST_JUMP = 0.2
# Starts of each grasp, and postures of each that are followed along the path. Steps of inverse kinematics for both.
_STARTS, _FOLLOWED = 8, 2
_STEPS, _WAY_STEPS = 8, 5
# Joint values nearer than this are one posture [rad].
_SAME = 0.1
# Grasps at once.
_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class ArmTask:
    """An arm with a hand in a scene.

    Attributes:
        arm, hand, scene: the parts.
        base: `T_scene_base` of the arm's base frame, one.
        usable: entries of the arm's start table that are clear of the support.
        bounds: distances of their tips, see `reach_bounds`.
    """

    arm: Arm
    hand: HandModel
    scene: Scene
    base: SE3
    usable: Bool[Tensor, "entries"]
    bounds: Float[Tensor, "2 points"]

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """Direction of a lift in the scene: off the support, else along the z axis of the arm's base."""
        return self.base.rotation[:, 2].numpy() if self.scene.support is None else self.scene.support.normal


def make_task(arm: Arm, hand: HandModel, scene: Scene, base: SE3) -> ArmTask:
    """Build the task, with the entries of the start table that are clear of the support."""
    table = start_table(arm)
    hits = hits_of_support(arm, scene, base, (table.start, table.end))
    usable = (hits.depth <= 0).all(-1)
    return ArmTask(arm, hand, scene, base, usable, reach_bounds(table, usable))


def tip_poses(task: ArmTask, hand_poses: SE3) -> SE3:
    """Return the `T_base_tip` that bring the hand to `T_scene_hand`."""
    mount = tip_hand(task.arm, task.hand)
    rotation = hand_poses.rotation @ mount.rotation.T
    at = hand_poses.translation - (rotation @ mount.translation[:, None]).squeeze(-1)
    inverse = task.base.rotation.T
    return SE3(inverse @ rotation, (inverse @ (at - task.base.translation)[..., None]).squeeze(-1))


@torch.no_grad()
def arm_paths(task: ArmTask, grasps: Sequence[Grasp]) -> list[ArmPath | str]:
    """Return a path of the arm through each grasp, or the reason why there is none: "beyond joint_4's limit"."""
    found: list[ArmPath | str] = []
    for first in range(0, len(grasps), _AT_ONCE):
        found += _some_paths(task, grasps[first : first + _AT_ONCE])
    return found


def _some_paths(task: ArmTask, grasps: Sequence[Grasp]) -> list[ArmPath | str]:
    ways = tip_poses(task, hand_ways(grasps, task.hand.approach, task.up))
    q, owner = _postures(task, ways[:, STAGE_ROWS[2]])
    joints = torch.as_tensor(np.stack([grasp.pregrasp.joint_positions for grasp in grasps]))[owner]
    followed = _followed(task, ways[owner], q, joints)
    best = _best_of_each(followed, owner, len(grasps))
    reasons = _why_lost(task, ways, followed, best)
    return [
        reasons[grasp] if grasp in reasons else ArmPath(task.arm.joint_names, followed.path[row].numpy(), STAGE_ROWS)
        for grasp, row in enumerate(best)
    ]


def _best_of_each(followed: _Followed, owner: Int[Tensor, "postures"], count: int) -> list[int]:
    """Return the first posture of each grasp with a valid path, else the first of all, -1 for none."""
    best = [-1] * count
    for row in reversed(range(len(owner))):
        grasp, good = int(owner[row]), followed.good(row)
        if good or best[grasp] < 0 or not followed.good(best[grasp]):
            best[grasp] = row
    return best


def _why_lost(task: ArmTask, ways: SE3, followed: _Followed, best: Sequence[int]) -> dict[int, str]:
    """Return the reasons of the grasps without a path, by number."""
    reasons: dict[int, str] = {}
    unreached: list[tuple[int, int, Tensor]] = []
    for grasp, row in enumerate(best):
        if row < 0:
            unreached.append((grasp, STAGE_ROWS[2], torch.as_tensor(task.arm.seed)))
        elif followed.lost[row] >= 0:
            unreached.append((grasp, followed.lost[row], followed.path[row, STAGE_ROWS[2]]))
        elif followed.hit[row]:
            reasons[grasp] = followed.hit[row]
    if unreached:
        rows, waypoints, starts = zip(*unreached, strict=True)
        told = why_unreached(task.arm, ways[list(rows), list(waypoints)], torch.stack(starts))
        for (grasp, waypoint, _), reason in zip(unreached, told, strict=True):
            on_way = waypoint != STAGE_ROWS[2]
            missed = "without a way of the arm that goes on" if on_way else "whose posture of the arm was not found"
            reasons[grasp] = (f"{reason} on the way" if on_way else reason) if reason else missed
    return reasons


def _postures(task: ArmTask, target: SE3) -> tuple[Float[Tensor, "postures joints"], Int[Tensor, "postures"]]:
    """Return different joint values that bring the tip to each target, nearest to the seed first, and their targets.

    Postures above the support come first. Other collisions are checked along the paths.
    """
    arm, table = task.arm, start_table(task.arm)
    starts = nearest_postures(table, target, _STARTS, task.usable)
    count = starts.shape[1]
    owner = torch.arange(len(starts)).repeat_interleave(count)
    solved = solve(arm, target[owner], starts.flatten(0, 1), _STEPS)
    q, owner = _nearest_turn(arm, solved.q[solved.reached]), owner[solved.reached]
    if not len(q):
        return q, owner
    hits = hits_of_support(arm, task.scene, task.base, placed(arm.capsules, arm_links(arm, q))[:2])
    away = (q - torch.as_tensor(arm.seed)).square().sum(-1)
    order = (owner * 1e6 + (hits.depth > 0).any(-1) * 1e5 + away).argsort()
    q, owner = q[order], owner[order]
    # Of each grasp the first postures that differ from all before them.
    alike = (owner[:, None] == owner) & ((q[:, None] - q).abs().amax(-1) < _SAME)
    kept = torch.nonzero(~alike.tril(-1).any(1)).flatten()
    place = torch.arange(len(kept)) - torch.searchsorted(owner[kept].contiguous(), owner[kept].contiguous())
    kept = kept[place < _FOLLOWED]
    return q[kept], owner[kept]


def _nearest_turn(arm: Arm, q: Float[Tensor, "batch joints"]) -> Float[Tensor, "batch joints"]:
    """Return the same postures, with joints turned by full turns to be nearest to the seed within their limits."""
    turns = ((torch.as_tensor(arm.seed) - q) / (2 * np.pi)).round() * (2 * np.pi)
    turned = torch.where(torch.as_tensor(arm.chain.slides), q, q + turns)
    inside = (turned >= torch.as_tensor(arm.lower)) & (turned <= torch.as_tensor(arm.upper))
    return torch.where(inside, turned, q)


@dataclass(frozen=True)
class _Followed:
    """Paths from a posture at their grasp.

    Attributes:
        path: joint values at every waypoint.
        lost: the unreached waypoint nearest to the grasp, -1 if all are reached.
        hit: the jump or collision of a path whose waypoints are all reached, empty for a valid path.
    """

    path: Float[Tensor, "postures way joints"]
    lost: list[int]
    hit: list[str]

    def good(self, row: int) -> bool:
        """Tell whether a path is valid."""
        return self.lost[row] < 0 and not self.hit[row]


def _followed(
    task: ArmTask, ways: SE3, q: Float[Tensor, "postures joints"], joints: Float[Tensor, "postures hand_joints"]
) -> _Followed:
    """Follow each path from the posture at its grasp, with the hand's joints as they are at the pregrasp."""
    count, length = ways.translation.shape[:2]
    if not count:
        return _Followed(q.new_zeros(0, length, q.shape[1]), [], [])
    target = SE3(ways.rotation.flatten(0, 1), ways.translation.flatten(0, 1))
    solved = solve(task.arm, target, q.repeat_interleave(length, 0), _WAY_STEPS)
    path, reached = solved.q.unflatten(0, (count, length)), solved.reached.unflatten(0, (count, length))
    off = torch.where(reached, length, (torch.arange(length) - STAGE_ROWS[2]).abs())
    lost = torch.where(reached.all(1), -1, off.argmin(1)).tolist()
    jumps, hits = path.diff(dim=1).abs().amax(1), _hits_on_way(task, path, joints)
    told: list[str] = []
    for row in range(count):
        worst, joint = int(hits.depth[row].argmax()), int(jumps[row].argmax())
        hit = hits.what[worst] if hits.depth[row, worst] > 0 else ""
        told.append(f"with a jump of {task.arm.joint_names[joint]}" if jumps[row, joint] > LARGEST_JUMP else hit)
    return _Followed(path, lost, told)


def _hits_on_way(
    task: ArmTask, path: Float[Tensor, "postures way joints"], joints: Float[Tensor, "postures hand_joints"]
) -> Hits:
    """Return the deepest hits of each path: of the scene at every waypoint, of itself and the hand at its stages."""
    count = len(path)
    scene = hits_of_scene(task.arm, task.scene, task.base, arm_links(task.arm, path.flatten(0, 1)))
    stages = arm_links(task.arm, path[:, list(STAGE_ROWS)].flatten(0, 1))
    own = hits_of_self(task.arm, stages)
    hand = hits_of_hand(task.arm, task.hand, stages, joints.repeat_interleave(len(STAGE_ROWS), 0))
    return joined(*(Hits(hits.depth.unflatten(0, (count, -1)).amax(1), hits.what) for hits in (scene, own, hand)))
