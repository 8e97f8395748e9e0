"""Clouds for commands: out of files or bags, and into scenes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from graspd_core.bags.reader import BagFrame, is_bag, read_frames, read_transforms
from graspd_core.config import SceneConfig, load_scene_config
from graspd_core.errors import BagError, CloudError, ConfigError, TransformError
from graspd_core.pointcloud.point_cloud import PointCloud

# Views that are fused unasked: all are held in memory at once.
MOST_VIEWS = 100


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Which messages of a bag to take, and the frame to have them in."""
    parser.add_argument("--topic", default=None, help="of clouds or depth images, where a bag has several")
    parser.add_argument("--camera-info", default=None, metavar="TOPIC", help="of the depth images' camera")
    parser.add_argument("--frame", default=None, help="put clouds into this frame by the bag's /tf and /tf_static")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take one cloud of N")
    parser.add_argument("--limit", type=int, default=None, metavar="N", help="end after N clouds")


def add_object_options(parser: argparse.ArgumentParser) -> None:
    """Which of the things that a cloud shows is meant, and how clouds become scenes."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--target", type=float, nargs=3, default=None, metavar=("X", "Y", "Z"),
        help="a point on the object, in metres; else what is nearest the axis of view",
    )  # fmt: skip
    which.add_argument("--alone", action="store_true", help="the clouds show the object and nothing else")
    parser.add_argument(
        "--scene", type=Path, default=None, metavar="FILE.yaml",
        help="settings of segmentation, reconstruction and obstacles (docs/clouds.md)",
    )  # fmt: skip


def target_of(options: argparse.Namespace):
    """The `Target` that the options name, if any."""
    from graspd_core.segmentation.target_selection import Target

    return Target(point=np.array(options.target)) if options.target else None


def scene_config_of(options: argparse.Namespace) -> SceneConfig:
    """The settings in the file that the options name, else the defaults. Raises ConfigError."""
    return load_scene_config(options.scene) if options.scene else SceneConfig()


def check_bag_options(options: argparse.Namespace) -> None:
    """Refuse what `bag_views` could not use. Raises ConfigError."""
    for name in ("every", "limit"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ConfigError(f"{name}: {value} clouds; at least 1")


def bag_views(path: Path, options: argparse.Namespace) -> Iterator[tuple[BagFrame, PointCloud | str]]:
    """The clouds that the options choose, each with what it shows or why it cannot be used.

    Raises:
        BagError: nothing can be read, or the frame wanted is not in the bag.
    """
    transforms = None
    frames = read_frames(
        path, topic=options.topic, info_topic=options.camera_info, every=options.every, limit=options.limit
    )
    for frame in frames:
        if transforms is None and options.frame and options.frame.removeprefix("/") != frame.frame.removeprefix("/"):
            transforms = read_transforms(path)
            if options.frame.removeprefix("/") not in transforms.frames():
                known = ", ".join(transforms.frames())
                raise BagError(f"{path}: no frame {options.frame!r}; its transforms know: {known}")
        try:
            yield frame, frame.view(transforms, options.frame)
        except (CloudError, TransformError) as error:
            yield frame, str(error)


def merged_views(path: Path, options: argparse.Namespace) -> tuple[PointCloud, ...]:
    """The chosen clouds as views of one scene, less those that cannot be used, which stderr counts.

    Raises:
        BagError: nothing can be read, none can be used, they are not in one frame, or they are too many and no limit
            is set.
    """
    views, names, refusals = [], set(), []
    for frame, seen in bag_views(path, options):
        if isinstance(seen, str):
            refusals.append(f"cloud {frame.index}: {seen}")
            continue
        if len(views) == MOST_VIEWS and options.limit is None:
            raise BagError(f"{path}: more than {MOST_VIEWS} clouds to fuse; choose some with --every or --limit")
        views.append(seen)
        names.add(options.frame or frame.frame)
    if refusals and not views:
        raise BagError(f"{path}: {refusals[0]}")
    if refusals:
        count = len(views) + len(refusals)
        print(f"graspd: {len(refusals)} of {count} clouds left out, the first {refusals[0]}", file=sys.stderr)
    if len(names) > 1:
        raise BagError(f"{path}: clouds in several frames ({', '.join(sorted(names))}); name one with --frame")
    return tuple(views)


def load_views(path: Path, options: argparse.Namespace) -> tuple[PointCloud, ...]:
    """The views of a cloud file, or those that the options choose from a bag; the first one unless they say more."""
    from graspd_core.pointcloud import cloud_files

    if not is_bag(path):
        return cloud_files.load_views(path)
    chosen = argparse.Namespace(**{**vars(options), "limit": options.limit or 1})
    return merged_views(path, chosen)
