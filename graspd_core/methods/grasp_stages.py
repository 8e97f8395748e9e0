"""From an optimised pose to three postures: open and clear, just touching, and pressing with balanced forces.

The object is free while the hand closes, so the three are made together: every link that will touch starts clear of
the object and arrives at the end of the closing stage, and the squeeze presses with forces that cancel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.config import GraspStagesConfig
from graspd_core.hands.collision_tensors import pair_distance, solid_distance
from graspd_core.hands.kinematics import forward, place_points
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.methods import losses
from graspd_core.methods.obstacle_distance import RETREAT, RETREAT_SHARES, ObstacleTensors, obstacle_gaps
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import OBSTACLE_MARGIN, HandPlacement, Problem, hand_forward
from graspd_core.se3 import SE3, rotation_from_quaternion

_CONE_EDGES = 8
# Weight of an even spread of the load against balance.
_RIDGE = 0.5
# Contacts of one link beyond its nearest.
_SPREAD = 2
# Shares of the way from pregrasp to grasp that are kept clear.
_WAY = (0.0, 0.4, 0.8)


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
        away = (placed.points[:, None] - placed.points[rows, chosen[-1]][:, :, None]).norm(dim=-1)
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
    return _with_features(problem, placed, found, reach) if len(problem.object.features) else found


def _with_features(problem: Problem, placed: HandPlacement, found: ContactSet, reach: float) -> ContactSet:
    """Add one slot per solid: the object's sharp point nearest to it, with the solid's own normal turned round."""
    in_base = placed.base.apply_inverse(problem.object.features)
    nearest, pick = solid_distance(problem.hand.solids, placed.links, in_base).min(1)
    rows = torch.arange(len(pick), device=pick.device)[:, None]
    solids = torch.arange(len(problem.hand.solids.link), device=pick.device).expand_as(pick)
    with torch.enable_grad():
        points = in_base[rows, pick].requires_grad_(True)
        (directions,) = torch.autograd.grad(
            pair_distance(problem.hand.solids, placed.links, points, solids).sum(), points
        )
    outward = directions @ placed.base.rotation.transpose(-1, -2)
    return ContactSet(
        torch.cat([found.link, problem.hand.solids.link]),
        torch.cat([found.position, problem.object.features[pick]], 1),
        torch.cat([found.normal, -outward], 1),
        torch.cat([found.distance, nearest], 1),
        torch.cat([found.active, nearest.abs() <= reach], 1),
    )


@torch.no_grad()
def self_overlap(
    problem: Problem, joints: Float[Tensor, "batch joints"], adjacent: Bool[Tensor, "links links"]
) -> Float[Tensor, "batch"]:
    """Greatest depth of a contact candidate inside a solid of a link that is not adjacent to its own [m]."""
    if len(problem.hand.solids.link) == 0:
        return joints.new_zeros(len(joints))
    links = forward(problem.hand.kinematics, joints)
    points = place_points(problem.hand.fine.matrix, links)
    depth = -solid_distance(problem.hand.solids, links, points)
    checked = ~adjacent[problem.hand.fine.links][:, problem.hand.solids.link]
    return torch.where(checked, depth, 0.0).amax((-1, -2)).clamp_min(0.0)


@dataclass(frozen=True)
class Squeeze:
    """Balanced contact forces and the joint targets that make them.

    Attributes:
        joints: position targets [rad] or [m].
        forces: on the object, one per link [N].
        imbalance: norm of the net wrench over the sum of forces; one where there is no balance to be had.
    """

    joints: Float[Tensor, "batch joints"]
    forces: Float[Tensor, "batch slots 3"]
    imbalance: Float[Tensor, "batch"]


def squeeze(
    problem: Problem, poses: Poses, contact_set: ContactSet, effort: Float[Tensor, "joints"], config: GraspStagesConfig
) -> Squeeze:
    """Forces in the friction cones with zero net wrench (non-negative least squares), as joint offsets JᵀF / kp."""
    unit_forces, imbalance = balanced_forces(
        (contact_set.position - problem.object.center).double().cpu().numpy(),
        contact_set.normal.double().cpu().numpy(),
        contact_set.active.cpu().numpy(),
        problem.object.length,
        problem.friction,
    )
    forces = torch.as_tensor(unit_forces).to(problem.hand.lower)
    torque = joint_torques(problem, poses, contact_set, forces)
    limit = (effort * config.effort_share / torque.abs().clamp_min(1e-9)).amin(-1)
    scale = limit.clamp(max=config.grip_force)[:, None]
    stiffness = torch.where(problem.hand.joint_scale == 1.0, config.stiffness, config.slide_stiffness)
    targets = (poses.joints + scale * torque / stiffness).clamp(problem.hand.lower, problem.hand.upper)
    return Squeeze(targets, scale[..., None] * forces, torch.as_tensor(imbalance).to(problem.hand.lower))


def joint_torques(
    problem: Problem, poses: Poses, contact_set: ContactSet, forces: Float[Tensor, "batch slots 3"]
) -> Float[Tensor, "batch joints"]:
    """τ = JᵀF [N·m], of sliding joints [N]: the gradient of Σ F·x(q) over the hand's points at the contacts."""
    base = poses.base
    x = base.apply_inverse(contact_set.position)
    joints = poses.joints.detach().requires_grad_(True)
    links = forward(problem.hand.kinematics, joints)[:, contact_set.link]
    with torch.no_grad():
        material = links.rotation.transpose(-1, -2) @ (x - links.translation)[..., None]
    moved = (links.rotation @ material).squeeze(-1) + links.translation
    (torque,) = torch.autograd.grad((moved * (forces @ base.rotation)).sum(), joints)
    return torque


def balanced_forces(
    arms: Float[np.ndarray, "batch slots 3"],
    normals: Float[np.ndarray, "batch slots 3"],
    active: Bool[np.ndarray, "batch slots"],
    length: float,
    friction: float,
) -> tuple[Float[np.ndarray, "batch slots 3"], Float[np.ndarray, "batch"]]:
    """Contact forces on the object with normal components summing to one and the least net wrench.

    Args:
        arms: contact points about the centre of mass [m].
        normals: outward unit normals.
        active: which links touch.
        length: scale of torques [m].
        friction: Coulomb coefficient of the cones.

    Returns:
        Forces, and the norm of their net wrench (torque over `length`).
    """
    from scipy.optimize import nnls

    forces, imbalance = np.zeros_like(arms), np.ones(len(arms))
    angles = np.arange(_CONE_EDGES) * 2 * np.pi / _CONE_EDGES
    for row in range(len(arms)):
        touching = np.flatnonzero(active[row])
        if len(touching) < 2:
            continue
        n = normals[row, touching]
        first = np.cross(n, np.eye(3)[np.abs(n).argmin(-1)])
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        second = np.cross(n, first)
        tangents = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
        edges = -n[:, None] + friction * tangents
        torques = np.cross(arms[row, touching][:, None], edges) / length
        wrenches = np.concatenate([edges, torques], -1).reshape(-1, 6).T
        count = wrenches.shape[1]
        # Rows: zero net wrench; normal forces sum to one (heavily); a little ridge spreads the load over contacts.
        system = np.concatenate([wrenches, np.full((1, count), 10.0), _RIDGE * np.eye(count)])
        target = np.concatenate([np.zeros(6), [10.0], np.zeros(count)])
        weights, _ = nnls(system, target)
        weights /= max(weights.sum(), 1e-9)
        forces[row, touching] = (weights.reshape(-1, _CONE_EDGES, 1) * edges).sum(1)
        imbalance[row] = np.linalg.norm(wrenches @ weights)
    return forces, imbalance


def find_pregrasp(
    problem: Problem, poses: Poses, config: GraspStagesConfig, stop: Callable[[], bool] = lambda: False
) -> tuple[Poses, Float[Tensor, "batch"]]:
    """A nearby posture (base shifted, never turned) from which the hand closes without sweeping through the object.

    Both the posture and the straight way in joint space to the grasp are kept clear: at a share a of the way every
    candidate is to be (1 − a) times the clearance away from the object, so that all that touch arrive together. All of
    the way keeps clear of obstacles, where there are any.

    Returns:
        The postures, and the least distance on the way over what it should be there, one where all is clear.
    """
    start = torch.cat([poses.translation, poses.joints], -1)
    rotation = rotation_from_quaternion(poses.quaternion).repeat(len(_WAY), 1, 1)
    rates, cost = _rates_and_costs(problem, config)
    with torch.no_grad():
        reached = hand_distance(problem, poses.base, poses.joints)
    remaining = torch.tensor([1.0 - a for a in _WAY], dtype=start.dtype, device=start.device)[:, None, None]
    # Where the grasp itself sinks in, the way out starts from that depth.
    wanted = (reached.clamp(max=0.0) * (1 - remaining) + remaining * config.clearance).flatten(0, 1)

    def way_to(x: Float[Tensor, "batch variables"]) -> Float[Tensor, "way_batch variables"]:
        return (remaining * x + (1 - remaining) * start).flatten(0, 1)

    def distances(x: Float[Tensor, "batch variables"]) -> Float[Tensor, "way_batch points"]:
        way = way_to(x)
        return hand_distance(problem, SE3(rotation, way[:, :3]), way[:, 3:])

    x, mean, square = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    for count in range(1, config.open_steps + 1):
        if stop():
            break
        x.requires_grad_(True)
        short = ((wanted - distances(x)).clamp_min(0.0) / 0.001).unflatten(0, (len(_WAY), -1))
        loss = (short * short).mean(-1).sum(0) + (cost * (x - start) ** 2).sum(-1)
        if problem.obstacles is not None:
            blocked = _obstacle_cost(problem.obstacles, problem, rotation, way_to(x))
            loss = loss + blocked.unflatten(0, (len(_WAY), -1)).sum(0)
        (gradient,) = torch.autograd.grad(loss.sum(), x)
        gradient = torch.nan_to_num(gradient)
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.98 * square + 0.02 * gradient * gradient
        fade = 1.0 - 0.9 * count / config.open_steps
        x = x.detach() - fade * rates * (mean / (1 - 0.9**count)) / ((square / (1 - 0.98**count)).sqrt() + 1e-8)
        x = torch.cat([x[:, :3], x[:, 3:].clamp(problem.hand.lower, problem.hand.upper)], -1)
    with torch.no_grad():
        share = 1 - (wanted - distances(x)).amax(-1).unflatten(0, (len(_WAY), -1)).amax(0) / config.clearance
    return Poses(x[:, :3], poses.quaternion, x[:, 3:]), share


def _rates_and_costs(
    problem: Problem, config: GraspStagesConfig
) -> tuple[Float[Tensor, "variables"], Float[Tensor, "variables"]]:
    """Of base translation and joints: step sizes, and what a square of travel costs."""
    rates = problem.hand.lower.new_full((3 + len(problem.hand.lower),), config.open_joint_rate)
    rates[3:] *= problem.hand.joint_scale
    rates[:3] = config.open_base_rate
    cost = torch.full_like(rates, 0.1)
    cost[3:] /= problem.hand.joint_scale**2
    cost[:3] = 2e3
    return rates, cost


def _obstacle_cost(
    obstacles: ObstacleTensors,
    problem: Problem,
    rotation: Float[Tensor, "batch 3 3"],
    x: Float[Tensor, "batch variables"],
) -> Float[Tensor, "batch"]:
    """The loss term of obstacles for rows of translation and joints."""
    gaps = obstacle_gaps(obstacles, SE3(rotation, x[:, :3]), forward(problem.hand.kinematics, x[:, 3:]))
    return losses.penetration(gaps, torch.full_like(gaps[:, 0], OBSTACLE_MARGIN))


@torch.no_grad()
def approach_depth(problem: Problem, obstacles: ObstacleTensors, pregrasp: Poses) -> Float[Tensor, "batch"]:
    """How deep the hand is in the object on its straight way from the retreat to the pregrasp [m], zero where clear.

    What a pregrasp itself leaves is not looked at here.
    """
    rotation = rotation_from_quaternion(pregrasp.quaternion)
    back = rotation @ obstacles.retreat
    nearest = [
        hand_distance(problem, SE3(rotation, pregrasp.translation + RETREAT * share * back), pregrasp.joints).amin(-1)
        for share in RETREAT_SHARES
    ]
    return (-torch.stack(nearest).amin(0)).clamp_min(0.0)


def hand_distance(problem: Problem, base: SE3, joints: Float[Tensor, "batch joints"]) -> Float[Tensor, "batch points"]:
    """Signed distance of every contact candidate to the object [m]."""
    points = place_points(problem.hand.coarse.matrix, forward(problem.hand.kinematics, joints))
    return sample_sdf(problem.object.sdf, base.apply(points))[0]
