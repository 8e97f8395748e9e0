"""`graspd synthesize`: plan grasps for one object."""

from __future__ import annotations

import argparse
import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.options import (
    add_address,
    add_camera_option,
    add_object_options,
    add_planning_options,
    add_restriction_options,
    exit_status,
    good_grasps,
    not_loaded,
    plan_any_object,
    planning_options,
    restrictions_of,
    scene_config_of,
    summary,
    target_of,
)
from graspd_core.cli.output import Reporter, answer, busy, print_note
from graspd_core.cli.running import Deadline, DeadlinePassed, Interrupt, Watched, sibling
from graspd_core.errors import ConfigError
from graspd_core.types import GraspResult

if TYPE_CHECKING:
    from graspd_core.hands.model import HandModel
    from graspd_core.optimize.plan_config import PlanConfig
    from graspd_core.perception.scene import Scene

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 0.0254}


def add_command(commands: Any) -> None:
    """Add the command `synthesize` to the parsers in `commands`."""
    parser = commands.add_parser("synthesize")
    parser.set_defaults(run=run)
    parser.add_argument("object", metavar="OBJECT", help="mesh, cloud, depth image, or shape:NAME")
    add_planning_options(parser)
    add_camera_option(parser)
    add_object_options(parser, any_object=True)
    add_restriction_options(parser)
    sizes = parser.add_mutually_exclusive_group()
    sizes.add_argument("--scale", type=float, metavar="S", help="metres per unit of file or depth")
    sizes.add_argument("--units", choices=tuple(_UNITS), help="unit of the file's coordinates")
    parser.add_argument("--out", type=Path, metavar="grasps.json", help="grasps file (docs/format.md)")
    parser.add_argument("--html", type=Path, metavar="view.html", help="write a page with the grasps")
    parser.add_argument("--picture", type=Path, metavar="grasp.png", help="draw the best grasp")
    parser.add_argument("--view", action="store_true", help="show the run in a browser (docs/viewer.md)")
    add_address(parser)


def run(options: argparse.Namespace) -> int:
    """Plan grasps for one object, print a summary and write the requested files. Return the exit status."""
    from graspd_core.hands.library import load_hand
    from graspd_core.io.grasps_json import check_writable
    from graspd_core.perception.load_scene import load_scene
    from graspd_core.planning.plan_grasps import plan_grasps

    config, request = planning_options(options)
    request["restrictions"] = restrictions_of(options)
    deadline = Deadline(options.deadline, options.began)
    # Check the output paths before planning, so that the result of a long run is not lost.
    if options.picture and options.picture.suffix.lower() != ".png":
        raise ConfigError(f"--picture {options.picture}; valid: a file name that ends in .png")
    for path in (options.out, options.html, options.picture):
        if path:
            check_writable(path)
    if options.any:
        return _any_object(options, config, request, deadline)
    try:
        with deadline.cuts_short(), busy("load"):
            scene = load_scene(
                options.object,
                mass=options.mass,
                friction=options.friction,
                scale=_scale_of(options),
                target=target_of(options),
                alone=options.alone,
                view_point=options.view_point,
                settings=scene_config_of(options) if options.scene else None,
                camera=options.camera,
            )
            hand = load_hand(options.hand)
    except DeadlinePassed:
        # No file is written, because a result file needs an object.
        result, document = not_loaded(options, config, options.began)
        print(summary(result, options.count, 0))
        answer(document)
        return exit_status(result)
    known = (*scene.object.warnings, *hand.named_warnings)
    for warning in known:
        print_note(warning)
    page_of_run = nullcontext(Watched())
    if options.view:
        page_of_run = sibling("graspd_viewer.view_command").watched(options, scene, hand, config)
    with page_of_run as page:
        with Reporter() as reporter, Interrupt() as interrupt:
            tell = lambda progress: (reporter(progress), page.progress(progress))[0]  # noqa: E731
            hooks = {"progress": tell, "watch": page.watch, "stop": interrupt.is_interrupted}
            result = plan_grasps(scene, hand, preset=config, deadline=deadline.left(), **hooks, **request)
        for warning in result.warnings[len(known) :]:
            print_note(warning)
        _report(options, result, scene, hand, config)
        page.show(result)
    return exit_status(result)


def _scale_of(options: argparse.Namespace) -> float:
    """Return metres per unit of the file. Raises ConfigError: the options say metres, but the camera's file does not.

    `load_scene` takes a scale of 1 as the unit of the camera's file.
    """
    from graspd_core.perception.cloud.depth_files import load_depth_camera

    scale = _UNITS[options.units] if options.units else options.scale
    if scale == 1.0 and options.camera:
        told = load_depth_camera(options.camera)[2]
        if told not in (None, 1.0):
            given = f"--units {options.units}" if options.units else "--scale 1"
            raise ConfigError(f"{given}: {options.camera} has depth_unit {told:g} m; remove one of them")
    return 1.0 if scale is None else scale


def _any_object(options: argparse.Namespace, config: PlanConfig, request: dict[str, Any], deadline: Deadline) -> int:
    """Plan for any object of a cloud. Return the exit status. Raises ConfigError: no cloud, or `--view` is given."""
    from graspd_core.hands.library import load_hand
    from graspd_core.perception.cloud.cloud_files import is_cloud_file
    from graspd_core.perception.cloud.depth_files import is_depth_image
    from graspd_core.perception.load_scene import scaled_views

    if options.view:
        raise ConfigError("--any: --view is given too; remove one of them")
    if not (options.camera or is_depth_image(options.object) or is_cloud_file(options.object)):
        raise ConfigError(f"--any: given with {options.object}; valid with clouds and depth images of several objects")
    views = scaled_views(options.object, options.camera, _scale_of(options), options.view_point)
    hand = load_hand(options.hand)
    with Reporter() as reporter, Interrupt() as interrupt:
        hooks = {"progress": reporter, "stop": interrupt.is_interrupted}
        result, scene, about = plan_any_object(
            views, hand, options, deadline, source=options.object, preset=config, **hooks, **request
        )
    for warning in result.warnings:
        print_note(warning)
    _report(options, result, scene, hand, config, about)
    return exit_status(result)


def _report(
    options: argparse.Namespace,
    result: GraspResult,
    scene: Scene,
    hand: HandModel,
    config: PlanConfig,
    about: dict[str, Any] | None = None,
) -> None:
    """Write the result to the requested files and print a summary. `about` adds entries to the JSON document."""
    from graspd_core.io.grasps_json import result_document, save_result
    from graspd_core.verify.metrics import distinct

    # Write the files first, because printing fails if the reader of the output has ended.
    if options.out:
        save_result(options.out, result, scene.object, hand, config)
    if options.html or options.picture:
        page = sibling("graspd_viewer.grasp_page")
        content = (scene.object.mesh, hand, result.grasps)
        up = result.support and result.support.normal
        with busy("draw"):
            if options.html:
                page.save_view(options.html, *content, name=Path(options.object).name, up=up)
            if options.picture:
                page.save_picture(options.picture, *content, up=up)
    answer({**result_document(result, scene.object, hand, config), **(about or {})})
    different = len(distinct(result.grasps[: good_grasps(result)], hand))
    print(summary(result, options.count, different))
    if options.out:
        print(f"written: {options.out}; show it: graspd view {shlex.quote(str(options.out))}")
    if options.html:
        print(f"written: {options.html}: the grasps, for any browser")
    if options.picture:
        print(f"written: {options.picture}: the best grasp")
