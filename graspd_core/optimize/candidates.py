"""Find grasp candidates, before any trial: draw initial poses (starts), optimise, compute postures and rank."""

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
    by_link,
    find_contacts,
    find_pregrasp,
    self_overlap,
    settle,
    squeeze,
)
from graspd_core.optimize.loop import Hooks, Poses, pack
from graspd_core.optimize.obstacle_distance import gap_on_path
from graspd_core.optimize.plan_config import PlanConfig, method_row
from graspd_core.optimize.problem import Problem, build_problem
from graspd_core.optimize.ranking import Staged, score
from graspd_core.optimize.restrictions import UNRESTRICTED, BoundRestrictions
from graspd_core.perception.scene import Scene
from graspd_core.types import Contact, Grasp, Posture

# A candidate that penetrates the support or a neighbouring object deeper than this is dropped [m].
_DEEPEST = 0.0015
# Poses per batch in `assemble` on the CPU. Each pose needs about a megabyte of memory.
_AT_ONCE = 128
# Subtracted from the score if the hand hits the object between retreat and pregrasp. Such grasps are tried last.
_KNOCK_COST = 100.0
# Every usable candidate scores above this. A dropped candidate has a score of −inf.
_WORST = -1e3
# The search is repeated if the scores predict that less than this share of the requested grasps holds.
# The seed step between searches differs from that between rounds, so that no seed is used twice.
_LEAST_EXPECTED, _SEED_STEP = 0.9, 15_485_863


@dataclass(frozen=True)
class PlannerInput:
    """A request to a method: find `count` grasps of the scene's object. `seed` fixes every random draw."""

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
        """Scene and hand as tensors. Every method uses them to compute its postures and to rank its grasps."""
        scene = self.restrictions.searched(self.scene)
        return build_problem(
            scene, self.hand, self.config.problem, seed=self.seed, device=self.device, dtype=self.dtype
        )

    def allowed(self, starts: Poses) -> Poses:
        """Return the initial poses that the restrictions allow, for methods that draw their own initial poses."""
        if not self.restrictions.each:
            return starts
        turns = starts.quaternion / starts.quaternion.norm(dim=-1, keepdim=True)
        given = (values.double().cpu().numpy() for values in (starts.translation, turns, starts.joints))
        return starts[torch.as_tensor(self.restrictions.starts(*given), device=starts.joints.device)]


@dataclass(frozen=True)
class PlannerOutput:
    """The result of a method.

    Attributes:
        poses: hand poses in any order, at most a few times the requested count.
        interrupted: why the method ended early: "cancelled" or "deadline". Empty for a full run.
    """

    poses: Poses
    interrupted: str = ""


def find_candidates(task: PlannerInput, *, searches: int | None = None) -> tuple[Grasp, ...]:
    """Run the configured method and return its candidates, best first, perhaps fewer than `task.count`.

    If too few candidates are expected to pass the hold trial, the search is repeated from new starts. This helps on
    small, large and long objects. `searches` limits the number of searches. By default the method's settings limit it.
    This function restricts only the starts. The caller must check the candidates against the restrictions.
    """
    config, count = task.config, task.count
    found, interrupted = _searched(task)
    for again in range(1, searches or method_row(config.method).searches(config.settings)):
        if interrupted or expected_to_hold(found[:count]) >= _LEAST_EXPECTED * count:
            break
        more, interrupted = _searched(replace(task, seed=task.seed + _SEED_STEP * again))
        found = _best_first((*found, *more))
    return found


def expected_to_hold(grasps: Sequence[Grasp]) -> float:
    """Return the expected number of grasps that pass the hold trial, from their scores (log-odds)."""
    return sum((0.5 + 0.5 * math.tanh(0.5 * grasp.score) for grasp in grasps), 0.0)


def _searched(task: PlannerInput) -> tuple[tuple[Grasp, ...], str]:
    found = method_row(task.config.method).plan(task)
    # One pose that is not finite would end the whole run.
    poses = found.poses[pack(found.poses).isfinite().all(-1) & (found.poses.quaternion.norm(dim=-1) > 0)]
    if found.interrupted == "cancelled" or len(poses.translation) == 0:
        return (), found.interrupted
    return assemble(task.problem, task.hand, poses, task.config, task.hooks.stop), found.interrupted


def _best_first(grasps: Iterable[Grasp]) -> tuple[Grasp, ...]:
    return tuple(sorted(grasps, key=lambda grasp: grasp.score, reverse=True))


def assemble(
    problem: Problem, hand: HandModel, poses: Poses, config: PlanConfig, stop: Callable[[], bool] = lambda: False
) -> tuple[Grasp, ...]:
    """Turn poses into scored grasps with pregrasp, grasp and squeeze posture. Return the grasps, best first.

    Poses that penetrate an obstacle at the grasp or on the approach path are dropped. Poses whose fingers penetrate the
    object deeply are kept, because some methods produce such poses and their grasps hold.
    """
    grasps: list[Grasp] = []
    device, total = poses.translation.device, len(poses.translation)
    # On an accelerator one pose takes as long as all poses, so all poses form one batch.
    at_once = _AT_ONCE if device.type == "cpu" else max(total, 1)
    for first in range(0, total, at_once):
        rows = torch.arange(first, min(first + at_once, total), device=device)
        some = staged(problem, hand, poses[rows], config, stop)
        grasps += [grasp for grasp in finished(problem, hand, some) if grasp.score > _WORST]
    return _best_first(grasps)


def finished(problem: Problem, hand: HandModel, some: Staged) -> list[Grasp]:
    """Return a scored grasp for each pose of the batch `some`, in the same order. `staged` makes such a batch."""
    scores = score(problem, some)
    if problem.obstacles is not None:
        depth = -gap_on_path(problem.obstacles, problem.hand.kinematics, some.opened, some.poses)
        knocks = approach_depth(problem, problem.obstacles, some.opened) > _DEEPEST
        scores = torch.where(depth > _DEEPEST, -torch.inf, scores - torch.where(knocks, _KNOCK_COST, 0.0))
    poses, opened, found = some.poses, some.opened, some.contact_set
    quaternion = _numbers(poses.quaternion / poses.quaternion.norm(dim=-1, keepdim=True))
    active, distance = found.active.cpu().numpy(), found.distance.abs().cpu().numpy()
    link, position, normal = found.link.tolist(), _numbers(found.position).tolist(), _numbers(found.normal).tolist()
    pressing = _numbers(by_link(found, some.pressed.forces)).tolist()
    places = [_numbers(x) for x in (opened.translation, poses.translation)]
    # Rounding to float32 and back may exceed a joint limit by one ulp.
    joints = [np.clip(_numbers(x), hand.lower, hand.upper) for x in (opened.joints, poses.joints, some.pressed.joints)]
    grasps = []
    for row, odds in enumerate(scores.tolist()):
        # Each link has one contact: its active slot nearest to the surface.
        slots = np.flatnonzero(active[row])
        nearest = {link[slot]: slot for slot in slots[np.argsort(-distance[row, slots], kind="stable")]}
        contacts = tuple(
            Contact(hand.link_names[of], *map(tuple, (position[row][slot], normal[row][slot], pressing[row][of])))
            for of, slot in sorted(nearest.items())
        )
        pregrasp, grasp, squeezed = (
            Posture(place[row].copy(), quaternion[row].copy(), values[row].copy())
            for place, values in zip((places[0], places[1], places[1]), joints, strict=True)
        )
        grasps.append(Grasp(pregrasp=pregrasp, grasp=grasp, squeeze=squeezed, contacts=contacts, score=odds))
    return grasps


def staged(
    problem: Problem, hand: HandModel, poses: Poses, config: PlanConfig, stop: Callable[[], bool] = lambda: False
) -> Staged:
    """Reduce penetration (`settle`), then compute contacts, squeeze and pregrasp. The batch must fit in memory."""
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


def _numbers(values: Tensor) -> np.ndarray:
    return values.double().cpu().numpy()
