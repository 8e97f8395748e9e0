"""A palm, an approach and two postures for a hand whose description names none. A hand description beats them.

Fingers are the chains that end in links which move no others; the palm is the link that all of them hang from. Where
most fingers bend the same way (a human-like hand), the palm faces where they bend to: the linearised sweep of the
fingertips from straight to mid-range. Where fingers bend or slide against each other (a gripper), the palm faces along
them. The postures come from a search: fingertips evenly around a small ball in front of the palm, and around a large
one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.hands.fingers import (
    Fingers,
    find_fingers,
    knuckle_row,
    palm_points,
    placed_tips,
    straight_joints,
    units,
)
from graspd_core.hands.kinematics import forward, make_kinematics, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import link_overlaps
from graspd_core.hands.surface_points import dense_samples

# Radii of the balls that fingertips close and open around, and the ball's distance from the palm, in finger lengths.
_CLOSED, _OPEN, _AHEAD = 0.16, 0.55, 0.4
_STARTS, _SPREAD, _STEPS, _RATE = 24, 0.4, 100, 0.08
# How much the search minds one-sided fingertips, joints away from where they rest, a ball away from its place,
# overlap [1/m].
_BALANCE, _REST, _PLACE, _OVERLAP = 0.3, 0.08, 0.3, 60.0
# Breadth of the palm's surface that its middle is found on [m].
_SPOT = 0.02


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
    middle = 0.5 * (hand.lower + hand.upper)
    closed, ball = _around_ball(hand, fingers, ahead, _CLOSED * fingers.length, middle)
    away = _outward(hand, fingers, placed_tips(hand, fingers, closed) - _side_by_side(fingers) - ball)
    opened, _ = _around_ball(hand, fingers, ball, _OPEN * fingers.length, closed, away)
    guessed = {f"{name}_posture": posture for name, posture in (("open", opened), ("closed", closed)) if name in which}
    text = f"{' and '.join(which)} posture guessed; name them in a hand description if they are wrong"
    return replace(hand, **guessed, warnings=(*hand.warnings, text))


def _along(hand: HandModel, fingers: Fingers) -> Float[np.ndarray, "3"]:
    """The direction in which a gripper's fingers point at mid-range, square to the line or plane that they stand on."""
    half_way = placed_tips(hand, fingers, 0.5 * (hand.lower + hand.upper)) - fingers.roots
    along = units(half_way.mean(0), 1e-6)
    if not along.any():
        along = units(fingers.tips.mean(0) - palm_points(hand, fingers).mean(0), 1e-6)
    _, sizes, rows = np.linalg.svd(fingers.roots - fingers.roots.mean(0))
    ground = rows[: len(sizes)][sizes > max(0.3 * sizes[0], 1e-3)]
    upright = along - ground.T @ (ground @ along)
    if np.linalg.norm(upright) > 0.5:
        return units(upright, 0.0)
    return along if along.any() else np.array([0.0, 0.0, 1.0])


def _center(hand: HandModel, fingers: Fingers, normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The point of the palm's surface in front of which the fingers meet [m]."""
    surface = palm_points(hand, fingers)
    middle = 0.5 * (surface.min(0) + surface.max(0))
    roots = fingers.roots.mean(0)
    aside = 0.5 * (middle + roots) if fingers.mates.any() else roots
    offset = surface - aside
    lateral = np.linalg.norm(offset - np.outer(offset @ normal, normal), axis=1)
    near = lateral <= max(_SPOT, float(lateral.min()) + 0.005)
    return aside + normal * float((offset @ normal)[near].max())


def _around_ball(
    hand: HandModel,
    fingers: Fingers,
    ball: Float[np.ndarray, "3"],
    radius: float,
    rest: Float[np.ndarray, "joints"],
    directions: Float[np.ndarray, "tips 3"] | None = None,
) -> tuple[Float[np.ndarray, "joints"], Float[np.ndarray, "3"]]:
    """The posture that puts the fingertips around a ball, evenly and without overlap, and where the ball came to be.

    Joints stay near `rest` where they can, wrist joints stay put. The ball may move, unless the `directions` are given
    in which each fingertip has to lie from it.
    """
    kinematics = make_kinematics(hand, dtype=torch.float64)
    matrix = placement(hand.num_links, torch.as_tensor(fingers.points), torch.as_tensor(fingers.links))
    lower, half = torch.as_tensor(hand.lower), torch.as_tensor(0.5 * (hand.upper - hand.lower))
    origin = torch.as_tensor(ball + _side_by_side(fingers))
    mates = torch.as_tensor(fingers.mates)
    sides = [side for side in (mates, ~mates) if side.any()]
    home = torch.as_tensor(rest - hand.lower) / half - 1.0
    still = torch.zeros(hand.num_joints, dtype=torch.bool)
    still[fingers.wrist] = True
    wrist = torch.as_tensor(straight_joints(hand))
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(_STARTS, hand.num_joints, generator=generator, dtype=torch.float64) - 0.5
    noise[0] = 0.0
    share = (home + 2.0 * _SPREAD * noise).clamp(-1.0, 1.0)
    shift = torch.zeros(_STARTS, 3, dtype=torch.float64)
    variables = [share.requires_grad_(True), *([shift.requires_grad_(True)] if directions is None else [])]
    optimiser = torch.optim.Adam(variables, lr=_RATE)

    def posture() -> Float[Tensor, "starts joints"]:
        return torch.where(still, wrist, lower + half * (share.clamp(-1.0, 1.0) + 1.0))

    def cost() -> Float[Tensor, "starts"]:
        away = place_points(matrix, forward(kinematics, posture())) - (origin + fingers.length * shift[:, None])
        outside = (share.abs() - 1.0).clamp_min(0.0).square().sum(-1)
        bent = _REST * (share - home).square().mean(-1)
        if directions is not None:
            missed = (away - radius * torch.as_tensor(directions)) / fingers.length
            return missed.square().sum(-1).mean(-1) + bent + outside
        distance = away.norm(dim=-1).clamp_min(1e-9)
        onto = ((distance - radius) / fingers.length).square().mean(-1)
        outward = away / distance[..., None]
        one_sided = torch.stack([outward[:, side].mean(1) for side in sides]).mean(0).square().sum(-1)
        return onto + bent + outside + _BALANCE * one_sided + _PLACE * shift.square().sum(-1)

    for _ in range(_STEPS):
        optimiser.zero_grad()
        cost().sum().backward()
        optimiser.step()
    with torch.no_grad():
        final, values = cost(), posture().numpy()
        best = int((final + _OVERLAP * torch.as_tensor(_worst_overlap(hand, values))).argmin())
        return values[best].copy(), ball + fingers.length * shift[best].numpy()


def _outward(hand: HandModel, fingers: Fingers, away: Float[np.ndarray, "tips 3"]) -> Float[np.ndarray, "tips 3"]:
    """Which way each finger opens in the palm's plane, given where its tip lies from the ball.

    Fingers that bend together straighten together, square to the row of their knuckles, and the thumb goes the other
    way; a gripper's fingers go apart, each to the side that it stands on.
    """
    plane = np.eye(3) - np.outer(hand.palm_normal, hand.palm_normal)
    if not fingers.mates.any():
        # Not to the side that its tip was found on: fingers may have room to pass through each other.
        aside = units((fingers.roots - fingers.roots.mean(0)) @ plane, 1e-3)
        return np.where(aside.any(1, keepdims=True), aside, units(away @ plane, 1e-6))
    straight = (fingers.tips - fingers.roots)[fingers.mates].mean(0) @ plane
    if fingers.mates.sum() > 1:
        row = knuckle_row(fingers)
        straight = straight - (straight @ row) * row
    return np.where(fingers.mates[:, None], 1.0, -1.0) * units(straight, 1e-6)


def _side_by_side(fingers: Fingers) -> Float[np.ndarray, "tips 3"]:
    """Where each fingertip's ball lies from the middle one [m]: fingers side by side close side by side."""
    aside = np.zeros_like(fingers.roots)
    if fingers.mates.sum() > 1:
        knuckles, row = fingers.roots[fingers.mates], knuckle_row(fingers)
        aside[fingers.mates] = np.outer((knuckles - knuckles.mean(0)) @ row, row)
    return aside


def _worst_overlap(hand: HandModel, q: Float[np.ndarray, "postures joints"]) -> Float[np.ndarray, "postures"]:
    """Deepest overlap [m] of links that are neither welded nor joined."""
    groups = hand.link_group
    above = np.where(hand.link_parent >= 0, groups[np.maximum(hand.link_parent, 0)], -1)[groups]
    joined = (groups[:, None] == groups) | (above[:, None] == groups) | (groups[:, None] == above)
    points, links, _ = dense_samples(hand, count=600, seed=3)
    return np.where(joined, 0.0, link_overlaps(hand, q, points, links)).max(axis=(1, 2))
