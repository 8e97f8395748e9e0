"""Find the contacts of a grasp posture, and compute the pregrasp and the squeeze posture.

On the path from the pregrasp to the grasp, the hand touches nothing. The squeeze has the joint targets that produce
balanced contact forces, within the joints' effort limits. If the compiled C++ kernel supports the problem, the kernel
runs the same steps in place of torch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.config import GraspStagesConfig
from graspd_core.hands.kinematics import RETREAT, drawn_back, forward
from graspd_core.hands.link_distance import pair_distance, solid_distance
from graspd_core.hands.self_collision import solid_overlaps
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.kernel import builds as structs
from graspd_core.optimize.loop import Joints, Poses, Rows, Values, adam_moments, pack
from graspd_core.optimize.obstacle_distance import RETREAT_SHARES, ObstacleTensors
from graspd_core.optimize.problem import (
    HandPlacement,
    Problem,
    hand_distance,
    hand_forward,
    obstacle_depth,
    self_collision,
    solid_collision,
)
from graspd_core.se3 import SE3, rotation_from_quaternion

# Number of contacts of a link in addition to its nearest candidate.
_SPREAD = 2
# Fractions of the path from pregrasp to grasp at which the hand is kept clear of the object.
_PATH = (0.0, 0.4, 0.8)
# Cost of squared travel: of joints [1/rad²], of the base [1/m²].
_JOINT_COST, _BASE_COST = 0.1, 2e3
# Weight of the hand's self-collision at the pregrasp [1/mm²].
_SELF_WEIGHT = 10.0
# Settings of `settle`. Candidates within `clearance` [m] of the object are kept from moving away, with weight `keep`.
_SETTLING = structs.Pregrasp(
    0.001, 0.003, 0.0003, joint_cost=1.0, base_cost=1e4, self_collision=1.0, keep=0.03, steps=30
)
_CONE_EDGES = 8
# Weights relative to force balance: of an even load on the contacts, and of normal forces that sum to one.
_RIDGE, _SUM = 0.5, 10.0
# For heavy objects: sum of normal forces times friction, per mass [N/kg]. Two opposing contacts need a sixth of it.
_GRIP = 60.0
# Newton's method ends at the squared slope `_CONVERGED`, within ten steps. With NaN it ends after `_NEWTON_STEPS`.
_CONVERGED, _NEWTON_STEPS = 1e-22, 60


@dataclass(frozen=True)
class ContactSet:
    """Contacts of a batch of hands: a few slots (possible contacts) for every link. Only active slots are contacts.

    Attributes:
        link: link of each slot.
        position: point on the object, object frame [m].
        normal: outward unit normal of the object at `position`.
        distance: signed distance between hand and object at `position` [m].
        active: True if the slot is a contact.
    """

    link: Int[Tensor, "slots"]
    position: Float[Tensor, "batch slots 3"]
    normal: Float[Tensor, "batch slots 3"]
    distance: Float[Tensor, "batch slots"]
    active: Bool[Tensor, "batch slots"]


@torch.no_grad()
def find_contacts(problem: Problem, poses: Poses, reach: float) -> ContactSet:
    """Return contacts at three points of each link, and at the object's sharp point nearest to each hand primitive.

    The three points are contact candidates far apart. A contact is active within `reach` [m] of the object's surface.
    """
    points = problem.hand.fine
    placed = hand_forward(problem, points, poses)
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
    # A further candidate counts only if it is more than 4 mm from the nearest candidate of its link.
    apart = [torch.ones_like(chosen[0], dtype=torch.bool)]
    apart += [(placed.points[rows, c] - placed.points[rows, chosen[0]]).norm(dim=-1) > 0.004 for c in chosen[1:]]
    found = ContactSet(
        links.repeat_interleave(_SPREAD + 1),
        placed.points[rows, slots] - gap[..., None] * n,
        n,
        gap,
        (gap.abs() <= reach) & own_link & torch.stack(apart, -1).flatten(1),
    )
    return _with_features(problem, poses, found, reach) if len(problem.object.features) else found


def _with_features(problem: Problem, poses: Poses, found: ContactSet, reach: float) -> ContactSet:
    """Add a slot for each hand primitive at the object's nearest sharp point. The normal points into the primitive."""
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
    """Return the nearest sharp point of each hand primitive: index, signed distance [m], gradient of the distance."""
    solids = problem.hand.solids
    if (compiled := problem.compiled) is not None:
        x = pack(poses).contiguous()
        pick = torch.zeros((len(x), len(solids.link)), dtype=torch.int32)
        distance, gradient = x.new_empty(pick.shape), x.new_zeros((*pick.shape, 3))
        compiled.call("graspd_nearest_features", len(x), x, pick, distance, gradient)
        return pick.long(), distance, gradient
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
def self_overlap(problem: Problem, joints: Joints) -> Values:
    """Return the greatest penetration depth between two primitives of links that are not adjacent [m]."""
    if (compiled := problem.compiled) is not None:
        deepest = joints.new_empty(len(joints))
        compiled.call("graspd_self_overlap", len(joints), joints.contiguous(), deepest)
        return deepest
    links = forward(problem.hand.kinematics, joints)
    row, depth = solid_overlaps(problem.hand.solids, problem.hand.solid_pairs, links)
    return joints.new_zeros(len(joints)).scatter_reduce(0, row, depth, "amax")


def find_pregrasp(
    problem: Problem, poses: Poses, config: GraspStagesConfig, stop: Callable[[], bool] = lambda: False
) -> tuple[Poses, Values]:
    """Find a nearby pregrasp, from which the hand closes without pushing the object. The base shifts, never turns.

    The path to the grasp is straight in joint space. After the fraction a of the path, every contact candidate shall
    be at least (1 − a) times `clearance` away from the object. So all contacts arrive together. The whole path also
    avoids obstacles, and the pregrasp avoids self-collision.

    Returns:
        The pregrasps, and the fraction of the wanted clearance that each path keeps (1 if it keeps all).
    """
    if (compiled := problem.compiled) is None:
        return _find_pregrasp(problem, poses, config, stop)
    x = pack(poses).contiguous()
    out, share = x.new_empty(len(x), x.shape[1] - 4), x.new_empty(len(x))
    settings = _pregrasp_settings(config)
    settings.spheres = problem.hand.has_hulls
    compiled.call("graspd_find_pregrasps", settings, len(x), x, out, share, watch=lambda _: stop())
    return Poses(out[:, :3], poses.quaternion, out[:, 3:]), share


def _find_pregrasp(
    problem: Problem, poses: Poses, config: GraspStagesConfig, stop: Callable[[], bool]
) -> tuple[Poses, Values]:
    start = torch.cat([poses.translation, poses.joints], -1)
    rotation = rotation_from_quaternion(poses.quaternion).repeat(len(_PATH), 1, 1)
    rates, cost = _rates_and_costs(problem, _pregrasp_settings(config))
    with torch.no_grad():
        reached = hand_distance(problem, poses.base, poses.joints)
    remaining = torch.tensor([1.0 - a for a in _PATH], dtype=start.dtype, device=start.device)[:, None, None]
    # If the grasp penetrates the object, the path may end at this depth.
    wanted = (reached.clamp(max=0.0) * (1 - remaining) + remaining * config.clearance).flatten(0, 1)

    def path_to(x: Rows) -> Float[Tensor, "way_batch variables"]:
        return (remaining * x + (1 - remaining) * start).flatten(0, 1)

    def distances(x: Rows) -> Float[Tensor, "way_batch points"]:
        path = path_to(x)
        return hand_distance(problem, SE3(rotation, path[:, :3]), path[:, 3:])

    def loss(x: Rows) -> Values:
        short = ((wanted - distances(x)).clamp_min(0.0) / 0.001).unflatten(0, (len(_PATH), -1))
        total = (short * short).mean(-1).sum(0) + (cost * (x - start) ** 2).sum(-1)
        opened = forward(problem.hand.kinematics, x[:, 3:])
        total = total + _SELF_WEIGHT * solid_collision(problem, opened)
        if problem.hand.has_hulls:
            total = total + _SELF_WEIGHT * self_collision(problem, opened)
        if problem.obstacles is None:
            return total
        path = path_to(x)
        links = forward(problem.hand.kinematics, path[:, 3:])
        blocked = obstacle_depth(problem.obstacles, SE3(rotation, path[:, :3]), links)
        return total + blocked.unflatten(0, (len(_PATH), -1)).sum(0)

    x = _descended(problem, start, loss, rates, config.open_steps, stop)
    with torch.no_grad():
        share = 1 - (wanted - distances(x)).amax(-1).unflatten(0, (len(_PATH), -1)).amax(0) / config.clearance
    return Poses(x[:, :3], poses.quaternion, x[:, 3:]), share


def settle(problem: Problem, poses: Poses, stop: Callable[[], bool] = lambda: False) -> Poses:
    """Return nearby poses that penetrate the object less. The base may shift but does not turn.

    The loss penalises object surface points inside the hand's primitives, and contact candidates inside the object.
    Candidates that touch the object are kept near it.
    """
    start = torch.cat([poses.translation, poses.joints], -1)
    if (compiled := problem.of_surface.compiled) is not None:
        x, out = pack(poses).contiguous(), torch.empty_like(start)
        compiled.call("graspd_settle", _SETTLING, len(x), x, out, watch=lambda _: stop())
        return Poses(out[:, :3], poses.quaternion, out[:, 3:])
    rates, cost = _rates_and_costs(problem, _SETTLING)
    with torch.no_grad():
        reached = sample_sdf(problem.object.sdf, hand_forward(problem, problem.hand.fine, poses).points)[0]
    wanted = torch.where(reached < _SETTLING.clearance, reached.clamp_min(0.0), torch.inf)

    def loss(x: Rows) -> Values:
        placed = hand_forward(problem, problem.hand.fine, Poses(x[:, :3], poses.quaternion, x[:, 3:]))
        gap = sample_sdf(problem.object.sdf, placed.points)[0]
        sunk = ((1e3 * gap.clamp_max(0.0)) ** 2).sum(-1) + _sunk_surface(problem.of_surface, placed, poses, x)
        total = _SETTLING.self_collision * (sunk + solid_collision(problem, placed.links))
        total = total + _SETTLING.keep * ((1e3 * (gap - wanted).clamp_min(0.0)) ** 2).sum(-1)
        if problem.obstacles is not None:
            blocked = obstacle_depth(problem.obstacles, placed.base, placed.links)
            total = total + _SETTLING.self_collision * blocked
        return total + (cost * (x - start) ** 2).sum(-1)

    out = _descended(problem, start, loss, rates, _SETTLING.steps, stop)
    return Poses(out[:, :3], poses.quaternion, out[:, 3:])


def _sunk_surface(on_surface: Problem, placed: HandPlacement, poses: Poses, x: Rows) -> Values:
    """Find the object's deepest surface point in each hand primitive. Return the sum of the squared depths [mm²]."""
    solids, features = on_surface.hand.solids, on_surface.object.features
    if not len(features) or not len(solids.link):
        return x.new_zeros(len(x))
    at_rest = Poses(x.detach()[:, :3], poses.quaternion, x.detach()[:, 3:])
    pick, _, _ = nearest_features(on_surface, at_rest)
    which = torch.arange(len(solids.link), device=pick.device).expand_as(pick)
    gap = pair_distance(solids, placed.links, placed.base.apply_inverse(features[pick]), which)
    return ((1e3 * gap.clamp_max(0.0)) ** 2).sum(-1)


def _pregrasp_settings(config: GraspStagesConfig) -> structs.Pregrasp:
    rates = {"joint_rate": config.open_joint_rate, "base_rate": config.open_base_rate, "steps": config.open_steps}
    costs = {"joint_cost": _JOINT_COST, "base_cost": _BASE_COST, "self_collision": _SELF_WEIGHT}
    return structs.Pregrasp(clearance=config.clearance, **rates, **costs)


def _rates_and_costs(
    problem: Problem, settings: structs.Pregrasp
) -> tuple[Float[Tensor, "variables"], Float[Tensor, "variables"]]:
    """Return the step size and the cost per squared travel of each variable: base translation, then joints."""
    rates = problem.hand.lower.new_full((3 + len(problem.hand.lower),), settings.joint_rate)
    rates[3:] *= problem.hand.joint_scale
    rates[:3] = settings.base_rate
    cost = torch.full_like(rates, settings.joint_cost)
    cost[3:] /= problem.hand.joint_scale**2
    cost[:3] = settings.base_cost
    return rates, cost


def _descended(
    problem: Problem,
    start: Rows,
    loss: Callable[[Rows], Values],
    rates: Float[Tensor, "variables"],
    steps: int,
    stop: Callable[[], bool],
) -> Rows:
    """Return base translations and joints after `steps` Adam steps that minimise `loss`. The step sizes decay."""
    x, mean, square = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    for count in range(1, steps + 1):
        if stop():
            break
        x.requires_grad_(True)
        (gradient,) = torch.autograd.grad(loss(x).sum(), x)
        gradient = torch.nan_to_num(gradient)
        mean, square, top, root = adam_moments(mean, square, gradient, count)
        fade = 1.0 - 0.9 * count / steps
        x = x.detach() - fade * rates * top / root
        x = torch.cat([x[:, :3], x[:, 3:].clamp(problem.hand.lower, problem.hand.upper)], -1)
    return x


@torch.no_grad()
def approach_depth(problem: Problem, obstacles: ObstacleTensors, pregrasp: Poses) -> Values:
    """Return how deep the hand penetrates the object on the straight path from the retreat to the pregrasp [m].

    0 if the path is free. The retreat is the pregrasp moved back against the approach. The pregrasp is not tested.
    """
    rotation = rotation_from_quaternion(pregrasp.quaternion)
    begun = [drawn_back(pregrasp.translation, rotation, obstacles.approach, RETREAT * s) for s in RETREAT_SHARES]
    nearest = [hand_distance(problem, SE3(rotation, at), pregrasp.joints).amin(-1) for at in begun]
    return (-torch.stack(nearest).amin(0)).clamp_min(0.0)


@dataclass(frozen=True)
class Squeeze:
    """Balanced contact forces and the joint targets that produce these forces, within the joints' effort limits.

    Attributes:
        joints: position targets [rad] or [m].
        forces: contact force on the object at each possible contact [N], before the effort limits.
        imbalance: norm of the net wrench divided by the sum of the normal forces. 1 with fewer than two contacts.
    """

    joints: Float[Tensor, "batch joints"]
    forces: Float[Tensor, "batch slots 3"]
    imbalance: Float[Tensor, "batch"]


def squeeze(
    problem: Problem, poses: Poses, contact_set: ContactSet, effort: Float[Tensor, "joints"], config: GraspStagesConfig
) -> Squeeze:
    """Compute balanced contact forces F by non-negative least squares, and joint targets offset by JᵀF / stiffness.

    Heavier objects get larger forces. The torque JᵀF of each joint is limited to the share `effort_share` of `effort`.
    """
    unit_forces, imbalance = balanced_forces(
        (contact_set.position - problem.object.center).double().cpu().numpy(),
        contact_set.normal.double().cpu().numpy(),
        contact_set.active.cpu().numpy(),
        problem.object.length,
        problem.friction,
    )
    forces = torch.as_tensor(unit_forces).to(problem.hand.lower)
    pressed = by_link(contact_set, -(forces * contact_set.normal).sum(-1, keepdim=True)).amax((-2, -1))
    grip = max(config.grip_force, _GRIP * problem.object.mass / problem.friction)
    forces = (config.link_force / pressed.clamp_min(1e-9)).clamp(max=grip)[:, None, None] * forces
    limit = effort * config.effort_share
    torque = joint_torques(problem, poses, contact_set, forces).clamp(-limit, limit)
    stiffness = torch.where(problem.hand.joint_scale == 1.0, config.stiffness, config.slide_stiffness)
    targets = (poses.joints + torque / stiffness).clamp(problem.hand.lower, problem.hand.upper)
    return Squeeze(targets, forces, torch.as_tensor(imbalance).to(problem.hand.lower))


def by_link(contact_set: ContactSet, values: Float[Tensor, "batch slots n"]) -> Float[Tensor, "batch links n"]:
    """Return the sum of the values over the slots of each link, up to the last link that has a slot."""
    links = int(contact_set.link.max()) + 1
    return values.new_zeros(len(values), links, values.shape[-1]).index_add(1, contact_set.link, values)


def joint_torques(
    problem: Problem, poses: Poses, contact_set: ContactSet, forces: Float[Tensor, "batch slots 3"]
) -> Joints:
    """Return joint torques τ = JᵀF [N·m] or [N]: the gradient of Σ F·x in the joints, with x fixed to the links."""
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
    """Return the contact forces on the object with the least net wrench. Their normal components sum to one.

    Args:
        arms: contact points relative to the centre of mass [m].
        normals: outward unit normals.
        active: True for slots that are contacts.
        length: length that torques are divided by [m].
        friction: Coulomb coefficient of the friction cones.

    Returns:
        Forces, and the norm of their net wrench (torque over `length`).
    """
    active = active & (active.sum(-1, keepdims=True) > 1)
    # Put the active slots of every row first. Keep as many columns as the row with the most active slots has.
    order = np.argsort(~active, axis=-1, kind="stable")[:, : int(active.sum(-1).max(initial=0))]
    rows = np.arange(len(arms))[:, None]
    touching = active[rows, order]
    edges = _cone_edges(normals[rows, order], friction) * touching[..., None, None]
    torques = np.cross(arms[rows, order][:, :, None], edges) / length
    wrenches = np.concatenate([edges, torques], -1).reshape(len(arms), -1, 6)
    weights = _balancing_weights(wrenches, np.repeat(touching, _CONE_EDGES, -1))
    weights /= weights.sum(-1, keepdims=True).clip(1e-9)
    forces, imbalance = np.zeros_like(arms), np.ones(len(arms))
    forces[rows, order] = (weights.reshape(*order.shape, _CONE_EDGES, 1) * edges).sum(2)
    balanced = touching.any(-1)
    imbalance[balanced] = np.linalg.norm((weights[..., None] * wrenches).sum(1), axis=-1)[balanced]
    return forces, imbalance


def _cone_edges(
    normals: Float[np.ndarray, "batch slots 3"], friction: float
) -> Float[np.ndarray, "batch slots edges 3"]:
    """Return forces along the edges of every contact's friction cone, each with a normal component of one."""
    angles = np.arange(_CONE_EDGES) * 2 * np.pi / _CONE_EDGES
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True).clip(1e-12)
    second = np.cross(normals, first)
    tangents = np.cos(angles)[:, None] * first[:, :, None] + np.sin(angles)[:, None] * second[:, :, None]
    return friction * tangents - normals[:, :, None]


def _balancing_weights(
    wrenches: Float[np.ndarray, "batch edges 6"], allowed: Bool[np.ndarray, "batch edges"]
) -> Float[np.ndarray, "batch edges"]:
    """Return the x ≥ 0 that minimises ‖W x‖² + 10² (Σ x − 1)² + ridge² ‖x‖². W has the `allowed` `wrenches` as columns.

    Let G be W with a seventh row of tens, and t = (0, …, 0, 10). The dual problem seeks the residual r = t − G x. It
    minimises ‖r‖²/2 + ‖max(Gᵀr, 0)‖² / 2 ridge² − t·r. Then x = max(Gᵀr, 0) / ridge². The dual problem is piecewise
    quadratic. So Newton's method with step halving needs few steps.
    """
    batch, count, _ = wrenches.shape
    g = np.concatenate([wrenches, np.full((batch, count, 1), _SUM)], -1) * allowed[..., None]
    target, gain = np.array([0.0] * 6 + [_SUM]), 1 / _RIDGE**2
    r = np.zeros((batch, 7))
    r[:, 6] = _SUM / (1 + _SUM**2 * gain * allowed.sum(-1))

    def value(r: np.ndarray) -> np.ndarray:
        pressed = (g @ r[..., None])[..., 0].clip(0.0)
        return 0.5 * (r * r).sum(-1) + 0.5 * gain * (pressed * pressed).sum(-1) - r @ target

    for _ in range(_NEWTON_STEPS):
        pressed = (g @ r[..., None])[..., 0].clip(0.0)
        downhill = target - r - gain * (pressed[:, None] @ g)[:, 0]
        if (downhill * downhill).sum(-1).max(initial=0.0) < _CONVERGED:
            break
        chosen = g * (pressed > 0)[..., None]
        newton = np.linalg.solve(np.eye(7) + gain * chosen.transpose(0, 2, 1) @ chosen, downhill[..., None])[..., 0]
        now, slope, step = value(r), (downhill * newton).sum(-1), np.ones(batch)
        while (worse := (value(r + step[:, None] * newton) > now - 1e-4 * step * slope + 1e-14) & (step > 1e-8)).any():
            step[worse] /= 2
        r = r + step[:, None] * newton
    return gain * (g @ r[..., None])[..., 0].clip(0.0)
