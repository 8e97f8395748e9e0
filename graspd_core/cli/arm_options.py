"""The options that give the hand an arm."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from graspd_core.errors import ConfigError

if TYPE_CHECKING:
    from graspd_core.planning.reach import Reach


def add_arm_options(parser: argparse.ArgumentParser) -> None:
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


def reach_of(options: argparse.Namespace) -> tuple[Reach, ...]:
    """The restriction by reach, if an arm was given. Raises ConfigError: there is no such arm, or it stands nowhere."""
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
