"""Whether an object reaches the border of a picture."""

import numpy as np
import pytest

from graspd_core.config import SegmentationConfig
from graspd_core.perception.cloud.camera import reaches_image_border

EYE = np.array([0.0, 0.0, 1.0])
WIDTH = SegmentationConfig().border_width


def picture(rows: int = 120) -> np.ndarray:
    """A plane seen by a camera above, half a metre wide."""
    row, column = np.mgrid[-0.25 : 0.25 : rows * 1j, -0.25 : 0.25 : rows * 1j]
    return np.column_stack([row.ravel(), column.ravel(), np.zeros(row.size)])


@pytest.mark.parametrize(("middle", "reaches"), [((0.0, 0.0), False), ((0.24, 0.0), True), ((0.1, -0.24), True)])
def test_what_lies_on_the_border_reaches_it(middle: tuple[float, float], reaches: bool):
    points = picture()
    mine = np.hypot(points[:, 0] - middle[0], points[:, 1] - middle[1]) < 0.05
    assert reaches_image_border(points, EYE, mine, WIDTH) is reaches


@pytest.mark.parametrize("away", [0.5, 0.8, 1.3, 2.0])
def test_what_is_almost_on_the_border_is_told_from_what_is(away: float):
    """The hull of a few points, which is asked first, is smaller than that of all."""
    points = picture(rows=300)
    mine = (points[:, 0] < 0.25 - away * WIDTH) & (points[:, 0] > 0.15) & (np.abs(points[:, 1]) < 0.05)
    assert reaches_image_border(points, EYE, mine, WIDTH) is (away < 1)


def test_what_makes_the_outline_alone_does_not():
    points = picture()
    out = points[(np.abs(points[:, 0]) < 0.05) & (points[:, 1] > 0.15)] + [0.0, 0.1, 0.0]
    both = np.concatenate([points, out])
    assert not reaches_image_border(both, EYE, np.arange(len(both)) >= len(points), WIDTH)


def test_what_stands_out_over_the_end_of_the_table_does_not():
    """The sides of the outline go from its top to the corners of the table, and there is nothing along them."""
    points = picture(rows=300)
    out = points[(np.abs(points[:, 0]) < 0.05) & (points[:, 1] > 0.15)] + [0.0, 0.1, 0.0]
    both = np.concatenate([points, out])
    assert not reaches_image_border(both, EYE, np.arange(len(both)) >= len(points), WIDTH)


def test_nothing_reaches_nothing():
    assert not reaches_image_border(np.zeros((0, 3)), EYE, np.zeros(0, dtype=bool), WIDTH)
    assert not reaches_image_border(np.zeros((5, 3)), EYE, np.ones(5, dtype=bool), WIDTH)
