"""Model pinhole cameras with lens distortion, convert depth images to points, and find objects at the image border.

Camera frames follow the optical convention: z forward, x right, y down. The distortion follows OpenCV's model (Brown
and Conrady). ROS calls the model plumb_bob with k1, k2, p1, p2, k3, and rational_polynomial if k4, k5, k6 follow.
An object that reaches the image border may continue beyond the border.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, UInt16

from graspd_core.errors import CloudError
from graspd_core.mesh.convex_parts import convex_hull
from graspd_core.perception.cloud.free_space import view_frame
from graspd_core.perception.cloud.point_cloud import PointCloud, Vector, longest_side, transform_cloud

DISTORTION_MODELS = {"plumb_bob": 5, "rational_polynomial": 8}

_Numbers = Sequence[float | int]
# Positions (x, y) on the plane at depth 1, or (column, row) in an image [pixels].
_Places = Float[np.ndarray, "*batch 2"]
DepthImage = Float[np.ndarray, "height width"]

# Newton's method doubles the correct digits in each step. Most lenses need five steps, extreme lenses a few more.
_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-10
# Smallest valid focal length, and largest valid number of a calibration [pixels]. Other values give infinite rays.
_MIN_FOCAL_PX, _MAX_CALIBRATION_PX = 1e-2, 1e7
# A hull side is an image border only if this many points of the object touch the side, and as many other points. An
# object without other points around it has a hull too, but no image border.
MIN_BORDER_POINTS = 8
# Hull sides shorter than this fraction of the hull's longest extent are not image borders.
MIN_SIDE_SHARE = 0.1
# An image border has points along its whole length: with SIDE_PARTS equal parts, at least MIN_FILLED_SHARE of the parts
# have points. A hull side from an object's top to a corner of the table has points only at its ends.
SIDE_PARTS, MIN_FILLED_SHARE = 20, 0.6
# The hull of at most this many points is checked first, because most objects are far from the hull.
HULL_POINTS = 2000
# For each depth encoding: NumPy type of a pixel, and metres per unit.
ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0), "64FC1": ("f8", 1.0)}
# Advice for images that hold no depth, by the beginning of the encoding's name.
_REMEDIES = {
    ("8U", "mono8"): "8 bits per pixel are too few for depth: publish 16UC1 (millimetres) or 32FC1 (metres)",
    ("rgb", "bgr"): "it is a colour picture: name the depth image's topic",
}
# In depth images that were cut to 8 bits: greatest depth [m], and smallest fraction of pixels with the greatest depth.
_MOST_OF_8_BITS, _CUT_SHARE = 0.255, 0.2
# If the principal point is off the middle by equal factors across and down, the camera matrix is for another size.
# Cropping seldom gives equal factors. Limits: least |factor - 1|, relative difference of the factors, largest factor.
_OFF_MIDDLE, _SAME_MIDDLE, _MOST_SCALED = 0.3, 0.08, 4.5


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera, with optional lens distortion.

    Attributes:
        width, height: size of the image [pixels].
        fx, fy: focal lengths [pixels].
        cx, cy: principal point, where the optical axis meets the image [pixels].
        distortion: k1, k2, p1, p2, k3, k4, k5, k6. Missing coefficients are zero.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise CloudError(f"camera: an image of {self.width} x {self.height} pixels; valid: at least 1 x 1")
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        # For NaN, the comparisons are false.
        finite = all(abs(number) <= _MAX_CALIBRATION_PX for number in numbers)
        if not (finite and min(self.fx, self.fy) >= _MIN_FOCAL_PX):
            raise CloudError(
                f"camera: fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy} is not a calibration; "
                "valid: finite numbers, fx and fy above 0"
            )
        if len(self.distortion) > 8:
            raise CloudError(f"camera: {len(self.distortion)} distortion coefficients; valid: at most 8")


def camera_from_calibration(
    width: int, height: int, matrix: _Numbers, distortion: _Numbers = (), model: str = "plumb_bob"
) -> PinholeCamera:
    """Return a camera from image size [pixels], camera matrix (row by row), distortion coefficients and their model.

    Raises CloudError if `model` is unknown, `distortion` has too many numbers, size or `matrix` is not valid, or
    `matrix` is given column by column.
    """
    if len(matrix) != 9:
        raise CloudError(f"camera: its matrix K has {len(matrix)} numbers; 9 are needed")
    coefficients = tuple(float(value) for value in distortion)
    if not any(coefficients) and model in (*DISTORTION_MODELS, ""):
        coefficients = ()
    elif model not in DISTORTION_MODELS:
        raise CloudError(f"camera: unknown distortion model {model!r}; valid: {', '.join(DISTORTION_MODELS)}")
    elif len(coefficients) > DISTORTION_MODELS[model]:
        raise CloudError(
            f"camera: {len(coefficients)} distortion coefficients; {model} has at most {DISTORTION_MODELS[model]}"
        )
    fx, fy, cx, cy = (float(matrix[index]) for index in (0, 4, 2, 5))
    camera = PinholeCamera(int(width), int(height), fx, fy, cx, cy, coefficients)
    if any(matrix[index] for index in (3, 6, 7)):
        told = ", ".join(f"{float(number):g}" for number in matrix)
        raise CloudError(f"camera: its matrix K is {told}; valid: fx, 0, cx, 0, fy, cy, 0, 0, 1, row by row")
    return camera


@lru_cache(maxsize=8)
def camera_rays(camera: PinholeCamera) -> Float[np.ndarray, "height width 3"]:
    """Return a read-only array of one ray per pixel (camera frame, z = 1). NaN marks pixels without a ray."""
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    image = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy], -1)
    rays = np.concatenate([undistort(image, camera.distortion), np.ones((*image.shape[:2], 1))], -1)
    rays.setflags(write=False)
    return rays


def undistort(seen: _Places, coefficients: _Numbers) -> _Places:
    """Invert `distort`. Return NaN where the lens model has no inverse."""
    target, ideal = np.array(seen, dtype=float), np.array(seen, dtype=float)
    if not any(coefficients):
        return ideal
    # Beyond the range of the lens model, the iteration diverges. Such pixels become NaN below.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            image, (a, b, d) = distort(ideal, coefficients)
            off = target - image
            determinant = a * d - b * b
            step = np.stack([d * off[..., 0] - b * off[..., 1], a * off[..., 1] - b * off[..., 0]], -1)
            ideal += step / determinant[..., None]
            if np.abs(off[np.isfinite(off)]).max(initial=0.0) < 1e-3 * _NEWTON_TOLERANCE:
                break
        image, (a, b, d) = distort(ideal, coefficients)
        # Outside its valid range, a lens model folds back: the derivative has a negative determinant or trace.
        found = (np.abs(target - image).max(-1) < _NEWTON_TOLERANCE) & (a * d - b * b > 0) & (a + d > 0)
    return np.where(found[..., None], ideal, np.nan)


def distort(ideal: _Places, coefficients: _Numbers) -> tuple[_Places, Float[np.ndarray, "3 *batch"]]:
    """Apply the lens distortion to positions on the plane at depth 1.

    Return the distorted positions, and (a, b, d). The Jacobian with respect to `ideal` is [[a, b], [b, d]].
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * (8 - len(coefficients)))
    x, y = ideal[..., 0], ideal[..., 1]
    s = x * x + y * y
    above, below = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
    radial = above / below
    # Derivative of the radial factor by s.
    growth = (k1 + s * (2 * k2 + s * 3 * k3) - radial * (k4 + s * (2 * k5 + s * 3 * k6))) / below
    across = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    down = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
    a = radial + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x
    b = 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y
    d = radial + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x
    return np.stack([across, down], -1), np.stack([a, b, d])


def reaches_image_border(
    points: Float[np.ndarray, "points 3"], eye: Vector, mine: Bool[np.ndarray, "points"], width: float
) -> bool:
    """Return True if an object reaches an image border of the camera at `eye`. `mine` marks the object's points.

    In the image, each long side of the convex hull of all points counts as a border. The object reaches a border if
    its points and other points lie along the border, within `width` [rad].
    """
    if not mine.any():
        return False
    local = (points - eye) @ view_frame(PointCloud(points, eye))
    ahead = local[:, 2] > 1e-3
    plane, mine = local[ahead, :2] / local[ahead, 2:], mine[ahead]
    own, others, some = plane[mine], plane[~mine], convex_hull(plane[:: 1 + len(plane) // HULL_POINTS])
    if some is not None and all((own @ s[:2] + s[2]).max(initial=-np.inf) < -width for s in some.equations):
        return False
    hull = convex_hull(plane)
    if hull is None:
        return False
    ends = plane[hull.simplices]
    long = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > MIN_SIDE_SHARE * longest_side(plane)
    for (*normal, offset), (start, end) in zip(hull.equations[long], ends[long], strict=True):
        # The object's points are checked first, because they are few and far from most sides.
        near = own[own @ np.array(normal) + offset > -width]
        if len(near) < MIN_BORDER_POINTS:
            continue
        beside = others[others @ np.array(normal) + offset > -width]
        full = _filled(np.concatenate([near, beside]), start, end) >= MIN_FILLED_SHARE
        if full and len(beside) >= MIN_BORDER_POINTS:
            return True
    return False


def _filled(near: Float[np.ndarray, "near 2"], start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> float:
    side = end - start
    part = np.floor(SIDE_PARTS * ((near - start) @ side) / (side @ side))
    return len(np.unique(part[(part >= 0) & (part < SIDE_PARTS)])) / SIDE_PARTS


def depth_in_metres(image: UInt16[np.ndarray, "height width"] | DepthImage, encoding: str) -> DepthImage:
    """Return the depth along the optical axis [m]. Zero, negative, NaN and infinite values become 0 (missing depth).

    Raises:
        CloudError: the encoding is not a depth encoding, or the pixels have another type than the encoding.
    """
    kind, unit = depth_encoding(encoding)
    if image.dtype.kind != kind[0] or (kind[0] == "u" and image.dtype.itemsize != 2):
        raise CloudError(f"depth image: pixels are {image.dtype}, but encoding {encoding} holds {np.dtype(kind)}")
    if kind[0] == "u":
        return image.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(image) & (image > 0), image, image.dtype.type(0))


def cloud_from_depth(
    depth: DepthImage, camera: PinholeCamera, T_frame_camera: Float[np.ndarray, "4 4"] | None = None
) -> PointCloud:
    """Return the points of a depth image [m] as a point cloud.

    Args:
        depth: depth along the optical axis [m]. Pixels of 0, NaN or infinity give no point.
        camera: the camera, of the same size as the image.
        T_frame_camera: pose of the camera (z forward, x right, y down). If None, points are in the camera frame.

    Raises:
        CloudError: sizes of image, camera or matrix differ, depth was cut to 8 bits, or the pose is not rigid.
    """
    if depth.shape != (camera.height, camera.width):
        raise CloudError(
            f"depth image: {depth.shape[1]} x {depth.shape[0]} pixels, "
            f"but its camera has {camera.width} x {camera.height}"
        )
    flat = depth.reshape(-1)
    _check_image(flat, camera)
    seen = np.flatnonzero(np.isfinite(flat) & (flat > 0))
    points = camera_rays(camera).reshape(-1, 3).take(seen, axis=0)
    points *= flat[seen, None]
    if camera.distortion:
        # Pixels beyond the range of the lens model have no ray.
        points = points[np.isfinite(points[:, 0])]
    cloud = PointCloud(points, np.zeros(3), np.array([0.0, 0.0, 1.0]), posed=True)
    return cloud if T_frame_camera is None else transform_cloud(cloud, T_frame_camera)


def _check_image(depth: Float[np.ndarray, "pixels"], camera: PinholeCamera) -> None:
    """Raise CloudError if depths were cut to 8 bits (0 to 255 mm), or the camera matrix is for another image size."""
    known = depth[np.isfinite(depth) & (depth > 0)]
    share = float((known > _MOST_OF_8_BITS - 1e-6).mean()) if known.size else 0.0
    if share > _CUT_SHARE and abs(float(known.max()) - _MOST_OF_8_BITS) < 1e-6:
        raise CloudError(
            f"depth image: {100 * share:.0f} % of pixels are 255 mm: cut to 8 bits; send 16 bits (mm) or floats (m)"
        )
    across, down = (2 * camera.cx + 1) / camera.width, (2 * camera.cy + 1) / camera.height
    off = min(abs(across - 1), abs(down - 1))
    scaled = off > _OFF_MIDDLE and max(across, down) < _MOST_SCALED
    if scaled and abs(across - down) < _SAME_MIDDLE * max(across, down):
        raise CloudError(
            f"camera: its cx={camera.cx:g}, cy={camera.cy:g} are the middle of an image {across:.2g} times "
            f"{camera.width} x {camera.height}: K is for another resolution; scale K like the image"
        )


def depth_encoding(name: str) -> tuple[str, float]:
    """Return a depth encoding's NumPy type and metres per unit. Raises CloudError for an unknown encoding."""
    if name not in ENCODINGS:
        remedy = next((f"; {said}" for begins, said in _REMEDIES.items() if name.startswith(begins)), "")
        raise CloudError(f"depth image: encoding {name[:64]!r}; valid for depth: {', '.join(ENCODINGS)}{remedy}")
    return ENCODINGS[name]
