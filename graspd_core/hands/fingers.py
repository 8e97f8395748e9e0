"""Find the fingers of a hand: their roots at the palm, their tips, and which of them bend the same way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.hands.kinematics import LinkNumbers, LinkPoints, LinkPoses, in_base, link_poses, point_jacobian
from graspd_core.hands.model import HandModel
from graspd_core.hands.surface_points import surface_points, units

# In a human-like hand, the mean of the fingers' unit bending directions is longer than this. Three fingers against one
# give 1/2. Three fingers around a circle, or two against one, give at most 1/3.
_ALIKE = 0.42
# Two directions count as equal if the cosine between them exceeds this. A thumb differs more from the other fingers.
_SAME_WAY = 0.7
# A finger stands up from a plane if the cosine between the finger and the plane's normal exceeds this.
_UPRIGHT = 0.5


@dataclass(frozen=True, eq=False)
class Fingers:
    """Geometry of a hand's fingers, with all joints straight (see `straight_joints`).

    Attributes:
        points: fingertips in the frames of their links [m].
        links: link of each fingertip.
        roots: position of each finger's joint at the palm, base frame [m].
        tips: fingertips in the base frame [m].
        palm: rigid group of links from which all fingers branch (see `HandModel.link_group`).
        wrist: indices of the actuated joints that move the palm.
        mates: True for each finger that bends the same way as most others, so not for a thumb. All False in a gripper.
        bend: unit direction in which `mates` bend, base frame. Zero in a gripper.
    """

    points: Float[np.ndarray, "tips 3"]
    links: Int[np.ndarray, "tips"]
    roots: Float[np.ndarray, "tips 3"]
    tips: Float[np.ndarray, "tips 3"]
    palm: int
    wrist: Int[np.ndarray, "wrist"]
    mates: Bool[np.ndarray, "tips"]
    bend: Float[np.ndarray, "3"]

    @property
    def length(self) -> float:
        """Mean length of the fingers from root to tip [m]. 0.05 if the mean is zero."""
        return float(np.linalg.norm(self.tips - self.roots, axis=1).mean()) or 0.05


# The results for the last hands are cached. Hands are hashed by identity.
@lru_cache(maxsize=8)
def find_fingers(hand: HandModel) -> Fingers:
    """Find the fingers: chains that end in a link without children.

    A fingertip is the far end of a chain's last link with a collision shape.
    """
    groups = hand.link_group
    heads = np.unique(groups)
    above = {int(g): int(groups[hand.link_parent[g]]) if hand.link_parent[g] >= 0 else -1 for g in heads}
    solid = {int(groups[p.link]) for p in hand.primitives}
    # A last link without solids is a frame or a sensor. Then its parent is the fingertip.
    leaves = set()
    for group in set(above) - set(above.values()):
        while group > 0 and group not in solid:
            group = above[group]
        leaves.add(group)
    leaves = {g for g in leaves if g > 0 and not any(g in _chain(other, above)[1:] for other in leaves - {g})}
    chains = [_chain(leaf, above) for leaf in sorted(leaves)] or [[int(heads[-1]), 0]]
    palm = next(g for g in chains[0][1:] if all(g in chain for chain in chains))
    wrist = sorted({int(hand.link_joint[g]) for g in _chain(palm, above)[:-1]})
    rotations, translations = link_poses(hand, straight_joints(hand))
    rng = np.random.default_rng(0)
    points, roots = [], []
    middle = translations[hand.link_group == palm].mean(0)
    for chain in chains:
        root = translations[chain[chain.index(palm) - 1]]
        tip = chain[0]
        reached = _group_surface(hand, (rotations, translations), tip, 200, rng)
        reached = reached if len(reached) else translations[[tip]]
        points.append(_far_end(reached, root, middle))
        roots.append(root)
    links, tips = np.array([chain[0] for chain in chains]), np.array(points)
    local = np.einsum("tji,tj->ti", rotations[links], tips - translations[links])
    straight = units(tips - np.array(roots), 1e-6)
    mates, bend = _mates(hand, local, links, straight, wrist)
    if mates.sum() == 2 and len(mates) == 3 and _stand_up(np.array(roots), straight[mates]):
        mates, bend = np.zeros(3, dtype=bool), np.zeros(3)
    return Fingers(local, links, np.array(roots), tips, palm, np.array(wrist, dtype=int), mates, bend)


def _far_end(
    reached: Float[np.ndarray, "points 3"], root: Float[np.ndarray, "3"], middle: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return the mean of the points farthest from `root`. If the mean is near `root`, use `middle` instead."""
    for origin in (root, middle):
        distance = np.linalg.norm(reached - origin, axis=1)
        end = reached[distance >= np.quantile(distance, 0.85)].mean(0)
        if np.linalg.norm(end - root) > 0.5 * np.linalg.norm(reached - root, axis=1).max():
            break
    return end


def _chain(group: int, above: dict[int, int]) -> list[int]:
    chain = [group]
    while above[chain[-1]] >= 0:
        chain.append(above[chain[-1]])
    return chain


def _mates(
    hand: HandModel, points: LinkPoints, links: LinkNumbers, straight: LinkPoints, wrist: list[int]
) -> tuple[Bool[np.ndarray, "points"], Float[np.ndarray, "3"]]:
    """Return which fingers point and bend the same way, and the bending direction. Both are zero for a gripper."""
    q = straight_joints(hand)
    travel = 0.5 * (hand.lower + hand.upper) - q
    travel[wrist] = 0.0
    # Joint limits that are almost symmetric sweep a fingertip by up to half a millimetre, which counts as no sweep.
    sweep = units(point_jacobian(hand, q, points, links) @ travel, 5e-4)
    alike = (sweep @ sweep.T > _SAME_WAY) & (straight @ straight.T > _SAME_WAY)
    mates = alike[alike.sum(1).argmax()]
    few = mates.sum() <= (max(1, len(points) / 2) if len(points) > 1 else 0)
    if few or np.linalg.norm(sweep.mean(0)) <= _ALIKE:
        return np.zeros(len(points), dtype=bool), np.zeros(3)
    return mates, units(sweep[mates].mean(0))


def _stand_up(roots: Float[np.ndarray, "3 3"], pair: Float[np.ndarray, "2 3"]) -> bool:
    """Return True if the mean of the directions `pair` is within 60° of the normal to the plane of the `roots`."""
    across = np.cross(roots[1] - roots[0], roots[2] - roots[0])
    return bool(abs(pair.mean(0) @ units(across, 1e-6)) > _UPRIGHT)


def palm_points(hand: HandModel, fingers: Fingers) -> Float[np.ndarray, "points 3"]:
    """Return surface points of the palm, base frame [m]. If the palm has no shape, return the finger roots."""
    poses = link_poses(hand, straight_joints(hand))
    found = _group_surface(hand, poses, fingers.palm, 400, np.random.default_rng(0))
    return found if len(found) else fingers.roots


def _group_surface(
    hand: HandModel, poses: LinkPoses, group: int, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "points 3"]:
    rotations, translations = poses
    solids = [solid for solid in hand.primitives if hand.link_group[solid.link] == group]
    drawn = [surface_points(p, count, rng)[0] @ rotations[p.link].T + translations[p.link] for p in solids]
    return np.concatenate([np.zeros((0, 3)), *drawn])


def placed_tips(hand: HandModel, fingers: Fingers, q: Float[np.ndarray, "joints"]) -> Float[np.ndarray, "tips 3"]:
    """Return the fingertips at a posture, base frame [m]."""
    return in_base(link_poses(hand, q), fingers.points, fingers.links)


def knuckle_row(fingers: Fingers) -> Float[np.ndarray, "3"]:
    """Return the unit direction along the row of knuckles, which are the roots of `mates`. At least two are needed."""
    knuckles = fingers.roots[fingers.mates]
    return np.linalg.svd(knuckles - knuckles.mean(0))[2][0]


def straight_joints(hand: HandModel) -> Float[np.ndarray, "joints"]:
    """Return joint values of zero, clamped to the joint limits."""
    return np.clip(0.0, hand.lower, hand.upper)


def middle_joints(hand: HandModel, fingers: Fingers) -> Float[np.ndarray, "joints"]:
    """Return joint values at mid-range, with the wrist straight."""
    middle = 0.5 * (hand.lower + hand.upper)
    middle[fingers.wrist] = straight_joints(hand)[fingers.wrist]
    return middle
