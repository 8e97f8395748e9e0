"""Clouds that show an object from all round without saying which camera saw what."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError
from graspd_core.mesh.unique_rows import packed_rows
from graspd_core.pointcloud.free_space import view_frame
from graspd_core.pointcloud.point_cloud import PointCloud, clean_cloud
from graspd_core.reconstruction.merge_views import Surfels

# A surface seen from one side rises by less than this many cells over one cell on most lines of sight; with more than
# this share of exceptions, the cloud is taken to show the object from all round. Where it is known which way a camera
# looked it takes more: from above, a third of the lines may run along the sides of a cup.
MAX_RISE_CELLS = 4.0
LAYERED_SHARE, LAYERED_SHARE_OF_CAMERA = 0.15, 0.45

# Neighbours for a normal, and for passing its sense on.
NORMAL_NEIGHBOURS, ORIENTATION_NEIGHBOURS = 24, 16
# Points that are too regular for that are moved by up to this many steps.
JITTER_STEPS = 0.02


def is_unposed(view: PointCloud, axis_known: bool = False) -> bool:
    """Whether a cloud shows surface behind surface on many lines of sight, as no single camera sees it.

    Args:
        view: the object's points.
        axis_known: it is said which way the camera looked.
    """
    from scipy.spatial import KDTree

    points = clean_cloud(view.points, view.viewpoint).points
    local = (points - view.viewpoint) @ view_frame(PointCloud(points, view.viewpoint))
    distance = float(local[:, 2].mean())
    # From very near the object, lines of sight are not spread enough to sort points by: any direction will do.
    if distance > np.ptp(points, axis=0).max() and local[:, 2].min() > 0:
        local[:, :2] *= distance / local[:, 2:]
    cell = 1.5 * float(np.median(KDTree(points).query(points, k=5)[0][:, -1]))
    _, line = np.unique(packed_rows(np.round(local[:, :2] / cell).astype(int)), return_inverse=True)
    near, far = np.full(line.max() + 1, np.inf), np.full(line.max() + 1, -np.inf)
    np.minimum.at(near, line, local[:, 2])
    np.maximum.at(far, line, local[:, 2])
    most = LAYERED_SHARE_OF_CAMERA if axis_known else LAYERED_SHARE
    return bool((far - near > MAX_RISE_CELLS * cell).mean() > most)


def orient_unposed(view: PointCloud, step: float) -> Surfels:
    """Points of an all-round cloud, `step` [m] apart, with normals that agree with their neighbours'.

    Raises:
        CloudError: no surface passes through them.
    """
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(view.points)).voxel_down_sample(step)
    points = np.asarray(cloud.points)
    # The triangulation that passes the sense on fails on points exactly on a sphere, a plane or a line.
    shaken = points + JITTER_STEPS * step * np.random.default_rng(0).uniform(-1, 1, points.shape)
    for tried in (points, shaken):
        with suppress(RuntimeError):
            return Surfels(points, _normals(tried))
    raise CloudError(f"cloud: no surface passes through its {len(points)} points; views with their cameras are needed")


def _normals(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    cloud.orient_normals_consistent_tangent_plane(ORIENTATION_NEIGHBOURS)
    return np.asarray(cloud.normals)
