"""Stages by the compiled kernel: same steps as in torch, a row at a time, on as many threads as torch has."""

from __future__ import annotations

from collections.abc import Callable
from ctypes import byref

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.config import GraspStagesConfig
from graspd_core.kernel import structs
from graspd_core.kernel.builds import call
from graspd_core.methods.kernel_problem import KernelProblem
from graspd_core.methods.poses import Poses, pack

# What a square of travel costs: of joints per radian², of the base per metre².
JOINT_COST, BASE_COST = 0.1, 2e3


def find_pregrasp_compiled(
    compiled: KernelProblem, poses: Poses, config: GraspStagesConfig, stop: Callable[[], bool]
) -> tuple[Poses, Float[Tensor, "batch"]]:
    """`pregrasp.find_pregrasp` for the problem as the kernel reads it."""
    x = pack(poses).contiguous()
    out, share = x.new_empty(len(x), x.shape[1] - 4), x.new_empty(len(x))
    settings = structs.Pregrasp(
        clearance=config.clearance,
        joint_rate=config.open_joint_rate,
        base_rate=config.open_base_rate,
        joint_cost=JOINT_COST,
        base_cost=BASE_COST,
        steps=config.open_steps,
    )
    arguments = len(x), x.data_ptr(), out.data_ptr(), share.data_ptr(), torch.get_num_threads()
    call("graspd_find_pregrasps", byref(compiled.struct), byref(settings), *arguments, watch=lambda _: stop())
    return Poses(out[:, :3], poses.quaternion, out[:, 3:]), share


def self_overlap_compiled(
    compiled: KernelProblem, joints: Float[Tensor, "batch joints"], checked: Bool[Tensor, "links solids"]
) -> Float[Tensor, "batch"]:
    """`contact_set.self_overlap` of the pairs that are `checked`."""
    joints, asked = joints.contiguous(), checked.to(torch.int32).contiguous()
    depth = joints.new_empty(len(joints))
    arguments = len(joints), joints.data_ptr(), asked.data_ptr(), depth.data_ptr(), torch.get_num_threads()
    call("graspd_self_overlap", byref(compiled.struct), *arguments)
    return depth


def nearest_features_compiled(
    compiled: KernelProblem, poses: Poses, solids: int
) -> tuple[Int[Tensor, "batch solids"], Float[Tensor, "batch solids"], Float[Tensor, "batch solids 3"]]:
    """`contact_set.nearest_features` for the problem as the kernel reads it."""
    x = pack(poses).contiguous()
    pick = torch.zeros((len(x), solids), dtype=torch.int32)
    distance, gradient = x.new_empty(pick.shape), x.new_zeros((*pick.shape, 3))
    found = pick.data_ptr(), distance.data_ptr(), gradient.data_ptr()
    call("graspd_nearest_features", byref(compiled.struct), len(x), x.data_ptr(), *found, torch.get_num_threads())
    return pick.long(), distance, gradient
