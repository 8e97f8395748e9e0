"""Static quality of one grasp. Definitions are those of docs/metrics.md; every figure is independent of the frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspd_core.mesh.mesh_distance import DistanceQuery, signed_distance
from graspd_core.mesh.sharp_features import farthest_points
from graspd_core.metrics import hand_contacts as contacts
from graspd_core.metrics import intersection as overlap
from graspd_core.metrics.metrics_context import MetricsContext
from graspd_core.metrics.wrench_hull import wrench_hull
from graspd_core.types import GraspMetrics, Posture

# Contacts that the wrench hull is made of. The protocol allows 32, whose hull in six dimensions has some 22,000 facets
# and takes four times as long; that raises ε by a tenth (docs/metrics.md). Benchmarks ask for 32, planning does not.
MAX_CONTACTS, PROTOCOL_CONTACTS = 16, 32
# Half the distance of a central difference [m].
_STEP = 2e-4


def measure(context: MetricsContext, posture: Posture, *, max_contacts: int = MAX_CONTACTS) -> GraspMetrics:
    """All static metrics of the judge's hand at `posture` on the judge's object.

    ε and volume are those of at most `max_contacts` contacts.
    """
    target = context.target
    placed = contacts.placed_hand(context, posture)
    touching = placed.points[contacts.touching(placed)]
    chosen = touching[farthest_points(touching, max_contacts)]
    normals = surface_normals(context.query, chosen)
    epsilon, volume = wrench_hull(chosen - target.center_of_mass, normals, target.friction, target.radius)
    return GraspMetrics(
        contact_area=contacts.contact_area(placed),
        contact_links=contacts.contact_links(placed),
        intersection_volume=overlap.intersection_volume(context, placed),
        penetration=overlap.penetration(placed),
        self_penetration=overlap.self_penetration(context, placed),
        epsilon=epsilon,
        volume=volume,
        contact_area_5mm=contacts.contact_area(placed, 0.005),
        contact_area_10mm=contacts.contact_area(placed, 0.01),
    )


def contact_per_volume(metrics: GraspMetrics) -> float | None:
    """CA/IV, contact area over intersection volume [1/m]; None where hand and object share no volume."""
    volume = metrics.intersection_volume
    return metrics.contact_area / volume if volume > 0 else None


def surface_normals(query: DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Outward unit normals of the object's surface next to points, by central differences of the exact distance."""
    probes = points[:, None, None] + _STEP * np.stack([np.eye(3), -np.eye(3)])
    distance = signed_distance(query, probes.reshape(-1, 3)).reshape(len(points), 2, 3)
    gradient = distance[:, 0] - distance[:, 1]
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-12)
