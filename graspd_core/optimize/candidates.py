"""Find candidates: draw starts, minimise by a method, make the three postures, rank. No trial is run here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import deepest_overlap
from graspd_core.optimize.grasp_postures import (
    approach_depth,
    find_contacts,
    find_pregrasp,
    self_overlap,
    settle,
    squeeze,
)
from graspd_core.optimize.loop import Hooks, Poses
from graspd_core.optimize.obstacle_distance import gap_on_the_way
from graspd_core.optimize.plan_config import PlanConfig, method_row
from graspd_core.optimize.problem import Problem, build_problem
from graspd_core.optimize.ranking import Staged, score
from graspd_core.optimize.restrictions import UNRESTRICTED, BoundRestrictions
from graspd_core.perception.scene import Scene
from graspd_core.types import Contact, Grasp, Posture

# A candidate that reaches deeper than this into the support or a neighbour is dropped [m].
_DEEPEST = 0.0015
# Poses made into grasps at once. Each takes a megabyte on the way.
_AT_ONCE = 128
# Cost of a candidate that would sweep through the object on its way from the retreat: it is tried after all others.
_KNOCK_COST = 100.0
# A score that no candidate has.
_WORST = -1e3
# Share of the grasps asked for that the ranking expects to hold, below which a method searches again, and how far apart
# the seeds of two searches are: not those of two rounds.
_LEAST_EXPECTED, _SEED_STEP = 0.9, 15_485_863


@dataclass(frozen=True)
class PlannerInput:
    """What a method is asked for: `count` grasps of the scene's object. `seed` is that of everything that is drawn."""

    scene: Scene
    hand: HandModel
    count: int
    seed: int
    config: PlanConfig
    hooks: Hooks
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    restrictions: BoundRestrictions = UNRESTRICTED

    @cached_property
    def problem(self) -> Problem:
        """Scene and hand as tensors. Every method's poses are made into grasps and ranked in this problem."""
        scene = self.restrictions.searched(self.scene)
        return build_problem(
            scene, self.hand, self.config.problem, seed=self.seed, device=self.device, dtype=self.dtype
        )

    def allowed(self, starts: Poses) -> Poses:
        """Return the initial poses that the restrictions allow, for a method that draws its own."""
        if not self.restrictions.each:
            return starts
        turns = starts.quaternion / starts.quaternion.norm(dim=-1, keepdim=True)
        given = (values.double().cpu().numpy() for values in (starts.translation, turns, starts.joints))
        return starts[torch.as_tensor(self.restrictions.starts(*given), device=starts.joints.device)]


@dataclass(frozen=True)
class PlannerOutput:
    """What a method ended with.

    Attributes:
        poses: hand poses that the method found, at most a few times as many as asked for, in any order.
        interrupted: why it ended early: "", "cancelled" or "deadline".
    """

    poses: Poses
    interrupted: str = ""


@dataclass(frozen=True)
class Candidates:
    """Untried grasps, best first, and how the optimiser ended: "", "cancelled" or "deadline"."""

    grasps: tuple[Grasp, ...]
    interrupted: str


def find_candidates(task: PlannerInput) -> Candidates:
    """Return ranked candidates by the method of the task's settings. There are fewer if starts were hopeless.

    The search is repeated from as many other starts if the ranking expects too few grasps to hold: small, large and
    long objects gain by that. Restrictions shape only the starts. Their caller refuses candidates.
    """
    config, count = task.config, task.count
    found = _searched(task)
    for again in range(1, method_row(config.method).searches(config.settings)):
        if found.interrupted or expected_to_hold(found.grasps[:count]) >= _LEAST_EXPECTED * count:
            break
        more = _searched(replace(task, seed=task.seed + _SEED_STEP * again))
        found = Candidates(_best_first((*found.grasps, *more.grasps)), more.interrupted)
    return found


def expected_to_hold(grasps: Sequence[Grasp]) -> float:
    """Return how many of the grasps the ranking expects to pass the hold trial."""
    return sum((0.5 + 0.5 * math.tanh(0.5 * grasp.score) for grasp in grasps), 0.0)


def _searched(task: PlannerInput) -> Candidates:
    found = method_row(task.config.method).plan(task)
    if found.interrupted == "cancelled" or len(found.poses.translation) == 0:
        return Candidates((), found.interrupted)
    return Candidates(assemble(task.problem, task.hand, found.poses, task.config, task.hooks.stop), found.interrupted)


def _best_first(grasps: Iterable[Grasp]) -> tuple[Grasp, ...]:
    return tuple(sorted(grasps, key=lambda grasp: grasp.score, reverse=True))


def assemble(
    problem: Problem, hand: HandModel, poses: Poses, config: PlanConfig, stop: Callable[[], bool] = lambda: False
) -> tuple[Grasp, ...]:
    """Return grasps with three postures and a score, best first.

    Poses without a balanced squeeze are dropped, and poses that reach through an obstacle on their way or at its end.
    Poses whose fingers press deep into the object are kept: some methods press deep and their grasps hold.
    """
    grasps: list[Grasp] = []
    device, total = poses.translation.device, len(poses.translation)
    # An accelerator takes as long for one as for all of them.
    at_once = _AT_ONCE if device.type == "cpu" else max(total, 1)
    for first in range(0, total, at_once):
        rows = torch.arange(first, min(first + at_once, total), device=device)
        some = staged(problem, hand, poses[rows], config, stop)
        grasps += [grasp for grasp in finished(problem, hand, some) if grasp.score > _WORST]
    return _best_first(grasps)


def finished(problem: Problem, hand: HandModel, some: Staged) -> list[Grasp]:
    """Return the grasps of staged poses with their scores, in the same order."""
    scores = score(problem, some)
    if problem.obstacles is not None:
        depth = -gap_on_the_way(problem.obstacles, problem.hand.kinematics, some.opened, some.poses)
        knocks = approach_depth(problem, problem.obstacles, some.opened) > _DEEPEST
        scores = torch.where(depth > _DEEPEST, -torch.inf, scores - torch.where(knocks, _KNOCK_COST, 0.0))
    return _grasps(hand, some, scores)


def staged(
    problem: Problem, hand: HandModel, poses: Poses, config: PlanConfig, stop: Callable[[], bool] = lambda: False
) -> Staged:
    """Compute contacts, squeeze and pregrasp of every pose. The caller bounds the batch by its memory."""
    poses = settle(problem, poses, stop)
    contact_set = find_contacts(problem, poses, config.grasp_stages.touch_reach)
    effort = torch.as_tensor(hand.effort).to(problem.hand.lower)
    pressed = squeeze(problem, poses, contact_set, effort, config.grasp_stages)
    opened, clearance = find_pregrasp(problem, poses, config.grasp_stages, stop)
    overlap = torch.maximum(*(self_overlap(problem, at.joints) for at in (poses, opened)))
    if problem.hand.has_hulls:
        depths = [deepest_overlap(hand, at.joints.double().cpu().numpy()) for at in (poses, opened)]
        overlap = torch.maximum(overlap, torch.as_tensor(np.maximum(*depths)).to(overlap))
    return Staged(poses, opened, clearance, contact_set, pressed, overlap)


def _grasps(hand: HandModel, some: Staged, scores: Tensor) -> list[Grasp]:
    poses, opened, found = some.poses, some.opened, some.contact_set
    quaternion = _numbers(poses.quaternion / poses.quaternion.norm(dim=-1, keepdim=True))
    active, distance = found.active.cpu().numpy(), found.distance.abs().cpu().numpy()
    link, position, normal = found.link.tolist(), _numbers(found.position), _numbers(found.normal)
    places = [_numbers(x) for x in (opened.translation, poses.translation)]
    # Rounding to float32 and back may step over a limit by an ulp.
    joints = [np.clip(_numbers(x), hand.lower, hand.upper) for x in (opened.joints, poses.joints, some.pressed.joints)]
    grasps = []
    for row, odds in enumerate(scores.tolist()):
        # One contact a link: of its active slots, the one nearest to the surface.
        slots = np.flatnonzero(active[row])
        nearest = {link[slot]: slot for slot in slots[np.argsort(-distance[row, slots], kind="stable")]}
        contacts = tuple(
            Contact(hand.link_names[of], tuple(position[row, slot].tolist()), tuple(normal[row, slot].tolist()))
            for of, slot in sorted(nearest.items())
        )
        pregrasp, grasp, squeezed = (
            Posture(place[row].copy(), quaternion[row].copy(), values[row].copy())
            for place, values in zip((places[0], places[1], places[1]), joints, strict=True)
        )
        grasps.append(Grasp(pregrasp=pregrasp, grasp=grasp, squeeze=squeezed, contacts=contacts, score=odds))
    return grasps


def _numbers(values: Tensor) -> np.ndarray:
    return values.double().cpu().numpy()
