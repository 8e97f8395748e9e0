"""Where a hand at rest touches the object, and how deep it lies in itself."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.hands.collision_tensors import pair_distance, solid_distance
from graspd_core.hands.kinematics import forward, place_points
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.methods.kernel_problem import kernel_problem
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import Problem, hand_forward
from graspd_core.methods.stages.compiled_stages import nearest_features_compiled, self_overlap_compiled

# Contacts of one link beyond its nearest.
_SPREAD = 2


@dataclass(frozen=True)
class ContactSet:
    """Where a batch of hands touches: some slots for every link, of which only the active ones count.

    Attributes:
        link: link of each slot.
        position: point on the object, object frame [m].
        normal: outward unit normal of the object there.
        distance: signed distance of hand and object there [m].
        active: whether it counts as a contact.
    """

    link: Int[Tensor, "slots"]
    position: Float[Tensor, "batch slots 3"]
    normal: Float[Tensor, "batch slots 3"]
    distance: Float[Tensor, "batch slots"]
    active: Bool[Tensor, "batch slots"]


@torch.no_grad()
def find_contacts(problem: Problem, poses: Poses, reach: float) -> ContactSet:
    """For every link its nearest candidate, the two that spread that contact farthest, and its nearest sharp point.

    Slots within `reach` [m] of the surface are active.
    """
    points = problem.hand.fine
    placed = hand_forward(problem, points, poses.translation, poses.quaternion, poses.joints)
    distance, normal = sample_sdf(problem.object.sdf, placed.points)
    links = torch.unique(points.links)
    members = points.links[None, :] == links[:, None]
    near = members[None] & (distance.abs() <= reach)[:, None]
    rows = torch.arange(len(distance), device=distance.device)[:, None]
    chosen = [torch.where(members[None], distance[:, None], torch.inf).argmin(-1)]
    spread = torch.full_like(near, torch.inf, dtype=distance.dtype)
    for _ in range(_SPREAD):
        away = torch.cdist(placed.points[rows, chosen[-1]], placed.points, compute_mode="donot_use_mm_for_euclid_dist")
        spread = torch.minimum(spread, away)
        chosen.append(torch.where(near, spread, -1.0).argmax(-1))
    slots = torch.stack(chosen, -1).flatten(1)
    gap, n = distance[rows, slots], normal[rows, slots]
    own_link = points.links[slots] == links.repeat_interleave(_SPREAD + 1)
    # A patch that is hardly larger than a point is one contact, not three.
    apart = torch.cat([torch.ones_like(gap[:, :1], dtype=torch.bool).expand(-1, len(links))[..., None]] + [
        (placed.points[rows, c] - placed.points[rows, chosen[0]]).norm(dim=-1)[..., None] > 0.004 for c in chosen[1:]
    ], -1).flatten(1)  # fmt: skip
    found = ContactSet(
        links.repeat_interleave(_SPREAD + 1),
        placed.points[rows, slots] - gap[..., None] * n,
        n,
        gap,
        (gap.abs() <= reach) & own_link & apart,
    )
    return _with_features(problem, poses, found, reach) if len(problem.object.features) else found


def _with_features(problem: Problem, poses: Poses, found: ContactSet, reach: float) -> ContactSet:
    """Add one slot per solid: the object's sharp point nearest to it, with the solid's own normal turned round."""
    pick, nearest, outward = nearest_features(problem, poses)
    return ContactSet(
        torch.cat([found.link, problem.hand.solids.link]),
        torch.cat([found.position, problem.object.features[pick]], 1),
        torch.cat([found.normal, -outward], 1),
        torch.cat([found.distance, nearest], 1),
        torch.cat([found.active, nearest.abs() <= reach], 1),
    )


def nearest_features(
    problem: Problem, poses: Poses
) -> tuple[Int[Tensor, "batch solids"], Float[Tensor, "batch solids"], Float[Tensor, "batch solids 3"]]:
    """Which sharp point is nearest to every solid of the hand, its signed distance [m], and the gradient of that."""
    solids = problem.hand.solids
    compiled = kernel_problem(problem)
    if compiled is not None:
        return nearest_features_compiled(compiled, poses, len(solids.link))
    links, base = forward(problem.hand.kinematics, poses.joints), poses.base
    in_base = base.apply_inverse(problem.object.features)
    nearest, pick = solid_distance(solids, links, in_base).min(1)
    rows = torch.arange(len(pick), device=pick.device)[:, None]
    which = torch.arange(len(solids.link), device=pick.device).expand_as(pick)
    with torch.enable_grad():
        points = in_base[rows, pick].requires_grad_(True)
        (directions,) = torch.autograd.grad(pair_distance(solids, links, points, which).sum(), points)
    return pick, nearest, directions @ base.rotation.transpose(-1, -2)


@torch.no_grad()
def self_overlap(
    problem: Problem, joints: Float[Tensor, "batch joints"], adjacent: Bool[Tensor, "links links"]
) -> Float[Tensor, "batch"]:
    """Greatest depth of a contact candidate inside a solid of a link that is not adjacent to its own [m]."""
    if len(problem.hand.solids.link) == 0:
        return joints.new_zeros(len(joints))
    compiled = kernel_problem(problem)
    if compiled is not None:
        return self_overlap_compiled(compiled, joints, ~adjacent[:, problem.hand.solids.link])
    links = forward(problem.hand.kinematics, joints)
    points = place_points(problem.hand.fine.matrix, links)
    depth = -solid_distance(problem.hand.solids, links, points)
    checked = ~adjacent[problem.hand.fine.links][:, problem.hand.solids.link]
    return torch.where(checked, depth, 0.0).amax((-1, -2)).clamp_min(0.0)
