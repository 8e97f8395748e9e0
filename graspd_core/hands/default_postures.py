"""A palm, an approach and two postures for a hand whose description names none. A hand description beats them.

Fingers are the chains that end in links which move no others; the palm is the link that all of them hang from. Where
most fingers bend the same way (a human-like hand), the palm faces where they bend to: the linearised sweep of the
fingertips from straight to mid-range. Where fingers bend or slide against each other (a gripper), the palm faces along
them. The postures come from a search: fingertips around a small ball in front of the palm, and around a large one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from graspd_core.hands.fingers import (
    Fingers,
    find_fingers,
    knuckle_row,
    middle_joints,
    palm_points,
    placed_tips,
    units,
)
from graspd_core.hands.fingertip_search import FingertipGoal, around_ball, side_by_side
from graspd_core.hands.kinematics import link_poses, point_jacobian
from graspd_core.hands.model import HandModel
from graspd_core.hands.surface_points import dense_samples

# Radii of the balls that fingertips close and open around, and the ball's distance from the palm, in finger lengths.
_CLOSED, _OPEN, _AHEAD = 0.16, 0.55, 0.4
# Breadth of the palm's surface that its middle is found on [m].
_SPOT = 0.02
# From this cosine to the way in which the fingers point on, a joint's axis spreads them.
_SPREAD = 0.7


def default_palm(hand: HandModel) -> HandModel:
    """The hand with a palm centre, a palm normal and an approach, and a warning that they are guessed."""
    fingers = find_fingers(hand)
    normal = fingers.bend if fingers.mates.any() else _along(hand, fingers)
    warnings = [*hand.warnings, "palm guessed; name it in a hand description if it is wrong"]
    if len(fingers.wrist):
        names = ", ".join(hand.joint_names[joint] for joint in fingers.wrist)
        warnings.append(f"joints that carry the palm, left at zero: {names}; grasps are those of the palm there")
    return replace(
        hand,
        palm_center=_center(hand, fingers, normal),
        palm_normal=normal,
        approach=normal,
        warnings=tuple(warnings),
    )


def default_postures(hand: HandModel, which: tuple[str, ...] = ("open", "closed")) -> HandModel:
    """The hand with those postures guessed that `which` names, to suit its palm, and a warning that they are."""
    fingers = find_fingers(hand)
    ahead = hand.palm_center + _AHEAD * fingers.length * hand.palm_normal
    height = float(((fingers.tips - hand.palm_center) @ hand.palm_normal).mean())
    if height > _AHEAD * fingers.length:
        ahead = hand.palm_center + height * hand.palm_normal
    middle = middle_joints(hand, fingers)
    human = fingers.mates.any()
    apart = _apart(hand, fingers) if human else _own_sides(hand, fingers, hand.palm_normal)
    known = apart.any(1, keepdims=True)
    sides = None if human or not known.all() else apart
    weights = None if sides is None else _balance(sides)
    surface = dense_samples(hand, count=600, seed=3)[:2]
    goal = FingertipGoal(ahead, _CLOSED * fingers.length, middle, sides, weights)
    closed, ball = around_ball(hand, fingers, goal, surface)
    plane = np.eye(3) - np.outer(hand.palm_normal, hand.palm_normal)
    away = placed_tips(hand, fingers, closed) - side_by_side(fingers) - ball
    apart = np.where(known, apart, units(away @ plane, 1e-6))
    slide = float((hand.upper - hand.lower)[hand.slides].max(initial=0.0))
    wide = max(_OPEN * fingers.length, _CLOSED * fingers.length + slide)
    goal = FingertipGoal(ball, wide, closed, apart, weights, ball_fixed=True)
    opened, _ = around_ball(hand, fingers, goal, surface)
    guessed = {f"{name}_posture": posture for name, posture in (("open", opened), ("closed", closed)) if name in which}
    text = f"{' and '.join(which)} posture guessed; name them in a hand description if they are wrong"
    return replace(hand, **guessed, warnings=(*hand.warnings, text))


def _along(hand: HandModel, fingers: Fingers) -> Float[np.ndarray, "3"]:
    """The direction in which a gripper's fingers point at mid-range, square to the line or plane that they stand on."""
    middle = middle_joints(hand, fingers)
    half_way = placed_tips(hand, fingers, middle) - fingers.roots
    along = units(half_way.mean(0), 1e-6)
    if not along.any():
        along = units(fingers.tips.mean(0) - palm_points(hand, fingers).mean(0), 1e-6)
    stands = _first_bends(hand, fingers, middle, along)
    _, sizes, rows = np.linalg.svd(stands - stands.mean(0))
    ground = rows[: len(sizes)][sizes > max(0.3 * sizes[0], 1e-3)]
    upright = along - ground.T @ (ground @ along)
    if np.linalg.norm(upright) > 0.5:
        return units(upright, 0.0)
    return along if along.any() else np.array([0.0, 0.0, 1.0])


def _first_bends(
    hand: HandModel, fingers: Fingers, q: Float[np.ndarray, "joints"], along: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "tips 3"]:
    """Where each finger has the first joint that bends it, at a posture, base frame [m].

    A joint that turns it about the direction `along` does not bend it, and may lie anywhere along its axis.
    """
    rotations, translations = link_poses(hand, q)
    places = fingers.roots.copy()
    for finger, tip in enumerate(fingers.links):
        link = int(tip)
        while hand.link_group[link] != fingers.palm:
            axis = rotations[link] @ hand.joint_axis[link]
            if axis.any() and abs(axis @ along) < _SPREAD:
                places[finger] = translations[link]
            link = int(hand.link_parent[link])
    return places


def _center(hand: HandModel, fingers: Fingers, normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The point of the palm's surface in front of which the fingers meet [m]."""
    surface = palm_points(hand, fingers)
    middle = 0.5 * (surface.min(0) + surface.max(0))
    if fingers.mates.any():
        aside = 0.5 * (middle + fingers.roots.mean(0))
    else:
        aside = _balance(_own_sides(hand, fingers, normal)) @ fingers.roots
    offset = surface - aside
    lateral = np.linalg.norm(offset - np.outer(offset @ normal, normal), axis=1)
    near = lateral <= max(_SPOT, float(lateral.min()) + 0.005)
    return aside + normal * float((offset @ normal)[near].max())


def _balance(directions: Float[np.ndarray, "tips 3"]) -> Float[np.ndarray, "tips"]:
    """Weights with a sum of one that make the directions cancel as far as they can: two against one count as much."""
    from scipy.optimize import nnls

    # A little ridge shares the weight between fingers on the same side.
    system = np.vstack([directions.T, np.ones(len(directions)), 0.01 * np.eye(len(directions))])
    weights, _ = nnls(system, np.concatenate([np.zeros(3), [1.0], np.zeros(len(directions))]))
    return weights / weights.sum()


def _own_sides(hand: HandModel, fingers: Fingers, normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "tips 3"]:
    """The side on which each finger of a gripper stands, in the palm's plane: there it opens, and no farther it closes.

    Zero for a finger alone. Not the side that its tip is found on at some posture: fingers may have room to pass
    through each other.
    """
    middle = middle_joints(hand, fingers)
    plane = np.eye(3) - np.outer(normal, normal)
    by_root, by_tip = (
        (points - points.mean(0)) @ plane for points in (fingers.roots, placed_tips(hand, fingers, middle))
    )
    aside = np.where(np.linalg.norm(by_root, axis=1, keepdims=True) > 1e-3, by_root, by_tip)
    # As far as its joints can take it: of two fingers beside each other, straight away from the third.
    travel = plane @ (point_jacobian(hand, middle, fingers.points, fingers.links) * (middle - hand.lower))
    return units((travel @ (travel.transpose(0, 2, 1) @ aside[:, :, None])).squeeze(-1), 1e-12)


def _apart(hand: HandModel, fingers: Fingers) -> Float[np.ndarray, "tips 3"]:
    """Which way each finger of a human-like hand opens in the palm's plane.

    Fingers that bend together straighten together, square to the row of their knuckles, and the thumb goes the other
    way.
    """
    plane = np.eye(3) - np.outer(hand.palm_normal, hand.palm_normal)
    straight = (fingers.tips - fingers.roots)[fingers.mates].mean(0) @ plane
    if fingers.mates.sum() > 1:
        row = knuckle_row(fingers)
        straight = straight - (straight @ row) * row
    return np.where(fingers.mates[:, None], 1.0, -1.0) * units(straight, 1e-6)
