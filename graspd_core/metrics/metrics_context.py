"""What is the same for every grasp of one object by one hand, prepared once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int

from graspd_core.hands.kinematics import Kinematics, make_kinematics
from graspd_core.hands.model import HandModel
from graspd_core.hands.surface_points import kept_dense_samples
from graspd_core.mesh.mesh_distance import DistanceQuery, make_distance_query
from graspd_core.scene.scene import ObjectModel

# Samples and a seed that the optimiser's candidates never see.
_SAMPLES, _SEED = 4000, 20_000


@dataclass(frozen=True, eq=False)
class HandSurface:
    """Dense samples of a hand's collision surface, link frames.

    Attributes:
        points: [m].
        links: link of each sample.
        areas: surface that each sample stands for [m²].
        kinematics: float64.
    """

    points: Float[np.ndarray, "samples 3"]
    links: Int[np.ndarray, "samples"]
    areas: Float[np.ndarray, "samples"]
    kinematics: Kinematics


@dataclass(frozen=True, eq=False)
class MetricsContext:
    """An object and a hand, ready to measure grasps: build with `make_metrics_context`, ask with `quality.measure`."""

    target: ObjectModel
    hand: HandModel
    surface: HandSurface
    query: DistanceQuery


def make_metrics_context(target: ObjectModel, hand: HandModel) -> MetricsContext:
    """Sample the hand and prepare the object's distance, once for all grasps of that object by that hand."""
    return MetricsContext(target, hand, hand_surface(hand), make_distance_query(target.mesh))


@lru_cache(maxsize=8)
def hand_surface(hand: HandModel) -> HandSurface:
    """Dense samples of a hand."""
    points, links, areas = kept_dense_samples(hand, count=_SAMPLES, seed=_SEED)
    return HandSurface(points, links, areas, make_kinematics(hand, "cpu", torch.float64))
