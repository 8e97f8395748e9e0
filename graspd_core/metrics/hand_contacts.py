"""Where a posture of the hand touches an object, by dense samples that no optimiser ever sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from graspd_core.hands.kinematics import forward
from graspd_core.mesh.mesh_distance import signed_distance
from graspd_core.metrics.metrics_context import MetricsContext
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Posture

# Hand surface nearer than this to the object's is in contact [m].
CONTACT_DISTANCE = 0.002
# Samples farther than this from the object's bounding box have no exact distance [m]; the widest contact is 10 mm.
_REACH = 0.015


@dataclass(frozen=True, eq=False)
class PlacedHand:
    """Dense surface samples of a hand in the object frame.

    Attributes:
        points: [m].
        links: link of each sample.
        areas: surface that each sample stands for [m²].
        distance: signed distance of each sample to the object [m]; a lower bound beyond 15 mm.
        rotations: `R_object_link`.
        translations: link origins in the object frame [m].
    """

    points: Float[np.ndarray, "samples 3"]
    links: Int[np.ndarray, "samples"]
    areas: Float[np.ndarray, "samples"]
    distance: Float[np.ndarray, "samples"]
    rotations: Float[np.ndarray, "links 3 3"]
    translations: Float[np.ndarray, "links 3"]


def placed_hand(context: MetricsContext, posture: Posture) -> PlacedHand:
    """Put the hand's samples where a posture puts them, and measure every sample's distance to the object."""
    surface = context.surface
    joints = torch.as_tensor(posture.joint_positions, dtype=torch.float64)[None]
    links = forward(surface.kinematics, joints)[0]
    base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
    rotations = base @ links.rotation.numpy()
    translations = links.translation.numpy() @ base.T + posture.position
    placed = np.einsum("nij,nj->ni", rotations[surface.links], surface.points) + translations[surface.links]
    distance = signed_distance(context.query, placed, reach=_REACH)
    return PlacedHand(placed, surface.links, surface.areas, distance, rotations, translations)


def contact_area(placed: PlacedHand, within: float = CONTACT_DISTANCE) -> float:
    """Hand surface within a distance of the object's surface, on either side of it [m²]; at most 15 mm."""
    return float(placed.areas[np.abs(placed.distance) <= within].sum())


def contact_links(placed: PlacedHand, within: float = CONTACT_DISTANCE) -> int:
    """Number of links that come within a distance of the object, penetrating ones included."""
    return len(np.unique(placed.links[touching(placed, within)]))


def touching(placed: PlacedHand, within: float = CONTACT_DISTANCE) -> Bool[np.ndarray, "samples"]:
    """Samples that count as contacts."""
    return placed.distance <= within
