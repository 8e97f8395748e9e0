"""Topology and repair of triangle meshes. Integer rows and voxels are packed into single integers for sorting."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from graspd_core.types import TriangleMesh


def packed_rows(rows: Int[np.ndarray, "n k"]) -> Int[np.ndarray, "n"]:
    """Return one integer for each row, equal for equal rows. The integers sort in the same order as the rows.

    NumPy sorts integers several times as fast as rows, and lets other threads run meanwhile.
    """
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    # The minimum is computed by columns, because NumPy takes seven times as long for many short rows.
    columns = tuple(column - column.min() for column in rows.T)
    sides = tuple(int(column.max()) + 1 for column in columns)
    if math.prod(sides) < 2**63:
        return np.asarray(np.ravel_multi_index(columns, sides))
    # 64 bits are too few, so each row gets its rank among the distinct rows.
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)


def voxel_keys(points: Float[np.ndarray, "n k"], size: float) -> Int[np.ndarray, "n"]:
    """Return one integer for the voxel of side `size` of each point. The integers sort like the voxels' indices."""
    return packed_rows(np.floor(points / size).astype(np.int64))


Vertices = Float[np.ndarray, "vertices 3"]
Faces = Int[np.ndarray, "faces 3"]

# Vertices in one lattice cell of this side [m] are merged. Scanner noise is larger, float32 rounding at 2 m is smaller.
MERGE_DISTANCE = 1e-6


def merge_vertices(mesh: TriangleMesh) -> tuple[Vertices, Faces]:
    """Merge all vertices that lie in the same cell of a 1 µm lattice."""
    low = mesh.vertices.min(0)
    cells = np.round((mesh.vertices - low) / MERGE_DISTANCE).astype(np.int64)
    _, first, inverse = np.unique(packed_rows(cells), return_index=True, return_inverse=True)
    return np.asarray(mesh.vertices, dtype=float)[first], inverse[np.asarray(mesh.faces, dtype=np.int64)]


def drop_strays(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Return the mesh without the vertices that no face uses, and the number of dropped vertices.

    Degenerate faces, which repeat a vertex, do not count as using vertices. They stay in the mesh and stay degenerate.
    """
    a, b, c = mesh.faces.T
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces[(a != b) & (b != c) & (c != a)]] = True
    if used.all() or not used.any():
        return mesh, 0
    number = np.where(used, np.cumsum(used) - 1, 0)
    return TriangleMesh(mesh.vertices[used], number[mesh.faces]), int((~used).sum())


def scaled_normals(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "faces 3"]:
    """Return the normal of each face, with a length of twice the face's area [m²]."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def drop_degenerate(vertices: Vertices, faces: Faces) -> Int[np.ndarray, "kept 3"]:
    """Return the faces with an area. A face has an area if its height is above 1e-9 of its longest side."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(scaled_normals(vertices, faces), axis=1)
    longest = np.max([np.einsum("ij,ij->i", e, e) for e in (b - a, c - b, a - c)], axis=0)
    return faces[area > 1e-9 * longest + 1e-30]


def drop_repeated(faces: Faces) -> Int[np.ndarray, "kept 3"]:
    """Return the faces without repetitions. Faces on the same three vertices are equal, whatever their winding."""
    _, first = np.unique(packed_rows(np.sort(faces, axis=1)), return_index=True)
    return faces[np.sort(first)]


def face_edges(faces: Faces) -> Int[np.ndarray, "edges 2"]:
    """Return the edges of all faces in winding direction: first edges of all faces, then second, then third edges."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def is_oriented(faces: Faces) -> bool:
    """Return True if the winding is consistent: two faces run through their common edge in opposite directions."""
    edges = face_edges(faces)
    low, high = edges.min(1), edges.max(1)
    _, which, counts = np.unique(low * (int(faces.max()) + 1) + high, return_inverse=True, return_counts=True)
    balance = np.bincount(which, weights=np.where(edges[:, 0] < edges[:, 1], 1, -1))
    return bool((balance[counts == 2] == 0).all())


def edge_counts(faces: Faces) -> tuple[Int[np.ndarray, "edges 2"], Int[np.ndarray, "edges"]]:
    """Return the vertices of each edge, the lower first, and the number of faces at the edge."""
    edges, base = np.sort(face_edges(faces), axis=1), int(faces.max(initial=0)) + 1
    keys, counts = np.unique(edges[:, 0] * base + edges[:, 1], return_counts=True)
    return np.column_stack([keys // base, keys % base]), counts


def is_closed(mesh: TriangleMesh) -> bool:
    """Return True if every edge belongs to an even number of faces."""
    return bool((edge_counts(mesh.faces)[1] % 2 == 0).all())


def orient(vertices: Vertices, faces: Faces) -> Faces:
    """Make the winding consistent within each connected patch of faces, and turn each patch outwards."""
    import igl

    oriented, patch = igl.bfs_orient(np.ascontiguousarray(faces))
    # libigl returns long long, which NumPy treats as another type than int64.
    oriented, patch = np.asarray(oriented, dtype=np.int64), np.asarray(patch, dtype=np.int64)
    a, b, c = (vertices - vertices.mean(0))[oriented].transpose(1, 0, 2)
    volume = np.bincount(patch, weights=np.einsum("ij,ij->i", a, np.cross(b, c)))
    return np.where((volume[patch] < 0)[:, None], oriented[:, ::-1], oriented)


def cut_long_faces(mesh: TriangleMesh, longest: float) -> TriangleMesh:
    """Return the same surface with no edge above `longest` [m].

    Faces are halved at their longest edge. The returned faces share no vertices.
    """
    corners = mesh.vertices[mesh.faces]
    done = []
    while len(corners):
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        which = lengths.argmax(1)
        long = lengths.max(1) > longest
        done.append(corners[~long])
        # Rotate the corners of each face so that a-b is the longest edge, and halve this edge.
        order = (which[long, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[long], order[..., None], axis=1).transpose(1, 0, 2)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    soup = np.concatenate(done)
    return TriangleMesh(soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3))


# A mesh is far if its distance is over this many times its size. At this distance, float32 resolves 1e-5 of the size.
_FAR = 100.0


def far_centre(vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "3"]:
    """Return a mesh's centre [m], or zero if it is closer to the origin than a hundred times the mesh's size."""
    low, high = vertices.min(0), vertices.max(0)
    centre = (low + high) / 2
    return centre if np.linalg.norm(centre) > _FAR * (high - low).max() else np.zeros(3)


def moved_mesh(mesh: TriangleMesh, offset: Float[np.ndarray, "3"]) -> TriangleMesh:
    """Return the mesh moved by an offset [m]. For a zero offset, return the same mesh."""
    return TriangleMesh(mesh.vertices + offset, mesh.faces) if offset.any() else mesh
