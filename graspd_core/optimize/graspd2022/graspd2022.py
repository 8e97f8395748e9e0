"""Solve Grasp'D as published (Turpin et al., ECCV 2022): find forces that stop the object, and a pose that gives them.

    min L_phys + L_range + L_inter  subject to  L_task < C_task, L_limit < C_limit

with damped multipliers and Adamax. The hand touches the level set φ = r, where r shrinks to zero (docs/method.md, §1).

Physics is relaxed as in contact-invariant optimisation. Every hand point has in every simulation a desired force f̂ on
the object. L_task is a constraint: f̂ shall stop the object. L_phys is a cost: the pose shall supply f̂.

For min f(x) subject to g(x) < C the Lagrangian is f + λ c + d c² / 2 with c = max(g − C, 0). Each step decreases the
Lagrangian in x and increases it in λ. The damping d c² / 2 prevents oscillation (Platt & Barr, NIPS 1987).

Hand points that penetrate the object push it by the penalty contact of Grasp'D:

    f_n = k_n min(φ − r, 0) ∇φ        f_t = −min(k_f ‖v_t‖, μ ‖f_n‖) v̂_t

φ is the object's signed distance at the hand's point. v_t is the tangential part of the object's velocity relative to
the hand. The simulation is one semi-implicit Euler step of a free rigid body without gravity. Only velocities are
computed. Values are in SI units and in the object frame. Torques and angular velocities are about the mass centre.

Gradients are exact with four exceptions. Points out of contact get a gradient too (`leaky_min`). The tangential speed
has a floor, so that friction is smooth at rest. L_task has no gradient in the pose. `into_cone` has no gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize import losses
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput
from graspd_core.optimize.graspd2022.graspd2022_config import ContactConfig, Graspd2022Config, PoseStepsConfig
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Distances, Points, Poses, Rows, Values, minimise, pack, unpack
from graspd_core.optimize.problem import PointSet, Problem, hand_forward, least_distance, obstacle_depth, self_collision
from graspd_core.perception.scene import Scene
from graspd_core.se3 import EPSILON, aligning_rotation, quaternion_from_rotation, rotation_from_axis_angle

# Floor of the squared tangential speed [m²/s²]. A micrometre per second counts as no motion.
_SLIP_FLOOR = 1e-12
_BETA1, _EPSILON = 0.9, 1e-8
# Number of poses drawn for each kept start. Poses that touch the object come last. The released code redraws them.
_POOL = 4
# L_task if nothing slows the object: 1e5 times the sum of the squared speeds 0, 3e-4 and 3e-4 [m²/s²].
_ALL_MOTION = 60.0
# One variable with a row for every start.
Variable = Float[Tensor, "batch *shape"]
# Forces on the object [N], or wrenches, at every point in every simulation.
Forces = Float[Tensor, "batch points simulations components"]


def leaky_min(x: Float[Tensor, "*shape"], leak: float) -> Float[Tensor, "*shape"]:
    """Return min(x, 0). Where x ≥ 0, the gradient is `leak` instead of zero: the leaky gradient of Grasp'D."""
    return torch.where(x < 0, x, leak * (x - x.detach()))


def contact_forces(
    height: Distances, normals: Points, velocities: Float[Tensor, "simulations 3"], contact: ContactConfig
) -> Float[Tensor, "batch points simulations 3"]:
    """Compute the force [N] on the object at every hand point, once for each velocity of the object.

    Args:
        height: height of the hand's points above the level set, φ − r [m].
        normals: ∇φ at the hand's points. A zero vector gives no normal force.
        velocities: linear velocities of the object relative to the hand [m/s].
        contact: settings k_n, k_f, μ and `leak`, the gradient out of contact (`leaky_min`).
    """
    push = contact.stiffness * leaky_min(height, contact.leak)
    along = normals @ velocities.T
    slip = ((velocities * velocities).sum(-1) - along * along).clamp_min(_SLIP_FLOOR).sqrt()
    # `drag` is the friction force per tangential speed. The last line adds the normal force to the drag of v − (n·v) n.
    drag = (-contact.friction * push[..., None] / slip).clamp(max=contact.friction_stiffness)
    return (push[..., None] + drag * along)[..., None] * normals[:, :, None] - drag[..., None] * velocities


@dataclass(frozen=True)
class FreeBody:
    """The object as a rigid body.

    Attributes:
        mass: mass [kg].
        inverse_inertia: inverse of the inertia about the centre of mass [1/(kg·m²)].
        center: centre of mass [m].
        length: characteristic length that makes angular and linear velocity comparable [m].
    """

    mass: float
    inverse_inertia: Float[Tensor, "3 3"]
    center: Float[Tensor, "3"]
    length: float


def make_body(
    mass: float,
    inertia: Float[np.ndarray, "3 3"],
    center: Float[np.ndarray, "3"],
    length: float,
    device: torch.device | str,
    dtype: torch.dtype,
) -> FreeBody:
    """Build the body. Thin objects get a radius of gyration of at least `length` / 10 about every axis."""
    moments, axes = np.linalg.eigh(inertia)
    moments = np.maximum(moments, mass * (0.1 * length) ** 2)
    arrays = axes @ np.diag(1 / moments) @ axes.T, center
    inverse, middle = (torch.as_tensor(array, device=device, dtype=dtype) for array in arrays)
    return FreeBody(mass, inverse, middle, length)


def net_wrench(
    forces: Float[Tensor, "batch points simulations 3"], arms: Points
) -> tuple[Float[Tensor, "batch simulations 3"], Float[Tensor, "batch simulations 3"]]:
    """Return Σ f [N] and Σ r × f [N·m] for every simulation, with `arms` r from the centre of mass [m]."""
    # One matrix product gives Σ rᵢ fⱼ. Its antisymmetric part is the torque.
    products = (arms.transpose(1, 2) @ forces.flatten(2)).unflatten(2, forces.shape[2:])
    x, y, z = products.unbind(1)
    torque = torch.stack([y[..., 2] - z[..., 1], z[..., 0] - x[..., 2], x[..., 1] - y[..., 0]], -1)
    return forces.sum(1), torque


def euler_step(
    body: FreeBody,
    linear: Float[Tensor, "*#batch 3"],
    force: Float[Tensor, "*#batch 3"],
    torque: Float[Tensor, "*#batch 3"],
    time_step: float,
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Return linear [m/s] and angular [rad/s] velocity after `time_step` [s] of a force [N] and a torque [N·m].

    The angular velocity before the step is zero.
    """
    return linear + (time_step / body.mass) * force, time_step * (torque @ body.inverse_inertia)


def speed_left(
    body: FreeBody, linear: Float[Tensor, "*batch 3"], angular: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Return the squared speed ‖v‖² + ‖L ω‖² of a body of length L [m²/s²]."""
    return (linear * linear).sum(-1) + body.length**2 * (angular * angular).sum(-1)


def actual(forces: Float[Tensor, "batch points simulations 3"], arms: Points, length: float, components: int) -> Forces:
    """Return the forces unchanged (3 components), or as wrenches with torques divided by `length` (6 components)."""
    if components == 3:
        return forces
    torques = torch.linalg.cross(arms[:, :, None] / length, forces)
    return torch.cat([forces, torques], -1)


def physics(desired: Forces, supplied: Forces) -> Values:
    """Return L_phys [N²]: squared differences of desired and supplied forces, summed over points and simulations."""
    difference = (desired - supplied).flatten(1)
    return (difference * difference).sum(-1)


def motion_left(
    body: FreeBody, forces: Forces, arms: Points, velocities: Float[Tensor, "simulations 3"], time_step: float
) -> Float[Tensor, "batch simulations"]:
    """Return the object's squared speed after a step, divided by the mean of the squared initial speeds.

    Without forces the results average 1. Forces with six components contain torques, divided by the body's length.
    """
    if forces.shape[-1] == 3:
        force, torque = net_wrench(forces, arms)
    else:
        force, torque = forces.sum(1).split(3, -1)
        torque = torque * body.length
    linear, angular = euler_step(body, velocities, force, torque, time_step)
    return speed_left(body, linear, angular) / (velocities * velocities).sum(-1).mean()


@torch.no_grad()
def into_cone(
    forces: Float[Tensor, "batch points simulations 3"], normals: Points, friction: float
) -> Float[Tensor, "batch points simulations 3"]:
    """Project forces into the friction cones of pushing contacts on a surface with outward `normals`."""
    along = -(forces * normals[:, :, None]).sum(-1)
    across = forces + along[..., None] * normals[:, :, None]
    side = across.norm(dim=-1)
    # Forces inside the cone do not change. For other forces the nearest point is on the cone.
    rim = ((along + friction * side) / (1 + friction**2)).clamp_min(0.0)
    inside = side <= friction * along
    push = torch.where(inside, along, rim)
    share = torch.where(inside, torch.ones_like(side), friction * rim / side.clamp_min(EPSILON))
    return share[..., None] * across - push[..., None] * normals[:, :, None]


@dataclass(frozen=True)
class Adamax:
    """A variable with a row for every start, and its moments (Kingma & Ba 2015, §7.1).

    Attributes:
        value: the iterate.
        mean: running mean of the gradient.
        top: decaying maximum of the gradient's magnitude (Adamax), or running mean of its square (Adam).
    """

    value: Variable
    mean: Variable
    top: Variable


def adamax(value: Variable) -> Adamax:
    """Return the state before the first step."""
    return Adamax(value, torch.zeros_like(value), torch.zeros_like(value))


def adamax_step(state: Adamax, gradient: Variable, rate: float, count: int, memory: float = 0.999) -> Adamax:
    """Take Adamax step `count`, counted from one. A negative rate maximises. `memory` is the decay rate of `top`."""
    mean = torch.lerp(gradient, state.mean, _BETA1)
    top = torch.maximum(memory * state.top, gradient.abs())
    return Adamax(torch.addcdiv(state.value, mean, top + _EPSILON, value=-rate / (1 - _BETA1**count)), mean, top)


def adam_step(state: Adamax, gradient: Variable, rate: float, count: int, memory: float = 0.999) -> Adamax:
    """Take Adam step `count`, counted from one (Kingma & Ba 2015, §2). `memory` is β2."""
    mean = torch.lerp(gradient, state.mean, _BETA1)
    squares = torch.lerp(gradient * gradient, state.top, memory)
    size = (squares / (1 - memory**count)).sqrt() + _EPSILON
    return Adamax(torch.addcdiv(state.value, mean, size, value=-rate / (1 - _BETA1**count)), mean, squares)


def excess(value: Float[Tensor, "*shape"], bound: float) -> Float[Tensor, "*shape"]:
    """Return the violation max(`value` − `bound`, 0) of a constraint. It is also the Lagrangian's gradient in λ."""
    return (value - bound).clamp_min(0.0)


def damped(broken: Variable, multiplier: Variable, damping: float) -> Variable:
    """Return a constraint's term in the Lagrangian: λ c + d c² / 2, with violation c = `broken` and `damping` d."""
    return broken * (multiplier + 0.5 * damping * broken)


@torch.no_grad()
def published_starts(problem: Problem, scene: Scene, hand: HandModel, count: int, seed: int, standoff: float) -> Poses:
    """Draw `count` starts: palm at `standoff` [m] from a random surface point, random roll, fingers open.

    Starts that touch the object are chosen last.
    """
    generator = torch.Generator().manual_seed(seed)
    # Samples come in the order of the mesh's faces. Without shuffling, all chosen samples would lie on one side.
    order = torch.randperm(_POOL * count, generator=generator)
    points, normals = (torch.as_tensor(x)[order] for x in surface_samples(scene.object.mesh, _POOL * count, seed))
    roll = math.pi * (2 * torch.rand(len(points), generator=generator, dtype=torch.float64) - 1)
    rotation = aligning_rotation(torch.as_tensor(hand.palm_normal), -normals)
    rotation = rotation_from_axis_angle(normals, roll) @ rotation
    palm = points + standoff * normals
    translation = palm - (rotation @ torch.as_tensor(hand.palm_center)[:, None]).squeeze(-1)
    joints = torch.as_tensor(hand.open_posture).expand(len(points), -1)
    drawn = Poses(*(x.to(problem.hand.lower) for x in (translation, quaternion_from_rotation(rotation), joints)))
    touching = least_distance(problem, drawn) <= 0
    return drawn[touching.int().argsort(stable=True)[:count]]


class Evaluation(NamedTuple):
    """Values per start, and the outward normals at the hand's points.

    `cost` is L_phys + L_range + L_inter, weighted. Without relaxation, an unweighted loss on the motion replaces
    L_phys. `task` and `limit` are L_task and L_limit.
    """

    cost: Values
    task: Values
    limit: Values
    normals: Points


@dataclass(frozen=True)
class RelaxedState:
    """Current and best iterate of every start. Only iterates for contact at r = 0 can become the best.

    Attributes:
        pose: rows of translation, quaternion, joints.
        forces: desired forces [N]. Empty without relaxation.
        multipliers: multipliers of L_task and L_limit.
        radius: level set r at the first step [m].
        loss: loss of the last evaluation.
    """

    pose: Adamax
    forces: Adamax
    multipliers: Adamax
    radius: Values
    best: Rows
    best_loss: Values
    loss: Values


@dataclass(frozen=True)
class Graspd2022:
    """The solver of docs/method.md, §1. `body` is the object as a rigid body."""

    config: Graspd2022Config
    body: FreeBody

    @property
    def steps(self) -> int:
        return self.config.steps

    @property
    def velocities(self) -> Float[Tensor, "3 3"]:
        """Initial velocities of the object in the three simulations [m/s]."""
        speed = self.config.simulation.speed
        return self.body.center.new_tensor([[0.0] * 3, [speed] * 3, [-speed] * 3])

    @property
    def time_step(self) -> float:
        """Duration of the simulation step [s]."""
        config = self.config
        if config.simulation.scaling == "published":
            return config.simulation.time_step
        return self.body.mass * config.simulation.speed * math.sqrt(3) / config.simulation.stopping_force

    def points(self, problem: Problem) -> PointSet:
        """Return the contact candidates that the configuration selects."""
        return problem.hand.fine if self.config.contact.all_candidates else problem.hand.coarse

    def init(self, problem: Problem, starts: Poses) -> RelaxedState:
        config = self.config
        x = pack(starts)
        points = len(self.points(problem).links) if config.relaxation.enabled else 0
        components = 6 if config.relaxation.desired == "wrench" else 3
        radius = x.new_full((len(x),), config.level_set.radius_start)
        if config.level_set.schedule == "code":
            with torch.no_grad():
                nearest = least_distance(problem, starts)
                radius = (nearest - config.level_set.clearance).clamp_min(0.0)
        worst = x.new_full((len(x),), torch.inf)
        return RelaxedState(
            adamax(x),
            adamax(x.new_zeros(len(x), points, 3, components)),
            adamax(x.new_zeros(len(x), 2)),
            radius,
            x,
            worst,
            worst,
        )

    def step(self, problem: Problem, state: RelaxedState, index: int) -> RelaxedState:
        config = self.config
        remaining = max(0.0, 1.0 - index / config.level_set.coarse_steps) if config.level_set.coarse_steps else 0.0
        found, broken, by_pose, by_force = self.slope(problem, state, remaining * state.radius)
        loss = found.cost.detach() + damped(broken, torch.ones_like(broken), 1.0).sum(-1)
        finite = torch.isfinite(by_pose).all(-1) & torch.isfinite(loss)
        loss = torch.where(finite, loss, torch.inf)
        # An iterate on a padded surface cannot become the best iterate.
        better = (loss < state.best_loss) & (remaining == 0.0)
        rate = self.rate(index) * config.relaxation.force_rate
        pulled, count = state.forces, index + 1
        if by_force is not None:
            pulled = adamax_step(pulled, _clean(by_force, finite), rate, count, config.beta2)
            if config.relaxation.desired == "cone":
                cone = into_cone(pulled.value, found.normals, config.contact.friction)
                pulled = replace(pulled, value=cone)
        climb = -config.constraints.multiplier_rate
        stepped = replace(
            state,
            pose=self.moved(problem, state.pose, _clean(by_pose, finite), (index, 0)),
            forces=pulled,
            multipliers=adamax_step(state.multipliers, _clean(broken, finite), climb, count),
            best=torch.where(better[:, None], state.pose.value, state.best),
            best_loss=torch.where(better, loss, state.best_loss),
            loss=loss,
        )
        if config.pose_steps.in_turns:
            _, _, by_pose, _ = self.slope(problem, stepped, remaining * state.radius, pose_only=True)
            clean = _clean(by_pose, finite & torch.isfinite(by_pose).all(-1))
            stepped = replace(stepped, pose=self.moved(problem, stepped.pose, clean, (index, 1)))
        return stepped

    def slope(
        self, problem: Problem, state: RelaxedState, radius: Values, *, pose_only: bool = False
    ) -> tuple[Evaluation, Float[Tensor, "batch constraints"], Rows, Forces | None]:
        """Evaluate an iterate, for contact with the level set φ = `radius` [m].

        Returns:
            The evaluation, the constraint violations, and the Lagrangian's gradients in the pose and in the forces. The
            last is None without relaxation, or with `pose_only`.
        """
        bounds = self.config.constraints
        pose = state.pose.value.detach().requires_grad_(True)
        forces = state.forces.value.detach().requires_grad_(not pose_only)
        found = self.evaluate(problem, pose, forces, radius)
        task, limit = excess(found.task, bounds.task_bound), excess(found.limit, bounds.limit_bound)
        broken = torch.stack([task, limit], -1)
        lagrangian = found.cost + damped(broken, state.multipliers.value, bounds.damping).sum(-1)
        wanted = (pose,) if pose_only else (pose, forces)
        by_pose, *by_force = torch.autograd.grad(lagrangian.sum(), wanted, allow_unused=True)
        return found, broken.detach(), by_pose, by_force[0] if by_force else None

    def rate(self, index: int) -> float:
        """Return the factor of the step sizes at step `index`: a linear warm-up times a half-cosine decay."""
        config = self.config
        fade = config.final_rate + (1 - config.final_rate) * 0.5 * (1 + math.cos(math.pi * index / self.steps))
        return fade * min(1.0, index / config.warm_up) if config.warm_up else fade

    def moved(self, problem: Problem, pose: Adamax, gradient: Rows, when: tuple[int, int]) -> Adamax:
        """Move the pose once. `when` is (step, turn). With `in_turns`, a step has the turns 0 and 1, otherwise only 0.

        As in the released code, the moments of all variables are updated, also of variables that do not move this turn.
        """
        config, (index, turn) = self.config, when
        steps = config.pose_steps
        step = adam_step if steps.optimiser == "adam" else adamax_step
        count = 2 * index + turn + 1 if steps.in_turns else index + 1
        after = step(pose, gradient, self.rate(index) * config.pose_rate, count, config.beta2)
        x, shares = after.value, move_shares(steps, turn, len(problem.hand.lower))
        if any(share != 1.0 for share in shares):
            x = torch.lerp(pose.value, x, x.new_tensor(shares))
        quaternion = x[:, 3:7] / x[:, 3:7].norm(dim=-1, keepdim=True)
        joints = x[:, 7:].clamp(problem.hand.lower, problem.hand.upper) if steps.within_limits else x[:, 7:]
        return replace(after, value=torch.cat([x[:, :3], quaternion, joints], -1))

    def best(self, state: RelaxedState) -> tuple[Poses, Values]:
        if self.config.keep == "last":
            return unpack(state.pose.value), state.loss
        scored = torch.isfinite(state.best_loss)
        x = torch.where(scored[:, None], state.best, state.pose.value)
        return unpack(x), torch.where(scored, state.best_loss, state.loss)

    def evaluate(self, problem: Problem, pose: Rows, desired: Forces, radius: Values) -> Evaluation:
        """Compute all loss terms at a pose with desired forces, for contact with the level set φ = `radius` [m]."""
        config, body, poses, velocities = self.config, self.body, unpack(pose), self.velocities
        placed = hand_forward(problem, self.points(problem), poses)
        distance, normals = sample_sdf(problem.object.sdf, placed.points)
        arms = placed.points - body.center
        supplied = contact_forces(distance - radius[:, None], normals, velocities, config.contact)
        if config.relaxation.enabled:
            goal = config.weights.physics * physics(desired, actual(supplied, arms, body.length, desired.shape[-1]))
            # As in the released code, L_task depends on the forces alone. `detach` drops its dependence on the pose.
            task = _ALL_MOTION * motion_left(body, desired, arms.detach(), velocities, self.time_step).mean(-1)
        else:
            goal = _ALL_MOTION * motion_left(body, supplied, arms, velocities, self.time_step).mean(-1)
            task = torch.zeros_like(radius)
        inter = self_collision(problem, placed.links)
        if problem.obstacles is not None:
            inter = inter + obstacle_depth(problem.obstacles, placed.base, placed.links)
        beyond = (poses.joints - problem.hand.upper).clamp_min(0.0) + (problem.hand.lower - poses.joints).clamp_min(0.0)
        spread = losses.posture(poses.joints, problem.hand.lower, problem.hand.upper)
        cost = goal + config.weights.range * spread + config.weights.inter * inter
        return Evaluation(cost, task, beyond.sum(-1), normals)


def move_shares(steps: PoseStepsConfig, turn: int, joints: int) -> list[float]:
    """Return the step-size factor of each pose variable. With `in_turns`, a variable of the other turn has 0."""
    position, others = (1 - turn, turn) if steps.in_turns else (1, 1)
    return [position * steps.translation_share] * 3 + [others * steps.rotation_share] * 4 + [float(others)] * joints


def _clean(gradient: Tensor, finite: Tensor) -> Tensor:
    if finite.all():
        return gradient
    return torch.where(finite.view(-1, *[1] * (gradient.dim() - 1)), gradient, torch.zeros_like(gradient))


def plan(task: PlannerInput) -> PlannerOutput:
    """Run Grasp'D from `starts_per_grasp` starts for every requested grasp."""
    settings, target, problem = task.config.settings, task.scene.object, task.problem
    drawn = max(1, round(task.count * settings.initial.starts_per_grasp))
    if settings.initial.kind == "published":
        starts = published_starts(problem, task.scene, task.hand, drawn, task.seed, settings.initial.standoff)
        starts = task.allowed(starts)
    else:
        drawing = task.scene, task.hand, drawn, task.seed, task.device, task.dtype
        starts = draw_starts(*drawing, restrictions=task.restrictions)
    if len(starts.joints) == 0:
        return PlannerOutput(starts)
    body = make_body(target.mass, target.inertia, target.center_of_mass, target.radius, task.device, task.dtype)
    solution = minimise(Graspd2022(settings, body), problem, starts, task.hooks)
    poses = solution.poses[torch.isfinite(solution.loss)]
    inside = replace(poses, joints=poses.joints.clamp(problem.hand.lower, problem.hand.upper))
    return PlannerOutput(inside, solution.interrupted)
