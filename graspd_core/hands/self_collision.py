"""Which links overlap at a posture, and which pairs of links are never worth checking."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from graspd_core.hands.kinematics import forward, make_kinematics, place_points, placement
from graspd_core.hands.link_distance import depth_inside
from graspd_core.hands.model import HandModel
from graspd_core.hands.surface_points import dense_samples, kept, parent_groups

# Overlap that counts as touching rather than colliding [m].
_TOUCH = 1e-4
# Overlap of links two joints apart that square corners make where the true links are round [m].
_GRAZE = 2e-3
_SAMPLES, _POSTURES = 1200, 24


def link_overlaps(
    hand: HandModel,
    q: Float[np.ndarray, "postures joints"],
    points: Float[np.ndarray, "samples 3"],
    links: Int[np.ndarray, "samples"],
) -> Float[np.ndarray, "postures links links"]:
    """Greatest depth [m] of each link's surface samples (link frames) inside each other link, symmetric, 0 where clear.

    Adjacent pairs are reported like any other: mask with `hand.adjacent`.
    """
    poses = forward(make_kinematics(hand, dtype=torch.float64), torch.as_tensor(q).double())
    owner = torch.as_tensor(links)
    base = place_points(placement(hand.num_links, torch.as_tensor(points).double(), owner), poses)
    depth = np.zeros((len(q), hand.num_links, hand.num_links))
    for link in range(hand.num_links):
        if not hand.primitives_of[link]:
            continue
        local = poses[:, link].apply_inverse(base)
        inside = depth_inside(hand, link, local.flatten(0, 1).numpy()).reshape(local.shape[:-1])
        np.maximum.at(depth[:, link].T, links, inside.T)
    depth[:, range(hand.num_links), range(hand.num_links)] = 0.0
    return np.maximum(depth, depth.transpose(0, 2, 1))


def deepest_overlap(hand: HandModel, q: Float[np.ndarray, "postures joints"]) -> Float[np.ndarray, "postures"]:
    """Greatest depth [m] of a contact candidate inside a link that is not adjacent to its own, hulls included."""
    overlap = link_overlaps(hand, q, hand.candidate_points, hand.candidate_link)
    return np.where(hand.adjacent, 0.0, overlap).max((1, 2))


def adjacent_links(hand: HandModel) -> Bool[np.ndarray, "links links"]:
    """Pairs of links that are never checked against each other, remembered on disk by the hand's content.

    Welded links; links with one joint between them; links with two joints between them that never do more than graze
    (boxes stand for rounded knuckles, whose corners would otherwise block the joint); and pairs that overlap in the
    open posture or in every sampled posture.
    """
    build = lambda: {"adjacent": _adjacent_links(hand)}  # noqa: E731
    return kept(hand, "adjacent", hand.num_links, {"adjacent": (hand.num_links,)}, build)["adjacent"]


def _adjacent_links(hand: HandModel) -> Bool[np.ndarray, "links links"]:
    groups = hand.link_group
    same = groups[:, None] == groups[None, :]
    above = parent_groups(hand)[groups]
    one = above[:, None] == groups[None, :]
    two = np.where(above >= 0, above[np.maximum(above, 0)], -1)[:, None] == groups[None, :]
    points, links, _ = dense_samples(hand, count=_SAMPLES, seed=2)
    rng = np.random.default_rng(0)
    random = rng.uniform(hand.lower, hand.upper, (_POSTURES, hand.num_joints))
    postures = np.stack([hand.open_posture, hand.lower, hand.upper, *random])
    overlap = link_overlaps(hand, postures, points, links)
    grazing = (two | two.T) & (overlap.max(axis=0) < _GRAZE)
    return same | one | one.T | grazing | (overlap[0] > _TOUCH) | (overlap[1:] > _TOUCH).all(axis=0)
