"""A low-dimensional space of postures for any hand, and the places on the inside of its links.

Eigengrasps (Ciocarlie and Allen, IJRR 2009) are the principal components of how people shape their hands. No such
recordings exist for an arbitrary hand, so here they are those of seeded random postures between open and closed, in
which the fingers mostly close together: the first is the hand's closing, the next are how fingers differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel
from graspd_core.methods.finger_closing import finger_of

# Random postures, how far fingers differ from the common closing (shares), and joints from their finger (range).
_POSTURES, _FINGER_SPREAD, _JOINT_SPREAD = 512, 0.3, 0.05
# The inside of a group of links: where its surface faces the way that closing moves it (cosine), or comes nearest to
# facing it; a group that never does by as much as the second has no inside.
_FACING, _LEAST_FACING = 0.85, 0.5


@dataclass(frozen=True, eq=False)
class PostureSpace:
    """Postures `center + amplitudes @ basis`, clamped to the joint limits.

    Attributes:
        center: the mean posture [rad] or [m].
        basis: the eigengrasps, orthonormal rows, in units of joint range.
        low, high: the range of each amplitude.
    """

    center: Float[np.ndarray, "joints"]
    basis: Float[np.ndarray, "dimensions joints"]
    low: Float[np.ndarray, "dimensions"]
    high: Float[np.ndarray, "dimensions"]


def posture_space(hand: HandModel, dimensions: int, seed: int) -> PostureSpace:
    """The first principal components of random postures; fewer where the hand has fewer joints that vary."""
    rng = np.random.default_rng(seed)
    fingers = finger_of(hand)
    span = hand.upper - hand.lower
    common = rng.uniform(0.0, 1.0, (_POSTURES, 1))
    share = common + _FINGER_SPREAD * rng.uniform(-1.0, 1.0, (_POSTURES, int(fingers.max()) + 1))[:, fingers]
    postures = hand.open_posture + share * (hand.closed_posture - hand.open_posture)
    postures += _JOINT_SPREAD * span * rng.uniform(-1.0, 1.0, postures.shape)
    postures = np.clip(postures, hand.lower, hand.upper)
    center = postures.mean(0)
    # In units of each joint's range, so that metres and radians weigh alike.
    scaled = (postures - center) / span
    values, rows = np.linalg.svd(scaled, full_matrices=False)[1:]
    rows = rows[: min(dimensions, int((values > 1e-9 * values[0]).sum()))]
    # The sign of a component is arbitrary: closing is positive.
    sign = np.where(rows @ ((hand.closed_posture - hand.open_posture) / span) < 0, -1.0, 1.0)
    rows = rows * sign[:, None]
    amplitudes = scaled @ rows.T
    return PostureSpace(center, rows * span, amplitudes.min(0), amplitudes.max(0))


def inner_contacts(hand: HandModel, per_link: int) -> Int[np.ndarray, "contacts"]:
    """Indices of contact candidates on the inside of the hand: the palm's, and those that closing moves ahead of it.

    For each rigid group of links the one nearest to the middle of its inside, then those farthest from the chosen.
    """
    chosen: list[int] = []
    facing = _facing(hand)
    group = hand.link_group[hand.candidate_link]
    rotation, translation = link_poses(hand, hand.open_posture)
    hand_forward = np.einsum("pij,pj->pi", rotation[hand.candidate_link], hand.candidate_points)
    hand_forward += translation[hand.candidate_link]
    for number in np.unique(group):
        most = float(facing[group == number].max())
        if most < _LEAST_FACING:
            continue
        inside = np.flatnonzero((group == number) & (facing >= min(most, _FACING)))
        middle = hand.palm_center if number == hand.link_group[0] else hand_forward[inside].mean(0)
        away = np.linalg.norm(hand_forward[inside] - middle, axis=1)
        picks = [int(away.argmin())]
        for _ in range(min(per_link, len(inside)) - 1):
            nearest = np.linalg.norm(hand_forward[inside][:, None] - hand_forward[inside][picks], axis=-1).min(1)
            picks.append(int(nearest.argmax()))
        chosen += inside[picks].tolist()
    return np.array(chosen, dtype=np.int64)


def _facing(hand: HandModel) -> Float[np.ndarray, "candidates"]:
    """Cosine between each candidate's outward normal and the way that closing moves it; for the palm, its normal."""
    links = hand.candidate_link
    early, late = (
        link_poses(hand, hand.open_posture + share * (hand.closed_posture - hand.open_posture)) for share in (0.4, 0.6)
    )

    def points(frames) -> Float[np.ndarray, "candidates 3"]:
        return np.einsum("pij,pj->pi", frames[0][links], hand.candidate_points) + frames[1][links]

    motion = points(late) - points(early)
    length = np.linalg.norm(motion, axis=1)
    still = length < 1e-6
    motion = np.where(still[:, None], hand.palm_normal, motion / np.maximum(length, 1e-6)[:, None])
    normals = np.einsum("pij,pj->pi", early[0][links], hand.candidate_normals)
    # Links that stand still but are not the palm have no inside.
    idle = still & (hand.link_group[links] != hand.link_group[0])
    return np.where(idle, 0.0, (normals * motion).sum(1))
