"""Guess the palm, the approach direction and two postures of a hand, if its description gives none.

A finger is a chain of links that ends in a link without children. All fingers branch from the palm. In a human-like
hand most fingers bend the same way. Then the palm normal is the direction in which the fingertips move from straight to
mid-range joints. In a gripper the fingers move against each other. Then the palm normal is along the fingers. A search
finds the postures: fingertips around a small sphere in front of the palm (closed), or a large sphere (open).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.hands.fingers import (
    Fingers,
    find_fingers,
    knuckle_row,
    middle_joints,
    palm_points,
    placed_tips,
    straight_joints,
)
from graspd_core.hands.kinematics import forward, link_poses, make_kinematics, place_points, placement, point_jacobian
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import link_overlaps
from graspd_core.hands.surface_points import dense_samples, units

_STARTS, _TIP_SPREAD, _STEPS, _RATE = 24, 0.4, 100, 0.08
# Weights of the costs in the search: fingertips all on one side of the sphere, joints away from their rest posture,
# sphere away from its wanted place, and overlap of links [1/m].
_BALANCE, _REST, _PLACE, _OVERLAP = 0.3, 0.08, 0.3, 60.0


@dataclass(frozen=True, eq=False)
class FingertipGoal:
    """The goal of the search for a posture: fingertips on an imagined sphere.

    Attributes:
        ball: centre of the sphere, base frame [m].
        radius: radius of the sphere [m].
        rest: joint values near which the search stays [rad] or [m].
        directions: wanted unit vectors from `ball` to each fingertip. None to surround the sphere evenly.
        weights: weight of each fingertip's error, used only with `directions`. They sum to one. None for equal weights.
        ball_fixed: True if the search must not move the sphere.
    """

    ball: Float[np.ndarray, "3"]
    radius: float
    rest: Float[np.ndarray, "joints"]
    directions: Float[np.ndarray, "tips 3"] | None = None
    weights: Float[np.ndarray, "tips"] | None = None
    ball_fixed: bool = False


def around_ball(
    hand: HandModel,
    fingers: Fingers,
    goal: FingertipGoal,
    surface: tuple[Float[np.ndarray, "samples 3"], Int[np.ndarray, "samples"]],
) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "3"]]:
    """Return a posture with fingertips around a sphere and little overlap of links, and the sphere's final centre [m].

    Wrist joints stay straight. `surface` has surface points in link frames [m] and their links, to measure overlap.
    """
    kinematics = make_kinematics(hand, dtype=torch.float64)
    matrix = placement(hand.num_links, torch.as_tensor(fingers.points), torch.as_tensor(fingers.links))
    lower, half = torch.as_tensor(hand.lower), torch.as_tensor(0.5 * (hand.upper - hand.lower))
    origin = torch.as_tensor(goal.ball + side_by_side(fingers))
    home = torch.as_tensor(goal.rest - hand.lower) / half - 1.0
    # A prismatic joint has no preferred rest position.
    turns = torch.as_tensor(~hand.slides).double()
    still = torch.zeros(hand.num_joints, dtype=torch.bool)
    still[fingers.wrist] = True
    wrist = torch.as_tensor(straight_joints(hand))
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(_STARTS, hand.num_joints, generator=generator, dtype=torch.float64) - 0.5
    noise[0] = 0.0
    share = (home + 2.0 * _TIP_SPREAD * noise).clamp(-1.0, 1.0)
    shift = torch.zeros(_STARTS, 3, dtype=torch.float64)
    variables = [share.requires_grad_(True), *([] if goal.ball_fixed else [shift.requires_grad_(True)])]
    optimiser = torch.optim.Adam(variables, lr=_RATE)

    def posture() -> Float[Tensor, "starts joints"]:
        return torch.where(still, wrist, lower + half * (share.clamp(-1.0, 1.0) + 1.0))

    def cost() -> Float[Tensor, "starts"]:
        away = place_points(matrix, forward(kinematics, posture())) - (origin + fingers.length * shift[:, None])
        missed, one_sided = _missed(fingers, goal, away)
        outside = (share.abs() - 1.0).clamp_min(0.0).square().sum(-1)
        bent = _REST * ((share - home) * turns).square().mean(-1)
        return missed + bent + outside + _BALANCE * one_sided + _PLACE * shift.square().sum(-1)

    for _ in range(_STEPS):
        optimiser.zero_grad()
        cost().sum().backward()
        optimiser.step()
    with torch.no_grad():
        final, values = cost(), posture().numpy()
        overlap = np.where(_joined_links(hand), 0.0, link_overlaps(hand, values, *surface)).max(axis=(1, 2))
        best = int((final + _OVERLAP * torch.as_tensor(overlap)).argmin())
        return values[best].copy(), goal.ball + fingers.length * shift[best].numpy()


def _missed(
    fingers: Fingers, goal: FingertipGoal, away: Float[Tensor, "starts tips 3"]
) -> tuple[Float[Tensor, "starts"], Float[Tensor, "starts"]]:
    """Return squared error [finger lengths²] and one-sidedness (0 to 1) of tips at `away` from the sphere's centre."""
    if goal.directions is not None:
        missed = ((away - goal.radius * torch.as_tensor(goal.directions)) / fingers.length).square().sum(-1)
        mean = missed.mean(-1) if goal.weights is None else missed @ torch.as_tensor(goal.weights)
        return mean, away.new_zeros(len(away))
    distance = away.norm(dim=-1).clamp_min(1e-9)
    onto = ((distance - goal.radius) / fingers.length).square().mean(-1)
    outward = away / distance[..., None]
    mates = torch.as_tensor(fingers.mates)
    sides = [side for side in (mates, ~mates) if side.any()]
    return onto, torch.stack([outward[:, side].mean(1) for side in sides]).mean(0).square().sum(-1)


def side_by_side(fingers: Fingers) -> Float[np.ndarray, "tips 3"]:
    """Return for each fingertip a shift of its sphere along the knuckles [m], so that fingers close side by side."""
    aside = np.zeros_like(fingers.roots)
    if fingers.mates.sum() > 1:
        knuckles, row = fingers.roots[fingers.mates], knuckle_row(fingers)
        aside[fingers.mates] = np.outer((knuckles - knuckles.mean(0)) @ row, row)
    return aside


def _joined_links(hand: HandModel) -> Bool[np.ndarray, "links links"]:
    groups = hand.link_group
    above = np.where(hand.link_parent >= 0, groups[np.maximum(hand.link_parent, 0)], -1)[groups]
    return (groups[:, None] == groups) | (above[:, None] == groups) | (groups[:, None] == above)


# In finger lengths: sphere radius of the closed and of the open posture, and distance of the sphere from the palm.
_CLOSED, _OPEN, _AHEAD = 0.16, 0.55, 0.4
# The palm's surface within this distance of the palm axis gives the height of the palm centre [m].
_SPOT = 0.02
# A joint spreads a finger if the cosine between joint axis and finger direction is at least this.
_SPREAD = 0.7


def default_palm(hand: HandModel) -> HandModel:
    """Return the hand with guessed palm centre, palm normal and approach, and with a warning about the guess."""
    fingers = find_fingers(hand)
    normal = fingers.bend if fingers.mates.any() else _along(hand, fingers)
    warnings = [*hand.warnings, "palm guessed; if it is wrong, set it in a hand description"]
    if len(fingers.wrist):
        names = ", ".join(hand.joint_names[joint] for joint in fingers.wrist)
        warnings.append(f"joints between base and palm stay at zero: {names}; grasps are valid for this pose only")
    return replace(
        hand, palm_center=_center(hand, fingers, normal), palm_normal=normal, approach=normal, warnings=tuple(warnings)
    )


def default_postures(hand: HandModel, which: tuple[str, ...] = ("open", "closed")) -> HandModel:
    """Return the hand with a guess for each posture in `which`, and with a warning. The palm must be known."""
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
    text = f"{' and '.join(which)} posture guessed; if it is wrong, set it in a hand description"
    return replace(hand, **guessed, warnings=(*hand.warnings, text))


def _along(hand: HandModel, fingers: Fingers) -> Float[np.ndarray, "3"]:
    """Return a gripper's mean finger direction at mid-range. Make it normal to the row of finger joints if possible."""
    middle = middle_joints(hand, fingers)
    half_way = placed_tips(hand, fingers, middle) - fingers.roots
    along = units(half_way.mean(0), 1e-6)
    if not along.any():
        along = units(fingers.tips.mean(0) - palm_points(hand, fingers).mean(0), 1e-6)
    stands = _first_bends(hand, fingers, middle, along)
    _, sizes, rows = np.linalg.svd(stands - stands.mean(0))
    ground = rows[: len(sizes)][sizes > max(0.3 * sizes[0], 1e-3)]
    upright = along - ground.T @ (ground @ along)
    if np.linalg.norm(upright) > 0.5:  # Over 30° from the plane or line of joints.
        return units(upright)
    return along if along.any() else np.array([0.0, 0.0, 1.0])


def _first_bends(
    hand: HandModel, fingers: Fingers, q: Float[np.ndarray, "joints"], along: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "tips 3"]:
    """Return the position of each finger's first joint whose axis is not parallel to `along`, base frame [m]."""
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
    """Return the point of the palm's surface in front of which the fingers meet, base frame [m]."""
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
    """Return weights with a sum of one, for which the weighted sum of the directions is as short as possible."""
    from scipy.optimize import nnls

    # A small ridge term distributes the weight over fingers on the same side.
    system = np.vstack([directions.T, np.ones(len(directions)), 0.01 * np.eye(len(directions))])
    weights, _ = nnls(system, np.concatenate([np.zeros(3), [1.0], np.zeros(len(directions))]))
    return weights / weights.sum()


def _own_sides(hand: HandModel, fingers: Fingers, normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "tips 3"]:
    """Return the unit direction in the palm plane from the gripper's middle to each finger. Zero for one finger."""
    middle = middle_joints(hand, fingers)
    plane = np.eye(3) - np.outer(normal, normal)
    by_root, by_tip = (
        (points - points.mean(0)) @ plane for points in (fingers.roots, placed_tips(hand, fingers, middle))
    )
    # The roots are preferred, because the tips may cross each other.
    aside = np.where(np.linalg.norm(by_root, axis=1, keepdims=True) > 1e-3, by_root, by_tip)
    # The joints limit the direction. So two fingers side by side move straight away from a third finger.
    travel = plane @ (point_jacobian(hand, middle, fingers.points, fingers.links) * (middle - hand.lower))
    return units((travel @ (travel.transpose(0, 2, 1) @ aside[:, :, None])).squeeze(-1), 1e-12)


def _apart(hand: HandModel, fingers: Fingers) -> Float[np.ndarray, "tips 3"]:
    """Return the unit direction in the palm plane in which each finger of a human-like hand opens.

    Fingers open along their mean root-to-tip direction. The thumb opens in the opposite direction.
    """
    plane = np.eye(3) - np.outer(hand.palm_normal, hand.palm_normal)
    straight = (fingers.tips - fingers.roots)[fingers.mates].mean(0) @ plane
    if fingers.mates.sum() > 1:
        row = knuckle_row(fingers)
        straight = straight - (straight @ row) * row
    return np.where(fingers.mates[:, None], 1.0, -1.0) * units(straight, 1e-6)
