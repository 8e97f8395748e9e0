"""A palm and two postures for a hand that comes as a bare URDF. Guesses: a hand description beats them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel
from graspd_core.hands.sampling import surface_points

# How far in front of the palm a held object's middle is taken to be [m].
_HOLD_DISTANCE = 0.04


def guess_palm_and_postures(hand: HandModel) -> HandModel:
    """The hand with an open posture at mid-range, a palm facing where the fingertips sweep, and a closed posture.

    The palm is the root link. Each joint closes by a quarter of its range, the way that brings the fingertips nearer to
    a point in front of the palm.
    """
    middle = 0.5 * (hand.lower + hand.upper)
    tips = _leaf_links(hand)
    center = _center(hand)
    straight = link_poses(hand, np.clip(0.0, hand.lower, hand.upper))[1][tips].mean(0)
    bent = link_poses(hand, middle)[1][tips].mean(0)
    along = _unit(straight - center, np.array([0.0, 0.0, 1.0]))
    sweep = bent - straight
    side = np.array([1.0, 0.0, 0.0]) if abs(along[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    normal = _unit(sweep - (sweep @ along) * along, _unit(side - (side @ along) * along, side))
    target = center + _HOLD_DISTANCE * normal
    closed = middle.copy()
    for joint in range(hand.num_joints):
        step = np.zeros(hand.num_joints)
        step[joint] = 0.25 * (hand.upper - hand.lower)[joint]
        gap = [np.linalg.norm(link_poses(hand, middle + s * step)[1][tips] - target, axis=1).mean() for s in (-1, 0, 1)]
        closed += (int(np.argmin(gap)) - 1) * step
    return replace(
        hand,
        open_posture=middle,
        closed_posture=closed,
        palm_center=center,
        palm_normal=normal,
        approach=normal,
        warnings=(*hand.warnings, f"{hand.name}: palm and postures were guessed; write a hand description to set them"),
    )


def _leaf_links(hand: HandModel) -> Int[np.ndarray, "leaves"]:
    return np.setdiff1d(np.arange(1, hand.num_links), hand.link_parent)


def _center(hand: HandModel) -> Float[np.ndarray, "3"]:
    """Middle of the root link's solids, or of the finger roots where it has none [m]."""
    rng = np.random.default_rng(0)
    parts = [surface_points(p, 200, rng)[0] for p in hand.primitives_of[0]]
    if not parts:
        return hand.link_offset_translation[hand.link_parent == 0].mean(0)
    points = np.concatenate(parts)
    return 0.5 * (points.min(0) + points.max(0))


def _unit(vector: Float[np.ndarray, "3"], otherwise: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else otherwise
