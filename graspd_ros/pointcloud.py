"""Clouds and depth images of messages; the conversion itself knows no ROS and lies in `graspd_core.bags.messages`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from sensor_msgs.msg import PointCloud2

from graspd_core.bags import messages


def points_from_message(message: PointCloud2) -> Float[np.ndarray, "n 3"]:
    """The finite points of a cloud, in row order, in the cloud's own frame and unit.

    Organised or not, padded points and rows, float32 or float64, either byte order, x, y and z at any offset.

    Raises:
        CloudError: no points, x, y or z missing or not a float, sizes that contradict each other, or nothing finite.
    """
    return messages.points_from_message(message)
