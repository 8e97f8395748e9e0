"""The command `graspd view`: show grasps or a benchmark in a browser, or a page that plans grasps."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.options import add_address
from graspd_core.cli.output import print_note
from graspd_core.cli.running import EXIT_OK, Interrupt, Watched
from graspd_core.errors import ConfigError
from graspd_core.types import GraspResult

if TYPE_CHECKING:
    from graspd_core.hands.model import HandModel
    from graspd_core.optimize.plan_config import PlanConfig
    from graspd_core.perception.scene import Scene


# Time that a run with --view waits for the first visitor [s].
_PATIENCE = 60.0


def add_command(commands: Any) -> None:
    """Add this command to the parser."""
    parser = commands.add_parser("view")
    parser.set_defaults(run=run, json=False)
    parser.add_argument(
        "path", metavar="PATH", type=Path, nargs="?", default=None,
        help="grasps.json or the folder of a benchmark (default: a page for planning)",
    )  # fmt: skip
    parser.add_argument("--object", default=None, metavar="OBJECT", help="replaces the object that the file names")
    parser.add_argument("--hand", default=None, metavar="NAME|PATH", help="replaces the hand that the file names")
    parser.add_argument("--html", type=Path, default=None, metavar="page.html", help="write a benchmark's page")
    add_address(parser)


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C. With --html, write a benchmark's page instead. Return the exit status 0."""
    import torch

    torch.set_num_threads(1)
    if options.path is not None and options.path.is_dir():
        return _view_benchmark(options)
    if options.html is not None:
        raise ConfigError(f"--html {options.html} needs a benchmark's folder; `graspd synthesize --html` draws a grasp")
    from graspd_viewer.session import open_grasps
    from graspd_viewer.viewer import Viewer

    if options.path is None and (options.object or options.hand):
        raise ConfigError("--object, --hand: no grasps.json is given; give its path, or choose both on the page")
    session = options.path and open_grasps(options.path, object_source=options.object, hand=options.hand)
    viewer = Viewer(host=options.host, port=options.port)
    try:
        if session:
            viewer.show(session)
        wait_for_end(viewer.url)
    finally:
        viewer.close()
    return EXIT_OK


@contextmanager
def watched(options: argparse.Namespace, scene: Scene, hand: HandModel, config: PlanConfig) -> Iterator[Watched]:
    """Open a page for a run with --view. Wait up to a minute for a visitor. Yield the functions that show the run."""
    from graspd_viewer.session import make_session, seen_points
    from graspd_viewer.viewer import Viewer

    seen, notes = seen_points(options.object, scene.object.scale, options.camera), scene.object.warnings
    name = Path(options.object).name

    def show(result: GraspResult) -> None:
        viewer.live.end()
        about = scene, config, seen, result.warnings
        viewer.show(make_session(name, hand, result.tried, *about, mass=result.tried_mass))
        wait_for_end(viewer.url)

    viewer = Viewer(host=options.host, port=options.port, plan=False)
    try:
        session = make_session(name, hand, (), scene, config, seen, notes)
        viewer.show(session)
        viewer.live.begin(session)
        print_note(f"{viewer.url} - planning begins when the page is open")
        viewer.wait_for_visitor(_PATIENCE)
        yield Watched(viewer.live.watch, viewer.live.progress, show)
    finally:
        viewer.close()


def wait_for_end(url: str) -> None:
    """Print the page's address, and wait for Ctrl-C."""
    print(f"{url} - Ctrl-C ends it", flush=True)
    with Interrupt() as interrupt:
        pause = threading.Event()
        while not interrupt.is_interrupted():
            pause.wait(0.2)


def _view_benchmark(options: argparse.Namespace) -> int:
    from graspd_core.io.grasps_json import save_text
    from graspd_viewer.bench_page import bench_page, plan_again, serve_page
    from graspd_viewer.viewer import Viewer

    page, runs = bench_page(options.path, served=options.html is None)
    if options.html is not None:
        save_text(options.html, page)
        print(f"{options.html}: open it in a browser")
        return EXIT_OK
    viewer = Viewer(host=options.host, port=options.port and options.port + 1)

    def open_run(key: str) -> int | None:
        if key not in runs:
            return None
        viewer.run(lambda stop: plan_again(runs[key], viewer.show, viewer.say, stop))
        return viewer.port

    try:
        with serve_page(page, options.host, options.port, open_run) as url:
            wait_for_end(url)
    finally:
        viewer.close()
    return EXIT_OK
