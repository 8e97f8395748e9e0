"""One grasp ready to be measured: what several metrics need is computed once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from graspd_core.mesh.mesh_distance import DistanceQuery, signed_distance
from graspd_core.mesh.sharp_features import farthest_points
from graspd_core.metrics import intersection
from graspd_core.metrics.hand_contacts import PlacedHand, placed_hand, touching
from graspd_core.metrics.metrics_context import MetricsContext
from graspd_core.metrics.wrench_hull import weakest_push, wrench_hull
from graspd_core.types import Posture

# Contacts that the wrench hull is made of. The protocol allows 32, whose hull in six dimensions has some 22,000 facets
# and takes four times as long; that raises ε by a tenth (docs/metrics.md). Benchmarks ask for 32, planning does not.
MAX_CONTACTS, PROTOCOL_CONTACTS = 16, 32
# Half the distance of a central difference [m].
_STEP = 2e-4


@dataclass(frozen=True, eq=False)
class PreparedGrasp:
    """A hand at its grasp, about to be measured.

    Attributes:
        context: the object and the hand.
        placed: the hand's samples in the object frame.
        max_contacts: contacts that the wrench hull is made of at most.
    """

    context: MetricsContext
    placed: PlacedHand
    max_contacts: int

    @cached_property
    def wrench_hull(self) -> tuple[float, float]:
        """Ferrari-Canny radius and volume of the grasp wrench hull."""
        return wrench_hull(*self._contacts)

    @cached_property
    def weakest_push(self) -> Float[np.ndarray, "6"] | None:
        """The unit disturbance that the wrench hull resists least (force, torque over the object's radius)."""
        return weakest_push(*self._contacts)

    @property
    def _contacts(self) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], float, float]:
        """Arms [m], normals, friction and torque scale [m] of the contacts that the wrench hull is made of."""
        target, points = self.context.target, self.placed.points[touching(self.placed)]
        chosen = points[farthest_points(points, self.max_contacts)]
        normals = surface_normals(self.context.query, chosen)
        return chosen - target.center_of_mass, normals, target.friction, target.radius

    @cached_property
    def intersection_volume(self) -> float:
        """Volume of the hand inside the object [m³]."""
        return intersection.intersection_volume(self.context, self.placed)


def prepare_grasp(context: MetricsContext, posture: Posture, max_contacts: int = MAX_CONTACTS) -> PreparedGrasp:
    """Put the hand at a posture."""
    return PreparedGrasp(context, placed_hand(context, posture), max_contacts)


def surface_normals(query: DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Outward unit normals of the object's surface next to points, by central differences of the exact distance."""
    probes = points[:, None, None] + _STEP * np.stack([np.eye(3), -np.eye(3)])
    distance = signed_distance(query, probes.reshape(-1, 3)).reshape(len(points), 2, 3)
    gradient = distance[:, 0] - distance[:, 1]
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-12)
