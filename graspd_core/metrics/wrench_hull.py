"""The grasp wrench space of unit contact forces: the classic quality figures of Ferrari and Canny (ICRA 1992)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

CONE_EDGES = 8
# A set of wrenches whose smallest extent is below this share of its largest spans no volume.
_FLAT = 1e-9


def wrench_hull(
    arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float
) -> tuple[float, float]:
    """Ferrari-Canny ε and volume of the convex hull of unit-force friction-cone wrenches.

    Args:
        arms: contact points about the centre of mass [m].
        normals: outward unit normals of the object.
        friction: Coulomb coefficient.
        length: torque scale, the object's largest radius [m].

    Returns:
        Radius of the largest origin-centred ball in the hull (0 where the origin is outside) and the hull's volume.
    """
    hull = _hull(arms, normals, friction, length)
    return (0.0, 0.0) if hull is None else (max(0.0, float(-hull.equations[:, -1].max())), float(hull.volume))


def weakest_push(
    arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float
) -> Float[np.ndarray, "6"] | None:
    """The unit disturbance (force, torque over length) that contacts resist least: against the hull's nearest facet.

    Arguments as of `wrench_hull`. None where the hull does not hold the origin.
    """
    hull = _hull(arms, normals, friction, length)
    if hull is None or hull.equations[:, -1].max() >= 0:
        return None
    return -hull.equations[hull.equations[:, -1].argmax(), :-1]


def _hull(arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float) -> Any:
    """The convex hull of the contacts' wrenches; None where it has no volume."""
    from scipy.spatial import ConvexHull

    if len(arms) < 2:
        return None
    wrenches = cone_wrenches(arms, normals, friction, length)
    extent = np.linalg.svd(wrenches - wrenches.mean(0), compute_uv=False)
    if extent[-1] <= _FLAT * extent[0]:
        return None
    # Joggled by some 1e-10: takes half the time of merging facets, and is the same every time.
    return ConvexHull(wrenches, qhull_options="QJ")


def cone_wrenches(
    arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float
) -> Float[np.ndarray, "wrenches 6"]:
    """Wrenches (force, torque over length) of unit forces along the edges of each contact's friction cone."""
    reference = np.eye(3)[np.abs(normals).argmin(-1)]
    first = np.cross(normals, reference)
    first /= np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    angles = np.arange(CONE_EDGES) * 2 * np.pi / CONE_EDGES
    tangents = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    forces = (-normals[:, None] + friction * tangents) / np.sqrt(1 + friction**2)
    torques = np.cross(arms[:, None], forces) / length
    return np.concatenate([forces, torques], -1).reshape(-1, 6)
