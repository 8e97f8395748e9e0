"""Clouds from files: point formats, arrays, and depth images with the camera that took them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError
from graspd_core.pointcloud.camera import camera_from_calibration
from graspd_core.pointcloud.depth_image import cloud_from_depth, depth_in_metres
from graspd_core.pointcloud.ply_pcd import read_pcd_points, read_ply_points
from graspd_core.pointcloud.point_cloud import PointCloud

CLOUD_ENDINGS = ("npy", "npz", "pcd", "ply", "xyz")

_ROTATION_TOLERANCE = 1e-4
# What an archive may unpack to [bytes]: 100 depth images of two million pixels are a quarter of it.
_MAX_UNPACKED_BYTES = 2**31


def is_cloud_file(path: str | Path) -> bool:
    """Whether a path names a cloud by its ending; a ply counts when its header declares no faces."""
    path = Path(path)
    ending = path.suffix.lower().lstrip(".")
    if ending == "ply":
        return path.is_file() and not _ply_has_faces(path)
    return ending in CLOUD_ENDINGS


def load_views(path: str | Path) -> tuple[PointCloud, ...]:
    """Read what one or several cameras saw, in one frame.

    * ply, xyz; npy (n×3 or h×w×3): points [m], seen from the origin.
    * pcd: points [m], seen from where its `VIEWPOINT` stands; which way that looked, the format leaves open.
    * npz with `points`, and where known `viewpoint` [m] and `forward` (the direction of the optical axis).
    * npz with `depth` (h×w; integers are millimetres, floats metres) and the camera's matrix `K` (3×3), where known
      also `distortion` (k1 k2 p1 p2 k3) and the camera's pose `T_world_camera` (4×4).
    * npz with `depths` (views×h×w), `K`, `poses` (views×4×4, each `T_world_camera`), where known `distortion`.

    Raises:
        CloudError: the file is missing, of an unknown ending, unreadable, or does not hold one of these.
    """
    path = Path(path)
    ending = path.suffix.lower().lstrip(".")
    if path.is_dir():
        raise CloudError(f"{path}: is a directory; give a cloud file ({', '.join(CLOUD_ENDINGS)})")
    if not path.exists():
        raise CloudError(f"{path}: no such cloud file")
    if ending not in CLOUD_ENDINGS:
        raise CloudError(f"{path}: unknown cloud ending {path.suffix!r}; valid endings: {', '.join(CLOUD_ENDINGS)}")
    if ending not in ("npy", "npz"):
        return (PointCloud(_read_points(path, ending), _pcd_viewpoint(path) if ending == "pcd" else np.zeros(3)),)
    arrays = _read_numpy(path)
    try:
        if "depth" in arrays or "depths" in arrays:
            return _depth_views(arrays)
        return (_points_view(arrays),)
    except CloudError as error:
        raise CloudError(f"{path}: {error}") from None


def _points_view(arrays: Mapping[str, np.ndarray]) -> PointCloud:
    if "points" not in arrays:
        raise CloudError(f"holds no array called 'points', 'depth' or 'depths'; it has: {', '.join(arrays) or 'none'}")
    points, viewpoint = _numbers(arrays, "points"), np.zeros(3)
    forward = None
    if "viewpoint" in arrays:
        viewpoint = _numbers(arrays, "viewpoint")
    if "forward" in arrays:
        forward = _numbers(arrays, "forward")
    if points.ndim == 3 and points.shape[2] == 3:
        points = points.reshape(-1, 3)
    if points.ndim != 2 or points.shape[1] != 3 or viewpoint.shape != (3,):
        raise CloudError(f"shape {points.shape}, viewpoint {viewpoint.shape}; points × 3 and 3 are needed")
    if not np.isfinite(viewpoint).all():
        raise CloudError("'viewpoint' is NaN or infinite")
    if forward is not None:
        largest = np.abs(forward).max(initial=0.0)
        if forward.shape != (3,) or not 0 < largest < np.inf:
            raise CloudError("'forward' is no direction; 3 finite numbers are needed, not all zero")
        forward = forward / largest
        forward = forward / np.linalg.norm(forward)
    return PointCloud(points, viewpoint, forward)


def _depth_views(arrays: Mapping[str, np.ndarray]) -> tuple[PointCloud, ...]:
    several = "depths" in arrays
    name, place = ("depths", "poses") if several else ("depth", "T_world_camera")
    for needed in ("K", place) if several else ("K",):
        if needed not in arrays:
            raise CloudError(f"holds {name!r} but no {needed!r}; it has: {', '.join(arrays)}")
    images, poses = arrays[name], arrays.get(place)
    if not several:
        images, poses = images[None], None if poses is None else poses[None]
    if images.ndim != 3 or images.size == 0:
        raise CloudError(f"{name!r} has shape {arrays[name].shape}; {'views × ' * several}height × width is needed")
    if poses is not None and poses.shape != (len(images), 4, 4):
        raise CloudError(f"{place!r} has shape {arrays[place].shape}; {f'{len(images)} × ' * several}4 × 4 is needed")
    matrix = _numbers(arrays, "K")
    if matrix.shape != (3, 3):
        raise CloudError(f"'K' has shape {matrix.shape}; 3 × 3 is needed")
    distortion = _numbers(arrays, "distortion").reshape(-1).tolist() if "distortion" in arrays else ()
    _, height, width = images.shape
    model = "plumb_bob" if len(distortion) <= 5 else "rational_polynomial"
    camera = camera_from_calibration(width, height, matrix.reshape(-1).tolist(), distortion, model)
    views = []
    for index, image in enumerate(images):
        pose = None if poses is None else _rigid(poses[index], place)
        views.append(cloud_from_depth(_metres(image, name), camera, pose))
    return tuple(views)


def _metres(image: np.ndarray, name: str) -> Float[np.ndarray, "height width"]:
    if image.dtype.kind in "iu":
        return depth_in_metres(image.astype(float).clip(0, 2**16 - 1).astype(np.uint16), "16UC1")
    if image.dtype.kind == "f":
        # What is too far for a number of 32 bits is infinitely far, which means no depth.
        with np.errstate(over="ignore", invalid="ignore"):
            return depth_in_metres(image.astype(np.float32), "32FC1")
    raise CloudError(f"{name!r} holds {image.dtype}; integers (mm) or floats (m) are needed")


def _rigid(pose: np.ndarray, name: str) -> Float[np.ndarray, "4 4"]:
    pose = _numbers({name: pose}, name)
    turn = np.nan_to_num(pose[:3, :3]).clip(-2, 2)
    square = np.abs(turn @ turn.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(turn) > 0
    if not (np.isfinite(pose).all() and square and np.allclose(pose[3], (0, 0, 0, 1))):
        raise CloudError(
            f"{name!r} is no rigid transform: its upper left 3 × 3 must be a rotation, its last row 0 0 0 1"
        )
    return pose


def _numbers(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    if arrays[name].dtype.kind not in "biuf":
        raise CloudError(f"{name!r} not readable as numbers: it holds {str(arrays[name].dtype)[:80]}")
    # A NaN of any kind stays one: numpy would warn of those that signal.
    with np.errstate(invalid="ignore", over="ignore"):
        return arrays[name].astype(float)


def _read_numpy(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz, or that of an npy as `points`."""
    try:
        # numpy leaves a spoilt file open when it is given the path.
        with path.open("rb") as file:
            stored = np.load(file, allow_pickle=False)
            if isinstance(stored, np.ndarray):
                return {"points": stored}
            unpacked = sum(entry.file_size for entry in stored.zip.infolist())
            if unpacked > _MAX_UNPACKED_BYTES:
                raise ValueError(f"{unpacked} bytes when unpacked; at most {_MAX_UNPACKED_BYTES} are taken")
            return {name: stored[name] for name in stored.files}
    # A spoilt file shows as whatever it brings about in numpy, its zip reader and its reader of Python's literals;
    # one whose header promises more than there is as a lack of memory.
    except Exception as error:
        raise CloudError(f"{path}: not readable as numbers ({_first_line(error)})") from error


def _ply_has_faces(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.read(4096).split(b"end_header")[0]
    faces = [line.split() for line in header.splitlines() if line.startswith(b"element face")]
    return any(len(words) > 2 and words[2] != b"0" for words in faces)


def _pcd_viewpoint(path: Path) -> Float[np.ndarray, "3"]:
    """Where the sensor stood, by the header; the origin where it does not say."""
    with path.open("rb") as file:
        header = file.read(4096).split(b"\nDATA")[0]
    line = next((line.split()[1:4] for line in header.splitlines() if line.startswith(b"VIEWPOINT")), [b"0"] * 3)
    try:
        place = np.array([float(word) for word in line])
    except ValueError:
        place = np.zeros(0)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise CloudError(f"{path}: its VIEWPOINT is not 3 finite numbers and a quaternion")
    return place


def _read_points(path: Path, ending: str) -> Float[np.ndarray, "n 3"]:
    points = None
    try:
        if ending == "ply":
            points = read_ply_points(path)
        elif ending == "pcd":
            points = read_pcd_points(path)
    except (ValueError, TypeError, OSError) as error:
        raise CloudError(f"{path}: not a readable {ending} cloud ({_first_line(error)})") from error
    points = _read_open3d(path) if points is None else points
    if len(points) == 0:
        raise CloudError(f"{path}: empty, or not a readable {ending} cloud")
    return points


def _read_open3d(path: Path) -> Float[np.ndarray, "n 3"]:
    import open3d as o3d

    # Open3D prints its complaints and returns nothing; the error below says it once.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            cloud = o3d.io.read_point_cloud(path, remove_nan_points=False, remove_infinite_points=False)
        except (MemoryError, RuntimeError) as error:
            raise CloudError(f"{path}: not a readable cloud ({_first_line(error)})") from error
    return np.array(cloud.points).reshape(-1, 3)


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).splitlines()), "")[:200] or type(error).__name__
