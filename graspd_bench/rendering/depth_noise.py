"""Noise model of depth cameras: flying pixels, holes, rounding, and errors that grow with the square of depth.

The random error of stereo depth is z² / (f B) times the error of disparity (Khoshelham and Elberink 2012). Intel's
tuning guide for the D400 series gives 0.08 pixels for a D415. With f = 616 pixels and a baseline of B = 55 mm, this is
0.0024 z² [m]. DEFAULT was compared with real D415 frames of a table. The real errors are 0.9 mm at 0.5 m and 1.3 mm at
0.7 m. They correlate by 0.96 between neighbours and 0.6 over eight pixels, as stereo matching averages many pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.errors import CloudError
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays

Depth = Float[np.ndarray, "height width"]

# If the depths of neighbouring pixels differ by more than this, there is an edge of an object [m].
EDGE = 0.02
# Blur of the smooth bias, as a fraction of the image height.
_SLOW = 0.15


@dataclass(frozen=True)
class DepthNoise:
    """Noise of a depth camera. With all defaults there is no noise.

    Attributes:
        floor: standard deviation of depth, extrapolated to depth zero [m].
        quadratic: growth of the standard deviation with depth squared [1/m]: σ = floor + quadratic z².
        correlation: standard deviation of the blur that correlates neighbouring errors [pixels].
        white: share of the error's variance that is uncorrelated between pixels, 0 to 1.
        jitter: standard deviation of the lateral error of a pixel [pixels].
        flying: share of edge pixels with a depth between foreground and background.
        edge_loss: share of edge pixels without depth.
        loss: share of all pixels that lose depth. These pixels form patches.
        grazing: angle between surface and line of sight below which pixels may lose depth [rad]. At angle 0, all do.
        baseline: distance between the two lenses of a stereo camera [m]. A point that one lens cannot see has no depth.
        step: depth is rounded to multiples of this unit [m].
        disparity_step: disparity (focal length x baseline / depth) is rounded to multiples of this unit [pixels].
        bias: standard deviation, at 1 m, of an error that varies slowly in the image and grows with depth squared [m].
        nearest, farthest: range outside which there is no depth [m].
    """

    floor: float = 0.0
    quadratic: float = 0.0
    correlation: float = 6.0
    white: float = 0.05
    jitter: float = 0.0
    flying: float = 0.0
    edge_loss: float = 0.0
    loss: float = 0.0
    grazing: float = 0.0
    baseline: float = 0.0
    step: float = 0.0
    disparity_step: float = 0.0
    bias: float = 0.0
    nearest: float = 0.0
    farthest: float = float("inf")

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0:
                raise CloudError(f"noise: {name}={value}; valid: 0 or more")
        for name in ("white", "flying", "edge_loss", "loss"):
            if getattr(self, name) > 1:
                raise CloudError(f"noise: {name}={getattr(self, name)}; valid: 0 to 1")


NONE = DepthNoise()
LOW = DepthNoise(
    floor=1e-4, quadratic=1e-3, jitter=0.3, flying=0.1, edge_loss=0.1, loss=0.002, grazing=0.1, step=1e-4, nearest=0.2
)
DEFAULT = DepthNoise(
    floor=3e-4, quadratic=2.4e-3, jitter=0.7, flying=0.3, edge_loss=0.3, loss=0.01, grazing=0.25, baseline=0.055,
    step=1e-3, nearest=0.3, farthest=2.0,
)  # fmt: skip
HIGH = replace(DEFAULT, floor=5e-4, quadratic=5e-3, white=0.1, jitter=1.2, flying=0.6, loss=0.04, grazing=0.4)
LEVELS = {"none": NONE, "low": LOW, "default": DEFAULT, "high": HIGH}


@dataclass(frozen=True)
class DepthCamera:
    """A kind of depth camera: its lens and its noise."""

    lens: PinholeCamera
    noise: DepthNoise


# d415 and d435 are stereo cameras with a narrow and a wide lens (Intel's tuning guide: disparity error 0.08 pixels).
# Structured light has disparity in steps of 1/8 pixel (Khoshelham and Elberink 2012). The error of time of flight
# hardly grows with depth, and edges mix foreground and background (Tölgyessy et al. 2021: 1 to 2 mm up to 1 m).
CAMERAS = {
    "d415": DepthCamera(PinholeCamera(640, 480, 616.0, 616.0, 319.5, 239.5), DEFAULT),
    "d435": DepthCamera(
        PinholeCamera(640, 480, 385.0, 385.0, 319.5, 239.5),
        replace(DEFAULT, quadratic=4.2e-3, correlation=4.0, baseline=0.05, farthest=3.0),
    ),
    "structured_light": DepthCamera(
        PinholeCamera(640, 480, 575.0, 575.0, 319.5, 239.5),
        replace(
            DEFAULT, quadratic=1.4e-3, correlation=3.0, baseline=0.075, step=0.0, disparity_step=0.125, bias=2e-3,
            nearest=0.4, farthest=4.0,
        ),
    ),
    "time_of_flight": DepthCamera(
        PinholeCamera(512, 424, 365.0, 365.0, 255.5, 211.5),
        DepthNoise(
            floor=1.5e-3, quadratic=3e-4, correlation=1.5, white=0.5, jitter=0.4, flying=0.8, edge_loss=0.1, loss=0.002,
            grazing=0.15, step=1e-3, bias=1.5e-3, nearest=0.3, farthest=4.0,
        ),
    ),
}  # fmt: skip


def add_noise(depth: Depth, camera: PinholeCamera, noise: DepthNoise, seed: int) -> Depth:
    """Add camera noise to a true depth image [m]. The result is 0 at pixels without depth.

    The order is flying pixels, depth error, holes. The same seed gives the same image.
    """
    rng = np.random.default_rng(seed)
    true = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)
    near, far, edge = _around(true)
    holes = _shadow(true, camera, noise.baseline) | _grazing(true, camera, noise.grazing, edge, rng)
    holes |= edge & (rng.random(true.shape) < noise.edge_loss)
    if noise.loss:
        from scipy.special import ndtri

        holes |= _field(true.shape, 2.0, 0.0, rng) < ndtri(noise.loss)
    seen = _jittered(true, noise.jitter, rng)
    flying = edge & (seen > 0) & (rng.random(true.shape) < noise.flying)
    seen = np.where(flying, near + rng.random(true.shape) * (far - near), seen)
    if noise.floor or noise.quadratic:
        sigma = noise.floor + noise.quadratic * seen**2
        seen = seen + (seen > 0) * sigma * _field(true.shape, noise.correlation, noise.white, rng)
    if noise.bias:
        seen = seen + noise.bias * seen**2 * _field(true.shape, _SLOW * true.shape[0], 0.0, rng)
    if noise.disparity_step:
        scale = camera.fx * noise.baseline / noise.disparity_step
        seen = np.where(seen > 0, scale / np.round(scale / np.maximum(seen, 1e-9)).clip(1), 0.0)
    if noise.step:
        seen = noise.step * np.round(seen / noise.step)
    return np.where(holes | (seen < noise.nearest) | (seen > noise.farthest), 0.0, seen.clip(0.0))


def _around(depth: Depth) -> tuple[Depth, Depth, Bool[np.ndarray, "height width"]]:
    from scipy.ndimage import maximum_filter, minimum_filter

    far = maximum_filter(depth, 3)
    near = np.minimum(minimum_filter(np.where(depth > 0, depth, np.inf), 3), far)
    return near, far, (depth > 0) & ((far - near > EDGE) | (minimum_filter(depth, 3) == 0))


def _jittered(depth: Depth, pixels: float, rng: np.random.Generator) -> Depth:
    """Replace each pixel's depth by the depth of a random pixel nearby (lateral noise). Outlines become ragged."""
    if not pixels:
        return depth
    height, width = depth.shape
    moved = np.rint(pixels * rng.standard_normal((2, height, width))).astype(int)
    row, column = np.indices(depth.shape) + moved
    return depth[row.clip(0, height - 1), column.clip(0, width - 1)]


def _shadow(depth: Depth, camera: PinholeCamera, baseline: float) -> Bool[np.ndarray, "height width"]:
    """Return the pixels that a second lens, `baseline` [m] to the right, cannot see because a nearer point hides them.

    In the second image a point appears f B / z pixels further left. If two pixels of a row thus coincide or change
    their order, the left pixel of the two is hidden.
    """
    if not baseline:
        return np.zeros(depth.shape, dtype=bool)
    with np.errstate(divide="ignore"):
        other_column = np.arange(camera.width) - np.where(depth > 0, camera.fx * baseline / depth, -np.inf)
    leftmost = np.minimum.accumulate(other_column[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, dtype=bool)
    hidden[:, :-1] = (depth[:, :-1] > 0) & (leftmost[:, 1:] <= other_column[:, :-1])
    return hidden


def _grazing(depth: Depth, camera: PinholeCamera, limit: float, edge: np.ndarray, rng: np.random.Generator):
    """Draw which pixels below the grazing angle `limit` [rad] lose depth. Edges are exempt, as they have no normal."""
    if not limit:
        return np.zeros(depth.shape, dtype=bool)
    rays = np.nan_to_num(camera_rays(camera))
    points = rays * depth[..., None]
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    length = np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1)
    sine = np.abs((normal * rays).sum(-1)) / np.maximum(length, 1e-30)
    share = 1 - np.arcsin(sine.clip(0, 1)) / limit
    return (depth > 0) & ~edge & (rng.random(depth.shape) < share)


def _field(shape: tuple[int, ...], blur: float, white: float, rng: np.random.Generator) -> Depth:
    """Return noise of unit variance. A share `white` of it is uncorrelated, the rest is blurred by `blur` [pixels]."""
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(rng.standard_normal(shape), blur, mode="wrap") / _blurred_scale(shape, blur)
    return np.sqrt(1 - white) * smooth + np.sqrt(white) * rng.standard_normal(shape)


@lru_cache(maxsize=16)
def _blurred_scale(shape: tuple[int, ...], blur: float) -> float:
    """Return the standard deviation of blurred white noise. The blur wraps around, so all pixels are equal."""
    from scipy.ndimage import gaussian_filter

    impulse = np.zeros(shape)
    impulse[0, 0] = 1.0
    return float(np.sqrt((gaussian_filter(impulse, blur, mode="wrap") ** 2).sum()))
