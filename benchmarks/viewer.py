"""What the viewer costs: opening 200 grasps, scrubbing, watching a run, and minutes of random clicking. Not a test.

    python benchmarks/viewer.py [--minutes 10] [--grasps grasps.json] [--pace 0.5] [--clicks-only]

Needs viser, playwright and a Chromium of the system's packages, as test/viewer does. Without a graphics card the
browser draws in software, on the same cores as the server: its frames are a lower bound. Memory is resident memory.
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

# One thread, said before torch is imported.
os.environ.update(OMP_NUM_THREADS="1")

import numpy as np
import torch
from playwright.sync_api import Error, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[1] / "test" / "viewer"))

from conftest import FLAGS  # pyright: ignore

from graspd_core import load_hand, load_preset, load_scene, plan_grasps, save_result
from graspd_viewer.session import make_session, open_grasps
from graspd_viewer.viewer import Viewer

# What three.js says of itself, by way of viser: frames that were really drawn.
FRAMES = """() => {
  const drawn = () => window.__viserTestpoints.rendererInfo.render.frame, first = drawn();
  window.drawn = () => drawn() - first;
}"""
# To and fro over the slider, 60 times a second: the driver's own mouse waits for a frame behind each move.
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
    parser.add_argument("--minutes", type=float, default=10.0, help="of random clicking")
    parser.add_argument("--grasps", type=Path, default=None, help="a file of many grasps; without it 200 are planned")
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
    print(f"threads left behind: {left or 'none'}; child processes: {children() or 'none'}")


def planned(count: int) -> Path:
    """So many grasps of the mug by the Allegro hand."""
    scene, hand, config = load_scene("shape:mug"), load_hand("allegro_right"), load_preset("fast")
    path = Path(tempfile.mkdtemp()) / "grasps.json"
    save_result(path, plan_grasps(scene, hand, count=count, preset=config), scene.object, hand, config)
    return path


def opened(viewer: Viewer, page: Any, path: Path) -> None:
    """From the file to the page that says its first grasp."""
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
    """Frames of the browser and poses of the hand while the slider is dragged to and fro for ten seconds."""
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
    """CPU seconds of a planning thread, and wall seconds of a run, with and without somebody who watches."""
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
    """Memory of the server and the browser while somebody clicks anywhere in the panel and types any key.

    Args:
        minutes: so long.
        pace: seconds between the end of a click and the next.
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
    server, browser = resident(os.getpid()), browser_memory()
    print(
        f"{time.strftime('%H:%M:%S')}, after {clicks} clicks: server {server:.0f} MB, browser {browser:.0f} MB",
        flush=True,
    )


def resident(process: int) -> float:
    """Resident memory of a process [MB]; none where it is gone."""
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return 0.0


def children() -> list[int]:
    """Processes below this one, by number."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            continue
    found, ahead = [], [os.getpid()]
    while ahead:
        parent = ahead.pop()
        below = [process for process, above in parents.items() if above == parent]
        found, ahead = found + below, ahead + below
    return found


def browser_cpu() -> float:
    """CPU seconds of everything that this process has started and that still runs."""
    ticks = 0
    for process in children():
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def browser_memory() -> float:
    """Resident memory of everything that this process has started [MB]; what processes share counts for each."""
    return sum(map(resident, children()))


if __name__ == "__main__":
    main()
