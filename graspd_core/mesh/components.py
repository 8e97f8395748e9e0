"""Find connected pieces of a mesh: drop tiny floating pieces, and count separate bodies.

Scanners and careless exports leave floating pieces. Planning would treat separate bodies as one rigid body.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from graspd_core.mesh.surface_queries import make_surface, surface_distance, winding_inside
from graspd_core.mesh.topology import drop_strays, scaled_normals
from graspd_core.types import TriangleMesh

# A piece is tiny if its extent is below this fraction of the extent of the piece with the most area. If the other
# pieces hold less than STAYS of all area, nothing is dropped. So a mesh of loose triangles stays whole.
TINY, STAYS = 0.05, 0.98


def drop_small_components(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Return the mesh without its tiny floating pieces, and the number of dropped pieces.

    A piece is tiny if it has under 5 % of the extent of the piece with the most area. A tiny piece is dropped if
    its distance from the larger pieces exceeds its extent. If tiny pieces hold over 2 % of the area, none is dropped.
    """
    piece = face_components(mesh)
    count = int(piece.max()) + 1
    if count == 1:
        return mesh, 0
    corners = mesh.vertices[mesh.faces]
    area = np.bincount(piece, weights=np.linalg.norm(scaled_normals(mesh.vertices, mesh.faces), axis=1))
    extent = _extents(corners, piece)
    tiny = extent < TINY * extent[area.argmax()]
    if not tiny.any() or area[~tiny].sum() < STAYS * area.sum():
        return mesh, 0
    gap = np.full(count, np.inf)
    rest = make_surface(TriangleMesh(mesh.vertices, mesh.faces[~tiny[piece]]))
    distance = surface_distance(rest, corners[tiny[piece]].reshape(-1, 3)).reshape(-1, 3).min(1)
    np.minimum.at(gap, piece[tiny[piece]], distance)
    small = tiny & (gap > extent)
    return drop_strays(TriangleMesh(mesh.vertices, mesh.faces[~small[piece]]))[0], int(small.sum())


def face_components(mesh: TriangleMesh) -> Int[np.ndarray, "faces"]:
    """Return the index of the connected piece of each face. Pieces share no vertex."""
    a, b, c = mesh.faces.T
    label = connected_parts(len(mesh.vertices), np.concatenate([a, b]), np.concatenate([b, c]))
    return np.unique(label[a], return_inverse=True)[1].reshape(-1)


def connected_parts(
    count: int, one: Int[np.ndarray, "edges"], other: Int[np.ndarray, "edges"]
) -> Int[np.ndarray, "count"]:
    """Return the index of the connected part of each of `count` nodes. Each edge joins a node `one` to an `other`."""
    graph = coo_matrix((np.ones(len(one), dtype=bool), (one, other)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def keep_cavities(mesh: TriangleMesh, outward: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "faces 3"]:
    """Turn the walls of cavities inwards again, after all faces of `mesh` were turned to `outward`.

    A piece is the wall of a cavity if it lies within other pieces, and most of its area had the opposite winding.
    """
    piece = face_components(mesh)
    given, turned = (scaled_normals(mesh.vertices, faces) for faces in (mesh.faces, outward))
    area = np.linalg.norm(given, axis=1)
    agree = np.bincount(piece, weights=np.where((given * turned).sum(1) < 0, -area, area))
    # The piece with the most area shows the winding of the whole mesh, which may be inside out.
    opposite = agree * agree[np.abs(agree).argmax()] < 0
    if not opposite.any():
        return outward
    others = TriangleMesh(mesh.vertices, outward[~opposite[piece]])
    _, first = np.unique(piece, return_index=True)
    cavity = opposite & winding_inside(others, mesh.vertices[outward[first, 0]])
    return np.where(cavity[piece][:, None], outward[:, ::-1], outward)


def _extents(corners: Float[np.ndarray, "faces 3 3"], piece: Int[np.ndarray, "faces"]) -> Float[np.ndarray, "pieces"]:
    order = np.argsort(piece, kind="stable")
    starts = np.flatnonzero(np.diff(piece[order], prepend=-1))
    low = np.minimum.reduceat(corners.min(1)[order], starts)
    high = np.maximum.reduceat(corners.max(1)[order], starts)
    return np.linalg.norm(high - low, axis=1)


# Pieces nearer to each other than this fraction of the mesh's extent form one body. Parts that were modelled separately
# touch, overlap, or have small gaps.
_APART = 0.05
# Number of points that represent the surface, besides its vertices. Their spacing is at most about half of `_APART`.
_SAMPLES = 4096


def bodies_apart(mesh: TriangleMesh) -> tuple[int, float]:
    """Return the number of separate bodies, and the gap [m] from the largest to the nearest other body.

    For one body, the gap is infinite. Pieces inside the largest body, such as the inner side of a wall, belong to it.
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
    """Return surface points and the piece of each point. The points are the used vertices and points spread by area."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(scaled_normals(mesh.vertices, mesh.faces), axis=1)
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
    """Return which points of `among` lie on its longest piece, or on pieces joined to it by gaps below `reach` [m]."""
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
