"""Hand and object laid out as tensors on one device and dtype: what every evaluation of a problem reads."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.config import ProblemConfig
from graspd_core.hands.collision_spheres import collision_spheres
from graspd_core.hands.collision_tensors import CollisionTensors, make_collision_tensors
from graspd_core.hands.kinematics import Kinematics, in_base, link_poses, make_kinematics, placement
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import GridSDF
from graspd_core.mesh.sharp_features import THIN_WALLED, neighbours_together
from graspd_core.scene.scene import Scene, object_sharp_points

# How far a group of links is drawn to the surface [m]: the ends of fingers from afar, the rest to finish a contact.
_REACH_OF_TIPS = 0.1
_REACH_OF_OTHERS = 0.004
# The same of patches of a hand that is to touch with all of itself [m].
_REACH_OF_PATCHES = 0.03
# A base frame this near to the middle of the palm lies in the palm [m].
_PALM_RADIUS = 0.05


@dataclass(frozen=True)
class PointSet:
    """Contact candidates of a hand.

    Attributes:
        matrix: places them by their links' poses, see `hands.kinematics.placement`.
        links: link of each.
        groups: candidates of each rigid group of links, or of each patch of one, padded by repetition.
    """

    matrix: Float[Tensor, "points columns"]
    links: Int[Tensor, "points"]
    groups: Int[Tensor, "groups members"]


@dataclass(frozen=True)
class SphereTensors:
    """Spheres that fill the hand's links, for self-collision.

    Attributes:
        matrix: places their centres by their links' poses, see `hands.kinematics.placement`.
        radii: [m].
        weight: 1 / 2R of the checked pairs with R the sum of their radii, zero elsewhere [1/m].
    """

    matrix: Float[Tensor, "spheres columns"]
    radii: Float[Tensor, "spheres"]
    weight: Float[Tensor, "spheres spheres"]


@dataclass(frozen=True, eq=False)
class HandTensors:
    """A hand.

    Attributes:
        model: the hand that is laid out.
        kinematics: forward kinematics.
        coarse: the first, evenly spread contact candidates; what most steps look at.
        fine: all contact candidates; what the last steps look at.
        reach: attraction range of each group of candidates [m].
        solids: collision primitives.
        group_of_solid: index of the group of each solid's links, the first where they have several; one past the last
            where they have no coarse candidate.
        spheres: for self-collision.
        lower: joint limits [rad] or [m].
        upper: joint limits [rad] or [m].
        pivot: the point that a solver turns the hand about, base frame [m].
        joint_scale: travel of each joint that counts as much as one radian, one where it turns [rad] or [m].
    """

    model: HandModel
    kinematics: Kinematics
    coarse: PointSet
    fine: PointSet
    reach: Float[Tensor, "groups"]
    solids: CollisionTensors
    group_of_solid: Int[Tensor, "solids"]
    spheres: SphereTensors
    lower: Float[Tensor, "joints"]
    upper: Float[Tensor, "joints"]
    pivot: Float[Tensor, "3"]
    joint_scale: Float[Tensor, "joints"]


@dataclass(frozen=True, eq=False)
class ObjectTensors:
    """An object.

    Attributes:
        sdf: signed distance field.
        features: sharp points of its surface, which candidates would not notice sinking in [m].
        coarse_features: how many of them, from the first, the coarse steps look at too: none, but on thin walls, which
            a finger could otherwise step through.
        center: centre of mass [m].
        length: characteristic length of torques [m].
        confidence: in the surface near each node of `sdf`, raised to a floor; None: all of it is known.
    """

    sdf: GridSDF
    features: Float[Tensor, "features 3"]
    coarse_features: int
    center: Float[Tensor, "3"]
    length: float
    confidence: Float[Tensor, "x y z"] | None


@lru_cache(maxsize=8)
def make_hand_tensors(
    hand: HandModel, candidates: int, patch_size: int, device: str, dtype: torch.dtype
) -> HandTensors:
    """Lay a hand out; the coarse set is the first `candidates` of the contact candidates that it was loaded with.

    They are grouped by rigid groups of links, or into patches of so many of them. Kept for the last few hands, which
    are hashed by identity.
    """

    def tensor(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, device=device, dtype=dtype)

    def index(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, device=device, dtype=torch.long)

    kinematics, of_link = make_kinematics(hand, device, dtype), hand.link_group[hand.candidate_link]
    groups = _patches(hand, candidates, patch_size) if patch_size else of_link
    present, first = np.unique(groups[:candidates], return_index=True)
    reach = np.where(np.isin(of_link[first], hand.fingertip_groups), _REACH_OF_TIPS, _REACH_OF_OTHERS)

    def point_set(count: int) -> PointSet:
        links = hand.candidate_link[:count]
        points = tensor(hand.candidate_points[:count])
        members = _members(groups[:count], present)
        return PointSet(placement(hand.num_links, points, index(links)), index(links), index(members))

    solids = make_collision_tensors(hand, device, dtype)
    same = hand.link_group[solids.link.cpu().numpy()][:, None] == of_link[first]
    place = np.where(same.any(1), same.argmax(1), len(present))
    return HandTensors(
        model=hand,
        kinematics=kinematics,
        coarse=point_set(candidates),
        fine=point_set(len(hand.candidate_link)),
        reach=tensor(np.full(len(present), _REACH_OF_PATCHES) if patch_size else reach),
        solids=solids,
        group_of_solid=index(place),
        spheres=_sphere_tensors(hand, device, dtype),
        lower=tensor(hand.lower),
        upper=tensor(hand.upper),
        pivot=tensor(_pivot(hand)),
        joint_scale=tensor(hand.joint_scale),
    )


def _sphere_tensors(hand: HandModel, device: str, dtype: torch.dtype) -> SphereTensors:
    centers, radii, links = collision_spheres(hand)
    checked = ~hand.adjacent[np.ix_(links, links)]
    weight = np.triu(checked, 1) * 0.5 / (radii[:, None] + radii[None, :])
    points, radius, pairs = (torch.as_tensor(x, device=device, dtype=dtype) for x in (centers, radii, weight))
    at = torch.as_tensor(links, device=device, dtype=torch.long)
    return SphereTensors(placement(hand.num_links, points, at), radius, pairs)


@lru_cache(maxsize=4)
def make_object_tensors(scene: Scene, settings: ProblemConfig, device: str, dtype: torch.dtype) -> ObjectTensors:
    """Lay the scene's object out; kept for the last few scenes, which are hashed by identity."""
    sharp, thin_share = object_sharp_points(scene.object, 2 * settings.features)
    thin = thin_share > THIN_WALLED
    floor, confidence = settings.confidence_floor, None
    if scene.confidence is not None:
        confidence = floor + (1 - floor) * scene.confidence.to(device, dtype)
    sdf = scene.sdf.to(device, dtype)
    if settings.softness:
        sharp, thin = sharp[:0], False
        sdf = replace(sdf, field=torch.cat([sdf.field[:1] + settings.softness, sdf.field[1:]]))
    # They were chosen one by one, each the farthest from all before: the first half is spread as well.
    coarse = max(settings.features, len(sharp) // 2) if thin else 0
    features = [part[neighbours_together(part)] for part in (sharp[:coarse], sharp[coarse:])]
    return ObjectTensors(
        sdf=sdf,
        features=torch.as_tensor(
            np.concatenate(features) if thin else sharp[: settings.features], device=device, dtype=dtype
        ),
        coarse_features=coarse,
        center=torch.as_tensor(scene.object.center_of_mass, device=device, dtype=dtype),
        length=scene.object.radius,
        confidence=confidence,
    )


def _pivot(hand: HandModel) -> Float[np.ndarray, "3"]:
    """The middle of the palm, or the base frame's origin where that lies in the palm [m]."""
    far = np.linalg.norm(hand.palm_center) > _PALM_RADIUS
    return hand.palm_center if far else np.zeros(3)


def _patches(hand: HandModel, candidates: int, size: int) -> Int[np.ndarray, "points"]:
    """Which patch each contact candidate belongs to: the nearest of its links', each around a coarse candidate.

    The coarse candidates of a rigid group of links have one patch for `size` of them, the centres far from each other.
    """
    posture = link_poses(hand, (hand.lower + hand.upper) / 2)
    points = in_base(posture, hand.candidate_points, hand.candidate_link)
    of_link, patch, count = hand.link_group[hand.candidate_link], np.zeros(len(points), dtype=int), 0
    for group in np.unique(of_link[:candidates]):
        members = np.flatnonzero(of_link == group)
        coarse = members[members < candidates]
        # Rounded, so that which of two equal ones is nearer does not depend on where the base frame is.
        gaps = np.linalg.norm(points[members][:, None] - points[coarse], axis=-1).round(6)
        centres = [0]
        while len(centres) < round(len(coarse) / size):
            centres.append(int(gaps[np.searchsorted(members, coarse)][:, centres].min(1).argmax()))
        patch[members] = count + gaps[:, centres].argmin(1)
        count += len(centres)
    patch[~np.isin(of_link, of_link[:candidates])] = -1
    return patch


def _members(group_of: Int[np.ndarray, "n"], present: Int[np.ndarray, "groups"]) -> Int[np.ndarray, "groups width"]:
    """Indices that belong to each group, rows padded by repetition; a group without any repeats the first index."""
    members = [np.flatnonzero(group_of == group) for group in present]
    width = max(map(len, members))
    return np.stack([np.resize(m if len(m) else [0], width) for m in members])
