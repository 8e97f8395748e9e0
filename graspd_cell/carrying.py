"""Arm motions that graspd does not plan: straight lines of the arm's tip, and postures to release objects in a bin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from graspd_cell.layout import Bin, Box
from graspd_cell.motion import DEEPEST, Balls, Mover, Points, balls_about
from graspd_core.arms.arm import Arm
from graspd_core.arms.arm_paths import nearest_turn
from graspd_core.arms.inverse_kinematics import nearest_postures, solve, start_table
from graspd_core.se3 import SE3

Joints = Float[np.ndarray, "joints"]
Pose = Float[np.ndarray, "4 4"]
# Step of a straight path [m], greatest joint motion in a step [rad], and iterations of inverse kinematics.
_STEP, _JUMP = 0.02, 0.25
_STEPS = 12


def tip_pose(mover: Mover, q: Joints) -> Pose:
    """Return `T_base_tip` [m] at the arm's joint values `q`."""
    tip, pose = mover.shape.links(q[None])[0, mover.shape.arm.tip], np.eye(4)
    pose[:3, :3], pose[:3, 3] = tip.rotation.numpy(), tip.translation.numpy()
    return pose


def straight(
    mover: Mover, q: Joints, way: Float[np.ndarray, "3"], *, freeing: bool = False
) -> Float[np.ndarray, "rows joints"]:
    """Return joint values that move the tip straight by `way` [m], base frame. The first row is `q`.

    The path ends before the first pose that collides, is out of reach, or makes a joint jump. With `freeing`, hand and
    object may penetrate obstacles as deep as at `q`, but at most 2 cm. So a held object can leave a heap.
    """
    arm, pose, rows = mover.shape.arm, tip_pose(mover, q), [q]
    allowed = mover.allowed(q[None])
    if freeing:
        carried = mover.carried_columns
        allowed[carried] = np.minimum(allowed[carried], max(allowed[carried].min(), DEEPEST))
    count = max(1, int(np.ceil(np.linalg.norm(way) / _STEP)))
    for k in range(1, count + 1):
        target = pose.copy()
        target[:3, 3] += k / count * way
        found, reached = solve(arm, _se3([target]), torch.as_tensor(rows[-1])[None], _STEPS)
        after = found[0].double().numpy()
        far = np.abs(after - rows[-1]).max() > _JUMP
        if not bool(reached[0]) or far or not mover.clear(np.stack([rows[-1], after]), allowed):
            break
        rows.append(after)
    return np.stack(rows)


def held_balls(mover: Mover, q: Joints, surface: Points) -> Balls:
    """Return the mover's spheres that move with the tip, plus spheres of a held object, in the tip frame [m].

    `surface` has the object's surface points [m] in the base frame. The arm is at joint values `q`.
    """
    pose = tip_pose(mover, q)
    local = balls_about((surface - pose[:3, 3]) @ pose[:3, :3])
    at, radius = (np.concatenate(both) for both in ((mover.carried.at, local.at), (mover.carried.radius, local.radius)))
    return Balls(at, radius)


# Rotations about the vertical at which an object may be released [rad]. Release spots as fractions of the bin's `half`.
_TURNS = np.linspace(-np.pi, np.pi, 16, endpoint=False)
SPOTS = ((0.0, 0.0), (0.45, 0.45), (-0.45, -0.45), (0.45, -0.45), (-0.45, 0.45))
# Heights of the object's lowest point above the table at release [m], tried in this order.
_HEIGHTS = (0.08, 0.12, 0.17, 0.22, 0.28)


def dropped_box(thing: Points) -> Box:
    """Return the bounding box of a released object, lowered to the table. `thing`: surface points at release [m]."""
    low, high = thing.min(0), thing.max(0)
    half, rise = 0.5 * (high - low)[:2], 0.5 * float(high[2] - low[2])
    x, y = (0.5 * (low + high))[:2].tolist()
    return Box("dropped", (x, y, rise), (float(half[0]), float(half[1]), rise))


def release_posture(mover: Mover, q: Joints, thing: Points, bin_: Bin, number: int) -> Joints | None:
    """Return a collision-free posture near `q` with the object above a bin, or None. The object turns only about z.

    Args:
        mover: arm and hand with the object in the hand.
        q: current joint values of the arm.
        thing: points of the object's surface at `q`, base frame [m].
        bin_: the target bin.
        number: number of objects already released. It selects the release spot that is tried first.
    """
    arm, pose = mover.shape.arm, tip_pose(mover, q)
    middle = np.array([*thing.mean(0)[:2], thing[:, 2].min()])
    for height in _HEIGHTS:
        for shift in range(len(SPOTS)):
            spot = np.asarray(bin_.center) + bin_.half * np.asarray(SPOTS[(number + shift) % len(SPOTS)])
            targets = [_turned(pose, middle, np.array([*spot, height]), turn) for turn in _TURNS]
            found = _clear_postures(mover, arm, q, targets)
            if len(found):
                return found[np.abs(found - q).max(1).argmin()]
    return None


def _turned(pose: Pose, middle: np.ndarray, place: np.ndarray, turn: float) -> Pose:
    about = np.eye(4)
    about[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    moved = about @ pose
    moved[:3, 3] = about[:3, :3] @ (pose[:3, 3] - middle) + place
    return moved


def _clear_postures(mover: Mover, arm: Arm, q: Joints, targets: Sequence[Pose]) -> Float[np.ndarray, "_ joints"]:
    goal = _se3(targets)
    starts = torch.cat([torch.as_tensor(q).expand(len(targets), 1, -1), nearest_postures(start_table(arm), goal, 2)], 1)
    count = starts.shape[1]
    rows = torch.arange(len(targets)).repeat_interleave(count)
    found, there = solve(arm, goal[rows], starts.flatten(0, 1), _STEPS)
    reached = nearest_turn(arm, found[there].double(), q).numpy()
    return reached[mover.clearances(reached).min(1) >= mover.margin] if len(reached) else reached


def _se3(poses: Sequence[Pose]) -> SE3:
    stacked = torch.as_tensor(np.stack(poses))
    return SE3(stacked[:, :3, :3], stacked[:, :3, 3])
