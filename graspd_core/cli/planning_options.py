"""What every command that plans has in common: its options, what they stand for, and the lines at its end."""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import Any

from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, EXIT_TOO_FEW
from graspd_core.config import VERIFICATIONS
from graspd_core.errors import ConfigError
from graspd_core.methods.method_registry import METHODS
from graspd_core.methods.plan_config import PlanConfig, load_preset, preset_names
from graspd_core.types import GraspResult, Outcome, Timing

# Metrics in the summary of a run.
_SHOWN = ("penetration", "contact_area", "epsilon", "robustness")
# Grasps that it lists; the others it counts.
_FIRST = 3


def add_planning_options(parser: argparse.ArgumentParser) -> None:
    """Hand, number, method and trial of the grasps, and what is known of the object."""
    parser.add_argument("--hand", default="allegro_right", metavar="NAME|PATH", help="graspd hands lists the names")
    parser.add_argument("-n", "--count", type=int, default=16, help="verified grasps wanted (default 16)")
    parser.add_argument("--method", choices=METHODS, default=None)
    parser.add_argument("--preset", default="balanced", help=f"{', '.join(preset_names())}, or a .yaml file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mass", type=float, default=0.1, metavar="KG", help="of the object (default 0.1)")
    parser.add_argument("--friction", type=float, default=0.6, metavar="MU", help="default 0.6")
    parser.add_argument(
        "--deadline", type=float, default=None, metavar="SEC", help="end with what there is then; loading counts"
    )
    parser.add_argument("--verify", choices=VERIFICATIONS, default="standard")
    parser.add_argument("--robust", action="store_true", help="grasps that hold out of place too come first")
    parser.add_argument("--device", default="cpu", help="torch device of the optimiser")
    parser.add_argument("--threads", type=int, default=1, help="of the optimiser and the trials (default 1)")


def planning_options(options: argparse.Namespace) -> tuple[PlanConfig, dict[str, Any]]:
    """The settings, and the arguments of `plan_grasps` but for the deadline; sets torch's threads.

    Raises:
        ConfigError: an option is out of range, or the preset is unknown or malformed.
    """
    import torch

    from graspd_core.planning.plan_grasps import check_request

    request = {key: getattr(options, key) for key in ("count", "seed", "verify", "device")}
    check_request(**request, deadline=options.deadline)
    if options.threads < 1:
        raise ConfigError(f"threads: {options.threads}; at least 1")
    torch.set_num_threads(options.threads)
    config = load_preset(options.preset)
    if options.method:
        config = config.with_method(options.method)
    if options.robust:
        config = dataclasses.replace(config, robust=dataclasses.replace(config.robust, rank=True))
    return config, request


def not_loaded(options: argparse.Namespace, config: PlanConfig, began: float) -> GraspResult:
    """What a run comes to whose deadline passed while its object was loaded, from `began` on."""
    taken = time.perf_counter() - began
    return GraspResult(Outcome.DEADLINE, (), Timing(load=taken, total=taken), options.seed, config.method)


def summary(result: GraspResult, wanted: int, different: int) -> str:
    """A few lines for a person; so many of the good grasps are `different`."""
    from graspd_core.metrics.metric_registry import METRICS

    good = good_grasps(result)
    kind = "unverified" if any(not grasp.trials for grasp in result.grasps) else "verified"
    ending = result.message or result.outcome.value
    copies = f", {different} of them different" if different < good else ""
    lines = [f"{good} of {wanted} grasps ({kind}{copies}, {len(result.grasps)} tried): {ending}"]
    timing = result.timing
    lines.append(
        f"load {timing.load:.2f} s, sdf {timing.sdf:.2f} s, optimise {timing.optimise:.2f} s, "
        f"verify {timing.verify:.2f} s, total {timing.total:.2f} s"
        + (f", first verified after {timing.first_verified:.2f} s" if timing.first_verified else "")
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
    """How many grasps are as sure as was asked for; they come first."""
    return sum(grasp.usable for grasp in result.grasps)


def exit_status(result: GraspResult) -> int:
    """Enough grasps, fewer, or interrupted."""
    if result.outcome is Outcome.CANCELLED:
        return EXIT_INTERRUPTED
    return EXIT_OK if result.outcome is Outcome.SUCCEEDED else EXIT_TOO_FEW
