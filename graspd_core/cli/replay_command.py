"""`graspd replay`: plan grasps for each cloud of a recording, as the ROS node would."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.options import (
    add_bag_options,
    add_object_options,
    add_planning_options,
    bag_views,
    check_bag_options,
    exit_status,
    good_grasps,
    merged_views,
    not_loaded,
    plan_any_object,
    planning_options,
    scene_config_of,
    target_of,
)
from graspd_core.cli.output import Reporter, answer, busy, print_note, waiting
from graspd_core.cli.running import (
    EXIT_BAD_INPUT,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_TOO_FEW,
    Deadline,
    DeadlinePassed,
    Interrupt,
)
from graspd_core.errors import CloudError, ConfigError, GraspdError, NoObjectError
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.transforms import SECOND
from graspd_core.types import GraspResult

if TYPE_CHECKING:
    from graspd_core.hands.model import HandModel
    from graspd_core.perception.cloud.point_cloud import PointCloud


@dataclass(frozen=True)
class _Job:
    """Views of one scene for one run of the planner. An unusable cloud gives no `views`, and `refusal` says why."""

    name: str
    label: str
    frame: str
    stamp: float | None = None
    views: tuple[PointCloud, ...] = ()
    refusal: str = ""


def add_command(commands: Any) -> None:
    """Add the command `replay` to the parsers in `commands`."""
    parser = commands.add_parser("replay")
    parser.set_defaults(run=run)
    parser.add_argument("bag", metavar="BAG", type=Path, help="a directory, or a .mcap or .db3 file")
    add_bag_options(parser)
    parser.add_argument("--fuse", action="store_true", help="use all clouds as views of one scene")
    add_object_options(parser, any_object=True)
    add_planning_options(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder, or .json file for one result")


def run(options: argparse.Namespace) -> int:
    """Plan on every cloud. Return 0 if all have enough grasps, 3 if not, 2 if no cloud is usable, 130 if stopped."""
    from graspd_core.hands.library import load_hand
    from graspd_core.io.grasps_json import check_writable

    config, request = planning_options(options)
    check_bag_options(options)
    settings = scene_config_of(options)
    single = options.out is not None and options.out.suffix == ".json"
    if single and not (options.fuse or options.limit == 1):
        raise ConfigError(f"--out {options.out}: one file for several clouds; give a directory, --limit 1, or --fuse")
    if options.out:
        check_writable(options.out if single else options.out / "probe")
    hand = load_hand(options.hand)
    for warning in hand.named_warnings:
        print_note(warning)
    began, statuses, grasps, interrupted = time.perf_counter(), [], 0, False
    scenes: list[dict[str, Any]] = []
    with Interrupt() as interrupt:
        for job in waiting(_jobs(options), "read cloud"):
            # Check here, so that an interrupt also ends the loop if every cloud is refused.
            if interrupted := interrupt.is_interrupted():
                break
            try:
                result, document = _planned(
                    job, options, hand, config, {**request, "settings": settings, "stop": interrupt.is_interrupted}
                )
            except GraspdError as error:
                print(f"{job.label}: refused: {error}", flush=True)
                scenes.append({"label": job.label, "refused": str(error)})
                # A cloud without an object counts as too few grasps. An unusable cloud is bad input.
                statuses.append(EXIT_TOO_FEW if isinstance(error, NoObjectError) else EXIT_BAD_INPUT)
                continue
            print(_outcome_line(job, result, options.count), flush=True)
            scenes.append({"label": job.label, **document})
            grasps += good_grasps(result)
            statuses.append(exit_status(result))
    enough, refused = statuses.count(EXIT_OK), statuses.count(EXIT_BAD_INPUT)
    print(
        f"{len(statuses)} scenes: {enough} with enough grasps, {len(statuses) - refused - enough} with fewer, "
        f"{refused} refused; {grasps} grasps in {time.perf_counter() - began:.1f} s"
    )
    answer({"scenes": scenes})
    return EXIT_INTERRUPTED if interrupted else _status(statuses)


def _outcome_line(job: _Job, result: GraspResult, count: int) -> str:
    first = result.timing.first_verified
    return (
        f"{job.label}: {sum(len(v.points) for v in job.views)} points, {good_grasps(result)} of {count} grasps "
        f"({len(result.tried)} tried): {result.message or result.outcome.value}; "
        + (f"first verified after {first:.2f} s, " if first else "")
        + f"total {result.timing.total:.2f} s"
    )


def _planned(
    job: _Job, options: argparse.Namespace, hand: HandModel, config: PlanConfig, request: dict[str, Any]
) -> tuple[GraspResult, dict[str, Any]]:
    """Plan on a job's views and, with `--out`, write the result file. Return the result and its JSON document.

    Raises GraspdError: the views are unusable or show no usable object.
    """
    from graspd_core.io.grasps_json import result_document, save_result
    from graspd_core.perception.scene_from_views import scene_from_views
    from graspd_core.planning.plan_grasps import plan_grasps

    if job.refusal:
        raise CloudError(job.refusal)
    began = time.perf_counter()
    deadline, about = Deadline(options.deadline, began), {}
    settings = request.pop("settings")
    if options.any:
        with Reporter() as reporter:
            request |= {"preset": config, "progress": reporter}
            result, scene, about = plan_any_object(job.views, hand, options, deadline, source=job.label, **request)
        told = [warning for warning in result.warnings if warning not in hand.named_warnings]
    else:
        try:
            with deadline.cuts_short(), busy("load"):
                scene = scene_from_views(
                    job.views,
                    target=target_of(options),
                    alone=options.alone,
                    settings=settings,
                    mass=options.mass,
                    friction=options.friction,
                    source=f"{options.bag}: {job.label}",
                )
        except DeadlinePassed:
            return not_loaded(options, config, began)
        for warning in scene.object.warnings:
            print_note(f"{job.label}: {warning}")
        with Reporter() as reporter:
            result = plan_grasps(scene, hand, preset=config, progress=reporter, deadline=deadline.left(), **request)
        told = result.warnings[len(scene.object.warnings) + len(hand.named_warnings) :]
    for warning in told:
        print_note(f"{job.label}: {warning}")
    if options.out:
        path = options.out if options.out.suffix == ".json" else options.out / f"{job.name}.json"
        save_result(path, result, scene.object, hand, config, frame=job.frame, stamp=job.stamp)
    return result, {**result_document(result, scene.object, hand, config), **about}


def _jobs(options: argparse.Namespace) -> Iterator[_Job]:
    """Yield one job per cloud. With `--fuse`, yield one job with all clouds."""
    if options.fuse:
        views = merged_views(options.bag, options)
        yield _Job("fused", f"{len(views)} clouds fused", options.frame or "", views=views)
        return
    for frame, seen in bag_views(options.bag, options):
        name = f"cloud_{frame.index:06d}"
        label = f"cloud {frame.index} at {frame.stamp // SECOND}.{frame.stamp % SECOND:09d} s"
        job = _Job(name, label, options.frame or frame.frame, (frame.stamp or frame.received) / SECOND)
        yield replace(job, refusal=seen) if isinstance(seen, str) else replace(job, views=(seen,))


def _status(statuses: list[int]) -> int:
    if EXIT_INTERRUPTED in statuses:
        return EXIT_INTERRUPTED
    if not statuses or set(statuses) == {EXIT_BAD_INPUT}:
        return EXIT_BAD_INPUT
    return EXIT_OK if set(statuses) == {EXIT_OK} else EXIT_TOO_FEW
