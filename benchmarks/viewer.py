"""Measure the viewer's cost: opening 200 grasps, dragging the slider, watching a run, random clicks. Not a test.

    python benchmarks/viewer.py [--minutes 10] [--grasps grasps.json] [--pace 0.5] [--clicks-only]

The program needs viser, playwright and the system's package of Chromium, like test/viewer. Without a graphics card the
browser draws in software on the server's cores, so the frame rate is a lower bound. Memory is resident
memory, and counts for each process that shares it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

# One thread. The variable must be set before torch is imported.
os.environ.update(OMP_NUM_THREADS="1")

import numpy as np
import psutil
import torch
from playwright.sync_api import Error, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[1] / "test" / "viewer"))

from conftest import FLAGS  # pyright: ignore

from graspd_core import load_hand, load_preset, load_scene, plan_grasps, save_result
from graspd_core.runtime.worker_process import resident_mb
from graspd_viewer.session import make_session, open_grasps
from graspd_viewer.viewer import Viewer

# JavaScript that counts the frames drawn by three.js. viser exposes the counter.
FRAMES = """() => {
  const drawn = () => window.__viserTestpoints.rendererInfo.render.frame, first = drawn();
  window.drawn = () => drawn() - first;
}"""
# JavaScript that drags the slider to and fro, 60 moves a second. Playwright's mouse would wait for a frame each time.
DRAG = """([left, right, y]) => {
  let moves = 0;
  const step = () => {
    const x = left + (right - left) * Math.abs((moves++ % 120) / 60 - 1);
    document.dispatchEvent(new MouseEvent("mousemove", {clientX: x, clientY: y, bubbles: true, buttons: 1}));
  };
  window.drag = setInterval(step, 1000 / 60);
}"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="duration of random clicks")
    parser.add_argument("--grasps", type=Path, default=None, help="file of many grasps (default: plan 200)")
    parser.add_argument("--pace", type=float, default=0.05, help="seconds between clicks")
    parser.add_argument("--clicks-only", action="store_true", help="leave out the scrubs and the watched runs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    path = options.grasps or planned(200)
    before = set(threading.enumerate())
    viewer = Viewer(port=0)
    if not options.clicks_only:
        watched(viewer, "nobody there")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        opened(viewer, page, path)
        if not options.clicks_only:
            for address in ("", "/?fixedDpr=0.5"):
                page.goto(viewer.url + address)
                scrubbed(viewer, page, address)
            watched(viewer, "a browser beside it")
        clicked(viewer, page, options.minutes, options.pace)
        browser.close()
    viewer.close()
    time.sleep(1.0)
    left = [thread.name for thread in set(threading.enumerate()) - before]
    print(
        f"threads left behind: {left or 'none'}; child processes: {[process.pid for process in children()] or 'none'}"
    )


def planned(count: int) -> Path:
    """Plan `count` grasps of the mug with the Allegro hand. Return the path of their file."""
    scene, hand, config = load_scene("shape:mug"), load_hand("allegro_right"), load_preset("fast")
    path = Path(tempfile.mkdtemp()) / "grasps.json"
    save_result(path, plan_grasps(scene, hand, count=count, preset=config), scene.object, hand, config)
    return path


def opened(viewer: Viewer, page: Any, path: Path) -> None:
    """Print the time from opening a file until the page shows the first grasp, then the same time after a reload."""
    page.goto(viewer.url)
    page.wait_for_selector("canvas")
    time.sleep(3.0)
    began = time.perf_counter()
    viewer.show(open_grasps(path))
    page.get_by_text("#0 verified").first.wait_for()
    shown = time.perf_counter() - began
    began = time.perf_counter()
    page.reload()
    page.get_by_text("#0 verified").first.wait_for()
    anew = time.perf_counter() - began
    print(f"{path}: on an open page after {shown:.2f} s; a page opened anew says so after {anew:.2f} s")


def scrubbed(viewer: Viewer, page: Any, address: str) -> None:
    """Drag the slider for ten seconds. Print frames of the browser, poses of the hand, and CPU time."""
    page.get_by_text("#0 verified").first.wait_for()
    time.sleep(3.0)
    poses, nodes = [0], viewer._nodes
    put = nodes.pose_hand

    def counted(*arguments: Any) -> None:
        poses[0] += 1
        put(*arguments)

    setattr(nodes, "pose_hand", counted)  # noqa: B010
    thumb = page.get_by_role("slider").first
    box = thumb.bounding_box()
    page.mouse.move(box["x"] + 4, box["y"] + 4)
    page.mouse.down()
    page.evaluate(FRAMES)
    page.evaluate(DRAG, [box["x"] - 90, box["x"] + 30, box["y"] + 4])
    began, server, browser = time.perf_counter(), time.process_time(), browser_cpu()
    page.wait_for_timeout(10_000)
    seconds, server, browser = time.perf_counter() - began, time.process_time() - server, browser_cpu() - browser
    frames = page.evaluate("clearInterval(window.drag), window.drawn()")
    page.mouse.up()
    setattr(nodes, "pose_hand", put)  # noqa: B010 - a method is no attribute to pyright
    print(
        f"scrubbing {address}: {frames / seconds:.0f} frames and {poses[0] / seconds:.0f} poses a second; CPU: "
        f"browser {browser:.1f} s, {1e3 * browser / frames:.0f} ms a frame, server and driver {server:.1f} s"
    )


def watched(viewer: Viewer, who: str, repeats: int = 6) -> None:
    """Print the CPU time of planning thread and process, and the wall time, of a run with and without live view."""
    scene, hand, config = load_scene("shape:mug"), load_hand("allegro_right"), load_preset("balanced")
    session = make_session("mug", hand, (), scene, config, np.zeros((0, 3)), ())
    figures: dict[bool, list[tuple[float, float, float]]] = {False: [], True: []}
    for watch in [False, True] * repeats:
        viewer.live.begin(session)
        hooks = {"watch": viewer.live.watch, "progress": viewer.live.progress} if watch else {}
        clocks = time.thread_time(), time.process_time(), time.perf_counter()
        plan_grasps(scene, hand, count=16, preset=config, **hooks)
        now = time.thread_time(), time.process_time(), time.perf_counter()
        figures[watch].append(tuple(b - a for a, b in zip(clocks, now, strict=True)))  # pyright: ignore[reportArgumentType]
        viewer.live.end()
    for index, name in enumerate(("CPU of the planning thread", "CPU of the process", "wall time")):
        off, on = (statistics.median(row[index] for row in figures[watch]) for watch in (False, True))
        print(f"watched run, {who}, {name}: {off:.2f} s without, {on:.2f} s with, {100 * (on / off - 1):+.1f} %")


def clicked(viewer: Viewer, page: Any, minutes: float, pace: float) -> None:
    """Print memory of server and browser during random clicks in the panel and random keys.

    Args:
        minutes: duration [min].
        pace: pause after each click or key [s].
    """
    random.seed(0)
    page.reload()
    page.get_by_text("#0 verified").first.wait_for()
    end, clicks, told = time.monotonic() + 60 * minutes, 0, 0.0
    while time.monotonic() < end:
        if time.monotonic() - told > 60:
            told = time.monotonic()
            _tell_memory(clicks)
        try:
            if random.random() < 0.7:
                page.mouse.click(random.uniform(960, 1260), random.uniform(110, 780))
            else:
                page.keyboard.press(random.choice(["n", "p", "r", "ArrowLeft", "ArrowRight", "Escape"]))
        except Error as error:
            print(f"click {clicks}: {error}")
        clicks += 1
        time.sleep(pace)
    _tell_memory(clicks)


def _tell_memory(clicks: int) -> None:
    server, browser = resident_mb(os.getpid()), sum(resident_mb(process.pid) for process in children())
    when = f"{time.strftime('%H:%M:%S')}, after {clicks} clicks"
    print(f"{when}: server {server:.0f} MB, browser {browser:.0f} MB", flush=True)


def children() -> list[psutil.Process]:
    """Return all descendants of this process."""
    return psutil.Process().children(recursive=True)


def browser_cpu() -> float:
    """Return the CPU time of all running descendants of this process [s]."""
    seconds = 0.0
    for process in children():
        with contextlib.suppress(psutil.Error):
            seconds += sum(process.cpu_times()[:2])
    return seconds


if __name__ == "__main__":
    main()
