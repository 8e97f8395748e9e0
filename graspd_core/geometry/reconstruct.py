"""From a cloud to a closed mesh.

A cloud seen from all round is surfaced by screened Poisson (Kazhdan and Hoppe 2013). A single view shows only the
front: the back is guessed as the front's reflection through the centre of the silhouette, which is exact for boxes,
balls, cylinders and all that is point-symmetric, and gives a cup seen from above its walls; where that contradicts what
was seen, as the front's mirror image across the silhouette's depth. The guess is named in the warnings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.errors import CloudError
from graspd_core.geometry.cloud import PointCloud, clean_cloud
from graspd_core.geometry.mesh import check_mesh
from graspd_core.geometry.topology import is_closed
from graspd_core.types import TriangleMesh

# A surface seen from one side rises by less than this many cells over one cell on most lines of sight; with more than
# this share of exceptions, the cloud is taken to show the object from all round.
STEEPEST = 4.0
LAYERED_SHARE = 0.15

# Cells of the height maps across the object's larger side, as far as the points are dense enough.
CELLS = 72


@dataclass(frozen=True)
class _Slab:
    """A solid between two height maps over the image plane; depth grows away from the camera.

    Attributes:
        mask: where the object is.
        front, back: depth of the near and far surface [m], NaN outside the mask.
        low: image-plane position of the first cell [m].
        cell: side of a cell [m].
    """

    mask: Bool[np.ndarray, "x y"]
    front: Float[np.ndarray, "x y"]
    back: Float[np.ndarray, "x y"]
    low: Float[np.ndarray, "2"]
    cell: float


def reconstruct(
    points: Float[np.ndarray, "n 3"], *, viewpoint: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[TriangleMesh, tuple[str, ...]]:
    """A closed mesh of the object that the points show, and what was guessed.

    Args:
        points: the object's points alone [m]; NaN and stray points are dropped.
        viewpoint: where the camera stood [m].

    Raises:
        CloudError: too few points, or no closed surface fits them.
    """
    cloud = clean_cloud(points, np.asarray(viewpoint, dtype=float))
    if _layered_share(cloud) > LAYERED_SHARE:
        mesh, warnings = _poisson(cloud), ()
    else:
        mesh, warnings = _complete(cloud)
    mesh, _ = check_mesh(mesh, "reconstruction")
    if not is_closed(mesh):
        raise CloudError(f"cloud: no closed surface fits its {len(cloud.points)} points; more views are needed")
    return mesh, warnings


def _layered_share(cloud: PointCloud) -> float:
    """Share of lines of sight that meet points at depths too far apart for one surface, however steep."""
    from scipy.spatial import KDTree

    frame = _view_frame(cloud)
    local = (cloud.points - cloud.viewpoint) @ frame
    distance = float(local[:, 2].mean())
    # From very near the object, lines of sight are not spread enough to sort points by: any direction will do.
    if distance > np.ptp(cloud.points, axis=0).max() and local[:, 2].min() > 0:
        local[:, :2] *= distance / local[:, 2:]
    cell = 1.5 * float(np.median(KDTree(cloud.points).query(cloud.points, k=5)[0][:, -1]))
    _, sight = np.unique(np.round(local[:, :2] / cell).astype(int), axis=0, return_inverse=True)
    near, far = np.full(sight.max() + 1, np.inf), np.full(sight.max() + 1, -np.inf)
    np.minimum.at(near, sight.reshape(-1), local[:, 2])
    np.maximum.at(far, sight.reshape(-1), local[:, 2])
    return float((far - near > STEEPEST * cell).mean())


def _poisson(cloud: PointCloud) -> TriangleMesh:
    import open3d as o3d

    shell = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    shell.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(24))
    shell.orient_normals_consistent_tangent_plane(16)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        surface, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(shell, depth=7, n_threads=1)
    label, _, area = (np.asarray(x) for x in surface.cluster_connected_triangles())
    if len(area) == 0:
        raise CloudError(f"cloud: no surface fits its {len(cloud.points)} points")
    faces = np.asarray(surface.triangles, dtype=np.int64)[label == area.argmax()]
    mesh = TriangleMesh(np.asarray(surface.vertices), faces)
    reach = np.ptp(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0).max() / np.ptp(cloud.points, axis=0).max()
    if reach > 1.3:
        raise CloudError(f"cloud: the surface fitted to it is {reach:.1f} times its size; more views are needed")
    return mesh


def _complete(cloud: PointCloud) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Close a single view by a guessed back."""
    frame = _view_frame(cloud)
    centre = cloud.points.mean(0)
    slab, extruded = _guess_back(_height_map((cloud.points - centre) @ frame))
    mesh = _surface(slab)
    warnings = ("cloud: seen from one side only; its back is guessed by symmetry",)
    if extruded:
        warnings += ("cloud: seen face on; its depth is unknown and taken as half its smaller width",)
    return TriangleMesh(mesh.vertices @ frame.T + centre, mesh.faces), warnings


def _view_frame(cloud: PointCloud) -> Float[np.ndarray, "3 3"]:
    """Columns: two axes of the image plane, then the direction of view, in the cloud's frame."""
    view = cloud.points.mean(0) - cloud.viewpoint
    length = np.linalg.norm(view)
    view = view / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    right = np.cross(view, np.eye(3)[np.abs(view).argmin()])
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(view, right), view])


def _height_map(points: Float[np.ndarray, "n 3"]) -> _Slab:
    """The nearest depth over each cell, small holes closed; `back` is the farthest depth seen there."""
    from scipy.ndimage import binary_closing, binary_fill_holes
    from scipy.spatial import KDTree

    spacing = float(np.median(KDTree(points[:, :2]).query(points[:, :2], k=5)[0][:, -1]))
    size = float(np.ptp(points[:, :2], axis=0).max())
    cell = max(size / CELLS, 0.8 * spacing)
    margin = 4
    low = points[:, :2].min(0) - margin * cell
    index = np.round((points[:, :2] - low) / cell).astype(int)
    shape = tuple(index.max(0) + margin + 1)
    near, far = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(near, tuple(index.T), points[:, 2])
    np.maximum.at(far, tuple(index.T), points[:, 2])
    seen = np.isfinite(near)
    mask = np.asarray(binary_closing(seen, iterations=2), dtype=bool)
    # Holes of a cell or two are missing pixels; greater ones are the object's own, as in a ring.
    holes = np.asarray(binary_fill_holes(mask), dtype=bool) & ~mask
    mask |= holes & (_depth_within(holes)[0] < 1.5)
    _, nearest = _depth_within(~seen)
    front = np.where(mask, near[nearest], np.nan)
    return _Slab(mask, front, np.where(mask, far[nearest], np.nan), low, cell)


def _guess_back(seen: _Slab) -> tuple[_Slab, bool]:
    """A slab with a guessed back, and whether its depth had to be invented."""
    mask, front, deepest = seen.mask, seen.front, seen.back
    rim, lost = _rim(seen)
    # A point-symmetric body's outline is point-symmetric in all three coordinates: its mean is the centre.
    rows, columns = np.nonzero(rim)
    middle = np.array([rows.min() + rows.max(), columns.min() + columns.max()])
    depth = float(np.median(deepest[rim])) + lost
    i, j = np.indices(mask.shape)
    mirrored_i, mirrored_j = middle[0] - i, middle[1] - j
    valid = (mirrored_i >= 0) & (mirrored_i < mask.shape[0]) & (mirrored_j >= 0) & (mirrored_j < mask.shape[1])
    opposite = np.full(mask.shape, np.nan)
    opposite[valid] = front[mirrored_i[valid], mirrored_j[valid]]
    through_centre = 2 * depth - opposite
    mirrored = 2 * depth - front
    thinnest = max(2.0 * seen.cell, 0.003)
    usable = np.isfinite(through_centre) & (through_centre > deepest)
    back = np.where(usable, through_centre, mirrored)
    extruded = bool(np.nanmedian(back - front) < 0.1 * seen.cell * CELLS)
    if extruded:
        sides = np.array([np.ptp(rows), np.ptp(columns)]) * seen.cell
        back = np.full(mask.shape, np.nanmedian(front) + 0.5 * sides.min())
    back = np.where(mask, np.fmax(back, deepest + thinnest), np.nan)
    return _Slab(mask, front, back, seen.low, seen.cell), extruded


def _rim(seen: _Slab) -> tuple[Bool[np.ndarray, "x y"], float]:
    """The outermost cells, and how much deeper than them the outline lies [m].

    A round body's depth falls off as k √s at distance s from its outline, and the last row of pixels, a cell from it,
    misses k √cell. k is the median over pairs of a rim cell and one a few cells further in.
    """
    from scipy.ndimage import binary_erosion

    rim = seen.mask & ~np.asarray(binary_erosion(seen.mask), dtype=bool)
    inward, _ = _depth_within(seen.mask)
    _, nearest = _depth_within(~rim)
    band = (inward > 2) & (inward < 8)
    rise = seen.front[nearest][band] - seen.front[band]
    if len(rise) == 0:
        return rim, 0.0
    slope = np.median(rise / (np.sqrt(inward[band]) - 1))
    return rim, float(max(slope, 0.0))


def _surface(slab: _Slab) -> TriangleMesh:
    """The zero surface of the greatest of: depth before the front, depth past the back, distance from the mask."""
    import igl
    from scipy.ndimage import gaussian_filter

    cell, mask = slab.cell, slab.mask
    outside, nearest = _depth_within(~mask)
    lateral = (outside - _depth_within(mask)[0]) * cell
    lateral += np.where(mask, 0.5, -0.5) * cell
    front, back = slab.front[nearest], slab.back[nearest]
    depth = np.arange(front.min() - 3 * cell, back.max() + 3 * cell, cell)
    side = np.broadcast_to(lateral[..., None], (*mask.shape, len(depth)))
    value = np.maximum.reduce([front[..., None] - depth, depth - back[..., None], side])
    # Smoothed, because height maps are stairs; kept off zero at the nodes, where the surface would pinch to nothing.
    value = gaussian_filter(value, 0.7)
    value = np.where(np.abs(value) < 0.03 * cell, np.where(value < 0, -0.03, 0.03) * cell, value)
    nodes = np.stack(
        np.meshgrid(*(slab.low[k] + cell * np.arange(mask.shape[k]) for k in (0, 1)), depth, indexing="ij"), -1
    )
    # igl counts the first coordinate fastest.
    columns = nodes.transpose(2, 1, 0, 3).reshape(-1, 3)
    march: Any = igl.marching_cubes
    answer = march(value.ravel(order="F"), columns, *value.shape, 0.0)
    vertices, faces = answer[:2]
    if len(faces) == 0:
        raise CloudError("cloud: the object is too small against the spacing of its points")
    a, b, c = vertices[faces].transpose(1, 0, 2)
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        faces = faces[:, ::-1]
    return TriangleMesh(np.asarray(vertices), np.asarray(faces, dtype=np.int64))


def _depth_within(mask: Bool[np.ndarray, "x y"]) -> tuple[Float[np.ndarray, "x y"], tuple[np.ndarray, ...]]:
    """How many cells each cell of the mask is from the nearest one outside it, and that one's indices."""
    from scipy.ndimage import distance_transform_edt

    answer: Any = distance_transform_edt(mask, return_indices=True)
    return answer[0], tuple(answer[1])
