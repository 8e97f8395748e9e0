"""Batches of hand poses, and the rows of numbers that solvers step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.se3 import SE3, rotation_from_quaternion


@dataclass(frozen=True)
class Poses:
    """A batch of hand poses on the problem's device.

    Attributes:
        translation: base origin in the object frame [m].
        quaternion: base orientation, wxyz, any non-zero length.
        joints: [rad].
    """

    translation: Float[Tensor, "batch 3"]
    quaternion: Float[Tensor, "batch 4"]
    joints: Float[Tensor, "batch joints"]

    @property
    def base(self) -> SE3:
        """`T_object_base`."""
        return SE3(rotation_from_quaternion(self.quaternion), self.translation)

    def __getitem__(self, rows: Tensor) -> Poses:
        return Poses(self.translation[rows], self.quaternion[rows], self.joints[rows])


def pack(poses: Poses) -> Float[Tensor, "batch variables"]:
    """Rows of translation, quaternion, joints."""
    return torch.cat([poses.translation, poses.quaternion, poses.joints], -1)


def unpack(x: Float[Tensor, "batch variables"]) -> Poses:
    """Inverse of `pack`."""
    return Poses(x[:, :3], x[:, 3:7], x[:, 7:])


def moved_along(poses: Poses, point: Float[Tensor, "*batch 3"]) -> Poses:
    """The poses with their translation moved along a vector of the base frame [m]."""
    turned = (rotation_from_quaternion(poses.quaternion) @ point[..., None]).squeeze(-1)
    return Poses(poses.translation + turned, poses.quaternion, poses.joints)
