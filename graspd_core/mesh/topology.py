"""Topology of a triangle soup, and its repair. Rows of integers and voxels are packed into single numbers."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from graspd_core.types import TriangleMesh


def packed_rows(rows: Int[np.ndarray, "n k"]) -> Int[np.ndarray, "n"]:
    """Return one number for each row, in the order of the rows, equal for equal rows.

    NumPy sorts numbers several times as fast as rows, and lets other threads run meanwhile.
    """
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    # Column by column: NumPy takes seven times as long for the least of short rows.
    columns = tuple(column - column.min() for column in rows.T)
    sides = tuple(int(column.max()) + 1 for column in columns)
    if math.prod(sides) < 2**63:
        return np.asarray(np.ravel_multi_index(columns, sides))
    # No room: the rows' ranks among each other.
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)


def voxel_keys(points: Float[np.ndarray, "n k"], size: float) -> Int[np.ndarray, "n"]:
    """Return one number for the cell of side `size` of each point, in the order of the cells' coordinates."""
    return packed_rows(np.floor(points / size).astype(np.int64))


Vertices = Float[np.ndarray, "vertices 3"]
Faces = Int[np.ndarray, "faces 3"]

# Vertices nearer than this are one [m]: far below any scanner's noise, far above float32 rounding at 2 m.
MERGE_DISTANCE = 1e-6


def merge_vertices(mesh: TriangleMesh) -> tuple[Vertices, Faces]:
    """Merge the vertices of each lattice cell of 1 µm."""
    low = mesh.vertices.min(0)
    cells = np.round((mesh.vertices - low) / MERGE_DISTANCE).astype(np.int64)
    _, first, inverse = np.unique(packed_rows(cells), return_index=True, return_inverse=True)
    return np.asarray(mesh.vertices, dtype=float)[first], inverse[np.asarray(mesh.faces, dtype=np.int64)]


def drop_strays(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Return the mesh without the vertices that no face uses, and their number.

    A face that names a vertex twice uses none. It comes to name one vertex three times.
    """
    a, b, c = mesh.faces.T
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces[(a != b) & (b != c) & (c != a)]] = True
    if used.all() or not used.any():
        return mesh, 0
    number = np.where(used, np.cumsum(used) - 1, 0)
    return TriangleMesh(mesh.vertices[used], number[mesh.faces]), int((~used).sum())


def scaled_normals(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "faces 3"]:
    """Return the normals of faces, as long as twice their area [m²]."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def drop_degenerate(vertices: Vertices, faces: Faces) -> Int[np.ndarray, "kept 3"]:
    """Return the faces with an area (height above 1e-9 of the longest side)."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(scaled_normals(vertices, faces), axis=1)
    longest = np.max([np.einsum("ij,ij->i", e, e) for e in (b - a, c - b, a - c)], axis=0)
    return faces[area > 1e-9 * longest + 1e-30]


def drop_repeated(faces: Faces) -> Int[np.ndarray, "kept 3"]:
    """Return the first face on each set of three vertices, whatever its winding."""
    _, first = np.unique(packed_rows(np.sort(faces, axis=1)), return_index=True)
    return faces[np.sort(first)]


def _edges(faces: Faces) -> Int[np.ndarray, "edges 2"]:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def is_oriented(faces: Faces) -> bool:
    """Tell whether every edge between just two faces is walked once in either direction."""
    edges = _edges(faces)
    low, high = edges.min(1), edges.max(1)
    _, which, counts = np.unique(low * (int(faces.max()) + 1) + high, return_inverse=True, return_counts=True)
    balance = np.bincount(which, weights=np.where(edges[:, 0] < edges[:, 1], 1, -1))
    return bool((balance[counts == 2] == 0).all())


def is_closed(mesh: TriangleMesh) -> bool:
    """Tell whether every edge has an even number of faces."""
    a, b = _edges(mesh.faces).T
    _, counts = np.unique(np.minimum(a, b) * len(mesh.vertices) + np.maximum(a, b), return_counts=True)
    return bool((counts % 2 == 0).all())


def orient(vertices: Vertices, faces: Faces) -> Faces:
    """Make each connected patch agree with itself, and face outwards as a whole."""
    import igl

    oriented, patch = igl.bfs_orient(np.ascontiguousarray(faces))
    # The wheel says long long, which NumPy holds to be another type.
    oriented, patch = np.asarray(oriented, dtype=np.int64), np.asarray(patch, dtype=np.int64)
    a, b, c = (vertices - vertices.mean(0))[oriented].transpose(1, 0, 2)
    volume = np.bincount(patch, weights=np.einsum("ij,ij->i", a, np.cross(b, c)))
    return np.where((volume[patch] < 0)[:, None], oriented[:, ::-1], oriented)


def cut_long_faces(mesh: TriangleMesh, longest: float) -> TriangleMesh:
    """Return the same surface with no edge above `longest` [m].

    Longest edges are halved. Faces share no corners then.
    """
    corners = mesh.vertices[mesh.faces]
    done = []
    while len(corners):
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        which = lengths.argmax(1)
        long = lengths.max(1) > longest
        done.append(corners[~long])
        # Turn each face so that its longest edge is a-b, then halve that.
        order = (which[long, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[long], order[..., None], axis=1).transpose(1, 0, 2)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    soup = np.concatenate(done)
    return TriangleMesh(soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3))


# A thing is far that is this many times its own size away: float32 still tells a hundred-thousandth of its size.
_FAR = 100.0


def far_centre(vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "3"]:
    """Return the middle of a body if it is farther from the origin than a hundred times its size [m], else zero."""
    low, high = vertices.min(0), vertices.max(0)
    centre = (low + high) / 2
    return centre if np.linalg.norm(centre) > _FAR * (high - low).max() else np.zeros(3)


def moved_mesh(mesh: TriangleMesh, offset: Float[np.ndarray, "3"]) -> TriangleMesh:
    """Return the mesh moved by an offset [m], the mesh itself for zero."""
    return TriangleMesh(mesh.vertices + offset, mesh.faces) if offset.any() else mesh
