"""How often and how fast poses that an arm reaches are found: by graspd, and by pytorch-kinematics if installed."""

from __future__ import annotations

import importlib.util
import re
import time
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from graspd_core.arms.arm import Arm, arm_links
from graspd_core.arms.inverse_kinematics import POSITION_TOLERANCE, ROTATION_TOLERANCE, solve
from graspd_core.arms.start_table import nearest_postures, random_postures, start_table
from graspd_core.bench.study import Record
from graspd_core.se3 import SE3

# Poses at once; starts of each, one after another for those that are left, and steps of each start.
BATCH, STARTS, STEPS = 256, 12, 16
# Of the library: starts at once and steps; fewer of either find fewer poses.
_RETRIES, _ITERATIONS = 20, 50


def measure_arm(arm: Arm, poses: int) -> Record:
    """Both solvers on the same poses, made by forward kinematics from joint values within the limits."""
    q = random_postures(arm, poses, torch.Generator().manual_seed(11))
    target = arm_links(arm, q)[:, arm.tip]
    start_table(arm)
    library = _library(arm) if importlib.util.find_spec("pytorch_kinematics") else None
    return {
        "own": _measured(lambda tip: _own(arm, tip), target),
        "library": library and _measured(library, target),
    }


def _measured(solver: Callable[[SE3], Bool[Tensor, "batch"]], target: SE3) -> Record:
    """Share of poses that are reached, and CPU milliseconds of each."""
    solver(target[:BATCH])
    began, reached = time.process_time(), 0
    for first in range(0, len(target.translation), BATCH):
        reached += int(solver(target[first : first + BATCH]).sum())
    count = len(target.translation)
    return {"reached": reached / count, "ms": 1e3 * (time.process_time() - began) / count}


def _own(arm: Arm, target: SE3) -> Bool[Tensor, "batch"]:
    reached = torch.zeros(len(target.translation), dtype=torch.bool)
    for starts in nearest_postures(start_table(arm), target, STARTS).unbind(1):
        rows = torch.nonzero(~reached).flatten()
        if not len(rows):
            break
        reached[rows] = solve(arm, target[rows], starts[rows], STEPS).reached
    return reached


def _library(arm: Arm) -> Callable[[SE3], Bool[Tensor, "batch"]]:
    """The library's damped least squares within the arm's limits, to the same tolerances."""
    import pytorch_kinematics

    # Its reader knows no capsules.
    text = re.sub(r"<collision>.*?</collision>", "", Path(arm.chain.urdf).read_text(), flags=re.DOTALL)
    tip = arm.chain.link_names[arm.tip]
    chain = pytorch_kinematics.build_serial_chain_from_urdf(text.encode(), tip).to(dtype=torch.float64)
    limits = torch.stack([torch.as_tensor(arm.lower), torch.as_tensor(arm.upper)], 1)
    solver = pytorch_kinematics.PseudoInverseIK(
        chain,
        max_iterations=_ITERATIONS,
        num_retries=_RETRIES,
        joint_limits=limits,
        pos_tolerance=POSITION_TOLERANCE,
        rot_tolerance=ROTATION_TOLERANCE,
        early_stopping_any_converged=True,
        early_stopping_no_improvement="all",
    )

    def solved(target: SE3) -> Bool[Tensor, "batch"]:
        matrix = torch.eye(4, dtype=torch.float64).repeat(len(target.translation), 1, 1)
        matrix[:, :3, :3], matrix[:, :3, 3] = target.rotation, target.translation
        found = solver.solve(pytorch_kinematics.Transform3d(matrix=matrix))
        inside = ((found.solutions >= limits[:, 0]) & (found.solutions <= limits[:, 1])).all(-1)
        return (found.converged & inside).any(1)

    return solved
