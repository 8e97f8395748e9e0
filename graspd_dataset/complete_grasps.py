"""Grasps of others made into graspd's own: what their format lacks is found as for a grasp that was planned here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from graspd_core.hands.model import HandModel
from graspd_core.optimize.candidates import finished, staged
from graspd_core.optimize.loop import Hooks, Poses, minimise
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.optimize.problem import Problem, build_problem
from graspd_core.perception.scene import Scene
from graspd_core.types import Grasp, Posture
from graspd_dataset.finger_closing import CLOSE_STEPS, make_closing
from graspd_dataset.foreign_grasps import ImportedGrasp

# A joint may be so far beyond its limit [rad] or [m]: limits are rounded differently in other descriptions.
_BEYOND = 1e-3
# Grasps at once; each takes a megabyte on the way.
_AT_ONCE = 128


@dataclass(frozen=True)
class CompletedGrasps:
    """Grasps of one object, in the order of their files, unverified; and how many were refused, by reason."""

    grasps: tuple[Grasp, ...]
    refused: Mapping[str, int]


def complete_grasps(
    scene: Scene, hand: HandModel, imported: Sequence[ImportedGrasp], config: PlanConfig
) -> CompletedGrasps:
    """Close the hands whose joints are not known, and find each pregrasp and squeeze that is missing.

    What a file has is kept to the digit; squeezes are targets, so that they may be beyond the limits of joints. Refused
    is what its own file calls no grasp, what is beyond the limits of the hand's joints, and what touches with fewer
    than two links where a squeeze is to be found.
    """
    faults = [grasp.refused or beyond_limits(grasp, hand) for grasp in imported]
    kept = [grasp for grasp, fault in zip(imported, faults, strict=True) if not fault]
    problem = build_problem(scene, hand, config.problem, seed=0)
    grasps: list[Grasp] = []
    for first in range(0, len(kept), _AT_ONCE):
        some = kept[first : first + _AT_ONCE]
        poses = _poses(problem, [grasp.grasp for grasp in some])
        own = finished(problem, hand, staged(problem, hand, poses, config))
        if opened := [row for row, grasp in enumerate(some) if not grasp.closed]:
            closing = make_closing(problem, hand, CLOSE_STEPS)
            closed = minimise(closing, problem, poses[torch.tensor(opened)], Hooks()).poses
            for row, grasp in zip(opened, finished(problem, hand, staged(problem, hand, closed, config)), strict=True):
                own[row] = grasp
        for theirs, ours in zip(some, own, strict=True):
            if theirs.squeeze is None and len(ours.contacts) < 2:
                faults.append("no squeeze to be found: fewer than two links touch the object")
            else:
                grasps.append(_merged(theirs, ours))
    return CompletedGrasps(tuple(grasps), dict(Counter(filter(None, faults))))


def beyond_limits(grasp: ImportedGrasp, hand: HandModel) -> str:
    """Which joint is beyond its limits at the grasp or the pregrasp; empty where none is."""
    for posture in filter(None, (grasp.grasp, grasp.pregrasp)):
        beyond = np.maximum(hand.lower - posture.joint_positions, posture.joint_positions - hand.upper)
        if beyond.max(initial=0.0) > _BEYOND:
            return f"joint {hand.joint_names[int(beyond.argmax())]} is beyond its limits"
    return ""


def _poses(problem: Problem, postures: Sequence[Posture]) -> Poses:
    rows = [(posture.position, posture.quaternion_wxyz, posture.joint_positions) for posture in postures]
    return Poses(*(torch.as_tensor(np.stack(part)).to(problem.hand.lower) for part in zip(*rows, strict=True)))


def _merged(theirs: ImportedGrasp, ours: Grasp) -> Grasp:
    """Our grasp with what a file has, to the digit."""
    grasp = theirs.grasp
    if not theirs.closed:
        grasp = replace(grasp, joint_positions=ours.grasp.joint_positions)
    pregrasp = theirs.pregrasp or replace(ours.pregrasp, quaternion_wxyz=grasp.quaternion_wxyz)
    squeeze = replace(grasp, joint_positions=(theirs.squeeze or ours.squeeze).joint_positions)
    return replace(ours, grasp=grasp, pregrasp=pregrasp, squeeze=squeeze)


def by_object(imported: Sequence[ImportedGrasp]) -> dict[tuple[str, float], tuple[ImportedGrasp, ...]]:
    """Grasps by their object, mesh and scale, in the order of the first of each."""
    found: dict[tuple[str, float], list[ImportedGrasp]] = {}
    for grasp in imported:
        found.setdefault((grasp.mesh, grasp.scale), []).append(grasp)
    return {target: tuple(grasps) for target, grasps in found.items()}
