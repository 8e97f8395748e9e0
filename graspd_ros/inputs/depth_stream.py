"""Depth images: an Image with its CameraInfo to metres and a camera, and which of the two streams belong together."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from sensor_msgs.msg import CameraInfo, Image

from graspd_core import PinholeCamera
from graspd_core.errors import CloudError
from graspd_core.io import bags as messages

SECOND = 1_000_000_000

M = TypeVar("M", Image, CameraInfo)


@dataclass(frozen=True)
class DepthFrame:
    """One depth image with the camera that took it.

    Attributes:
        depth: along the optical axis, 0 where there is none [m].
        camera: of the image's size.
        frame: the camera's optical frame: z forward, x right, y down.
        stamp: when it was taken [ns].
    """

    depth: Float[np.ndarray, "height width"]
    camera: PinholeCamera
    frame: str
    stamp: int


def frame_of(image: Image, info: CameraInfo, rectified: bool = True) -> DepthFrame:
    """Depth in metres and its camera. Encodings 16UC1 and mono16 (millimetres), 32FC1 (metres).

    Args:
        image: padded rows or not, either byte order.
        info: the calibration, of the whole sensor or of the part that the image shows (binning and roi).
        rectified: whether the lens' distortion was taken out of the image already, as image_rect topics say; the
            camera is then that of P, without distortion, otherwise that of K and D.

    Raises:
        CloudError: no depth encoding, sizes that contradict each other, another frame, or no calibration.
    """
    if info.header.frame_id and info.header.frame_id != image.header.frame_id:
        raise CloudError(f"depth image in {image.header.frame_id!r}, but its camera_info in {info.header.frame_id!r}")
    camera = messages.camera_from_message(info, rectified=rectified)
    return DepthFrame(messages.depth_from_message(image), camera, image.header.frame_id, messages.stamp_of(image))


class ImagePairs:
    """Finds the CameraInfo of each depth image by its stamp. Not for several threads.

    Each image is given out once, with the nearest calibration in time; what is older than the last pair is dropped.

    Args:
        slop: stamps of a pair differ by this much at most [s].
        capacity: messages of each kind that wait for their partner; the oldest give way.
    """

    def __init__(self, slop: float = 0.01, capacity: int = 4) -> None:
        self._slop = round(slop * SECOND)
        self._capacity = capacity
        self._images: OrderedDict[int, Image] = OrderedDict()
        self._infos: OrderedDict[int, CameraInfo] = OrderedDict()

    def add_image(self, image: Image) -> tuple[Image, CameraInfo] | None:
        """Take an image; the pair that it completes, if it does."""
        stamp = self._keep(self._images, image)
        partner = self._nearest(self._infos, stamp)
        return None if partner is None else self._pair(stamp, partner)

    def add_info(self, info: CameraInfo) -> tuple[Image, CameraInfo] | None:
        """Take a calibration; the pair that it completes, if it does."""
        stamp = self._keep(self._infos, info)
        partner = self._nearest(self._images, stamp)
        return None if partner is None else self._pair(partner, stamp)

    def __len__(self) -> int:
        """Messages that wait."""
        return len(self._images) + len(self._infos)

    def _keep(self, kept: OrderedDict[int, M], message: M) -> int:
        stamp = messages.stamp_of(message)
        kept[stamp] = message
        kept.move_to_end(stamp)
        while len(kept) > self._capacity:
            kept.popitem(last=False)
        return stamp

    def _nearest(self, kept: OrderedDict[int, M], stamp: int) -> int | None:
        nearest = min(kept, key=lambda other: abs(other - stamp), default=None)
        return None if nearest is None or abs(nearest - stamp) > self._slop else nearest

    def _pair(self, image_stamp: int, info_stamp: int) -> tuple[Image, CameraInfo]:
        pair = self._images.pop(image_stamp), self._infos[info_stamp]
        for stamp in [stamp for stamp in self._images if stamp < image_stamp]:
            del self._images[stamp]
        # The calibration stays: a second image within the slop may need it.
        for stamp in [stamp for stamp in self._infos if stamp < info_stamp]:
            del self._infos[stamp]
        return pair
