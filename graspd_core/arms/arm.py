"""What an arm is: a frozen chain of links from its base to the tip that carries the hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.arms.capsules import Capsules
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import forward, make_kinematics
from graspd_core.hands.model import HandModel, Mount
from graspd_core.se3 import SE3, rotation_from_quaternion


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm as loaded; hashed by identity. Joints are those between base and tip, base first.

    Attributes:
        name: the arm's name.
        chain: its links and joints, link 0 the base, whose frame is the arm's base frame.
        tip: number of the link that carries the hand.
        lower, upper: joint limits, the URDF's or narrower [rad] or [m].
        seed: joint values clear of everything, which joints stay near where a choice is free.
        capsules: its links' solids, a little larger than they are.
        mounts: where hands' base links sit on the tip, by the hand's name; others sit as they say themselves.
    """

    name: str
    chain: HandModel
    tip: int
    lower: Float[np.ndarray, "joints"]
    upper: Float[np.ndarray, "joints"]
    seed: Float[np.ndarray, "joints"]
    capsules: Capsules
    mounts: Mapping[str, Mount] = field(default_factory=dict)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, base first."""
        return self.chain.joint_names

    @cached_property
    def moved_link(self) -> Int[np.ndarray, "joints"]:
        """The link that each joint moves against its parent."""
        return np.flatnonzero(self.chain.link_joint >= 0)


def tip_hand(arm: Arm, hand: HandModel) -> SE3:
    """`T_tip_hand`: where the hand's base link sits on the tip. Raises ConfigError: neither arm nor hand says."""
    mount = arm.mounts.get(hand.name, hand.mount)
    if mount is None:
        known = ", ".join(arm.mounts) or "none"
        raise ConfigError(
            f"arm {arm.name}: nobody says how hand {hand.name} is mounted; mounts of the arm: {known}; "
            "or give the hand's description a mount (docs/arms.md)"
        )
    rotation = rotation_from_quaternion(torch.tensor(mount.quaternion_wxyz, dtype=torch.float64))
    return SE3(rotation, torch.tensor(mount.position, dtype=torch.float64))


def arm_links(arm: Arm, q: Float[Tensor, "batch joints"]) -> SE3:
    """`T_base_link` of every link at joint values q [rad] or [m]: a batch of arms by links."""
    return forward(make_kinematics(arm.chain, dtype=q.dtype), q)
