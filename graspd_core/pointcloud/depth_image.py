"""Depth images to points: their encodings, their bytes as a camera sends them, and the cloud they show."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt16

from graspd_core.errors import CloudError
from graspd_core.pointcloud.camera import PinholeCamera, camera_rays
from graspd_core.pointcloud.point_cloud import PointCloud, transform_cloud

# Encoding: type of a pixel, and metres per unit of it.
ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}


def depth_in_metres(
    image: UInt16[np.ndarray, "height width"] | Float[np.ndarray, "height width"], encoding: str
) -> Float[np.ndarray, "height width"]:
    """Depth along the optical axis [m], 0 where the image has none: zero, negative, NaN or infinite.

    Raises:
        CloudError: an encoding that is no depth, or pixels that are not of its type.
    """
    kind, unit = _encoding(encoding)
    if image.dtype.kind != kind[0] or (kind[0] == "u" and image.dtype.itemsize != 2):
        raise CloudError(f"depth image: pixels are {image.dtype}, but encoding {encoding} holds {np.dtype(kind)}")
    if kind[0] == "u":
        return image.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(image) & (image > 0), image, image.dtype.type(0))


def depth_from_bytes(
    data: memoryview,
    *,
    width: int,
    height: int,
    step: int,
    encoding: str,
    is_bigendian: bool = False,
) -> Float[np.ndarray, "height width"]:
    """Depth [m] from the bytes of an Image message: rows of `step` bytes, padded or not, in either byte order.

    Raises:
        CloudError: an encoding that is no depth, an empty image, or sizes that contradict each other.
    """
    if width == 0 or height == 0:
        raise CloudError(f"the depth image is empty: width={width}, height={height}")
    dtype = np.dtype((">" if is_bigendian else "<") + _encoding(encoding)[0])
    row = width * dtype.itemsize
    if step < row:
        raise CloudError(f"depth image: step={step} is smaller than width={width} pixels of {dtype.itemsize} bytes")
    needed = (height - 1) * step + row
    if data.nbytes < needed:
        raise CloudError(
            f"depth image: {data.nbytes} bytes, but height={height}, step={step} and width={width} need {needed}"
        )
    pixels = np.ndarray((height, width), dtype, data, 0, (step, dtype.itemsize))
    return depth_in_metres(pixels.astype(dtype.newbyteorder("=")), encoding)


def cloud_from_depth(
    depth: Float[np.ndarray, "height width"],
    camera: PinholeCamera,
    T_frame_camera: Float[np.ndarray, "4 4"] | None = None,
) -> PointCloud:
    """What a camera saw, in its own frame or, where its pose is given, in that frame; pixels without depth give none.

    Args:
        depth: along the optical axis [m]; 0, NaN and infinite mean none.
        camera: of the same size as the image.
        T_frame_camera: pose of the camera (z forward, x right, y down).

    Raises:
        CloudError: the image is not of the camera's size.
    """
    if depth.shape != (camera.height, camera.width):
        raise CloudError(
            f"depth image: {depth.shape[1]} x {depth.shape[0]} pixels, "
            f"but its camera has {camera.width} x {camera.height}"
        )
    flat = depth.reshape(-1)
    seen = np.flatnonzero(np.isfinite(flat) & (flat > 0))
    points = camera_rays(camera).reshape(-1, 3).take(seen, axis=0)
    points *= flat[seen, None]
    if camera.distortion:
        # Pixels beyond the range of the lens model have no ray.
        points = points[np.isfinite(points[:, 0])]
    cloud = PointCloud(points, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return cloud if T_frame_camera is None else transform_cloud(cloud, T_frame_camera)


def _encoding(name: str) -> tuple[str, float]:
    if name not in ENCODINGS:
        raise CloudError(f"depth image: encoding {name!r} is no depth; valid: {', '.join(ENCODINGS)}")
    return ENCODINGS[name]
