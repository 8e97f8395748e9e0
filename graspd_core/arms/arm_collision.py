"""Check collisions of an arm's capsules with the support, the object, obstacles, the hand, and each other.

The support is a plane. Object and obstacles are signed distance fields, sampled along the segment of each capsule. The
samples are spheres that cover the capsule. Their radii exceed the capsule's radius by less than an eighth. The base is
checked only against the arm. The first moving link is not checked against the support, above which it only turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.arms.arm import Arm, arm_links, capsules_about, placed, segment_distance, tip_hand
from graspd_core.hands.kinematics import forward, make_kinematics, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.perception.scene import Scene
from graspd_core.se3 import SE3


@dataclass(frozen=True)
class Hits:
    """Collision depths of an arm.

    Attributes:
        depth: depth of each possible collision at each arm posture [m]. Negative without collision.
        what: description of each possible collision, such as "forearm in the table".
    """

    depth: Float[Tensor, "batch things"]
    what: tuple[str, ...]


def joined(*hits: Hits) -> Hits:
    """Concatenate several sets of collisions."""
    return Hits(torch.cat([h.depth for h in hits], -1), tuple(what for h in hits for what in h.what))


def hits_of_scene(arm: Arm, scene: Scene, base: SE3, links: SE3) -> Hits:
    """Return the collision depths of the arm in the support, the object and the obstacles.

    Args:
        base: pose `T_scene_base` of the arm's base, without batch dimensions.
        links: link poses from `arm_links`.
    """
    solids = [("the object", scene.sdf), *(("an obstacle", obstacle.sdf) for obstacle in scene.obstacles)]
    moved = np.flatnonzero(arm.chain.link_group[arm.capsules.link] != 0)
    points, padded, owner = capsule_balls(arm)
    at = (base.rotation @ place_points(points, links)[..., None]).squeeze(-1) + base.translation
    found = [hits_of_support(arm, scene, base, placed(arm.capsules, links)[:2])]
    for what, sdf in solids:
        depth = padded - sample_sdf(sdf, at.to(sdf.field))[0].to(at)
        worst = _worst_of_each(depth, owner, len(arm.capsules.link))
        found.append(Hits(worst[:, moved], tuple(f"{_name(arm, k)} in {what}" for k in moved.tolist())))
    return joined(*found)


def hits_of_support(
    arm: Arm, scene: Scene, base: SE3, ends: tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n 3"]]
) -> Hits:
    """Return the depths of the arm's capsules in the scene's support. `ends`: both segment ends, base frame [m]."""
    start, end = ends
    if scene.support is None:
        return Hits(start.new_zeros(len(start), 0), ())
    group = arm.chain.link_group[arm.capsules.link]
    beyond = np.flatnonzero((group != 0) & (group != arm.chain.link_group[arm.moved_link[0]]))
    normal = torch.as_tensor(scene.support.normal).to(start)
    # The support plane in the base frame is local · x = offset.
    local, offset = normal @ base.rotation, scene.support.offset - float(normal @ base.translation)
    height = (
        torch.minimum(start @ local, end @ local)[:, beyond] - offset - torch.as_tensor(arm.capsules.radius[beyond])
    )
    return Hits(-height, tuple(f"{_name(arm, k)} in the table" for k in beyond.tolist()))


def _name(arm: Arm, capsule: int) -> str:
    return arm.chain.link_names[arm.capsules.link[capsule]]


def _worst_of_each(
    depth: Float[Tensor, "batch n"], owner: Int[np.ndarray, "n"], count: int
) -> Float[Tensor, "batch owners"]:
    worst = depth.new_full((len(depth), count), -torch.inf)
    return worst.scatter_reduce(1, torch.as_tensor(owner).expand(len(depth), -1), depth, "amax")


def hits_of_self(arm: Arm, links: SE3) -> Hits:
    """Return collision depths of pairs of arm links. Neighbours and links that touch in posture `seed` are left out."""
    start, end, radius = placed(arm.capsules, links)
    first, second = _pairs(arm)
    distance = segment_distance(start[:, first], end[:, first], start[:, second], end[:, second])
    what = tuple(
        f"{_name(arm, b)} against {_name(arm, a)}" for a, b in zip(first.tolist(), second.tolist(), strict=True)
    )
    return Hits(radius[first] + radius[second] - distance, what)


def hits_of_hand(arm: Arm, hand: HandModel, links: SE3, joints: Float[Tensor, "batch hand_joints"]) -> Hits:
    """Return collision depths of arm and hand at the hand's `joints`, without links that touch in posture `seed`."""
    own_start, own_end, own_radius = placed(arm.capsules, links)
    start, end, radius = _hand_capsules(arm, hand, links, joints)
    # Arm links outside a bounding sphere of the hand cannot collide with the hand.
    center = 0.5 * (start + end).mean(1, keepdim=True)
    ball = torch.maximum((start - center).norm(dim=-1), (end - center).norm(dim=-1)).add(radius).amax(1, keepdim=True)
    near = segment_distance(own_start, own_end, center, center) < own_radius + ball
    checked = _clear_of_hand(arm, hand) & near.any(0).numpy()[:, None]
    first, second = np.nonzero(checked)
    distance = segment_distance(own_start[:, first], own_end[:, first], start[:, second], end[:, second])
    worst = _worst_of_each(own_radius[first] + radius[second] - distance, first, len(checked))
    own = np.flatnonzero(checked.any(1))
    return Hits(worst[:, own], tuple(f"{_name(arm, k)} against the hand" for k in own.tolist()))


def _hand_capsules(arm: Arm, hand: HandModel, links: SE3, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    fingers = forward(make_kinematics(hand, dtype=joints.dtype), joints)
    base = links[:, arm.tip].compose(tip_hand(arm, hand))
    start, end, radius = placed(capsules_about(hand.primitives), fingers)
    return base.apply(start), base.apply(end), radius


# Arms are hashed by identity.
@lru_cache(maxsize=8)
def _pairs(arm: Arm) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Return the pairs of capsules to check. Neighbouring links and pairs that touch in posture `seed` are left out."""
    group = arm.chain.link_group[arm.capsules.link]
    parent = arm.chain.link_parent[group]
    above = np.where(parent < 0, -1, arm.chain.link_group[parent])
    first, second = np.triu_indices(len(group), 1)
    near = (group[first] == group[second]) | (above[first] == group[second]) | (above[second] == group[first])
    first, second = first[~near], second[~near]
    start, end, radius = (x[0] if x.dim() == 3 else x for x in placed(arm.capsules, _seed_links(arm)))
    gap = segment_distance(start[first], end[first], start[second], end[second]) - radius[first] - radius[second]
    clear = (gap > 0).numpy()
    return first[clear], second[clear]


@lru_cache(maxsize=8)
def _clear_of_hand(arm: Arm, hand: HandModel) -> np.ndarray:
    links = _seed_links(arm)
    start, end, radius = _hand_capsules(arm, hand, links, torch.as_tensor(hand.open_posture)[None].double())
    a, b, own = placed(arm.capsules, links)
    gap = segment_distance(a[0, :, None], b[0, :, None], start[0], end[0]) - own[:, None] - radius
    return (gap > 0).numpy()


def _seed_links(arm: Arm) -> SE3:
    return arm_links(arm, torch.as_tensor(arm.seed)[None])


@lru_cache(maxsize=8)
def capsule_balls(arm: Arm) -> tuple[Float[Tensor, "n columns"], Float[Tensor, "n"], Int[np.ndarray, "n"]]:
    """Return samples of all segments: points as a matrix for `place_points`, larger radii [m], and capsule indices."""
    points, radii, owner = [], [], []
    for k in range(len(arm.capsules.link)):
        start, end, radius = arm.capsules.start[k], arm.capsules.end[k], arm.capsules.radius[k]
        count = 1 + int(np.ceil(np.linalg.norm(end - start) / radius))
        spacing = np.linalg.norm(end - start) / max(count - 1, 1)
        points.append(start + np.linspace(0.0, 1.0, count)[:, None] * (end - start))
        # The nearest sample is at most half a spacing away along the segment, so the larger sphere covers the capsule.
        radii.append(np.full(count, np.hypot(radius, spacing / 2)))
        owner.append(np.full(count, k))
    owner = np.concatenate(owner)
    links = torch.as_tensor(arm.capsules.link[owner])
    matrix = placement(arm.chain.num_links, torch.as_tensor(np.concatenate(points)), links)
    return matrix, torch.as_tensor(np.concatenate(radii)), owner
