"""Close a hand until contact: each finger closes until one of its links touches the object or another link.

`Closing` is a solver for `optimize/loop.py`, without gradients. The base does not move. Each joint moves at its own
rate towards the limit beyond its closed value. A step that would push a link into something is refused and halved.
Below 1/32 of a step, the joints that move the blocked link stop. The finger's other joints continue.
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

# Default number of full steps from open to closed.
CLOSE_STEPS = 60
# A finger has arrived when its steps are below this fraction of a full step (closing travel / `close_steps`).
_ARRIVED = 1 / 32
# The hand collides with itself if proxy spheres overlap by this much more than before the closing [m].
_SELF_SLACK = 0.001
# Joints may pass their closed value. They travel at most this multiple of the way from open to closed.
_OVERTRAVEL = 2.0


@dataclass(frozen=True)
class ClosingState:
    """A batch of closing hands.

    Attributes:
        poses: current poses of the hands, in the object frame.
        floor: smallest allowed gap of each link, to the object and to other links [m]. Negative for a link that
            overlaps before closing, because it may keep the overlap.
        stride: fraction of a full step that each joint tries next, equal for the joints of a finger.
        blamed: links whose gap would have been below `floor` in the last refused step of their finger.
        stopped: joints that do not move any more, or never moved.
    """

    poses: Poses
    floor: Float[Tensor, "batch 2 links"]
    stride: Float[Tensor, "batch joints"]
    blamed: Bool[Tensor, "batch links"]
    stopped: Bool[Tensor, "batch joints"]


@dataclass(frozen=True)
class Closing:
    """Solver that closes hands until contact (`make_closing`). Its loss is the fraction of joints that still move.

    Attributes:
        rate: signed travel of each joint in a full step [rad] or [m]. Zero for joints that do not close.
        target: the limit that each joint moves to [rad] or [m].
        moves: whether each joint moves each link.
        finger_links: whether each link belongs to the finger of each joint.
        sphere_links: link index of each proxy sphere. Proxy spheres fill the hand for the self-collision check.
        close_steps: number of full steps from open to closed.
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
        # No joint passes its limit. The sign of its rate decides whether the limit is a maximum or a minimum.
        turned = torch.where(self.rate > 0, turned.minimum(self.target), turned.maximum(self.target))
        turned = torch.where(self.rate == 0.0, joints, turned)
        gaps = link_gaps(problem, replace(state.poses, joints=turned), self.sphere_links)
        bad = (gaps < state.floor).any(1)
        refused = self.some(bad, self.finger_links)
        in_refused = self.some(refused, self.finger_links.T)
        blamed = torch.where(in_refused, bad, state.blamed)
        # After its first refused step, a finger halves every step, accepted or not. This is a bisection.
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
        """Return, for each row of `of`, whether any flag is set where the row is true."""
        return flags.to(self.rate) @ of.to(self.rate).T > 0


def make_closing(problem: Problem, hand: HandModel, close_steps: int) -> Closing:
    """Build the solver. A joint goes from its open to its closed value in `close_steps` full steps."""
    device = problem.hand.lower.device
    travel = hand.closed_posture - hand.open_posture
    # A joint with nearly equal values in both postures shapes the hand and does not close it.
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
    """Return a table: whether each actuated joint moves each link, directly or through coupled joints."""
    moved = np.zeros((hand.num_joints, hand.num_links), dtype=bool)
    for link in range(1, hand.num_links):
        moved[:, link] = moved[:, hand.link_parent[link]]
        if hand.link_joint[link] >= 0:
            moved[hand.link_joint[link], link] = True
    return moved


def finger_of(hand: HandModel) -> Int[np.ndarray, "joints"]:
    """Return each joint's finger index. Joints that move a common link are connected. Connected joints are a finger."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    moves = moved_links(hand).astype(int)
    return connected_components(csr_array(moves @ moves.T), directed=False)[1]


@torch.no_grad()
def link_gaps(problem: Problem, poses: Poses, sphere_links: Int[Tensor, "spheres"]) -> Float[Tensor, "batch 2 links"]:
    """Return two gaps of every link [m]: first its signed distance to the object, second its gap to other links.

    The second gap is minus the greatest overlap of proxy spheres, so it is never positive. Adjacent links do not
    count. The first gap is infinite if the link has neither contact candidates nor collision shapes. The second is
    infinite if the link has no proxy spheres.
    """
    placed = hand_forward(problem, problem.hand.fine, poses)
    count = placed.links.translation.shape[1]
    gaps = [_least(sample_sdf(problem.object.sdf, placed.points)[0], problem.hand.fine.links, count)]
    if len(problem.object.features) and len(problem.hand.solids.link):
        gaps.append(_least(nearest_features(problem, poses)[1], problem.hand.solids.link, count))
    overlap = _least(-sphere_overlap(problem, placed), sphere_links, count)
    return torch.stack([torch.stack(gaps).amin(0), overlap], 1)


def sphere_overlap(problem: Problem, placed: HandPlacement) -> Float[Tensor, "batch spheres"]:
    """Return each proxy sphere's greatest overlap with spheres of links that are not adjacent [m]. Zero if none."""
    centers = place_points(problem.hand.spheres.matrix, placed.links)
    reach = problem.hand.spheres.radii[:, None] + problem.hand.spheres.radii[None, :]
    depth = (reach - torch.cdist(centers, centers)).clamp_min(0.0) * (problem.hand.spheres.weight > 0)
    return torch.maximum(depth.amax(-1), depth.amax(-2))


def _least(values: Float[Tensor, "batch n"], links: Int[Tensor, "n"], count: int) -> Float[Tensor, "batch links"]:
    start = values.new_full((len(values), count), torch.inf)
    return start.scatter_reduce(1, links.expand(len(values), -1), values, "amin")
