"""Fill links with spheres for a differentiable self-collision term, and measure overlaps of links and primitives.

The spheres extend beyond the flat faces of long boxes by up to a tenth of the thickness, and beyond very thin shapes.
Metrics use signed distances instead. The term tests every pair of spheres, so the number of spheres is limited. If a
hand has too many, the spheres that extend farthest beyond the others are kept.

The overlap of two primitives is found by the separating axis test. A separating axis of two boxes is a face normal or
a cross product of two edges. Two boxes have fifteen such directions, and the least overlap along them is the exact
depth. Round primitives need three more directions. If an edge meets a rim, the depth is slightly too large. A hull
counts as the box inside it. Gradients are exact if a single direction has the least overlap.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.hands.kinematics import forward, in_base, link_poses, make_kinematics, place_points, placement
from graspd_core.hands.link_distance import CollisionTensors, depth_inside
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.surface_points import dense_samples, kept, parent_groups
from graspd_core.se3 import SE3

# Greatest number of spheres of a rigid group, and of a hand. If a hand has more groups, each has one sphere.
MOST_OF_GROUP, MOST_OF_HAND = 64, 160
# Least radius of the spheres in a box, except in a smaller box. Least step along capsules and cylinders [m].
_FINEST = 0.003
# A dropped sphere may extend beyond the kept spheres by `_BARE` [m]. A cylinder is filled like a box if its radius
# exceeds its half length by more than `_RIM` [m].
_BARE, _RIM = 0.001, 0.01


@lru_cache(maxsize=8)
def collision_spheres(
    hand: HandModel,
) -> tuple[Float[np.ndarray, "spheres 3"], Float[np.ndarray, "spheres"], Int[np.ndarray, "spheres"]]:
    """Return centres in link frames [m], radii [m] and links of at most `MOST_OF_HAND` spheres that fill the links."""
    filled = [(*_fill(solid), solid) for solid in hand.primitives]
    center = np.concatenate([at @ solid.rotation.T + solid.translation for at, _, solid in filled])
    counts = [len(at) for at, _, _ in filled]
    radius = np.repeat([radius for _, radius, _ in filled], counts)
    link = np.repeat([solid.link for _, _, solid in filled], counts)
    groups = hand.link_group[link]
    if len(link) > MOST_OF_HAND or np.bincount(groups).max() > MOST_OF_GROUP:
        kept = _spread(in_base(link_poses(hand, hand.open_posture), center, link), radius, groups)
        return center[kept], radius[kept], link[kept]
    return center, radius, link


def _spread(
    centers: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, "n"], groups: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "kept"]:
    """Choose the largest sphere of each group, then repeatedly the sphere that extends farthest beyond the chosen ones.

    This is farthest-point sampling (Gonzalez 1985).
    """
    # A value above 1e3 m marks a sphere whose group has no chosen sphere yet.
    bare = 1e3 + radii
    chosen: list[int] = []
    while bare.max() > _BARE and (len(chosen) < MOST_OF_HAND or bare.max() > 1e3):
        last = int(bare.argmax())
        chosen.append(last)
        mates = np.flatnonzero(groups == groups[last])
        away = np.linalg.norm(centers[mates] - centers[last], axis=1)
        bare[mates] = np.minimum(bare[mates], away + radii[mates] - radii[last])
        if (groups[chosen] == groups[last]).sum() == MOST_OF_GROUP:
            bare[mates] = 0.0
    return np.sort(chosen)


def _fill(primitive: Primitive) -> tuple[Float[np.ndarray, "spheres 3"], float]:
    """Fill a primitive with spheres. Return the centres in the primitive's frame [m] and the common radius [m]."""
    size = primitive.size
    if primitive.kind == "sphere":
        return np.zeros((1, 3)), size[0]
    if primitive.kind == "box":
        return _fill_box(np.asarray(size))
    if primitive.kind == "hull":
        low, high = primitive.vertices.min(0), primitive.vertices.max(0)
        centers, radius = _fill_box(0.5 * (high - low))
        return centers + 0.5 * (low + high), 0.9 * radius
    radius, half = size
    if primitive.kind == "cylinder" and radius > half + _RIM:
        centers, ball = _fill_box(np.array([radius, radius, half]))
        return centers[np.linalg.norm(centers[:, :2], axis=1) <= radius], ball
    reach = half if primitive.kind == "capsule" else half - radius
    if reach <= 0:
        return np.zeros((1, 3)), min(radius, half) if primitive.kind == "cylinder" else radius
    heights = _row(reach, max(radius, _FINEST, reach / 32))
    return np.column_stack([np.zeros((len(heights), 2)), heights]), radius


def _fill_box(half: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "spheres 3"], float]:
    small, middle, large = np.sort(half)
    radius = float(max(min(0.5 * (small + middle), 1.2 * small), min(_FINEST, large)))
    step, rows = radius, [_row(extent - radius, radius) for extent in half]
    while np.prod([len(row) for row in rows]) > MOST_OF_GROUP:
        step *= 1.1
        rows = [_row(extent - radius, step) for extent in half]
    return np.stack(np.meshgrid(*rows, indexing="ij"), -1).reshape(-1, 3), radius


def _row(reach: float, step: float) -> Float[np.ndarray, "n"]:
    if reach < 0.2 * step:
        return np.zeros(1)
    return np.linspace(-reach, reach, int(np.ceil(2 * reach / (1.2 * step))) + 1)


# Overlap up to this counts as touching, not as collision [m].
_TOUCH = 1e-4
# Links two joints apart may overlap up to this [m], because boxes have corners where the true links are round.
_GRAZE = 2e-3
# Links two joints apart that overlap in at least this fraction of random postures overlap in their model only: the hull
# of a hollow palm is not hollow. Of 16 hands, three have such pairs (0.54 to 0.85). All other pairs have at most 0.35.
_OFTEN = 0.5
_SAMPLES, _POSTURES = 1200, 24


def link_overlaps(
    hand: HandModel,
    q: Float[np.ndarray, "postures joints"],
    points: Float[np.ndarray, "samples 3"],
    links: Int[np.ndarray, "samples"],
) -> Float[np.ndarray, "postures links links"]:
    """Return the overlap depth [m] of each pair of links: how deep surface samples of one link lie in the other.

    `points` are surface samples in link frames [m]. Adjacent pairs are included. Mask them with `hand.adjacent`.
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
    """Return the greatest depth [m] of a contact candidate inside a link not adjacent to the candidate's link."""
    overlap = link_overlaps(hand, q, hand.candidate_points, hand.candidate_link)
    return np.where(hand.adjacent, 0.0, overlap).max((1, 2))


def adjacent_links(hand: HandModel) -> Bool[np.ndarray, "links links"]:
    """Return the pairs of links that are never checked for collision. The result is cached on disk by hand content.

    Links are adjacent if they are in one rigid group or one joint apart, or overlap in the open posture or in every
    sampled posture. Links two joints apart are also adjacent if they never overlap by much or overlap in most postures.
    """
    shapes = {"adjacent": (hand.num_links,)}
    return kept(hand, "adjacent", hand.num_links, shapes, lambda: (_adjacent_links(hand),))["adjacent"]


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
    touching = overlap > _TOUCH
    false = (two | two.T) & ((overlap.max(axis=0) < _GRAZE) | (touching[1:].mean(axis=0) >= _OFTEN))
    return same | one | one.T | false | touching[0] | touching[1:].all(axis=0)


# Least length of a cross product of unit edges, and of the directions added for round primitives [m].
_PARALLEL, _SHORTEST = 1e-3, 1e-6
# Prefer face directions: the depth along any other direction is increased by this [m]. This avoids rounding effects.
_RATHER_FACES = 1e-6


def solid_pairs(hand: HandModel) -> Int[np.ndarray, "pairs 2"]:
    """Return the index pairs of primitives whose links are not adjacent."""
    link = np.array([p.link for p in hand.primitives], dtype=np.int64)
    return np.argwhere(np.triu(~hand.adjacent[np.ix_(link, link)], 1))


def solid_overlaps(
    solids: CollisionTensors, pairs: Int[Tensor, "pairs 2"], links: SE3
) -> tuple[Int[Tensor, "overlaps"], Float[Tensor, "overlaps"]]:
    """Return the batch row and the depth [m] of every overlapping pair. The depth is differentiable."""
    placed = links[:, solids.link].compose(SE3(solids.rotation, solids.translation))
    apart = placed.translation[:, pairs[:, 0]] - placed.translation[:, pairs[:, 1]]
    reach = (solids.core.norm(dim=-1) + solids.radius)[pairs].sum(-1)
    row, pair = ((apart * apart).sum(-1) < reach * reach).nonzero(as_tuple=True)
    sides, apart = pairs[pair].unbind(-1), apart[row, pair]
    axes = [placed.rotation[row, side].transpose(-1, -2) for side in sides]
    edges = torch.linalg.cross(axes[0][:, :, None], axes[1][:, None, :]).flatten(1, 2)
    across = [apart - (apart * of[:, 2]).sum(-1, keepdim=True) * of[:, 2] for of in axes]
    directions = torch.cat([*axes, edges, torch.stack([apart, *across], 1)], 1)
    swept = [(solids.is_round[side] > 0) | (solids.core[side, 0] == 0) for side in sides]
    length = (directions * directions).sum(-1).clamp_min(1e-24).sqrt()
    usable = length > torch.cat([length.new_full((15,), _PARALLEL), length.new_full((3,), _SHORTEST)])
    usable[:, 15:] &= (swept[0] | swept[1])[:, None]
    directions = directions / length[..., None]
    widths = sum(_width(solids, side, directions @ of.transpose(-1, -2)) for side, of in zip(sides, axes, strict=True))
    depth = torch.where(usable, widths - (directions * apart[:, None]).sum(-1).abs(), torch.inf)
    rated = depth.detach() + _RATHER_FACES * (torch.arange(18, device=depth.device) >= 6)
    least = depth.gather(1, rated.argmin(-1, keepdim=True))[:, 0]
    return row[least > 0], least[least > 0]


def _width(
    solids: CollisionTensors, which: Int[Tensor, "n"], local: Float[Tensor, "n directions 3"]
) -> Float[Tensor, "n directions"]:
    """Return half the extent of each primitive [m] along directions given in the primitive's frame."""
    core, round_one = solids.core[which][:, None], solids.is_round[which][:, None] > 0
    x, y, z = local.abs().unbind(-1)
    radial = (x * x + y * y).clamp_min(1e-24).sqrt()
    flat = torch.where(round_one, core[..., 0] * radial, core[..., 0] * x + core[..., 1] * y)
    return flat + core[..., 2] * z + solids.radius[which][:, None]
