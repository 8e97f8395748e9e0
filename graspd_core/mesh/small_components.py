"""Drop small components: tiny pieces that float clear of a mesh, as scanners and careless exports leave them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.types import TriangleMesh

# A piece is tiny below this share of the extent of the piece with the most area, and what stays must hold this share of
# all area: a surface that is in pieces everywhere, as loose triangles are, loses none.
TINY, STAYS = 0.05, 0.98


def drop_small_components(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """The mesh without its small components, and how many they were.

    A small component shares no vertex with the rest, is tiny, and lies farther from all that is not tiny than it is
    large: a bump, a screw's head or a loose triangle that touches the body stays.
    """
    piece = face_components(mesh)
    count = int(piece.max()) + 1
    if count == 1:
        return mesh, 0
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    area = np.bincount(piece, weights=area)
    extent = _extents(corners, piece)
    tiny = extent < TINY * extent[area.argmax()]
    if not tiny.any() or area[~tiny].sum() < STAYS * area.sum():
        return mesh, 0
    gap = np.full(count, np.inf)
    rest = make_surface(TriangleMesh(mesh.vertices, mesh.faces[~tiny[piece]]))
    asked = tiny[piece]
    distance = surface_distance(rest, corners[asked].reshape(-1, 3)).reshape(-1, 3).min(1)
    np.minimum.at(gap, piece[asked], distance)
    small = tiny & (gap > extent)
    used, compact = np.unique(mesh.faces[~small[piece]], return_inverse=True)
    return TriangleMesh(mesh.vertices[used], compact.reshape(-1, 3)), int(small.sum())


def face_components(mesh: TriangleMesh) -> Int[np.ndarray, "faces"]:
    """Number of the piece that each face belongs to; pieces share no vertex."""
    a, b, c = mesh.faces.T
    rows, columns = np.concatenate([a, b]), np.concatenate([b, c])
    shared = coo_matrix((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(len(mesh.vertices),) * 2)
    _, label = connected_components(shared, directed=False)
    return np.unique(label[a], return_inverse=True)[1].reshape(-1)


def _extents(corners: Float[np.ndarray, "faces 3 3"], piece: Int[np.ndarray, "faces"]) -> Float[np.ndarray, "pieces"]:
    """Diagonal of each piece's bounding box [m]."""
    order = np.argsort(piece, kind="stable")
    starts = np.flatnonzero(np.diff(piece[order], prepend=-1))
    low = np.minimum.reduceat(corners.min(1)[order], starts)
    high = np.maximum.reduceat(corners.max(1)[order], starts)
    return np.linalg.norm(high - low, axis=1)
