"""Complete imported grasps: compute the postures that a file lacks, in the same way as for planned grasps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.candidates import finished, staged
from graspd_core.optimize.loop import Hooks, Poses, minimise
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.optimize.problem import Problem, build_problem
from graspd_core.perception.scene import Scene
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, Posture, stacked
from graspd_dataset.finger_closing import CLOSE_STEPS, make_closing
from graspd_dataset.foreign_grasps import ImportedGrasp

# Joint values may exceed the limits by this much [rad] or [m]. Other descriptions of a hand may round the limits.
_BEYOND = 1e-3
# A hand does not grasp if it is deeper in the object than `_DEEP` [m], or farther from it than `_OFF` [m]. The frame of
# at least `_FEWEST` grasps is doubtful if the fraction `_NEARLY_ALL` is too deep, or this fraction is too far.
_DEEP, _OFF, _NEARLY_ALL, _FEWEST = 0.005, 0.005, 0.8, 5
# Grasps per batch. Each grasp needs a megabyte of temporary memory.
_AT_ONCE = 128


@dataclass(frozen=True)
class CompletedGrasps:
    """Imported grasps of one object, not yet tried in simulation.

    Attributes:
        grasps: the accepted grasps.
        refused: number of refused grasps for each reason.
        frame_doubt: a warning that the poses seem to be in a wrong frame. Empty if the frame seems right.
    """

    grasps: tuple[Grasp, ...]
    refused: Mapping[str, int]
    frame_doubt: str = ""


def complete_grasps(
    scene: Scene, hand: HandModel, imported: Sequence[ImportedGrasp], config: PlanConfig
) -> CompletedGrasps:
    """Close each hand whose file has no joint values. Compute each missing pregrasp and squeeze.

    Postures from a file are kept exactly. Joint values of a squeeze are targets, so they may exceed the limits. A grasp
    is refused if its file marks it as failed, or if a joint is beyond its limits. A grasp whose file has no squeeze is
    also refused if fewer than two links touch the object.
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
                faults.append("no squeeze can be computed: fewer than two links touch the object")
            else:
                grasps.append(_merged(theirs, ours))
    warning = frame_doubt(scene, hand, [grasp.grasp for grasp in kept if grasp.closed])
    return CompletedGrasps(tuple(grasps), dict(Counter(filter(None, faults))), warning)


def frame_doubt(scene: Scene, hand: HandModel, postures: Sequence[Posture]) -> str:
    """Return a warning if 80 % of at least 5 hands are over 5 mm inside the object, or 80 % over 5 mm off. Else ""."""
    if len(postures) < _FEWEST:
        return ""
    points = [
        in_base(link_poses(hand, posture.joint_positions), hand.candidate_points, hand.candidate_link)
        @ rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz).double()).numpy().T
        + posture.position
        for posture in postures
    ]
    nearest = np.array([float(sample_sdf(scene.sdf, torch.as_tensor(p).to(scene.sdf.field))[0].min()) for p in points])
    deep, off = int((nearest < -_DEEP).sum()), int((nearest > _OFF).sum())
    if max(deep, off) < _NEARLY_ALL * len(postures):
        return ""
    what = f"{deep} of {len(postures)} grasps are more than {_DEEP * 1000:g} mm deep in the object"
    if off > deep:
        what = f"{off} of {len(postures)} grasps are more than {_OFF * 1000:g} mm off the object"
    return f"{what}: the poses do not seem to be those of base link {hand.base_link!r} of {hand.name}; check the frame"


def beyond_limits(grasp: ImportedGrasp, hand: HandModel) -> str:
    """Return a sentence on the joint that exceeds its limits most at grasp or pregrasp. Empty if no joint does."""
    for posture in filter(None, (grasp.grasp, grasp.pregrasp)):
        beyond = np.maximum(hand.lower - posture.joint_positions, posture.joint_positions - hand.upper)
        if beyond.max(initial=0.0) > _BEYOND:
            return f"joint {hand.joint_names[int(beyond.argmax())]} is beyond its limits"
    return ""


def _poses(problem: Problem, postures: Sequence[Posture]) -> Poses:
    return Poses(*(torch.as_tensor(part).to(problem.hand.lower) for part in stacked(postures)))


def _merged(theirs: ImportedGrasp, ours: Grasp) -> Grasp:
    """Return the grasp `theirs` of a file. Take the postures that the file lacks from `ours`, which graspd computed."""
    grasp = theirs.grasp
    if not theirs.closed:
        grasp = replace(grasp, joint_positions=ours.grasp.joint_positions)
    pregrasp = theirs.pregrasp or replace(ours.pregrasp, quaternion_wxyz=grasp.quaternion_wxyz)
    squeeze = replace(grasp, joint_positions=(theirs.squeeze or ours.squeeze).joint_positions)
    return replace(ours, grasp=grasp, pregrasp=pregrasp, squeeze=squeeze)


def by_object(imported: Sequence[ImportedGrasp]) -> dict[tuple[str, float], tuple[ImportedGrasp, ...]]:
    """Group grasps by the mesh and scale of their object. Groups are in the order of their first grasp."""
    found: dict[tuple[str, float], list[ImportedGrasp]] = {}
    for grasp in imported:
        found.setdefault((grasp.mesh, grasp.scale), []).append(grasp)
    return {target: tuple(grasps) for target, grasps in found.items()}
