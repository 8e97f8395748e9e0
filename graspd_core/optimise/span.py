"""What of an object a hand closes around, and hands whose jaws only move together."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.geometry.sdf import GridSDF, sample_sdf
from graspd_core.hands.kinematics import link_poses, make_kinematics, point_jacobian, points_in_base
from graspd_core.hands.model import HandModel
from graspd_core.optimise.problem import fingertip_groups
from graspd_core.se3 import transform_points

# The slab of the object that a hand closes around [m].
_SLAB_HALF_BREADTH, _SLAB_DEPTH = 0.05, 0.09
# A vice is a hand in which no joint moves the middle between the fingertips by more than this share of a fingertip.
_VICE = 0.05
# Free space that the jaws of a vice keep at the start [m], and shares of their way at which that is looked at.
_JAW_GAP, _SHARES = 0.006, 12


def half_widths(
    surface: Float[Tensor, "points 3"],
    palm: Float[Tensor, "batch 3"],
    rotation: Float[Tensor, "batch 3 3"],
    hand: HandModel,
) -> Float[Tensor, "batch"]:
    """How far the object reaches from the middle of the palm along the direction in which the fingers close [m].

    Only the slab of the object counts that the fingers close around: a hand's breadth wide, and as deep as they reach.
    """
    along, within = _slab(surface, palm, rotation, hand)
    width = torch.where(within, along.abs(), 0.0).amax(-1)
    # A palm that faces past the object has nothing to close around.
    return torch.where(within.any(-1), width, torch.inf)


def centred(
    surface: Float[Tensor, "points 3"],
    palm: Float[Tensor, "batch 3"],
    rotation: Float[Tensor, "batch 3 3"],
    hand: HandModel,
) -> Float[Tensor, "batch 3"]:
    """Palms moved along the closing direction until what they close around reaches as far to either side [m]."""
    along, within = _slab(surface, palm, rotation, hand)
    high = torch.where(within, along, -torch.inf).amax(-1)
    low = torch.where(within, along, torch.inf).amin(-1)
    middle = torch.where(within.any(-1), 0.5 * (high + low), 0.0)
    return palm + middle[:, None] * (rotation @ torch.as_tensor(closing_axis(hand)))


def _slab(
    surface: Float[Tensor, "points 3"],
    palm: Float[Tensor, "batch 3"],
    rotation: Float[Tensor, "batch 3 3"],
    hand: HandModel,
) -> tuple[Float[Tensor, "batch points"], Bool[Tensor, "batch points"]]:
    """How far surface points lie along the closing direction [m], and which of them the fingers close around."""
    normal = torch.as_tensor(hand.palm_normal)
    closing = torch.as_tensor(closing_axis(hand))
    local = (surface[None] - palm[:, None]) @ rotation
    along, depth = local @ closing, local @ normal
    across = local @ torch.linalg.cross(normal, closing)
    return along, (across.abs() < _SLAB_HALF_BREADTH) & (depth < _SLAB_DEPTH)


def closing_axis(hand: HandModel) -> Float[np.ndarray, "3"]:
    """Unit direction in the palm plane along which the fingertips travel most from open to closed, base frame."""
    travel = (link_poses(hand, hand.closed_posture)[1] - link_poses(hand, hand.open_posture)[1])[_tips(hand)]
    in_plane = travel - np.outer(travel @ hand.palm_normal, hand.palm_normal)
    return np.linalg.svd(in_plane)[2][0]


def is_vice(hand: HandModel) -> bool:
    """Whether the hand closes like a vice: no joint takes the middle between the fingertips along the closing axis.

    So do the jaws of most grippers, and no hand with fingers that move one by one.
    """
    tips = _tips(hand)
    jacobian = point_jacobian(hand, hand.open_posture, np.zeros((len(tips), 3)), tips)
    along = np.einsum("tij,i->tj", jacobian, closing_axis(hand))
    return bool((np.abs(along.mean(0)) <= _VICE * np.abs(along).max(0)).all())


def close_up(
    sdf: GridSDF,
    hand: HandModel,
    rotation: Float[Tensor, "batch 3 3"],
    translation: Float[Tensor, "batch 3"],
    joints: Float[Tensor, "batch joints"],
) -> Float[Tensor, "batch joints"]:
    """Joint values on the way from `joints` to the closed posture at which the moving links still clear the object."""
    kinematics = make_kinematics(hand, dtype=torch.float64)
    moving = hand.link_group[hand.candidate_link] != hand.link_group[0]
    points = torch.as_tensor(hand.candidate_points[moving], dtype=torch.float64)
    links = torch.as_tensor(hand.candidate_link[moving])
    field = sdf.to("cpu", torch.float64)
    closed, best = torch.as_tensor(hand.closed_posture), joints
    clear = torch.ones(len(joints), dtype=torch.bool)
    for share in torch.linspace(0, 1, _SHARES + 1, dtype=torch.float64):
        there = joints + share * (closed - joints)
        placed = transform_points(rotation, translation, points_in_base(kinematics, there, points, links))
        clear = clear & (sample_sdf(field, placed)[0].amin(-1) > _JAW_GAP)
        best = torch.where(clear[:, None], there, best)
    return best


def _tips(hand: HandModel) -> Int[np.ndarray, "tips"]:
    """The last link of every group at the end of a finger."""
    return np.array([int(np.flatnonzero(hand.link_group == group)[-1]) for group in fingertip_groups(hand)])
