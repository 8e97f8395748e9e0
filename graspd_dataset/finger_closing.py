"""Closing until contact: every finger turns at its own rate until a link of it touches, as a gripper without sensors.

A solver for the shared loop, without loss and gradients. The base stands still. Each joint travels towards the limit
beyond its closed value. A step that would let a link of a finger sink in is halved instead. At a thirty-second of a
step the joints that move that link stop, and the finger's other joints go on. Links of the hand stop links as the
object does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.hands.kinematics import place_points
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import collision_spheres
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.grasp_postures import nearest_features
from graspd_core.optimize.loop import Poses
from graspd_core.optimize.problem import HandPlacement, Problem, hand_forward

# Steps of a closing from open to closed.
CLOSE_STEPS = 60
# A finger whose step is halved to this share has arrived. Steps are full travels of the closing over `close_steps`.
_ARRIVED = 1 / 32
# Overlap of proxy spheres beyond that at the start that counts as a collision of the hand with itself [m].
_SELF_SLACK = 0.001
# Joints go past their closed value, up to this many times the travel from open to closed.
_OVERTRAVEL = 2.0


@dataclass(frozen=True)
class ClosingState:
    """A batch of closing hands.

    Attributes:
        poses: where they are.
        floor: gaps that count as contact: zero, less where a link sank in already [m].
        stride: share of a step that each joint tries next, equal for the joints of a finger.
        blamed: links that the last refused step would have let sink in.
        stopped: joints that have arrived.
    """

    poses: Poses
    floor: Float[Tensor, "batch 2 links"]
    stride: Float[Tensor, "batch joints"]
    blamed: Bool[Tensor, "batch links"]
    stopped: Bool[Tensor, "batch joints"]


@dataclass(frozen=True)
class Closing:
    """A closing until contact, from `make_closing`. Its loss is the share of joints that no contact has stopped.

    Attributes:
        rate: what each joint turns in a full step, signed, zero for unmoved ones [rad] or [m].
        target: the limits that the joints turn to [rad] or [m].
        moves: which links each joint moves.
        finger_links: links of each joint's finger.
        sphere_links: link of each proxy sphere of the problem.
        close_steps: full steps from open to closed.
    """

    rate: Float[Tensor, "joints"]
    target: Float[Tensor, "joints"]
    moves: Bool[Tensor, "joints links"]
    finger_links: Bool[Tensor, "joints links"]
    sphere_links: Int[Tensor, "spheres"]
    close_steps: int

    @property
    def steps(self) -> int:
        return round(self.close_steps * _OVERTRAVEL)

    def init(self, problem: Problem, starts: Poses) -> ClosingState:
        gaps = link_gaps(problem, starts, self.sphere_links)
        floor = gaps.clamp(max=0.0)
        floor[:, 1] -= _SELF_SLACK
        return ClosingState(
            starts,
            floor,
            torch.ones_like(starts.joints),
            torch.zeros_like(gaps[:, 0], dtype=torch.bool),
            (self.rate == 0.0).expand(starts.joints.shape),
        )

    def step(self, problem: Problem, state: ClosingState, index: int) -> ClosingState:
        if bool(state.stopped.all()):
            return state
        joints = state.poses.joints
        turned = torch.where(state.stopped, joints, joints + state.stride * self.rate)
        # Nobody closes past the limit. Minimum and maximum by the way that each joint turns.
        turned = torch.where(self.rate > 0, turned.minimum(self.target), turned.maximum(self.target))
        turned = torch.where(self.rate == 0.0, joints, turned)
        gaps = link_gaps(problem, replace(state.poses, joints=turned), self.sphere_links)
        bad = (gaps < state.floor).any(1)
        refused = self.some(bad, self.finger_links)
        in_refused = self.some(refused, self.finger_links.T)
        blamed = torch.where(in_refused, bad, state.blamed)
        # After the first refusal a finger halves its steps whether they are taken or not: a bisection.
        stride = torch.where(refused | (state.stride < 1.0), 0.5 * state.stride, state.stride)
        arrived = stride < _ARRIVED
        stopped = state.stopped | (arrived & self.some(blamed, self.moves)) | (turned == self.target)
        return replace(
            state,
            poses=replace(state.poses, joints=torch.where(refused, joints, turned)),
            stride=torch.where(arrived, 1.0, stride),
            blamed=blamed & ~self.some(arrived, self.finger_links.T),
            stopped=stopped,
        )

    def best(self, state: ClosingState) -> tuple[Poses, Float[Tensor, "batch"]]:
        return state.poses, 1.0 - state.stopped.to(state.stride).mean(-1)

    def some(self, flags: Bool[Tensor, "batch n"], of: Bool[Tensor, "m n"]) -> Bool[Tensor, "batch m"]:
        """Return whether any flag is set among those that belong to each row of `of`."""
        return flags.to(self.rate) @ of.to(self.rate).T > 0


def make_closing(problem: Problem, hand: HandModel, close_steps: int) -> Closing:
    """Build the closing of a hand in `close_steps` full steps from its open to its closed posture."""
    device = problem.hand.lower.device
    travel = hand.closed_posture - hand.open_posture
    # Joints that hardly differ between the two postures shape the hand, they do not close it.
    travel = np.where(np.abs(travel) > 0.01 * (hand.upper - hand.lower), travel, 0.0)
    moves = moved_links(hand)
    fingers = finger_of(hand)
    same = fingers[:, None] == fingers[None, :]
    return Closing(
        rate=torch.as_tensor(travel / close_steps).to(problem.hand.lower),
        target=torch.as_tensor(np.where(travel > 0, hand.upper, hand.lower)).to(problem.hand.lower),
        moves=torch.as_tensor(moves, device=device),
        finger_links=torch.as_tensor((same.astype(int) @ moves) > 0, device=device),
        sphere_links=torch.as_tensor(collision_spheres(hand)[2], device=device),
        close_steps=close_steps,
    )


def moved_links(hand: HandModel) -> Bool[np.ndarray, "joints links"]:
    """Return which links each joint moves, through couplings too."""
    moved = np.zeros((hand.num_joints, hand.num_links), dtype=bool)
    for link in range(1, hand.num_links):
        moved[:, link] = moved[:, hand.link_parent[link]]
        if hand.link_joint[link] >= 0:
            moved[hand.link_joint[link], link] = True
    return moved


def finger_of(hand: HandModel) -> Int[np.ndarray, "joints"]:
    """Return a number for each joint, equal for joints that move a link in common, directly or through others."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    moves = moved_links(hand).astype(int)
    return connected_components(csr_array(moves @ moves.T), directed=False)[1]


@torch.no_grad()
def link_gaps(problem: Problem, poses: Poses, sphere_links: Int[Tensor, "spheres"]) -> Float[Tensor, "batch 2 links"]:
    """Return the signed distance of every link to the object and to the rest of the hand (proxy spheres, at most 0)
    [m].

    Adjacent links are never near each other. A link without candidates and solids is infinitely far from all.
    """
    placed = hand_forward(problem, problem.hand.fine, poses)
    count = placed.links.translation.shape[1]
    gaps = [_least(sample_sdf(problem.object.sdf, placed.points)[0], problem.hand.fine.links, count)]
    if len(problem.object.features) and len(problem.hand.solids.link):
        gaps.append(_least(nearest_features(problem, poses)[1], problem.hand.solids.link, count))
    overlap = _least(-sphere_overlap(problem, placed), sphere_links, count)
    return torch.stack([torch.stack(gaps).amin(0), overlap], 1)


def sphere_overlap(problem: Problem, placed: HandPlacement) -> Float[Tensor, "batch spheres"]:
    """Return the greatest depth of each proxy sphere in one of a link that is not adjacent, zero where clear [m]."""
    centers = place_points(problem.hand.spheres.matrix, placed.links)
    reach = problem.hand.spheres.radii[:, None] + problem.hand.spheres.radii[None, :]
    depth = (reach - torch.cdist(centers, centers)).clamp_min(0.0) * (problem.hand.spheres.weight > 0)
    return torch.maximum(depth.amax(-1), depth.amax(-2))


def _least(values: Float[Tensor, "batch n"], links: Int[Tensor, "n"], count: int) -> Float[Tensor, "batch links"]:
    start = values.new_full((len(values), count), torch.inf)
    return start.scatter_reduce(1, links.expand(len(values), -1), values, "amin")
