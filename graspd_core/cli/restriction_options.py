"""Options that restrict grasps: where a hand comes from, what it touches and keeps away from, what an arm reaches."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graspd_core.errors import ConfigError

if TYPE_CHECKING:
    from graspd_core.methods.restrictions import Restriction
    from graspd_core.planning.reach import Reach
    from graspd_core.planning.steering.regions import Region
    from graspd_core.planning.steering.steering import Steering

_FORMS = "box X Y Z SX SY SZ, sphere X Y Z R, or FILE [R]"


def add_restriction_options(parser: argparse.ArgumentParser) -> None:
    """Steering, and an arm."""
    _add_steering_options(parser)
    _add_arm_options(parser)


def restrictions_of(options: argparse.Namespace) -> tuple[Restriction, ...]:
    """What the options ask for; none where they ask for nothing.

    Raises:
        ConfigError: a value is out of its range, an option lacks another, or there is no such arm.
    """
    return (*_steering(options), *_reach(options))


def _add_steering_options(parser: argparse.ArgumentParser) -> None:
    """Approach, roll, region and avoided boxes; all in the object's frame."""
    group = parser.add_argument_group("steering (docs/usage.md)")
    group.add_argument(
        "--approach", type=float, nargs=3, default=None, metavar=("X", "Y", "Z"),
        help="direction that the hand moves in towards the object",
    )  # fmt: skip
    group.add_argument("--approach-angle", type=float, default=None, metavar="DEG", help="either way (default 30)")
    group.add_argument("--roll", type=float, default=None, metavar="DEG", help="of the hand about its approach")
    group.add_argument("--roll-tolerance", type=float, default=None, metavar="DEG", help="either way (default 15)")
    group.add_argument(
        "--region", nargs="+", default=None, metavar="REGION",
        help=f"where contacts may be: {_FORMS}: a cloud of points and how near to them [m]",
    )  # fmt: skip
    group.add_argument(
        "--avoid", type=float, nargs=6, action="append", default=[], metavar=("X", "Y", "Z", "SX", "SY", "SZ"),
        help="a box that no link enters: middle and edges [m]; may be given again",
    )  # fmt: skip


def _steering(options: argparse.Namespace) -> tuple[Steering, ...]:
    if options.approach is None:
        _refuse_alone("approach-angle", options.approach_angle, "approach")
    if options.roll is None:
        _refuse_alone("roll-tolerance", options.roll_tolerance, "roll")
    asked = (options.approach, options.roll, options.region)
    if all(value is None for value in asked) and not options.avoid:
        return ()
    from graspd_core.planning.steering.regions import Box
    from graspd_core.planning.steering.steering import Steering

    angles = {"approach_angle": options.approach_angle, "roll": options.roll, "roll_tolerance": options.roll_tolerance}
    wishes: dict[str, Any] = {name: float(np.radians(value)) for name, value in angles.items() if value is not None}
    region = None if options.region is None else _region(options.region)
    avoid = [Box(values[:3], values[3:]) for values in options.avoid]
    return (Steering(approach_direction=options.approach, region=region, avoid=avoid, **wishes),)


def _refuse_alone(name: str, value: float | None, other: str) -> None:
    if value is not None:
        raise ConfigError(f"--{name}: it needs --{other}")


def _region(words: list[str]) -> Region:
    from graspd_core.planning.steering.regions import Box, NearPoints, Sphere
    from graspd_core.pointcloud.cloud_files import load_views

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


def _add_arm_options(parser: argparse.ArgumentParser) -> None:
    """Which arm, and where it stands."""
    parser.add_argument(
        "--arm", default=None, metavar="NAME|FILE", help="only grasps that this arm reaches (docs/arms.md)"
    )
    parser.add_argument(
        "--arm-base",
        type=float,
        nargs="+",
        default=None,
        metavar="N",
        help="where the arm's base stands, in the object's or the cloud's frame: X Y Z [QW QX QY QZ]",
    )


def _reach(options: argparse.Namespace) -> tuple[Reach, ...]:
    if options.arm is None and options.arm_base is None:
        return ()
    if options.arm is None:
        raise ConfigError("--arm-base: there is no arm; give --arm NAME or FILE")
    from graspd_core.arms.arm_file import load_arm
    from graspd_core.planning.reach import Reach

    arm, base = load_arm(options.arm), options.arm_base
    if base is None:
        raise ConfigError("--arm: say where it stands, --arm-base X Y Z or X Y Z QW QX QY QZ")
    if len(base) not in (3, 7):
        raise ConfigError(f"--arm-base: {len(base)} numbers; valid: X Y Z, or X Y Z QW QX QY QZ")
    x, y, z, *turn = base
    w, i, j, k = turn or (1.0, 0.0, 0.0, 0.0)
    return (Reach(arm, (x, y, z), (w, i, j, k)),)
