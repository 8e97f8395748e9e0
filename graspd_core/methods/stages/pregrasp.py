"""The pregrasp: a posture near the grasp from which the hand closes without touching anything on its way."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.config import GraspStagesConfig
from graspd_core.hands.kinematics import forward, place_points
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.methods import losses
from graspd_core.methods.kernel_problem import kernel_problem
from graspd_core.methods.obstacle_distance import RETREAT, RETREAT_SHARES, ObstacleTensors, obstacle_gaps
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import OBSTACLE_MARGIN, Problem
from graspd_core.methods.stages.compiled_stages import BASE_COST, JOINT_COST, find_pregrasp_compiled
from graspd_core.se3 import SE3, rotation_from_quaternion

# Shares of the way from pregrasp to grasp that are kept clear.
_WAY = (0.0, 0.4, 0.8)


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
    compiled = kernel_problem(problem)
    if compiled is not None:
        return find_pregrasp_compiled(compiled, poses, config, stop)
    return _find_pregrasp(problem, poses, config, stop)


def _find_pregrasp(
    problem: Problem, poses: Poses, config: GraspStagesConfig, stop: Callable[[], bool]
) -> tuple[Poses, Float[Tensor, "batch"]]:
    """`find_pregrasp` in torch."""
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
    cost = torch.full_like(rates, JOINT_COST)
    cost[3:] /= problem.hand.joint_scale**2
    cost[:3] = BASE_COST
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
