"""Read a depth image from one file, and its camera from another file, the camera file (`--camera`).

The camera file is JSON with `width`, `height`, and one of `K` (row by row), Open3D's `intrinsic_matrix` (column by
column), or `fx fy cx cy`. Optional keys are `distortion` and `distortion_model` as in CameraInfo, `T_world_camera`
(4×4), and `depth_unit`: metres per unit of the image, or m, cm, mm or um. `depth_scale` is refused, as its unit varies.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError, short_repr
from graspd_core.perception.cloud.camera import (
    DepthImage,
    PinholeCamera,
    camera_from_calibration,
    cloud_from_depth,
    depth_in_metres,
)
from graspd_core.perception.cloud.cloud_files import read_numpy, refuse_near_names, rigid
from graspd_core.perception.cloud.point_cloud import PointCloud

IMAGE_ENDINGS, DEPTH_ENDINGS = ("png", "tif", "tiff"), ("png", "tif", "tiff", "npy", "npz")
_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
# Metres per unit of an integer image, if no unit is given. Cameras send millimetres.
_WHOLE = 1e-3
# If the median depth is above this [m], the unit must be wrong.
_FARTHEST = 50.0
_SIMPLE = ("fx", "fy", "cx", "cy")
# A camera, its pose `T_world_camera` (z forward, x right, y down), and metres per unit of its depth images. Pose and
# unit are None if the camera's file does not give them.
DepthCamera = tuple[PinholeCamera, Float[np.ndarray, "4 4"] | None, float | None]


def is_depth_image(path: str | Path) -> bool:
    """Return True if a path has the ending of a depth image. Such a file needs a camera file."""
    return Path(path).suffix.lower().lstrip(".") in IMAGE_ENDINGS


def load_depth_view(image: str | Path, camera: str | Path, unit: float | None = None) -> PointCloud:
    """Read the points of a depth image, in the world frame if the camera file has a pose, else in the camera frame.

    Args:
        image: a png or tiff of 16 bits or floats, an npy, or an npz with `depth`.
        camera: the camera file, described at the top of this module.
        unit: metres per unit of the image. If None, the unit of the camera file is used. If the camera file has no
            unit, integers are millimetres and floats are metres.

    Raises:
        CloudError: a file cannot be read or has the wrong content, or image and camera do not fit each other.
    """
    taken_by, pose, own_unit = load_depth_camera(camera)
    depth = _metres(_pixels(Path(image)), unit or own_unit, str(image))
    try:
        return cloud_from_depth(depth, taken_by, pose)
    except CloudError as error:
        raise CloudError(f"{image}: {error} ({camera})") from None


def load_depth_camera(path: str | Path) -> DepthCamera:
    """Read a camera file. Raises CloudError if the file is missing, is not JSON, lacks a key, or has a bad value."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise CloudError(f"{path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise CloudError(f"{path}: not JSON: {str(error)[:200]}") from None
    if not isinstance(content, dict):
        raise CloudError(f"{path}: {short_repr(content)}; valid: a JSON object with width, height and K")
    try:
        return _camera_of(content)
    except CloudError as error:
        raise CloudError(f"{path}: {error}") from None


def _camera_of(content: Mapping[str, Any]) -> DepthCamera:
    for key in ("width", "height"):
        if key not in content:
            raise CloudError(f"{key} is missing; give the image's width and height; the file has {_keys(content)}")
    if "depth_scale" in content and "depth_unit" not in content:
        raise CloudError(
            f"depth_scale: {short_repr(content['depth_scale'])} is ambiguous, because programs disagree on its unit; "
            "write depth_unit, in metres per unit: 0.001 for millimetres"
        )
    refuse_near_names(content, ("T_world_camera", "distortion", "distortion_model", "depth_unit"), "key")
    width, height = (int(_numbers(content[key], (), key)) for key in ("width", "height"))
    distortion = _numbers(content.get("distortion", []), None, "distortion").reshape(-1).tolist()
    model = content.get("distortion_model", "plumb_bob" if len(distortion) <= 5 else "rational_polynomial")
    camera = camera_from_calibration(width, height, _matrix(content), distortion, str(model))
    pose = None
    if "T_world_camera" in content:
        pose = rigid(_numbers(content["T_world_camera"], (4, 4), "T_world_camera"), "T_world_camera")
    return camera, pose, _unit(content["depth_unit"]) if "depth_unit" in content else None


def _matrix(content: Mapping[str, Any]) -> list[float]:
    """Return the nine numbers of the camera matrix, row by row, from the keys of a camera file."""
    if "K" in content:
        return _numbers(content["K"], None, "K").reshape(-1).tolist()
    if "intrinsic_matrix" in content:
        return _numbers(content["intrinsic_matrix"], (9,), "intrinsic_matrix").reshape(3, 3).T.reshape(-1).tolist()
    lost = [key for key in _SIMPLE if key not in content]
    if lost:
        raise CloudError(f"{lost[0]} is missing; give K, or fx, fy, cx and cy; the file has {_keys(content)}")
    fx, fy, cx, cy = (float(_numbers(content[key], (), key)) for key in _SIMPLE)
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _unit(value: Any) -> float:
    """Return metres per unit, from a number or from a text that begins with the name of a unit."""
    word = value.replace(",", " ").split()[:1] if isinstance(value, str) else None
    if word and word[0] in _UNITS:
        return _UNITS[word[0]]
    unit = 0.0 if isinstance(value, str) else float(_numbers(value, (), "depth_unit"))
    if not 0 < unit <= 1:
        raise CloudError(f"depth_unit: {short_repr(value)}; valid: metres per unit in (0, 1], or {', '.join(_UNITS)}")
    return unit


def _numbers(value: Any, shape: tuple[int, ...] | None, key: str) -> np.ndarray:
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all() or isinstance(value, bool) or (shape is not None and numbers.shape != shape):
        wanted = "numbers" if shape is None else f"{' × '.join(map(str, shape))} numbers" if shape else "a number"
        raise CloudError(f"{key}: {short_repr(value)}; expected {wanted}")
    return numbers


def _keys(content: Mapping[str, Any]) -> str:
    return ", ".join(str(key)[:40] for key in list(content)[:20]) or "no key"


def _pixels(path: Path) -> np.ndarray:
    """Read the pixels of an image, unchanged."""
    if not path.is_file():
        raise CloudError(f"{path}: no such depth image")
    if path.suffix.lower().lstrip(".") not in DEPTH_ENDINGS:
        valid = ", ".join(DEPTH_ENDINGS)
        raise CloudError(f"{path}: a camera file needs a depth image; valid endings: {valid}")
    if not is_depth_image(path):
        arrays = read_numpy(path)
        name = "points" if path.suffix.lower() == ".npy" else "depth"
        if name not in arrays:
            raise CloudError(f"{path}: holds no array called 'depth'; it has: {', '.join(arrays) or 'none'}")
        return arrays[name]
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image)
    # For a broken file, Pillow may raise any exception.
    except Exception as error:
        raise CloudError(f"{path}: not a readable image ({str(error)[:200] or type(error).__name__})") from None


def _metres(pixels: np.ndarray, unit: float | None, name: str) -> DepthImage:
    """Return depth [m], 0 for missing depth. Raises CloudError if pixels hold no depth or the unit seems wrong."""
    if pixels.ndim != 2 or pixels.dtype.kind not in "iuf" or pixels.dtype.itemsize < 2:
        size = f"{' × '.join(map(str, pixels.shape))} of {pixels.dtype}"
        raise CloudError(f"{name}: {size} is not a depth image; valid: one channel of 16 bits or more")
    unit = unit or (1.0 if pixels.dtype.kind == "f" else _WHOLE)
    # Values too large for float32 become infinite, which means missing depth.
    with np.errstate(over="ignore", invalid="ignore"):
        depth = depth_in_metres((pixels.astype(float) * unit).astype(np.float32), "32FC1")
    seen = depth[depth > 0]
    if len(seen) and float(np.median(seen)) > _FARTHEST:
        reason = f"half of its depths are beyond {float(np.median(seen)):.0f} m at {unit:g} m a unit"
        raise CloudError(f"{name}: {reason}; give the unit: --units mm, or depth_unit in the camera's file")
    return depth
