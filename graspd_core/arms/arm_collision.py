"""What an arm hits: its links as capsules against the support, the object, obstacles, each other and the hand.

The support is a plane and what stands on it a signed distance, sampled along a capsule's segment so densely that the
padding for what lies between two samples stays below an eighth of the radius. The arm's base is held against nothing
but the arm: it stands where it stands. Nor is the first link that moves held against the support, above which it turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.arms.arm import Arm, arm_links, tip_hand
from graspd_core.arms.capsules import Capsules, capsules_about, placed, segment_distance
from graspd_core.hands.kinematics import forward, make_kinematics, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import GridSDF, sample_sdf
from graspd_core.scene.scene import Scene
from graspd_core.se3 import SE3


@dataclass(frozen=True)
class Hits:
    """How deep an arm is in what it must not touch.

    Attributes:
        depth: of each thing that could be hit, negative where clear [m].
        what: the things, "forearm in the table".
    """

    depth: Float[Tensor, "batch things"]
    what: tuple[str, ...]


def joined(*hits: Hits) -> Hits:
    """All things of several."""
    return Hits(torch.cat([h.depth for h in hits], -1), tuple(what for h in hits for what in h.what))


def hits_of_scene(arm: Arm, scene: Scene, base: SE3, links: SE3) -> Hits:
    """Depths in the support, the object and the obstacles.

    Args:
        base: `T_scene_base`, one.
        links: of `arm_links`.
    """
    names = [arm.chain.link_names[link] for link in arm.capsules.link]
    moved = np.flatnonzero(arm.chain.link_group[arm.capsules.link] != 0)
    start, end, radius = placed(arm.capsules, links)
    found = []
    if scene.support is not None:
        normal = torch.as_tensor(scene.support.normal).to(start)
        # The plane in the base's frame.
        local, offset = normal @ base.rotation, scene.support.offset - float(normal @ base.translation)
        beyond = [k for k in moved if arm.chain.link_group[arm.capsules.link[k]] != _first_moved(arm)]
        height = torch.minimum(start @ local, end @ local)[:, beyond] - offset - radius[beyond]
        found.append(Hits(-height, tuple(f"{names[k]} in the table" for k in beyond)))
    solids = [("the object", scene.sdf), *(("an obstacle", obstacle.sdf) for obstacle in scene.obstacles)]
    points, padded, owner = _samples(arm)
    at = base.rotation @ place_points(points, links)[..., None]
    at = at.squeeze(-1) + base.translation
    for what, sdf in solids:
        depth = padded - _distance(sdf, at)
        worst = torch.full((len(at), len(names)), -torch.inf, dtype=depth.dtype)
        worst = worst.scatter_reduce(1, torch.as_tensor(owner).expand(len(at), -1), depth, "amax")
        found.append(Hits(worst[:, moved], tuple(f"{names[k]} in {what}" for k in moved)))
    return joined(*found)


def hits_of_self(arm: Arm, links: SE3) -> Hits:
    """Depths of links in each other, but for neighbours and pairs that touch in the seed posture."""
    start, end, radius = placed(arm.capsules, links)
    first, second = _pairs(arm)
    distance = segment_distance(start[:, first], end[:, first], start[:, second], end[:, second])
    name = [arm.chain.link_names[link] for link in arm.capsules.link]
    what = tuple(f"{name[b]} against {name[a]}" for a, b in zip(first, second, strict=True))
    return Hits(radius[first] + radius[second] - distance, what)


def hits_of_hand(arm: Arm, hand: HandModel, links: SE3, joints: Float[Tensor, "batch hand_joints"]) -> Hits:
    """Depths of links in the hand at its joint values, but for pairs that touch in the seed posture."""
    checked = _clear_of_hand(arm, hand)
    arm_start, arm_end, arm_radius = placed(arm.capsules, links)
    start, end, radius = _hand_capsules(arm, hand, links, joints)
    first, second = np.nonzero(checked)
    distance = segment_distance(arm_start[:, first], arm_end[:, first], start[:, second], end[:, second])
    depth = arm_radius[first] + radius[second] - distance
    own = np.flatnonzero(checked.any(1))
    worst = torch.full((len(depth), len(checked)), -torch.inf, dtype=depth.dtype)
    worst = worst.scatter_reduce(1, torch.as_tensor(first).expand(len(depth), -1), depth, "amax")
    return Hits(worst[:, own], tuple(f"{arm.chain.link_names[arm.capsules.link[k]]} against the hand" for k in own))


def _hand_capsules(arm: Arm, hand: HandModel, links: SE3, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Ends and radii of the hand's capsules in the arm's base frame."""
    capsules = capsules_of_hand(hand)
    fingers = forward(make_kinematics(hand, dtype=joints.dtype), joints)
    base = links[:, arm.tip].compose(tip_hand(arm, hand))
    start, end, radius = placed(capsules, fingers)
    return base.apply(start), base.apply(end), radius


# Hands and arms are hashed by identity.
@lru_cache(maxsize=8)
def capsules_of_hand(hand: HandModel) -> Capsules:
    """A capsule about each solid of a hand."""
    return capsules_about(hand.primitives)


def _first_moved(arm: Arm) -> int:
    """The group of links that the first joint moves."""
    return int(arm.chain.link_group[arm.moved_link[0]])


@lru_cache(maxsize=8)
def _pairs(arm: Arm) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Capsules to hold against each other: no neighbours, none that touch in the seed posture."""
    group = arm.chain.link_group[arm.capsules.link]
    above = np.array([_group_above(arm, g) for g in group])
    first, second = np.triu_indices(len(group), 1)
    near = (group[first] == group[second]) | (above[first] == group[second]) | (above[second] == group[first])
    first, second = first[~near], second[~near]
    start, end, radius = (x[0] if x.dim() == 3 else x for x in placed(arm.capsules, _seed_links(arm)))
    gap = segment_distance(start[first], end[first], start[second], end[second]) - radius[first] - radius[second]
    clear = (gap > 0).numpy()
    return first[clear], second[clear]


def _group_above(arm: Arm, group: int) -> int:
    """The group that a group of welded links hangs on; -1 for the base's."""
    parent = arm.chain.link_parent[group]
    return -1 if parent < 0 else int(arm.chain.link_group[parent])


@lru_cache(maxsize=8)
def _clear_of_hand(arm: Arm, hand: HandModel) -> np.ndarray:
    """Which of the arm's capsules (rows) are held against which of the open hand's: those clear in the seed posture."""
    links = _seed_links(arm)
    start, end, radius = _hand_capsules(arm, hand, links, torch.as_tensor(hand.open_posture)[None].double())
    a, b, own = placed(arm.capsules, links)
    gap = segment_distance(a[0, :, None], b[0, :, None], start[0], end[0]) - own[:, None] - radius
    return (gap > 0).numpy()


def _seed_links(arm: Arm) -> SE3:
    return arm_links(arm, torch.as_tensor(arm.seed)[None])


@lru_cache(maxsize=8)
def _samples(arm: Arm) -> tuple[Float[Tensor, "points columns"], Float[Tensor, "points"], Int[np.ndarray, "points"]]:
    """Points along the segments as a `placement`, their padded radii [m], and the capsule of each."""
    points, radii, owner = [], [], []
    for k in range(len(arm.capsules.link)):
        start, end, radius = arm.capsules.start[k], arm.capsules.end[k], arm.capsules.radius[k]
        count = 1 + int(np.ceil(np.linalg.norm(end - start) / radius))
        spacing = np.linalg.norm(end - start) / max(count - 1, 1)
        points.append(start + np.linspace(0.0, 1.0, count)[:, None] * (end - start))
        # Of the surface point nearest to a segment, a sample is at most half a spacing farther along.
        radii.append(np.full(count, np.hypot(radius, spacing / 2)))
        owner.append(np.full(count, k))
    owner = np.concatenate(owner)
    links = torch.as_tensor(arm.capsules.link[owner])
    matrix = placement(arm.chain.num_links, torch.as_tensor(np.concatenate(points)), links)
    return matrix, torch.as_tensor(np.concatenate(radii)), owner


def _distance(sdf: GridSDF, points: Float[Tensor, "batch n 3"]) -> Float[Tensor, "batch n"]:
    return sample_sdf(sdf, points.to(sdf.field))[0].to(points)
