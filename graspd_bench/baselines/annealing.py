"""Planner like GraspIt!'s eigengrasp planner (Ciocarlie and Allen, IJRR 2009): annealing, then closing of the fingers.

Eigengrasps are the principal components of human hand postures. No recordings of postures exist for an arbitrary hand.
Here seeded random postures between open and closed replace the recordings. In each posture, the fingers are closed to
similar degrees. The first component closes the hand. The next components are differences between fingers.

A chain steps from one hand state to the next. A state is the base pose and the amplitudes of a few eigengrasps.
GraspIt!'s energy of a state is a mean over contact locations i on the inside of the hand:

    E = mean_i |d_i| + α (1 − n_i · o_i)        α = 50 mm, n_i: outward normal of the hand

d_i and o_i are distance and unit direction from location i to the object. States in which the hand collides are
rejected. An increase ΔE is accepted with probability exp(−ΔE / (T · 10⁶ mm)). As in GraspIt!, T is 10⁶ exp(−7 k^⅛), k
from 30,000 to 100,000. Steps have Ingber's distribution (1989). The fingers of the best states close until contact. The
grasps with the largest ε are kept. ε is Ferrari and Canny's measure for forces that sum to one. Here it uses sampled
wrenches, not the faces of the wrench hull, so it is an upper bound. All chains are one batch, without gradients.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.hands.kinematics import in_base, link_poses, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import collision_spheres
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.sharp_features import farthest_first
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput
from graspd_core.optimize.grasp_postures import ContactSet, find_contacts
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Hooks, Poses, minimise
from graspd_core.optimize.losses import disturbance_directions, wrench_support
from graspd_core.optimize.obstacle_distance import obstacle_gaps
from graspd_core.optimize.plan_config import Method
from graspd_core.optimize.problem import HandPlacement, Problem, hand_forward
from graspd_dataset.finger_closing import finger_of, link_gaps, make_closing, sphere_overlap


@dataclass(frozen=True)
class AnnealingConfig:
    """Settings of simulated annealing in a low-dimensional space of hand postures, as in GraspIt!.

    Attributes:
        chains_per_grasp: number of chains for each requested grasp. Each chain gives at most one grasp.
        keep_per_grasp: number of grasps, those with the largest ε, that are kept for each requested grasp.
        steps: number of states that each chain tries.
        eigengrasps: number of eigengrasps, the dimension of the posture space.
        contacts_per_link: number of contact locations on the inside of each link.
        normal_weight: weight α of a location's orientation in the energy [m].
        translation_jump: largest translation of the base along each axis in one step [m].
        rotation_jump: largest rotation of the base about each axis of the object frame in one step [rad].
        posture_jump: largest change of an amplitude in one step, as a fraction of the amplitude's range.
        close_steps: number of steps in which the fingers close after the annealing.
        directions: number of sampled wrenches over which ε is computed.
    """

    chains_per_grasp: float = 4.0
    keep_per_grasp: float = 2.0
    steps: int = 2500
    eigengrasps: int = 2
    contacts_per_link: int = 2
    normal_weight: float = 0.05
    translation_jump: float = 0.1
    rotation_jump: float = 0.63
    posture_jump: float = 0.25
    close_steps: int = 60
    directions: int = 256


# Number of random postures. Each has one closing of the hand, from 0 (open) to 1 (closed). A finger deviates from it by
# up to `_FINGER_SPREAD`. A joint deviates from its finger by up to `_JOINT_SPREAD` of the joint range.
_POSTURES, _FINGER_SPREAD, _JOINT_SPREAD = 512, 0.3, 0.05
# A contact candidate is on the inside if the cosine between its normal and its closing motion is at least `_FACING`. If
# all cosines of a group are smaller, the greatest is on the inside, unless it is below `_LEAST_FACING`.
_FACING, _LEAST_FACING = 0.85, 0.5


@dataclass(frozen=True, eq=False)
class PostureSpace:
    """Space of postures `center + amplitudes @ basis`, clamped to the joint limits.

    Attributes:
        center: mean of the random postures [rad] or [m].
        basis: the eigengrasps [rad] or [m]. The rows are orthonormal in units of the joint ranges.
        low, high: range of each amplitude over the random postures.
    """

    center: Float[np.ndarray, "joints"]
    basis: Float[np.ndarray, "dimensions joints"]
    low: Float[np.ndarray, "dimensions"]
    high: Float[np.ndarray, "dimensions"]


def posture_space(hand: HandModel, dimensions: int, seed: int) -> PostureSpace:
    """Return the space of `dimensions` principal components of random postures, or of all if there are fewer."""
    rng = np.random.default_rng(seed)
    fingers = finger_of(hand)
    span = hand.upper - hand.lower
    common = rng.uniform(0.0, 1.0, (_POSTURES, 1))
    share = common + _FINGER_SPREAD * rng.uniform(-1.0, 1.0, (_POSTURES, int(fingers.max()) + 1))[:, fingers]
    postures = hand.open_posture + share * (hand.closed_posture - hand.open_posture)
    postures += _JOINT_SPREAD * span * rng.uniform(-1.0, 1.0, postures.shape)
    postures = np.clip(postures, hand.lower, hand.upper)
    center = postures.mean(0)
    # Each joint is scaled by its range, so that metres and radians weigh alike.
    scaled = (postures - center) / span
    values, rows = np.linalg.svd(scaled, full_matrices=False)[1:]
    rows = rows[: min(dimensions, int((values > 1e-9 * values[0]).sum()))]
    # The sign of a component is arbitrary. Here a positive amplitude closes the hand.
    sign = np.where(rows @ ((hand.closed_posture - hand.open_posture) / span) < 0, -1.0, 1.0)
    rows = rows * sign[:, None]
    amplitudes = scaled @ rows.T
    return PostureSpace(center, rows * span, amplitudes.min(0), amplitudes.max(0))


def inner_contacts(hand: HandModel, per_link: int) -> Int[np.ndarray, "contacts"]:
    """Choose up to `per_link` contact candidates on the inside of each rigid group of links. Return their indices.

    Fixed joints connect the links of a group. The inside is the side towards the palm's normal or a finger's closing
    motion. First choose the candidate nearest to the inside's middle, then repeatedly the one farthest from all chosen.
    """
    chosen: list[int] = []
    facing = _facing(hand)
    group = hand.link_group[hand.candidate_link]
    position = in_base(link_poses(hand, hand.open_posture), hand.candidate_points, hand.candidate_link)
    for number in np.unique(group):
        most = float(facing[group == number].max())
        if most < _LEAST_FACING:
            continue
        inside = np.flatnonzero((group == number) & (facing >= min(most, _FACING)))
        middle = hand.palm_center if number == hand.link_group[0] else position[inside].mean(0)
        points = position[inside]

        def distances(index: int, points: np.ndarray = points) -> np.ndarray:
            return np.linalg.norm(points - points[index], axis=-1)

        first = int(np.linalg.norm(points - middle, axis=1).argmin())
        chosen += inside[farthest_first(len(inside), per_link, [first], distances)].tolist()
    return np.array(chosen, dtype=np.int64)


def _facing(hand: HandModel) -> Float[np.ndarray, "candidates"]:
    """Return the cosine between each candidate's normal and its closing motion, or on the palm, the palm's normal."""
    links = hand.candidate_link
    early, late = (
        link_poses(hand, hand.open_posture + share * (hand.closed_posture - hand.open_posture)) for share in (0.4, 0.6)
    )
    before, after = (in_base(frames, hand.candidate_points, links) for frames in (early, late))
    motion = after - before
    length = np.linalg.norm(motion, axis=1)
    still = length < 1e-6
    motion = np.where(still[:, None], hand.palm_normal, motion / np.maximum(length, 1e-6)[:, None])
    normals = np.einsum("pij,pj->pi", early[0][links], hand.candidate_normals)
    # Links that stand still have no inside, except the palm.
    idle = still & (hand.link_group[links] != hand.link_group[0])
    return np.where(idle, 0.0, (normals * motion).sum(1))


# GraspIt!'s default temperatures: T₀ exp(−rate · k^(1 / dimensions)), where step k runs from `_FIRST` to `_LAST`.
_T0, _COOLING, _DIMENSIONS, _FIRST, _LAST = 1e6, 7.0, 8, 30_000, 100_000
# An energy increase ΔE [m] is accepted with probability exp(−ΔE / (`_ENERGY_SCALE` · T)).
_ENERGY_SCALE = 1e3
# The spheres that stand for the hand's shape may overlap by this much more than in the open hand [m].
_SELF_SLACK = 0.002
_FEWEST_CHAINS, _FEWEST_KEPT = 16, 8


@dataclass(frozen=True)
class ChainState:
    """Current and best states of a batch of chains.

    Attributes:
        x: current states: base translation [m], base quaternion (wxyz), amplitudes of the eigengrasps.
        energy: energies of the current states [m]. Infinite for a state in collision.
        best_x, best_energy: state of least energy so far in each chain, and its energy [m].
    """

    x: Float[Tensor, "batch variables"]
    energy: Float[Tensor, "batch"]
    best_x: Float[Tensor, "batch variables"]
    best_energy: Float[Tensor, "batch"]


@dataclass(frozen=True)
class Annealing:
    """Simulated annealing as a solver for `minimise`, the loop that all methods share. `make_annealing` builds it.

    Attributes:
        config: settings.
        seed: random seed of the jumps.
        center, basis, low, high: fields of the `PostureSpace`.
        lower, upper: joint limits [rad] or [m].
        contacts: matrix of the contact locations for `hands.kinematics.place_points`.
        normals: matrix of the outward normals at the contact locations, also for `place_points`.
        sphere_links: link index of each sphere that stands for a part of the hand in self-collision tests.
        self_overlap: allowed overlap of two such spheres [m].
    """

    config: AnnealingConfig
    seed: int
    center: Float[Tensor, "joints"]
    basis: Float[Tensor, "dimensions joints"]
    low: Float[Tensor, "dimensions"]
    high: Float[Tensor, "dimensions"]
    lower: Float[Tensor, "joints"]
    upper: Float[Tensor, "joints"]
    contacts: Float[Tensor, "contacts columns"]
    normals: Float[Tensor, "contacts columns"]
    sphere_links: Int[Tensor, "spheres"]
    self_overlap: float

    @property
    def steps(self) -> int:
        return self.config.steps

    def init(self, problem: Problem, starts: Poses) -> ChainState:
        # The amplitudes are the least-squares fit to the start's joints, which are those of the open hand.
        amplitudes = (starts.joints - self.center) @ torch.linalg.pinv(self.basis)
        x = torch.cat([starts.translation, starts.quaternion, amplitudes.clamp(self.low, self.high)], -1)
        energy = self.energy(problem, x)
        return ChainState(x, energy, x, energy)

    def step(self, problem: Problem, state: ChainState, index: int) -> ChainState:
        temperature = cooling(index / max(self.steps, 1))
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + index) % 2**63)
        drawn = torch.rand(len(state.x), 7 + len(self.low), generator=generator).to(state.x)
        tried = self.neighbour(state.x, jump(drawn[:, 1:], temperature))
        energy = self.energy(problem, tried)
        # If the current state collides, every collision-free state is accepted.
        rise = torch.where(torch.isfinite(state.energy), energy - state.energy, torch.where(energy < 1e3, -1.0, 1.0))
        taken = drawn[:, 0] < (-rise / (_ENERGY_SCALE * temperature)).exp()
        # The expensive test comes last, for the few states that would be accepted.
        taken = taken.masked_scatter(taken, ~self.pierced(problem, tried[taken]))
        better = taken & (energy < state.best_energy)
        return ChainState(
            torch.where(taken[:, None], tried, state.x),
            torch.where(taken, energy, state.energy),
            torch.where(better[:, None], tried, state.best_x),
            torch.where(better, energy, state.best_energy),
        )

    def best(self, state: ChainState) -> tuple[Poses, Float[Tensor, "batch"]]:
        return self.poses(state.best_x), state.best_energy

    def poses(self, x: Float[Tensor, "batch variables"]) -> Poses:
        return Poses(x[:, :3], x[:, 3:7], (self.center + x[:, 7:] @ self.basis).clamp(self.lower, self.upper))

    def neighbour(
        self, x: Float[Tensor, "batch variables"], jumps: Float[Tensor, "batch jumps"]
    ) -> Float[Tensor, "batch variables"]:
        """Return the states after a jump. `jumps` are -1 to 1: 3 for translation, 3 for rotation, then amplitudes."""
        config = self.config
        translation = x[:, :3] + config.translation_jump * jumps[:, :3]
        half = 0.5 * config.rotation_jump * jumps[:, 3:6]
        turned = quaternion_product(torch.cat([torch.ones_like(half[:, :1]), half], -1), x[:, 3:7])
        amplitudes = x[:, 7:] + config.posture_jump * (self.high - self.low) * jumps[:, 6:]
        quaternion = turned / turned.norm(dim=-1, keepdim=True)
        return torch.cat([translation, quaternion, amplitudes.clamp(self.low, self.high)], -1)

    @torch.no_grad()
    def energy(self, problem: Problem, x: Float[Tensor, "batch variables"]) -> Float[Tensor, "batch"]:
        """Return GraspIt!'s contact energy [m]. It is infinite if the hand hits the object, an obstacle or itself."""
        poses = self.poses(x)
        placed = hand_forward(problem, problem.hand.coarse, poses)
        points = placed.base.apply(place_points(self.contacts, placed.links))
        outward = place_points(self.normals, placed.links) @ placed.base.rotation.transpose(-1, -2)
        distance, normal = sample_sdf(problem.object.sdf, torch.cat([placed.points, points], 1))
        count = len(self.contacts)
        away = 1.0 + (outward * normal[:, -count:]).sum(-1)
        energy = (distance[:, -count:].abs() + self.config.normal_weight * away).mean(-1)
        legal = (distance.amin(-1) >= 0.0) & self.clear(problem, placed)
        return torch.where(legal & torch.isfinite(energy), energy, torch.inf)

    def clear(self, problem: Problem, placed: HandPlacement) -> Bool[Tensor, "batch"]:
        """Return for each state whether the hand hits neither itself nor obstacles."""
        clear = sphere_overlap(problem, placed).amax(-1) <= self.self_overlap
        if problem.obstacles is None:
            return clear
        return clear & (obstacle_gaps(problem.obstacles, placed.base, placed.links).amin(-1) >= 0.0)

    @torch.no_grad()
    def pierced(self, problem: Problem, x: Float[Tensor, "batch variables"]) -> Bool[Tensor, "batch"]:
        """Return whether each state's hand overlaps the object, by contact candidates and the object's sharp points."""
        if len(x) == 0:
            return torch.zeros(0, dtype=torch.bool, device=x.device)
        return link_gaps(problem, self.poses(x), self.sphere_links)[:, 0].amin(-1) < 0.0


def make_annealing(problem: Problem, hand: HandModel, config: AnnealingConfig, seed: int) -> Annealing:
    """Build the annealing solver of one hand and one object."""

    def tensor(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values).to(problem.hand.lower)

    space = posture_space(hand, config.eigengrasps, seed)
    chosen = inner_contacts(hand, config.contacts_per_link)
    links = torch.as_tensor(hand.candidate_link[chosen]).to(problem.hand.coarse.links)
    points, normals = tensor(hand.candidate_points[chosen]), tensor(hand.candidate_normals[chosen])
    stands = Poses(
        problem.object.center[None], torch.eye(4).to(problem.hand.lower)[:1], tensor(hand.open_posture)[None]
    )
    opened = hand_forward(problem, problem.hand.coarse, stands)
    return Annealing(
        config=config,
        seed=seed,
        center=tensor(space.center),
        basis=tensor(space.basis),
        low=tensor(space.low),
        high=tensor(space.high),
        lower=problem.hand.lower,
        upper=problem.hand.upper,
        contacts=placement(hand.num_links, points, links),
        normals=placement(hand.num_links, normals, links, directions=True),
        sphere_links=torch.as_tensor(collision_spheres(hand)[2]).to(links),
        self_overlap=_SELF_SLACK + float(sphere_overlap(problem, opened).max()),
    )


def cooling(progress: float) -> float:
    """Return the temperature of GraspIt!'s default schedule. `progress` is the fraction of steps done, from 0 to 1."""
    k = _FIRST + progress * (_LAST - _FIRST)
    return _T0 * math.exp(-_COOLING * k ** (1 / _DIMENSIONS))


def jump(uniform: Float[Tensor, "*batch"], temperature: float) -> Float[Tensor, "*batch"]:
    """Map uniform numbers in [0, 1) to jumps in [-1, 1] by Ingber's distribution, smaller at low temperature."""
    side = 2 * uniform - 1
    return side.sign() * temperature * ((1 + 1 / temperature) ** side.abs() - 1)


def quaternion_product(a: Float[Tensor, "batch 4"], b: Float[Tensor, "batch 4"]) -> Float[Tensor, "batch 4"]:
    """Return the Hamilton product a b (wxyz), which rotates by b first and then by a."""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(-1, keepdim=True)
    v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])
    return torch.cat([w, v], -1)


def sampled_epsilon(
    problem: Problem, contact_set: ContactSet, directions: Float[Tensor, "directions 6"]
) -> Float[Tensor, "batch"]:
    """Return Ferrari and Canny's ε of each grasp, for contact forces that sum to one.

    For each direction, take the support: the most that any contact contributes. ε is the least support of all
    directions, and zero without force closure. Few directions are tested, so the result is an upper bound.
    """
    batch, slots = contact_set.active.shape
    support = wrench_support(
        ((contact_set.position - problem.object.center) / problem.object.length).reshape(-1, 1, 3),
        contact_set.normal.reshape(-1, 1, 3),
        contact_set.active.to(problem.hand.lower).reshape(-1, 1),
        directions,
        problem.friction,
    )
    return support.reshape(batch, slots, -1).amax(1).amin(-1)


def plan(task: PlannerInput) -> PlannerOutput:
    """Anneal a batch of hand states, close the fingers of each best state, and return the grasps with the largest ε.

    If a deadline ends the annealing, close the fingers of the best states found so far.
    """
    settings, hooks = task.config.settings, task.hooks
    problem = task.problem
    annealing = make_annealing(problem, task.hand, settings, task.seed)
    count, restrictions = max(_FEWEST_CHAINS, round(task.count * settings.chains_per_grasp)), task.restrictions
    starts = draw_starts(task.scene, task.hand, count, task.seed, task.device, task.dtype, restrictions=restrictions)
    if len(starts.joints) == 0:
        return PlannerOutput(starts)
    annealed = minimise(annealing, problem, starts, hooks)
    legal = torch.nonzero(torch.isfinite(annealed.loss)).flatten()
    if annealed.interrupted == "cancelled" or len(legal) == 0:
        return PlannerOutput(annealed.poses[legal], annealed.interrupted)
    # States are closed even after a deadline, because hands with open fingers are not grasps.
    closing = make_closing(problem, task.hand, settings.close_steps)
    closed = minimise(closing, problem, annealed.poses[legal], Hooks(stop=hooks.stop))
    contact_set = find_contacts(problem, closed.poses, task.config.grasp_stages.touch_reach)
    directions = disturbance_directions(settings.directions, task.seed).to(problem.hand.lower)
    epsilon = sampled_epsilon(problem, contact_set, directions)
    kept = min(len(epsilon), max(_FEWEST_KEPT, round(task.count * settings.keep_per_grasp)))
    return PlannerOutput(closed.poses[epsilon.topk(kept).indices], annealed.interrupted or closed.interrupted)


METHOD = Method(__name__, AnnealingConfig, "annealing", "#009E73", "^", 8)
