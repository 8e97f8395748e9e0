"""Bodies of one mesh that stand apart: a hand grasps them as one rigid thing, which they may not be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from graspd_core.mesh.small_components import face_components
from graspd_core.mesh.winding_number import winding_inside
from graspd_core.types import TriangleMesh

# Pieces of surface that come nearer to each other than this share of the mesh's extent are of one body: parts that were
# modelled one by one touch, reach into each other, or miss each other by little.
_APART = 0.05
# Points that stand for the surface beside its vertices: from one to the next it is half of that or less.
_SAMPLES = 4096


def bodies_apart(mesh: TriangleMesh) -> tuple[int, float]:
    """How many bodies there are, and the gap from the largest to what is nearest to it [m]; infinite about one.

    What lies within the largest, as the inside of a hollow wall does, belongs to it.
    """
    pieces = face_components(mesh)
    if not pieces.any():
        return 1, np.inf
    points, owner = _points(mesh, pieces)
    reach = _APART * float(np.ptp(mesh.vertices, axis=0).max())
    largest = _grown(points, owner, np.ones(len(points), dtype=bool), reach)
    shell = TriangleMesh(mesh.vertices, mesh.faces[np.isin(pieces, owner[largest])])
    _, first = np.unique(owner, return_index=True)
    apart = ~largest & ~winding_inside(shell, points[first])[owner]
    if not apart.any():
        return 1, np.inf
    gap = float(KDTree(points[largest]).query(points[apart])[0].min())
    bodies = 1
    while apart.any():
        apart &= ~_grown(points, owner, apart, reach)
        bodies += 1
    return bodies, gap


def _points(
    mesh: TriangleMesh, pieces: Int[np.ndarray, "faces"]
) -> tuple[Float[np.ndarray, "points 3"], Int[np.ndarray, "points"]]:
    """Corners of all faces and points spread over them by area, and the piece that each is of."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(area), _SAMPLES, p=area / area.sum())
    spread = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), _SAMPLES), corners[chosen])
    used, first = np.unique(mesh.faces, return_index=True)
    return np.concatenate([mesh.vertices[used], spread]), np.concatenate([pieces[first // 3], pieces[chosen]])


def _grown(
    points: Float[np.ndarray, "points 3"],
    owner: Int[np.ndarray, "points"],
    among: Bool[np.ndarray, "points"],
    reach: float,
) -> Bool[np.ndarray, "points"]:
    """Those of the points `among` that belong to the most extended piece, or to pieces that are joined to it."""
    low, high = np.full((2, int(owner.max()) + 1, 3), np.inf)
    np.minimum.at(low, owner[among], points[among])
    np.minimum.at(high, owner[among], -points[among])
    start = np.where(np.isfinite(low), -high - low, 0.0).max(1).argmax()
    body = front = among & (owner == start)
    while front.any() and not body[among].all():
        left = among & ~body
        distance, _ = KDTree(points[front]).query(points[left], distance_upper_bound=reach)
        front = left & np.isin(owner, owner[left][distance < reach])
        body = body | front
    return body
