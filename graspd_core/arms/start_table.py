"""Postures of an arm all over its limits, and where its tip is in each: where to start, and what may be in reach.

Near a pose that the arm can reach, some posture has its tip. So the nearest entries are what inverse kinematics starts
from, and a pose without one near is out of reach, at the cost of one product of matrices for thousands of poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.arms.arm import Arm, arm_links
from graspd_core.arms.arm_collision import hits_of_self
from graspd_core.se3 import SE3

# Entries, of which those are dropped that would hit themselves; poses that tell how near an entry is to most.
_ENTRIES, _PROBES = 4000, 1000
# Share of reachable poses that are kept.
_KEPT = 0.98
# Metres that count as much as a change of one in an entry of the rotation matrix: 0.28 m a radian.
_PER_ENTRY = 0.2


@dataclass(frozen=True)
class StartTable:
    """Postures by the pose of the tip.

    Attributes:
        q: joint values [rad] or [m].
        features: position and scaled rotation of the tip, base frame.
        near: how near an entry is to all but few reachable poses, in the features' metric [m].
    """

    q: Float[Tensor, "entries joints"]
    features: Float[Tensor, "entries 12"]
    near: float


# Arms are hashed by identity.
@lru_cache(maxsize=8)
def start_table(arm: Arm) -> StartTable:
    """The table of an arm, made once; the same every time."""
    generator = torch.Generator().manual_seed(0)
    q, probes = (_clear_postures(arm, count, generator) for count in (_ENTRIES, _PROBES))
    features = tip_features(arm_links(arm, q)[:, arm.tip])
    nearest = torch.cdist(tip_features(arm_links(arm, probes)[:, arm.tip]), features).amin(1)
    return StartTable(q, features, float(torch.quantile(nearest, _KEPT)))


def random_postures(arm: Arm, count: int, generator: torch.Generator) -> Float[Tensor, "count joints"]:
    """Joint values drawn evenly within the limits, and within half a turn of the middle where those are wider."""
    middle = 0.5 * (arm.lower + arm.upper)
    half = np.where(arm.chain.slides, 0.5 * (arm.upper - arm.lower), np.minimum(0.5 * (arm.upper - arm.lower), np.pi))
    drawn = 2.0 * torch.rand(count, len(middle), generator=generator, dtype=torch.float64) - 1.0
    return torch.as_tensor(middle) + torch.as_tensor(half) * drawn


def _clear_postures(arm: Arm, count: int, generator: torch.Generator) -> Float[Tensor, "clear joints"]:
    q = random_postures(arm, count, generator)
    hits = hits_of_self(arm, arm_links(arm, q))
    return q[(hits.depth <= 0).all(-1)] if hits.what else q


def tip_features(tip: SE3) -> Float[Tensor, "batch 12"]:
    """Poses as vectors whose distance is that of position and rotation together [m]."""
    return torch.cat([tip.translation, _PER_ENTRY * tip.rotation.flatten(-2)], -1).float()


def nearest_entries(table: StartTable, tip: SE3, count: int) -> Int[Tensor, "batch count"]:
    """The entries nearest to poses `T_base_tip`, nearest first."""
    return torch.cdist(tip_features(tip), table.features).topk(min(count, len(table.q)), largest=False).indices


def within_reach(table: StartTable, tip: SE3, usable: Bool[Tensor, "entries"] | None = None) -> Bool[Tensor, "batch"]:
    """Which poses `T_base_tip` have an entry near, of the usable ones where not all are."""
    features = table.features if usable is None else table.features[usable]
    if not len(features):
        return torch.zeros(len(tip.translation), dtype=torch.bool)
    return torch.cdist(tip_features(tip), features).amin(1) <= table.near
