"""Point clouds in: reading and cleaning. Metres, in the camera's frame unless the file says where the camera stood."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError

CLOUD_ENDINGS = ("npy", "npz", "pcd", "ply", "xyz")

FEWEST_POINTS = 50
MOST_POINTS = 20_000


@dataclass(frozen=True)
class PointCloud:
    """Points that one camera saw. Several views of a scene are several of these, in one frame.

    Attributes:
        points: positions [m]; may hold NaN until cleaned.
        viewpoint: where the camera stood, in the same frame [m].
        forward: unit direction of its optical axis, in the same frame; None where it is not known.
    """

    points: Float[np.ndarray, "points 3"]
    viewpoint: Float[np.ndarray, "3"]
    forward: Float[np.ndarray, "3"] | None = None


def is_cloud_file(path: str | Path) -> bool:
    """Whether a path names a cloud by its ending; a ply counts when its header declares no faces."""
    path = Path(path)
    ending = path.suffix.lower().lstrip(".")
    if ending == "ply":
        return path.is_file() and not _ply_has_faces(path)
    return ending in CLOUD_ENDINGS


def load_cloud(path: str | Path) -> PointCloud:
    """Read a cloud: ply, pcd, xyz, npy (n×3) or npz (`points`, optional `viewpoint`; else the origin).

    Raises:
        CloudError: the file is missing, of an unknown ending, unreadable, or not n×3 numbers.
    """
    path = Path(path)
    ending = path.suffix.lower().lstrip(".")
    if path.is_dir():
        raise CloudError(f"{path}: is a directory; give a cloud file ({', '.join(CLOUD_ENDINGS)})")
    if not path.exists():
        raise CloudError(f"{path}: no such cloud file")
    if ending not in CLOUD_ENDINGS:
        raise CloudError(f"{path}: unknown cloud ending {path.suffix!r}; valid endings: {', '.join(CLOUD_ENDINGS)}")
    viewpoint = np.zeros(3)
    if ending in ("npy", "npz"):
        points, viewpoint = _read_numpy(path)
    else:
        points = _read_open3d(path)
    return PointCloud(points, viewpoint)


def clean_cloud(points: Float[np.ndarray, "n 3"], viewpoint: Float[np.ndarray, "3"]) -> PointCloud:
    """Drop points that are not finite, thin to an even density, drop outliers.

    Raises:
        CloudError: empty, all NaN, or fewer than 50 points left.
    """
    import open3d as o3d

    if len(points) == 0:
        raise CloudError("cloud: empty, no points at all")
    finite = np.asarray(points, dtype=float)[np.isfinite(points).all(1)]
    if len(finite) == 0:
        raise CloudError(f"cloud: all {len(points)} points are NaN or infinite")
    _refuse_few(len(finite), len(points), "finite")
    spread = np.percentile(finite, 98, axis=0) - np.percentile(finite, 2, axis=0)
    size = float(np.linalg.norm(spread))
    if size <= 0:
        raise CloudError(f"cloud: all {len(finite)} points are in one place")
    # A hundredth of the object's diagonal: fine enough for the shape, and at most some 10⁴ points on its surface.
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(finite))
    thinned = cloud.voxel_down_sample(size / 100)
    _refuse_few(len(thinned.points), len(points), "distinct")
    kept, _ = thinned.remove_statistical_outlier(nb_neighbors=20, std_ratio=2.5)
    result = np.asarray(kept.points)
    _refuse_few(len(result), len(points), "plausible")
    return PointCloud(result, np.asarray(viewpoint, dtype=float))


def _refuse_few(left: int, given: int, kind: str) -> None:
    if left < FEWEST_POINTS:
        raise CloudError(f"cloud: only {left} {kind} points of {given}; at least {FEWEST_POINTS} are needed")


def _ply_has_faces(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.read(4096).split(b"end_header")[0]
    faces = [line.split() for line in header.splitlines() if line.startswith(b"element face")]
    return any(len(words) > 2 and words[2] != b"0" for words in faces)


def _read_numpy(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        stored = np.load(path, allow_pickle=False)
        points = stored if isinstance(stored, np.ndarray) else stored["points"]
        viewpoint = np.zeros(3) if isinstance(stored, np.ndarray) or "viewpoint" not in stored else stored["viewpoint"]
        points, viewpoint = np.asarray(points, dtype=float), np.asarray(viewpoint, dtype=float)
    except KeyError as error:
        raise CloudError(f"{path}: holds no array called 'points'") from error
    except (ValueError, OSError, EOFError) as error:
        raise CloudError(f"{path}: not readable as numbers ({str(error).splitlines()[0]})") from error
    if points.ndim == 3 and points.shape[2] == 3:
        points = points.reshape(-1, 3)
    if points.ndim != 2 or points.shape[1] != 3 or viewpoint.shape != (3,):
        raise CloudError(f"{path}: shape {points.shape}, viewpoint {viewpoint.shape}; points × 3 and 3 are needed")
    return points, viewpoint


def _read_open3d(path: Path) -> np.ndarray:
    import open3d as o3d

    # Open3D prints its complaints and returns nothing; the error below says it once.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(path, remove_nan_points=False, remove_infinite_points=False)
    if len(cloud.points) == 0:
        raise CloudError(f"{path}: empty, or not a readable {path.suffix.lstrip('.')} cloud")
    return np.array(cloud.points)
