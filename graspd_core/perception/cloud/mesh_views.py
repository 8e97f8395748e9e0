"""Detect view meshes: one camera's points with faces between neighbouring pixels, as camera viewers export them.

A view mesh is open, and all faces turn to the camera. In the image, each face has half the area of a pixel. A view
mesh must not be used as a solid, because a table and the objects on the table would be one body.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from graspd_core.errors import MeshError
from graspd_core.mesh.components import connected_parts
from graspd_core.mesh.topology import edge_counts, scaled_normals
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector
from graspd_core.types import TriangleMesh

# A mesh with fewer vertices is not a camera's image.
MIN_VERTICES = 2000
# Least fraction of faces that turn the same side to the camera. Least cosine between the view axis and a line of sight.
FACING_SHARE, MIN_COSINE = 0.98, 0.25
# Faces of half a pixel have equal areas in the image: the median deviation is below this fraction of the median.
PIXEL_SPREAD = 0.1
# A grid of pixels: least fraction of inner vertices where six faces meet, least number of border loops at depth edges.
GRID_SHARE, MIN_BORDERS = 0.75, 3
_MOST_FACES, _STEPS = 20_000, 300  # faces to check, and steps of the search for the camera position


def view_in_mesh(mesh: TriangleMesh, source: str) -> PointCloud | None:
    """Return the points of a view mesh as a cloud seen from the origin, or None if the mesh is not a view mesh.

    Raises MeshError if the mesh is a view mesh, but not in the camera's frame: the camera's position is unknown.
    """
    if len(mesh.vertices) < MIN_VERTICES or len(mesh.faces) < MIN_VERTICES or not np.isfinite(mesh.vertices).all():
        return None
    some = mesh.faces[:: 1 + len(mesh.faces) // _MOST_FACES]
    # Pixels without depth are written as zeros, and some writers join them to their neighbours.
    some = some[np.asarray(mesh.vertices[some].any(2)).all(1)]
    if not len(some):
        return None
    corners, normals = mesh.vertices[some], scaled_normals(mesh.vertices, some)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    edges, count = edge_counts(mesh.faces)
    border = edges[count == 1]
    if len(border) and _faces(corners, normals, np.zeros(3)) and _pixels(corners):
        return PointCloud(mesh.vertices, np.zeros(3), posed=True)
    used, compact = np.unique(border, return_inverse=True)
    loops = len(np.unique(connected_parts(len(used), *compact.reshape(-1, 2).T)))
    if loops >= MIN_BORDERS and _is_grid(mesh, border) and _camera_place(corners, normals) is not None:
        raise MeshError(
            f"{source}: an open mesh of one camera's view, and not in the camera's frame; "
            "give a closed mesh, or the points as a cloud with the camera's position (npz: points, viewpoint)"
        )
    return None


def _faces(corners: Float[np.ndarray, "n 3 3"], normals: Points, eye: Vector) -> bool:
    """Return True if nearly all faces turn the same side to a camera at `eye`, and all are in front of the camera."""
    way = corners.mean(1) - eye
    distance = np.linalg.norm(way, axis=1)
    if not distance.min() > 0:
        return False
    way = way / distance[:, None]
    axis = way.mean(0)
    share = float(((way * normals).sum(1) > 0).mean())
    ahead = (way @ axis).min() > MIN_COSINE * np.linalg.norm(axis)
    return bool(ahead and max(share, 1 - share) > FACING_SHARE)


def _pixels(corners: Float[np.ndarray, "n 3 3"]) -> bool:
    """Return True if most faces have similar areas in the image of a camera at the origin that looks along an axis."""
    for axis in range(3):
        depth = corners[..., axis]
        if np.abs(depth).min() < 1e-9:
            continue
        image = np.delete(corners, axis, 2) / depth[..., None]
        one, other = image[:, 1] - image[:, 0], image[:, 2] - image[:, 0]
        area = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
        usual = float(np.median(area))
        if usual > 0 and np.median(np.abs(area - usual)) < PIXEL_SPREAD * usual:
            return True
    return False


def _camera_place(corners: Float[np.ndarray, "n 3 3"], normals: Points) -> Vector | None:
    """Find a camera position to which nearly all faces turn the same side. Return None if there is none."""
    centre, middle = corners.mean(1), corners.mean((0, 1))
    size = float(np.ptp(centre, axis=0).max())
    for side in (1.0, -1.0):
        eye = middle + side * size * normals.mean(0) / max(float(np.linalg.norm(normals.mean(0))), 1e-12)
        for _ in range(_STEPS):
            wrong = side * ((eye - centre) * normals).sum(1) < 0
            if wrong.mean() < 1 - FACING_SHARE:
                return eye if _faces(corners, normals, eye) else None
            eye = eye + 0.1 * size * side * normals[wrong].mean(0)
    return None


def _is_grid(mesh: TriangleMesh, border: Int[np.ndarray, "edges 2"]) -> bool:
    inner = np.ones(len(mesh.vertices), dtype=bool)
    inner[border] = False
    meet = np.bincount(mesh.faces.ravel(), minlength=len(mesh.vertices))
    inner &= meet > 0
    return bool(inner.any() and (meet[inner] == 6).mean() > GRID_SHARE)
