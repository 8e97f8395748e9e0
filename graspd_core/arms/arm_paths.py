"""Compute arm paths through grasps: joint values at every waypoint of the hand, or the reason why there is no path.

The hand passes retreat, pregrasp, grasp and lift, with closely spaced waypoints. For each grasp, inverse kinematics
starts from several arm postures, so that elbow and wrist vary. From each posture found at the grasp, all waypoints are
solved. The result is the valid path nearest to the arm's seed posture: within limits, without jump or collision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

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
from graspd_core.types import ArmPath, Grasp, stacked

# Height of the lift after the grasp [m].
LIFT = 0.1
# Number of steps from retreat to pregrasp, from pregrasp to grasp, and from grasp to lift. A step is about 2 cm.
STEPS = (5, 2, 5)
# Indices of the waypoints retreat, pregrasp, grasp and lift.
STAGE_ROWS = (0, STEPS[0], STEPS[0] + STEPS[1], sum(STEPS))
# `_ALONG`: position of each waypoint, in stages from 0 to 3. `_SHARES`: weights of the stages (columns) at waypoints.
_ALONG = np.concatenate([[0.0], *(k + np.arange(1, steps + 1) / steps for k, steps in enumerate(STEPS))])
_SHARES = np.maximum(1.0 - np.abs(_ALONG[:, None] - np.arange(len(STAGE_ROWS))), 0.0)


def hand_paths(grasps: Sequence[Grasp], approach: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"] | None) -> SE3:
    """Return `T_scene_hand` at the waypoints of each grasp. The batch shape is (grasps, waypoints).

    Args:
        grasps: the grasps. From pregrasp to grasp, the hand moves on a straight line, with the shortest rotation.
        approach: unit direction in which the hand moves towards an object, hand frame.
        up: unit direction of the lift, scene frame. None: back along the approach, as in the lift trial.
    """
    postures = ([grasp.pregrasp for grasp in grasps], [grasp.grasp for grasp in grasps])
    before, there = ([torch.as_tensor(rows) for rows in stacked(some)] for some in postures)
    begun = drawn_back(before[0], rotation_from_quaternion(before[1]), torch.as_tensor(approach))
    # Both signs of a quaternion give the same rotation. The sign nearer to the pregrasp gives the shortest path.
    sign = torch.where((before[1] * there[1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    away = drawn_back(there[0], rotation_from_quaternion(there[1]), torch.as_tensor(approach))
    raised = away if up is None else there[0] + LIFT * torch.as_tensor(up)
    corners = torch.stack([begun, before[0], there[0], raised], 1)
    turns = torch.stack([before[1], before[1], sign * there[1], sign * there[1]], 1)
    shares = torch.as_tensor(_SHARES)
    return SE3(rotation_from_quaternion(shares @ turns), shares @ corners)


# Greatest valid motion of a joint between two waypoints [rad] or [m].
LARGEST_JUMP = 0.2
# Per grasp: number of starts, and of arm postures whose path is solved. Below: solver steps per posture, and per path.
_STARTS, _FOLLOWED = 8, 2
_STEPS, _PATH_STEPS = 8, 5
# Arm postures count as equal if all joint values differ by less than this [rad] or [m].
_SAME = 0.1
# Number of grasps that are solved at once.
_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class ArmTask:
    """An arm with a hand in a scene.

    Attributes:
        base: pose `T_scene_base` of the arm's base, without batch dimensions.
        usable: True for each posture of `start_table` that does not collide with the support.
        bounds: least and greatest distance of each tip point from the shoulder at usable postures [m] (`reach_bounds`).
    """

    arm: Arm
    hand: HandModel
    scene: Scene
    base: SE3
    usable: Bool[Tensor, "entries"]
    bounds: Float[Tensor, "2 points"]

    @property
    def up(self) -> Float[np.ndarray, "3"] | None:
        """Direction of the lift, scene frame: the support's normal. None without a support."""
        return self.scene.support and self.scene.support.normal


def make_task(arm: Arm, hand: HandModel, scene: Scene, base: SE3) -> ArmTask:
    """Build the task. Find the postures of the start table that do not collide with the support."""
    table = start_table(arm)
    hits = hits_of_support(arm, scene, base, (table.start, table.end))
    usable = (hits.depth <= 0).all(-1)
    return ArmTask(arm, hand, scene, base, usable, reach_bounds(table, usable))


def tip_poses(task: ArmTask, hand_poses: SE3) -> SE3:
    """Return the tip poses `T_base_tip` for the hand poses `T_scene_hand`."""
    mount = tip_hand(task.arm, task.hand)
    rotation = hand_poses.rotation @ mount.rotation.T
    at = hand_poses.translation - (rotation @ mount.translation[:, None]).squeeze(-1)
    inverse = task.base.rotation.T
    return SE3(inverse @ rotation, (inverse @ (at - task.base.translation)[..., None]).squeeze(-1))


@torch.no_grad()
def arm_paths(task: ArmTask, grasps: Sequence[Grasp]) -> list[ArmPath | str]:
    """Return the arm path through each grasp. If there is none, return the reason, e.g. "beyond joint_4's limit"."""
    parts = (grasps[first : first + _AT_ONCE] for first in range(0, len(grasps), _AT_ONCE))
    return [found for part in parts for found in _some_paths(task, part)]


def _some_paths(task: ArmTask, grasps: Sequence[Grasp]) -> list[ArmPath | str]:
    paths = tip_poses(task, hand_paths(grasps, task.hand.approach, task.up))
    q, owner = _postures(task, paths[:, STAGE_ROWS[2]])
    joints = torch.as_tensor(stacked([grasp.pregrasp for grasp in grasps])[2])[owner]
    followed = _followed(task, paths[owner], q, joints)
    rows_of_each = [torch.nonzero(owner == grasp).flatten().tolist() for grasp in range(len(grasps))]
    # For each grasp: the row of its first valid path, else its first row, else -1.
    best = [next(filter(followed.good, rows), rows[0] if rows else -1) for rows in rows_of_each]
    reasons, names, chain = _why_lost(task, paths, followed, best), task.arm.joint_names, task.arm.chain
    made = partial(ArmPath, names, stages=STAGE_ROWS, velocity=chain.velocity, slides=chain.slides)
    return [reasons[grasp] if grasp in reasons else made(followed.path[row].numpy()) for grasp, row in enumerate(best)]


def _why_lost(task: ArmTask, paths: SE3, followed: _Followed, best: Sequence[int]) -> dict[int, str]:
    """Return by grasp index why a grasp has no path. `best`: row of each grasp in `followed`, or -1."""
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
        causes = why_unreached(task.arm, paths[list(rows), list(waypoints)], torch.stack(starts))
        for (grasp, waypoint, _), reason in zip(unreached, causes, strict=True):
            on_way = waypoint != STAGE_ROWS[2]
            missed = "without a continuous arm path" if on_way else "without a computed arm posture"
            reasons[grasp] = (f"{reason} on the path" if on_way else reason) if reason else missed
    return reasons


def _postures(task: ArmTask, target: SE3) -> tuple[Float[Tensor, "postures joints"], Int[Tensor, "postures"]]:
    """Return distinct arm postures that reach the targets, and the index of the target of each posture.

    Postures clear of the support come first, of these the nearest to the seed. Other collisions are checked later.
    """
    arm, table = task.arm, start_table(task.arm)
    starts = nearest_postures(table, target, _STARTS, task.usable)
    count = starts.shape[1]
    owner = torch.arange(len(starts)).repeat_interleave(count)
    q, reached = solve(arm, target[owner], starts.flatten(0, 1), _STEPS)
    q, owner = nearest_turn(arm, q[reached], arm.seed), owner[reached]
    if not len(q):
        return q, owner
    hits = hits_of_support(arm, task.scene, task.base, placed(arm.capsules, arm_links(arm, q))[:2])
    away = (q - torch.as_tensor(arm.seed)).square().sum(-1)
    order = (owner * 1e6 + (hits.depth > 0).any(-1) * 1e5 + away).argsort()
    q, owner = q[order], owner[order]
    # For each grasp, keep the first `_FOLLOWED` postures that differ from all earlier postures.
    alike = (owner[:, None] == owner) & ((q[:, None] - q).abs().amax(-1) < _SAME)
    kept = torch.nonzero(~alike.tril(-1).any(1)).flatten()
    place = torch.arange(len(kept)) - torch.searchsorted(owner[kept].contiguous(), owner[kept].contiguous())
    kept = kept[place < _FOLLOWED]
    return q[kept], owner[kept]


def nearest_turn(arm: Arm, q: Float[Tensor, "batch joints"], near: np.ndarray) -> Float[Tensor, "batch joints"]:
    """Add full turns to revolute joints, so that each joint is as near to the posture `near` as its limits allow."""
    turns = ((torch.as_tensor(near) - q) / (2 * np.pi)).round() * (2 * np.pi)
    turned = torch.where(torch.as_tensor(arm.chain.slides), q, q + turns)
    inside = (turned >= torch.as_tensor(arm.lower)) & (turned <= torch.as_tensor(arm.upper))
    return torch.where(inside, turned, q)


@dataclass(frozen=True)
class _Followed:
    """Paths, each solved from an arm posture at its grasp.

    Attributes:
        path: joint values at every waypoint [rad] or [m].
        lost: for each path, the unreached waypoint that is nearest to the grasp. -1 if all waypoints are reached.
        hit: for each path, a phrase about its jump or deepest collision. Empty without jump and collision.
    """

    path: Float[Tensor, "postures way joints"]
    lost: list[int]
    hit: list[str]

    def good(self, row: int) -> bool:
        """Return True if the path in `row` reaches all waypoints without jump and collision."""
        return self.lost[row] < 0 and not self.hit[row]


def _followed(
    task: ArmTask, paths: SE3, q: Float[Tensor, "postures joints"], joints: Float[Tensor, "postures hand_joints"]
) -> _Followed:
    """Solve each path from the arm posture `q` at its grasp. `joints`: the hand's joint values at the pregrasp."""
    count, length = paths.translation.shape[:2]
    if not count:
        return _Followed(q.new_zeros(0, length, q.shape[1]), [], [])
    target = SE3(paths.rotation.flatten(0, 1), paths.translation.flatten(0, 1))
    solved = solve(task.arm, target, q.repeat_interleave(length, 0), _PATH_STEPS)
    path, reached = (values.unflatten(0, (count, length)) for values in solved)
    off = torch.where(reached, length, (torch.arange(length) - STAGE_ROWS[2]).abs())
    lost = torch.where(reached.all(1), -1, off.argmin(1)).tolist()
    jumps, hits = path.diff(dim=1).abs().amax(1), _hits_on_path(task, path, joints)
    found: list[str] = []
    for row in range(count):
        worst, joint = int(hits.depth[row].argmax()), int(jumps[row].argmax())
        hit = hits.what[worst] if hits.depth[row, worst] > 0 else ""
        found.append(f"with a jump of {task.arm.joint_names[joint]}" if jumps[row, joint] > LARGEST_JUMP else hit)
    return _Followed(path, lost, found)


def _hits_on_path(
    task: ArmTask, path: Float[Tensor, "postures way joints"], joints: Float[Tensor, "postures hand_joints"]
) -> Hits:
    """Return the arm's collision depths: with the scene at all waypoints, with itself and the hand at four stages."""
    count = len(path)
    scene = hits_of_scene(task.arm, task.scene, task.base, arm_links(task.arm, path.flatten(0, 1)))
    links = arm_links(task.arm, path[:, list(STAGE_ROWS)].flatten(0, 1))
    own = hits_of_self(task.arm, links)
    hand = hits_of_hand(task.arm, task.hand, links, joints.repeat_interleave(len(STAGE_ROWS), 0))
    return joined(*(Hits(hits.depth.unflatten(0, (count, -1)).amax(1), hits.what) for hits in (scene, own, hand)))
