"""The tip of an arm and its Jacobian, in as few operations as can be: inverse kinematics is little else.

The links between two joints are one constant, and the transform of a joint is that constant times Rodrigues' formula
(`hands.kinematics`): a sum of matrices weighted with 1, sin q, cos q and, for slides, q. All joints of all postures are
one product of matrices; what is left is one product a joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from graspd_core.arms.arm import Arm
from graspd_core.se3 import SE3


@dataclass(frozen=True)
class TipChain:
    """An arm's constants.

    Attributes:
        weighted: what 1, sin q, cos q and q of each joint are multiplied by: 4x4 transforms, flat.
        axis: unit axis of each joint in the frame of the link that it moves.
        slides: which joints are prismatic, as a column; None where none is.
        tip: from the last joint's link to the tip.
    """

    weighted: Float[Tensor, "joints 4 16"]
    axis: Float[Tensor, "joints 1 3 1"]
    slides: Bool[Tensor, "joints 1 1"] | None
    tip: Float[Tensor, "4 4"]


# Arms are hashed by identity.
@lru_cache(maxsize=8)
def tip_chain(arm: Arm, dtype: torch.dtype = torch.float32) -> TipChain:
    """The constants of an arm; made once."""
    weighted, behind, chain = [], 0, arm.chain
    for link in arm.moved_link.tolist():
        offset = _welded(arm, behind, link)
        weighted.append([offset @ part for part in _joint_parts(chain.joint_axis[link], chain.joint_kind[link])])
        behind = link
    # The tip is behind the last joint, its own offset included.
    tip = np.eye(4) if behind == arm.tip else _welded(arm, behind, arm.tip)
    slides = torch.as_tensor(chain.slides)[:, None, None] if chain.slides.any() else None
    axis = torch.as_tensor(chain.joint_axis[arm.moved_link], dtype=dtype)[:, None, :, None]
    parts = torch.as_tensor(np.array(weighted), dtype=dtype).flatten(2)
    return TipChain(parts, axis, slides, torch.as_tensor(tip, dtype=dtype))


def _welded(arm: Arm, above: int, link: int) -> Float[np.ndarray, "4 4"]:
    """The constant part of the transform from one link to another below it, whose own joint is at zero."""
    matrix = np.eye(4)
    while link != above:
        offset = np.eye(4)
        offset[:3, :3] = arm.chain.link_offset_rotation[link]
        offset[:3, 3] = arm.chain.link_offset_translation[link]
        matrix, link = offset @ matrix, int(arm.chain.link_parent[link])
    return matrix


def _joint_parts(axis: Float[np.ndarray, "3"], kind: str) -> list[Float[np.ndarray, "4 4"]]:
    """What 1, sin q, cos q and q are multiplied by in a joint's own transform."""
    one, sine, cosine, slide = np.eye(4), np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    if kind == "prismatic":
        slide[:3, 3] = axis
    else:
        cross = np.cross(np.eye(3), axis).T * -1.0
        sine[:3, :3], cosine[:3, :3] = cross, -cross @ cross
        one[:3, :3] += cross @ cross
    return [one, sine, cosine, slide]


def tip_and_jacobian(chain: TipChain, q: Float[Tensor, "batch joints"]) -> tuple[SE3, Float[Tensor, "batch 6 joints"]]:
    """`T_base_tip` at joint values q [rad] or [m], and the geometric Jacobian: velocity, then turning, base frame.

    A revolute joint with axis a through o moves the tip x by `a × (x − o)` and turns it about a; a prismatic one moves
    it by a.
    """
    values = q.T
    weights = torch.stack([torch.ones_like(values), values.sin(), values.cos(), values], -1)
    local = torch.bmm(weights, chain.weighted).unflatten(-1, (4, 4))
    frames = [local[0]]
    for joint in range(1, len(local)):
        frames.append(torch.bmm(frames[-1], local[joint]))
    tip = frames[-1] @ chain.tip
    links = torch.stack(frames)
    axis = (links[..., :3, :3] @ chain.axis).squeeze(-1)
    velocity, turning = torch.linalg.cross(axis, tip[:, :3, 3] - links[..., :3, 3]), axis
    if chain.slides is not None:
        velocity, turning = torch.where(chain.slides, axis, velocity), torch.where(chain.slides, 0.0, axis)
    return SE3(tip[:, :3, :3], tip[:, :3, 3]), torch.cat([velocity, turning], -1).permute(1, 2, 0)
