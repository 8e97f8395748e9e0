"""What is the same for every grasp of one object by one hand, prepared once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int

from graspd_core.hands.kinematics import Kinematics, make_kinematics
from graspd_core.hands.model import HandModel, Primitive
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
        centers: of a ball about each link's solids [m].
        radii: of that ball [m]; negative for a link without solids.
        kinematics: float64.
    """

    points: Float[np.ndarray, "samples 3"]
    links: Int[np.ndarray, "samples"]
    areas: Float[np.ndarray, "samples"]
    centers: Float[np.ndarray, "links 3"]
    radii: Float[np.ndarray, "links"]
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
    """Dense samples and bounding balls of a hand."""
    points, links, areas = kept_dense_samples(hand, count=_SAMPLES, seed=_SEED)
    centers, radii = _balls(hand)
    return HandSurface(points, links, areas, centers, radii, make_kinematics(hand, "cpu", torch.float64))


def _balls(hand: HandModel) -> tuple[Float[np.ndarray, "links 3"], Float[np.ndarray, "links"]]:
    centers, radii = np.zeros((hand.num_links, 3)), np.full(hand.num_links, -1.0)
    for link, primitives in enumerate(hand.primitives_of):
        if primitives:
            corners = np.concatenate([_corners(primitive) for primitive in primitives])
            centers[link] = 0.5 * (corners.min(0) + corners.max(0))
            radii[link] = np.linalg.norm(corners - centers[link], axis=1).max()
    return centers, radii


def _corners(primitive: Primitive) -> Float[np.ndarray, "corners 3"]:
    """Points of the link frame whose convex hull holds the solid [m]."""
    corners = primitive.vertices
    if primitive.kind != "hull":
        size = primitive.size
        half = {"box": size, "sphere": size * 3, "cylinder": (size[0], *size), "capsule": (size[0], size[0], sum(size))}
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
        corners = signs * np.array(half[primitive.kind])
    return corners @ primitive.rotation.T + primitive.translation
