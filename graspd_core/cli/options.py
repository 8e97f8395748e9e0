"""Define options that several commands share: planning, clouds, bags and restrictions. Also summarise results."""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graspd_core.cli.output import print_note
from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, EXIT_TOO_FEW, Deadline
from graspd_core.config import VERIFICATIONS, SceneConfig, load_scene_config
from graspd_core.errors import BagError, CloudError, ConfigError, TransformError
from graspd_core.optimize.plan_config import PlanConfig, load_plugin, load_preset, preset_names
from graspd_core.transforms import ROOT, refuse_motion
from graspd_core.types import GraspResult, Outcome, Timing

if TYPE_CHECKING:
    from graspd_core.arms.reach import Reach
    from graspd_core.hands.model import HandModel
    from graspd_core.io.bags import BagFrame
    from graspd_core.optimize.restrictions import Restriction
    from graspd_core.perception.cloud.point_cloud import PointCloud
    from graspd_core.perception.scene import Scene
    from graspd_core.planning.regions import Region
    from graspd_core.planning.steering import Steering


# Metrics in the summary of a run.
_SHOWN = ("payload", "least_friction", "penetration", "contact_area", "epsilon", "robustness")
# Number of grasps that a summary lists.
_FIRST = 3
# Arguments of options that take a point or a direction.
_XYZ: dict[str, Any] = {"type": float, "nargs": 3, "metavar": ("X", "Y", "Z")}


def add_plugin_option(parser: argparse._ActionsContainer) -> None:
    """Add `--plugin`. The file runs while options are parsed, so that other options may name methods of the file."""
    parser.add_argument(
        "--plugin", type=load_plugin, action="append", metavar="FILE.py",
        help="run a file that registers methods, metrics or trials (repeatable)",
    )  # fmt: skip


def add_planning_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for hand, grasps, method, trials, and the object's mass and friction."""
    parser.add_argument("--hand", default="allegro_right", metavar="NAME|PATH", help="a hand (see graspd hands)")
    parser.add_argument("-n", "--count", type=int, default=16, help="number of verified grasps (default 16)")
    parser.add_argument("--method", metavar="NAME", help="method at its defaults (default: the preset's)")
    add_plugin_option(parser)
    parser.add_argument("--preset", default="balanced", help=f"{', '.join(preset_names())}, or a .yaml file")
    parser.add_argument("--seed", type=int, default=0)
    about = "mass of the object (default: the greatest plausible mass for its volume)"
    parser.add_argument("--mass", type=float, metavar="KG", help=about)
    parser.add_argument("--friction", type=float, default=0.6, metavar="MU", help="friction coefficient (default 0.6)")
    parser.add_argument("--deadline", type=float, metavar="SEC", help="time limit incl. loading; found grasps are kept")
    parser.add_argument("--verify", choices=VERIFICATIONS, default="standard")
    parser.add_argument("--robust", action="store_true", help="rank grasps by trials with a misplaced hand")
    parser.add_argument("--least-friction", action="store_true", help="measure the least friction for each grasp")
    parser.add_argument("--device", default="cpu", help="torch device of the optimiser")
    parser.add_argument("--threads", type=int, default=1, help="threads of optimiser and trials (default 1)")


def planning_options(options: argparse.Namespace) -> tuple[PlanConfig, dict[str, Any]]:
    """Return the settings and other arguments of `plan_grasps`, without the deadline. Set torch's number of threads.

    Raises ConfigError: an option is out of range, or the preset is unknown or malformed.
    """
    import torch

    from graspd_core.planning.plan_grasps import check_request

    request = {key: getattr(options, key) for key in ("count", "seed", "verify", "device")}
    check_request(**request, deadline=options.deadline)
    if options.threads < 1:
        raise ConfigError(f"--threads: {options.threads}; valid: 1 or more")
    torch.set_num_threads(options.threads)
    config = load_preset(options.preset)
    if options.method:
        config = config.with_method(options.method)
    robust = config.robust
    ranked = {"rank": robust.rank or options.robust, "friction": robust.friction or options.least_friction}
    config = dataclasses.replace(config, robust=dataclasses.replace(robust, **ranked))
    return config, request


def not_loaded(options: argparse.Namespace, config: PlanConfig, began: float) -> tuple[GraspResult, dict[str, Any]]:
    """Return the result of a run whose deadline passed while loading, and its JSON document.

    `began` is the start of the run by `time.perf_counter()`.
    """
    taken = time.perf_counter() - began
    result = GraspResult(Outcome.DEADLINE, (), Timing(load=taken, total=taken), options.seed, config.method)
    return result, {"outcome": {"name": result.outcome.name, "message": result.outcome.value}, "grasps": []}


def summary(result: GraspResult, wanted: int, different: int) -> str:
    """Return a text about a result. `wanted`: requested grasps. `different`: usable grasps without near-duplicates."""
    from graspd_core.verify.metrics import METRICS

    good = good_grasps(result)
    kind = "unverified" if any(not grasp.trials for grasp in result.tried) else "verified"
    ending = result.message or result.outcome.value
    copies = f", {different} without near-duplicates" if different < good else ""
    lines = [f"{good} of {wanted} grasps ({kind}{copies}, {len(result.tried)} tried): {ending}"]
    timing = result.timing
    lines.append(
        f"load {timing.load:.2f} s, sdf {timing.sdf:.2f} s, optimise {timing.optimise:.2f} s, "
        f"verify {timing.verify:.2f} s, total {timing.total:.2f} s"
        + (f", first verified after {timing.first_verified:.2f} s" if timing.first_verified else "")
        + (f"; object of {result.tried_mass:.2g} kg" if result.tried_mass else "")
    )
    for rank, grasp in enumerate(result.grasps[: min(good, _FIRST)]):
        figures = [
            METRICS[name].text(value) for name in _SHOWN if (value := (grasp.metrics or {}).get(name)) is not None
        ]
        lines.append(f"  #{rank}: {', '.join([f'{len(grasp.contacts)} contacts', *figures])}")
    if good > _FIRST:
        lines.append(f"  and {good - _FIRST} more")
    return "\n".join(lines)


def good_grasps(result: GraspResult) -> int:
    """Return the number of usable grasps (`Grasp.usable`). Usable grasps come first in the result."""
    return sum(grasp.usable for grasp in result.grasps)


def exit_status(result: GraspResult) -> int:
    """Return the exit status of a result: for enough grasps, for too few grasps, or for an interrupted run."""
    if result.outcome is Outcome.CANCELLED:
        return EXIT_INTERRUPTED
    return EXIT_OK if result.outcome is Outcome.SUCCEEDED else EXIT_TOO_FEW


# Greatest number of views to fuse without --limit, because all views are in memory at the same time.
MOST_VIEWS = 100


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the messages of a bag and the frame of their clouds."""
    parser.add_argument("--topic", help="topic of the clouds or depth images, if a bag has several")
    parser.add_argument("--camera-info", metavar="TOPIC", help="CameraInfo of the depth images")
    parser.add_argument("--frame", help="transform clouds to this frame by the bag's /tf and /tf_static")
    parser.add_argument("--sensor-frame", default="", metavar="FRAME", help="frame of the clouds' camera in /tf")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="use every N-th cloud")
    parser.add_argument("--limit", type=int, metavar="N", help="use at most N clouds")


def add_object_options(parser: argparse.ArgumentParser, *, any_object: bool = False) -> None:
    """Add the options for object, viewpoint and scene settings. With `any_object`, also add `--any`."""
    which = parser.add_mutually_exclusive_group()
    if any_object:
        which.add_argument("--any", action="store_true", help="choose the object with the surest grasp")
    about = "a point on the object [m]; by default the object nearest the camera's axis"
    which.add_argument("--target", **_XYZ, help=about)
    which.add_argument("--alone", action="store_true", help="the clouds show only the object")
    about = "position of a cloud's camera in the cloud's frame [m] (default: the origin)"
    parser.add_argument("--view-point", **_XYZ, help=about)
    about = "settings for segmentation, reconstruction and obstacles (docs/clouds.md)"
    parser.add_argument("--scene", type=Path, metavar="FILE.yaml", help=about)


def add_camera_option(parser: argparse.ArgumentParser) -> None:
    """Add `--camera`, the camera of a depth image."""
    about = "camera of the depth image (png, tiff, npy, npz): width, height, K (docs/clouds.md)"
    parser.add_argument("--camera", type=Path, metavar="camera.json", help=about)


def target_of(options: argparse.Namespace):
    """Return the `Target` of the option `--target`, or None."""
    from graspd_core.perception.segment.target_selection import Target

    return Target(point=np.array(options.target)) if options.target else None


def scene_config_of(options: argparse.Namespace) -> SceneConfig:
    """Return the settings from the file of `--scene`, or the defaults. Raises ConfigError: the file is not valid."""
    return load_scene_config(options.scene) if options.scene else SceneConfig()


def plan_any_object(
    views: Sequence[PointCloud],
    hand: HandModel,
    options: argparse.Namespace,
    deadline: Deadline,
    *,
    source: str,
    **request: Any,
) -> tuple[GraspResult, Scene, dict[str, Any]]:
    """Plan for any object in the views (`--any`). Return result, its scene, and JSON entries about all objects seen.

    Args:
        source: name of the views for messages.
        request: other keyword arguments of `plan_grasps`.

    Raises GraspdError: the views are unusable, or show no object.
    """
    from graspd_core.planning.any_thing import plan_any_thing, result_of_things

    about = {"settings": scene_config_of(options), "mass": options.mass, "friction": options.friction}
    things = plan_any_thing(views, hand, deadline=deadline.left(), source=source, **about, **request)
    result = result_of_things(things, options.seed)
    places = [thing.place.round(3).tolist() for thing in things]
    if things[0].grasp is not None:
        print_note(f"{source}: the object at about {tuple(places[0])} m, one of {len(things)} seen")
    entries = [{"center": place, "reason": thing.reason} for place, thing in zip(places, things, strict=True)]
    return result, next(thing.scene for thing in things if thing.scene is not None), {"objects": entries}


def check_bag_options(options: argparse.Namespace) -> None:
    """Check the options that `bag_views` uses. Raises ConfigError: --every or --limit is below 1."""
    for name in ("every", "limit"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ConfigError(f"--{name}: {value} clouds; valid: 1 or more")


def _refuse_bag_options(path: Path, options: argparse.Namespace) -> None:
    given = {name: getattr(options, name) for name in ("topic", "camera_info", "frame", "sensor_frame", "limit")}
    given["every"] = options.every if options.every > 1 else None
    for name, value in given.items():
        if value:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: given with {path}, a file; valid with recordings")


def bag_views(path: Path, options: argparse.Namespace) -> Iterator[tuple[BagFrame, PointCloud | str]]:
    """Yield the recorded frames that the options choose, each with its cloud, or with the reason why it has none.

    Raises BagError: nothing can be read, or the requested frame is not in the bag. Raises ConfigError: an option is
    given that messages of this kind do not use.
    """
    from graspd_core.io.bags import read_frames, read_transforms
    from graspd_core.io.messages import ORIGIN, CameraPlace, frame_fault

    said = options.view_point and tuple(options.view_point)
    transforms, place = None, CameraPlace(said, options.sensor_frame)
    done = set[str]()
    frames = read_frames(
        path, topic=options.topic, info_topic=options.camera_info, every=options.every, limit=options.limit
    )
    for frame in frames:
        _refuse_unused(options, frame)
        for name in (options.frame, options.sensor_frame):
            if not name or name.removeprefix("/") == frame.frame.removeprefix("/"):
                continue
            transforms = transforms or read_transforms(path)
            if name.removeprefix("/") not in transforms.frames():
                known = ", ".join(transforms.frames()) + transforms.refused
                raise BagError(f"{path}: no frame {name!r}; frames of its transforms: {known}")
        try:
            seen = frame.view(transforms, options.frame, place)
            if place == ORIGIN and frame.frame not in done and (note := frame_fault(frame.frame, frame.view().points)):
                print_note(note)
            done.add(frame.frame)
            yield frame, seen
        except (CloudError, TransformError) as error:
            yield frame, str(error)


def _refuse_unused(options: argparse.Namespace, frame: BagFrame) -> None:
    cloud = frame.info is None
    for name in ("camera_info",) if cloud else ("view_point", "sensor_frame"):
        if getattr(options, name):
            has, takes = ("clouds", "depth images") if cloud else ("depth images", "clouds")
            raise ConfigError(f"--{name.replace('_', '-')}: {frame.topic} has {has}; valid with {takes}")


def merged_views(path: Path, options: argparse.Namespace) -> tuple[PointCloud, ...]:
    """Return the chosen clouds as views of one scene. If clouds are unusable, print their number on stderr.

    Raises BagError: no cloud is usable, the clouds are in several frames, or there are too many without --limit.
    """
    views, stamps, names, refusals = [], [], set(), []
    for frame, seen in bag_views(path, options):
        if isinstance(seen, str):
            refusals.append(f"cloud {frame.index}: {seen}")
            continue
        if len(views) == MOST_VIEWS and options.limit is None:
            raise BagError(f"{path}: more than {MOST_VIEWS} clouds to fuse; choose some with --every or --limit")
        views.append(seen)
        stamps.append(frame.stamp or frame.received)
        names.add(options.frame or frame.frame)
    if refusals and not views:
        raise BagError(f"{path}: {refusals[0]}")
    if refusals:
        count = len(views) + len(refusals)
        print_note(f"{len(refusals)} of {count} clouds are left out, the first: {refusals[0]}")
    if len(names) > 1:
        raise BagError(f"{path}: clouds in several frames ({', '.join(sorted(names))}); name one with --frame")
    # A camera is at the origin of its own frame. Clouds in another frame may be of a turntable, say.
    if len(views) > 1 and not options.frame and not any(view.viewpoint.any() for view in views):
        _refuse_moving_camera(path, names.pop(), stamps)
    return tuple(views)


def _refuse_moving_camera(path: Path, frame: str, stamps: Sequence[int]) -> None:
    from graspd_core.io.bags import read_transforms

    poses = []
    # Without transforms nobody can tell. Recordings often begin with an image.
    with suppress(BagError):
        transforms = read_transforms(path)
        for stamp in stamps:
            with suppress(TransformError):
                poses.append(transforms.lookup(ROOT, frame, stamp))
    refuse_motion(frame, poses)


def load_views(path: Path, options: argparse.Namespace) -> tuple[PointCloud, ...]:
    """Return the views of a cloud file or a depth image, or the chosen views of a bag. Without --limit, take the first.

    Raises ConfigError: an option of bags is given with a file.
    """
    from graspd_core.io.bags import is_bag
    from graspd_core.perception.load_scene import scaled_views

    if not is_bag(path):
        _refuse_bag_options(path, options)
    if not is_bag(path) or options.camera is not None:
        return tuple(scaled_views(path, options.camera, view_point=options.view_point))
    chosen = argparse.Namespace(**{**vars(options), "limit": options.limit or 1})
    return merged_views(path, chosen)


_FORMS = "box X Y Z SX SY SZ, sphere X Y Z R, or FILE [R]"


def add_restriction_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("steering (docs/usage.md)")
    group.add_argument("--approach", **_XYZ, help="direction in which the hand moves towards the object")
    group.add_argument("--approach-angle", type=float, metavar="DEG", help="tolerance (default 30)")
    group.add_argument("--roll", type=float, metavar="DEG", help="angle of the hand about its approach")
    group.add_argument("--roll-tolerance", type=float, metavar="DEG", help="tolerance (default 15)")
    about = f"where contacts may be: {_FORMS} (a cloud, and the distance from it) [m]"
    group.add_argument("--region", nargs="+", metavar="REGION", help=about)
    group.add_argument(
        "--avoid", type=float, nargs=6, action="append", default=[], metavar=("X", "Y", "Z", "SX", "SY", "SZ"),
        help="a box that no link enters: centre and edge lengths [m] (repeatable)",
    )  # fmt: skip
    parser.add_argument("--arm", metavar="NAME|FILE", help="find only grasps that this arm reaches (docs/arms.md)")
    about = "pose of the arm's base in the object's or the cloud's frame: X Y Z [QW QX QY QZ]"
    parser.add_argument("--arm-base", type=float, nargs="+", metavar="N", help=about)


def restrictions_of(options: argparse.Namespace) -> tuple[Restriction, ...]:
    """Return the restrictions that the options request: steering constraints and the reach of an arm.

    Raises ConfigError: a value is out of range, an option needs another option, or the arm is unknown.
    """
    return (*_steering(options), *_reach(options))


def _steering(options: argparse.Namespace) -> tuple[Steering, ...]:
    for name, other in (("approach_angle", "approach"), ("roll_tolerance", "roll")):
        if getattr(options, name) is not None and getattr(options, other) is None:
            raise ConfigError(f"--{name.replace('_', '-')} needs --{other}; give both or neither")
    given = (options.approach, options.roll, options.region)
    if all(value is None for value in given) and not options.avoid:
        return ()
    from graspd_core.planning.regions import Box
    from graspd_core.planning.steering import Steering

    angles = {"approach_angle": options.approach_angle, "roll": options.roll, "roll_tolerance": options.roll_tolerance}
    radians: dict[str, Any] = {name: float(np.radians(value)) for name, value in angles.items() if value is not None}
    region = None if options.region is None else _region(options.region)
    avoid = [Box(values[:3], values[3:]) for values in options.avoid]
    return (Steering(approach_direction=options.approach, region=region, avoid=avoid, **radians),)


def _region(words: list[str]) -> Region:
    from graspd_core.perception.cloud.cloud_files import load_views
    from graspd_core.planning.regions import Box, NearPoints, Sphere

    kind, values = words[0], words[1:]
    counts = {"box": (6,), "sphere": (4,)}.get(kind, (0, 1))
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        numbers = []
    unknown = kind not in ("box", "sphere") and not Path(kind).is_file()
    if unknown or len(values) not in counts or len(numbers) != len(values):
        raise ConfigError(f"--region: {' '.join(words)}; valid: {_FORMS}")
    if kind == "box":
        return Box(numbers[:3], numbers[3:])
    if kind == "sphere":
        return Sphere(numbers[:3], numbers[3])
    points = np.concatenate([view.points for view in load_views(kind)])
    return NearPoints(points, *numbers)


def _reach(options: argparse.Namespace) -> tuple[Reach, ...]:
    if options.arm is None and options.arm_base is None:
        return ()
    if options.arm is None:
        raise ConfigError("--arm-base: no arm is given; give --arm NAME or --arm FILE")
    from graspd_core.arms.arm import load_arm
    from graspd_core.arms.reach import Reach

    arm, base = load_arm(options.arm), options.arm_base
    if base is None:
        raise ConfigError(
            "--arm: no base pose is given; give --arm-base X Y Z or X Y Z QW QX QY QZ, in metres, "
            "in the object's or cloud's frame"
        )
    if len(base) not in (3, 7):
        raise ConfigError(f"--arm-base: {len(base)} numbers; valid: X Y Z, or X Y Z QW QX QY QZ")
    x, y, z, *turn = base
    w, i, j, k = turn or (1.0, 0.0, 0.0, 0.0)
    return (Reach(arm, (x, y, z), (w, i, j, k)),)


def add_address(parser: argparse.ArgumentParser) -> None:
    """Add `--host` and `--port`, the address of a served page."""
    parser.add_argument("--host", default="127.0.0.1", help="address to serve at (default: for this machine only)")
    parser.add_argument("--port", type=int, default=8080, help="port, or the next free one (default 8080)")
