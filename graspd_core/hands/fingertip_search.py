"""A search for the posture that puts the fingertips around a ball: how hands without a description open and close."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.hands.fingers import Fingers, knuckle_row, straight_joints
from graspd_core.hands.kinematics import forward, make_kinematics, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import link_overlaps

_STARTS, _SPREAD, _STEPS, _RATE = 24, 0.4, 100, 0.08
# How much the search minds one-sided fingertips, joints away from where they rest, a ball away from its place,
# overlap [1/m].
_BALANCE, _REST, _PLACE, _OVERLAP = 0.3, 0.08, 0.3, 60.0


@dataclass(frozen=True, eq=False)
class FingertipGoal:
    """What the search looks for.

    Attributes:
        ball: middle of the ball, base frame [m].
        radius: of the ball [m].
        rest: the posture that joints stay near where they can [rad] or [m].
        directions: unit, from the ball to each fingertip; None for any that are evenly around it.
        weights: how much each fingertip's miss counts where directions are given, with a sum of one; None for evenly.
        ball_fixed: whether the ball has to stay where it is.
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
    """The posture that puts the fingertips around a ball without overlap of links, and where the ball came to be.

    Wrist joints stay put. Overlap is found by the points of `surface`, in link frames, and their links.
    """
    kinematics = make_kinematics(hand, dtype=torch.float64)
    matrix = placement(hand.num_links, torch.as_tensor(fingers.points), torch.as_tensor(fingers.links))
    lower, half = torch.as_tensor(hand.lower), torch.as_tensor(0.5 * (hand.upper - hand.lower))
    origin = torch.as_tensor(goal.ball + side_by_side(fingers))
    home = torch.as_tensor(goal.rest - hand.lower) / half - 1.0
    # A jaw that slides is as much at rest in one place as in another.
    turns = torch.as_tensor(~hand.slides).double()
    still = torch.zeros(hand.num_joints, dtype=torch.bool)
    still[fingers.wrist] = True
    wrist = torch.as_tensor(straight_joints(hand))
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(_STARTS, hand.num_joints, generator=generator, dtype=torch.float64) - 0.5
    noise[0] = 0.0
    share = (home + 2.0 * _SPREAD * noise).clamp(-1.0, 1.0)
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
        best = int((final + _OVERLAP * torch.as_tensor(_worst_overlap(hand, values, *surface))).argmin())
        return values[best].copy(), goal.ball + fingers.length * shift[best].numpy()


def _missed(
    fingers: Fingers, goal: FingertipGoal, away: Float[Tensor, "starts tips 3"]
) -> tuple[Float[Tensor, "starts"], Float[Tensor, "starts"]]:
    """By how much the fingertips miss their places, and how one-sided they lie; `away` are their places from the ball.

    In finger lengths and squared; fingertips whose directions are given lie as one-sided as these.
    """
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
    """Where each fingertip's ball lies from the middle one [m]: fingers side by side close side by side."""
    aside = np.zeros_like(fingers.roots)
    if fingers.mates.sum() > 1:
        knuckles, row = fingers.roots[fingers.mates], knuckle_row(fingers)
        aside[fingers.mates] = np.outer((knuckles - knuckles.mean(0)) @ row, row)
    return aside


def _worst_overlap(
    hand: HandModel,
    q: Float[np.ndarray, "postures joints"],
    points: Float[np.ndarray, "samples 3"],
    links: Int[np.ndarray, "samples"],
) -> Float[np.ndarray, "postures"]:
    """Deepest overlap [m] of links that are neither welded nor joined."""
    groups = hand.link_group
    above = np.where(hand.link_parent >= 0, groups[np.maximum(hand.link_parent, 0)], -1)[groups]
    joined = (groups[:, None] == groups) | (above[:, None] == groups) | (groups[:, None] == above)
    return np.where(joined, 0.0, link_overlaps(hand, q, points, links)).max(axis=(1, 2))
