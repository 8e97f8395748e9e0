"""The sensor's faults: each measured against its own setting."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_bench.rendering.depth_noise import DEFAULT, HIGH, LEVELS, LOW, NONE, DepthNoise, add_noise
from graspd_core.errors import CloudError
from graspd_core.perception.cloud.camera import PinholeCamera

CAMERA = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
NEAR, FAR = 0.5, 0.8


def wall(z: float = 0.6) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), z)


def block() -> np.ndarray:
    """A square in front of a wall."""
    depth = wall(FAR)
    depth[40:80, 60:100] = NEAR
    return depth


def test_no_noise_changes_nothing_and_seeds_differ():
    assert np.array_equal(add_noise(block(), CAMERA, NONE, 0), block())
    assert not np.array_equal(add_noise(block(), CAMERA, DEFAULT, 0), add_noise(block(), CAMERA, DEFAULT, 1))


@pytest.mark.parametrize("z", [0.3, 0.6, 1.2])
def test_the_error_grows_with_the_square_of_depth(z):
    noise = DepthNoise(floor=3e-4, quadratic=2.4e-3, correlation=1.0)
    error = np.concatenate([(add_noise(wall(z), CAMERA, noise, seed) - z).ravel() for seed in range(4)])
    # Some 10⁴ errors that are independent to within a few pixels: 5 % is more than four standard errors.
    assert error.std() == pytest.approx(3e-4 + 2.4e-3 * z**2, rel=0.05)
    assert abs(error.mean()) < 0.1 * error.std()


def test_neighbouring_errors_are_alike():
    error = add_noise(wall(), CAMERA, DepthNoise(quadratic=0.002, correlation=3.0, white=0.1), 0) - 0.6

    def correlation(pixels: int) -> float:
        return float(np.corrcoef(error[:, :-pixels].ravel(), error[:, pixels:].ravel())[0, 1])

    # A Gaussian of width s convolved with itself: exp(-d² / 4 s²), on all the variance but the white part.
    for pixels in (1, 4):
        assert correlation(pixels) == pytest.approx(0.9 * np.exp(-(pixels**2) / 36), abs=0.06)
    assert abs(correlation(20)) < 0.15


def test_flying_pixels_lie_between_the_block_and_the_wall_and_only_at_its_edge():
    seen = add_noise(block(), CAMERA, DepthNoise(flying=0.5), 0)
    off = seen != block()
    assert ((seen[off] > NEAR) & (seen[off] < FAR)).all()
    row, column = np.nonzero(off)
    inside = (row > 40) & (row < 79) & (column > 60) & (column < 99)
    outside = (row < 39) | (row > 80) | (column < 59) | (column > 100)
    assert not (inside | outside).any()
    # The outlines of 40 x 40 and of 42 x 42 pixels, half of them.
    assert off.sum() == pytest.approx(0.5 * (4 * 39 + 4 * 41), rel=0.2)


def test_what_the_other_eye_does_not_see_is_lost():
    noise = DepthNoise(baseline=0.05)
    lost = add_noise(block(), CAMERA, noise, 0) == 0
    # Width of the shadow in pixels: f B (1 / near - 1 / far).
    width = 150 * 0.05 * (1 / NEAR - 1 / FAR)
    columns = np.nonzero(lost[60])[0]
    assert abs(len(columns) - width) <= 1
    assert columns.max() == 59
    assert not lost[:40].any()


def test_edges_lose_their_share():
    lost = add_noise(block(), CAMERA, DepthNoise(edge_loss=0.4), 0) == 0
    assert lost.sum() == pytest.approx(0.4 * (4 * 39 + 4 * 41), rel=0.25)


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_holes_take_their_share_of_the_image(share):
    lost = np.mean([(add_noise(wall(), CAMERA, DepthNoise(loss=share), seed) == 0).mean() for seed in range(8)])
    assert lost == pytest.approx(share, rel=0.25)


def test_flatly_seen_surfaces_are_lost_and_steeply_seen_ones_are_not():
    column = np.arange(CAMERA.width)
    x = (column - CAMERA.cx) / CAMERA.fx
    noise = DepthNoise(grazing=np.deg2rad(20))

    def lost(angle: float) -> float:
        """Share lost of a plane through (0, 0, 0.2), turned about the vertical until `angle` from the optical axis."""
        depth = 0.2 * np.sin(angle) / (np.sin(angle) - x * np.cos(angle))
        narrow = np.abs(x) < 0.03
        return float((add_noise(np.tile(depth, (CAMERA.height, 1)), CAMERA, noise, 0) == 0)[:, narrow].mean())

    assert lost(np.deg2rad(40)) == 0
    # Half of the limit: half of the pixels. The view differs from the axis by up to 1.7°.
    assert lost(np.deg2rad(10)) == pytest.approx(0.5, abs=0.08)


def test_depth_comes_in_steps_and_within_range():
    ramp = np.tile(np.linspace(0.1, 1.0, CAMERA.width), (CAMERA.height, 1))
    noise = DepthNoise(quadratic=0.002, step=0.001, nearest=0.3, farthest=0.9)
    seen = add_noise(ramp, CAMERA, noise, 0)
    assert seen[seen > 0] * 1000 == pytest.approx(np.round(seen[seen > 0] * 1000))
    assert seen[seen > 0].min() >= 0.3
    assert seen.max() <= 0.9
    assert (seen[:, ramp[0] < 0.29] == 0).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32), level=st.sampled_from(sorted(LEVELS)))
def test_the_same_seed_gives_the_same_finite_image(seed, level):
    holed = block()
    holed[:5] = 0
    holed[5:10] = np.nan
    first = add_noise(holed, CAMERA, LEVELS[level], seed)
    assert np.array_equal(first, add_noise(holed, CAMERA, LEVELS[level], seed))
    assert np.isfinite(first).all()
    assert first.min() >= 0


def test_levels_are_in_order():
    def error(noise: DepthNoise) -> float:
        seen = add_noise(wall(), CAMERA, replace(noise, jitter=0.0), 0)
        return float((seen[seen > 0] - 0.6).std())

    def kept(noise: DepthNoise) -> float:
        return float((add_noise(block(), CAMERA, noise, 0) > 0).mean())

    assert error(NONE) == 0 < error(LOW) < error(DEFAULT) < error(HIGH)
    assert kept(NONE) == 1 > kept(LOW) > kept(DEFAULT) > kept(HIGH) > 0.8


@pytest.mark.parametrize("wrong", [{"quadratic": -1.0}, {"flying": 1.5}, {"floor": float("nan")}])
def test_impossible_settings_are_named(wrong):
    with pytest.raises(CloudError, match=f"noise: {next(iter(wrong))}="):
        DepthNoise(**wrong)
