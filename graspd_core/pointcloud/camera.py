"""Pinhole cameras and the lens distortion of CameraInfo: where each pixel looks, and where a point appears.

Camera frames follow the optical convention: z forward, x right, y down. Distortion is that of OpenCV's camera model
(Brown and Conrady), which ROS calls plumb_bob (k1, k2, p1, p2, k3) and rational_polynomial (k4, k5, k6 after those).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError

DISTORTION_MODELS = {"plumb_bob": 5, "rational_polynomial": 8}

_Numbers = Sequence[float | int]

# Newton's method on a smooth lens doubles its digits each round: five suffice, extreme lenses take a few more.
_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-10
# Of a focal length and of any other number of a calibration [pixels]: beyond them rays are no longer numbers.
_MIN_FOCAL_PX, _MAX_CALIBRATION_PX = 1e-2, 1e7


@dataclass(frozen=True)
class PinholeCamera:
    """A camera; its image is that of an ideal lens unless it has a distortion.

    Attributes:
        width, height: size of its image [pixels].
        fx, fy: focal lengths [pixels].
        cx, cy: where the optical axis meets the image [pixels].
        distortion: k1, k2, p1, p2, k3, k4, k5, k6; those left out are zero.
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
            raise CloudError(f"camera: an image of {self.width} x {self.height} pixels; both must be 1 or more")
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not (
            all(abs(number) <= _MAX_CALIBRATION_PX for number in numbers) and min(self.fx, self.fy) >= _MIN_FOCAL_PX
        ):
            raise CloudError(f"camera: fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy} is no calibration")
        if len(self.distortion) > 8:
            raise CloudError(f"camera: {len(self.distortion)} distortion coefficients; at most 8 are understood")


def camera_from_calibration(
    width: int,
    height: int,
    matrix: _Numbers,
    distortion: _Numbers = (),
    model: str = "plumb_bob",
) -> PinholeCamera:
    """The camera of a CameraInfo's `width`, `height`, `k` (row by row), `d` and `distortion_model`.

    Raises:
        CloudError: a model that is not known, more coefficients than it has, or no calibration at all.
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
    return PinholeCamera(int(width), int(height), fx, fy, cx, cy, coefficients)


@lru_cache(maxsize=8)
def camera_rays(camera: PinholeCamera) -> Float[np.ndarray, "height width 3"]:
    """Directions of unit depth through each pixel, camera frame; NaN where no point could be seen through this lens.

    Remembered for each camera, and therefore not writable.
    """
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    image = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy], -1)
    rays = np.concatenate([undistort(image, camera.distortion), np.ones((*image.shape[:2], 1))], -1)
    rays.setflags(write=False)
    return rays


def project(points: Float[np.ndarray, "*batch 3"], camera: PinholeCamera) -> Float[np.ndarray, "*batch 2"]:
    """Pixel coordinates (column, row) at which points in front of the camera appear; camera frame [m]."""
    seen = distort(points[..., :2] / points[..., 2:], camera.distortion)
    return seen * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def distort(ideal: Float[np.ndarray, "*batch 2"], coefficients: _Numbers) -> Float[np.ndarray, "*batch 2"]:
    """Where the lens puts what an ideal one would put at `ideal`; both on the plane of unit depth."""
    return _lens(ideal, coefficients)[0] if any(coefficients) else np.array(ideal, dtype=float)


def undistort(seen: Float[np.ndarray, "*batch 2"], coefficients: _Numbers) -> Float[np.ndarray, "*batch 2"]:
    """The inverse of `distort` on the part of the image where it has one; NaN elsewhere."""
    if not any(coefficients):
        return np.array(seen, dtype=float)
    target = np.asarray(seen, dtype=float)
    ideal = target.copy()
    # Beyond the lens's range the iteration runs off to infinity; such pixels are sorted out below.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            image, slope = _lens(ideal, coefficients)
            a, b, d = np.moveaxis(slope, -1, 0)
            off = target - image
            determinant = a * d - b * b
            step = np.stack([d * off[..., 0] - b * off[..., 1], a * off[..., 1] - b * off[..., 0]], -1)
            ideal += step / determinant[..., None]
            if np.abs(off[np.isfinite(off)]).max(initial=0.0) < 1e-3 * _NEWTON_TOLERANCE:
                break
        image, slope = _lens(ideal, coefficients)
        a, b, d = np.moveaxis(slope, -1, 0)
        # A lens model folds back at its rim: there the determinant, or the stretch along the radius, is negative.
        found = (np.abs(target - image).max(-1) < _NEWTON_TOLERANCE) & (a * d - b * b > 0) & (a + d > 0)
    return np.where(found[..., None], ideal, np.nan)


def _lens(
    ideal: Float[np.ndarray, "*batch 2"], coefficients: _Numbers
) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 3"]]:
    """Distorted positions, and a, b, d of their derivative, the symmetric matrix [[a, b], [b, d]]."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * (8 - len(coefficients)))
    x, y = ideal[..., 0], ideal[..., 1]
    s = x * x + y * y
    above, below = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
    radial = above / below
    # Derivative of the radial factor by s.
    growth = (k1 + s * (2 * k2 + s * 3 * k3) - radial * (k4 + s * (2 * k5 + s * 3 * k6))) / below
    image = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )
    a = radial + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x
    b = 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y
    d = radial + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x
    return image, np.stack([a, b, d], -1)
