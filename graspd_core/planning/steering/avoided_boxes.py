"""Whether a link enters a box: exact for solids that are the hull of balls, which all but finely cut hulls are.

Frank and Wolfe's steps (Naval Research Logistics 1956) lead to the point of a solid's core that is nearest to the box.
On their way they give a lower bound of the distance. A pair that they leave undecided counts as entered.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from graspd_core.hands.kinematics import forward, make_kinematics
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import build_sdf
from graspd_core.methods.obstacle_distance import RETREAT, extreme_points_of_solids, hand_reach
from graspd_core.planning.steering.regions import Box
from graspd_core.scene.scene import Obstacle, Scene
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Posture, TriangleMesh

_STEPS = 60
# A gap narrower than this is none [m].
_TOUCH = 1e-5
_GRID_RESOLUTION = 32
# The search keeps so far off a box [m]: it allows a little depth in obstacles, and a squeeze closes the fingers more.
_PAD = 0.004


def entered(hand: HandModel, postures: Sequence[Posture], boxes: Sequence[Box]) -> Bool[np.ndarray, "postures"]:
    """In which postures a link reaches into one of the boxes; positions in the boxes' frame."""
    if not boxes or not postures:
        return np.zeros(len(postures), dtype=bool)
    points, radii = _placed_solids(hand, postures)
    found = [_enter(box.local(points), radii, np.asarray(box.size) / 2) for box in boxes]
    return np.any(found, axis=0)


def _placed_solids(
    hand: HandModel, postures: Sequence[Posture]
) -> tuple[Float[np.ndarray, "postures solids corners 3"], Float[np.ndarray, "solids"]]:
    """Extreme points of each solid [m], the first again where it has fewer than others; and the radius about them."""
    solids = extreme_points_of_solids(hand)
    most = max(len(points) for points, _, _ in solids)
    local = np.stack([np.vstack([points, np.repeat(points[:1], most - len(points), 0)]) for points, _, _ in solids])
    joints = torch.as_tensor(np.stack([p.joint_positions for p in postures])).double()
    links = forward(make_kinematics(hand, dtype=torch.float64), joints)[:, torch.as_tensor([s[2] for s in solids])]
    inside = torch.einsum("bsij,skj->bski", links.rotation, torch.as_tensor(local)) + links.translation[:, :, None]
    turns = rotation_from_quaternion(torch.as_tensor(np.stack([p.quaternion_wxyz for p in postures])).double())
    base = SE3(turns, torch.as_tensor(np.stack([p.position for p in postures])).double())
    placed = base.apply(inside.flatten(1, 2)).reshape(inside.shape)
    return placed.numpy(), np.array([radius for _, radius, _ in solids])


def _enter(
    points: Float[np.ndarray, "postures solids corners 3"],
    radii: Float[np.ndarray, "solids"],
    half: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "postures"]:
    """Which hands have a solid less than its radius from the box |x| ≤ `half`."""
    flat = points.reshape(-1, *points.shape[2:])
    radius = np.tile(radii, len(points))
    # What lies beyond one of the box's faces is clear of it.
    clear = ((flat.min(1) - radius[:, None] > half) | (flat.max(1) + radius[:, None] < -half)).any(-1)
    rows = np.flatnonzero(~clear)
    x = flat[rows].mean(1)
    for _ in range(_STEPS):
        away = x - x.clip(-half, half)
        gap = np.linalg.norm(away, axis=-1)
        along = np.einsum("nki,ni->nk", flat[rows], away)
        nearest = along.argmin(1)
        bound = along.min(1) - (away * x.clip(-half, half)).sum(-1)
        parted = bound > (radius[rows] + _TOUCH) * gap
        inside = gap <= radius[rows] + _TOUCH
        clear[rows[parted & ~inside]] = True
        going = ~parted & ~inside
        if not going.any():
            break
        rows, x, away, nearest = rows[going], x[going], away[going], nearest[going]
        step = flat[rows, nearest] - x
        share = -(away * step).sum(-1) / np.maximum((step * step).sum(-1), 1e-18)
        x = x + share.clip(0.0, 1.0)[:, None] * step
    return ~clear.reshape(len(points), -1).all(-1)


def boxes_in_reach(scene: Scene, hand: HandModel, boxes: Sequence[Box]) -> tuple[Obstacle, ...]:
    """What the hand could meet of each box on its way to the object, as an obstacle of the search."""
    reach = scene.object.radius + hand_reach(hand) + RETREAT
    found = []
    for box in boxes:
        middle, half = box.local(scene.object.center_of_mass), np.asarray(box.size) / 2
        low, high = np.maximum(-half - _PAD, middle - reach), np.minimum(half + _PAD, middle + reach)
        if (low < high).all():
            mesh = _box_mesh(box, low, high)
            found.append(Obstacle(mesh, build_sdf(mesh, resolution=_GRID_RESOLUTION, padding=0.02)))
    return tuple(found)


def _box_mesh(box: Box, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> TriangleMesh:
    """The part of a box between two corners of its own frame."""
    import trimesh

    mesh = trimesh.creation.box(bounds=np.stack([low, high]))
    vertices = np.asarray(mesh.vertices) @ box.rotation.T + np.asarray(box.center)
    return TriangleMesh(vertices, np.asarray(mesh.faces, dtype=np.int64))
