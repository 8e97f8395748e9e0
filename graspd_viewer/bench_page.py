"""HTML page of a benchmark: charts of speed against accuracy. A click on a point lists the preset's runs and grasps.

The page is one file that needs no network. A benchmark stores the metrics of grasps, but no postures. To show the
grasps of a run, the server plans again with the run's settings and seed. The same code finds the same grasps.
"""

from __future__ import annotations

import html
import json
import shlex
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.charts import PANELS, Point, points_of
from graspd_bench.figures import Row, by_name, is_preset, per_verified, rows
from graspd_bench.result_store import read_results
from graspd_bench.study import PROTOCOL_MASS, Record
from graspd_core.errors import ConfigError, FormatError
from graspd_core.hands.library import load_hand
from graspd_core.mesh.shapes import SHAPES
from graspd_core.optimize.candidates import PlannerInput, find_candidates
from graspd_core.optimize.loop import Hooks
from graspd_core.optimize.plan_config import method_row, plan_config
from graspd_core.perception.load_scene import SHAPE_PREFIX, load_scene
from graspd_core.perception.scene import near_scene
from graspd_core.types import StopHook, Verdict
from graspd_core.verify.metrics import measure
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_core.verify.trial_registry import grasp_trials
from graspd_core.verify.verification import trial_context
from graspd_viewer.server import may_connect
from graspd_viewer.session import Session, make_session

ShowProgress = Callable[[str, float], None]
_TIMES = {"cpu_per_grasp": "CPU seconds per raw grasp", "cpu_per_verified": "CPU seconds per verified grasp"}
# Metrics of a grasp that the page shows: heading, key of the metric, factor on its SI value, decimals.
_FIGURES = (
    ("penetration mm", "penetration", 1e3, 2),
    ("contact area cm²", "contact_area", 1e4, 1),
    ("ε", "epsilon", 1, 3),
)


def bench_page(folder: Path, *, served: bool = False) -> tuple[str, dict[str, Record]]:
    """Return the HTML page of a benchmark's folder, and by key the records of runs that plan raw grasps.

    If `served`, the page has buttons that ask the server to show the grasps of a run.
    Raises FormatError: the folder has no readable results, or no raw grasps of a preset.
    """
    records = read_results(folder / "results.json")
    try:
        raw = [r for r in records if r.get("kind") == "raw" and not r["error"] and is_preset(r["name"])]
        data, runs = {**page_data(raw), "served": served}, {record["key"]: record for record in raw}
    except (KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{folder / 'results.json'}: a record has no valid {error}") from None
    if not data["panels"]:
        raise FormatError(f"{folder}: holds no results of raw grasps; `graspd bench` measures some")
    # Only the sequence `</` could end the script element early.
    text = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    return _PAGE.replace("@TITLE@", html.escape(folder.resolve().name)).replace("@DATA@", text), runs


def page_data(runs: Sequence[Record]) -> dict[str, Any]:
    """Return the data for the page's script: charts (`panels`) with a point for each preset, and all runs."""
    presets = by_name(rows(runs))
    panels = [
        {
            "time": label, "label": panel.label, "log": panel.log,
            "points": [_point(point, time, presets[point.name]) for point in points_of(presets, time, panel)],
        }
        for time, label in _TIMES.items()
        for panel in PANELS
    ]  # fmt: skip
    return {"panels": [panel for panel in panels if panel["points"]], "runs": [_run(record) for record in runs]}


def _point(point: Point, time: str, group: Sequence[Row]) -> dict[str, Any]:
    method, (low, middle, high) = method_row(point.method), point.x
    if time == "cpu_per_verified":  # the value over all objects together, as in the tables
        middle = per_verified(group)
    x = (low, middle, high)
    return {"name": point.name, "colour": method.colour, "method": method.label, "x": x, "y": point.y}


def _run(record: Record) -> dict[str, Any]:
    words = ["graspd", "synthesize", _source(record), "--hand", record["hand"], "--preset", record["name"]]
    words += ["--seed", str(record["seed"]), "-n", str(record["count"]), "--view"]
    return {
        **{name: record[name] for name in ("name", "key", "object", "seed", "count")}, "held": record.get("held"),
        "command": shlex.join(words), "grasps": [_grasp(grasp) for grasp in record["grasps"]],
    }  # fmt: skip


def _source(record: Record) -> str:
    # A record stores only the name of a mesh file, not its path.
    return f"{SHAPE_PREFIX}{record['object']}" if record["object"] in SHAPES else record["object"]


def _grasp(grasp: dict[str, Any]) -> dict[str, Any]:
    measured, tried = grasp.get("metrics") or {}, grasp.get("standard") or {}
    values = [(name, measured.get(key), scale, digits) for name, key, scale, digits in _FIGURES]
    figures = {name: f"{value * scale:.{digits}f}" for name, value, scale, digits in values if value is not None}
    # None: the run had no standard trial.
    return {"held": tried.get("passed"), "reason": str(tried.get("reason", "")), "figures": figures}


def plan_again(record: Record, show: Callable[[Session], None], report: ShowProgress, stop: StopHook) -> None:
    """Plan a run again. Then simulate, measure and show its grasps. `report` gets lines and the progress, 0 to 1.

    Raises GraspdError: the object or the hand of the run is not available.
    """
    config = plan_config(record["settings"], f"settings of {record['name']}")
    hand = load_hand(record["hand"], candidates=config.problem.fine_candidates)
    scene, _ = near_scene(load_scene(_source(record), mass=PROTOCOL_MASS, resolution=config.resolution))
    title = f"{record['name']}, {record['object']}, seed {record['seed']}"
    session = make_session(title, hand, (), scene, config, np.zeros((0, 3)), ())
    show(session)
    count, hooks = record["count"], Hooks(lambda step, of, _: report(f"searching {step} of {of}", step / of), stop)
    found = find_candidates(PlannerInput(scene, hand, count, record["seed"], config, hooks))[:count]
    worlds = trial_context(scene, hand, "standard")
    context, grasps = make_metrics_context(scene.object, hand), []
    for grasp in found:
        if stop():
            break
        report(f"trying {len(grasps)} of {len(found)}", len(grasps) / len(found))
        trials = grasp_trials(worlds, grasp, stop)
        grasps.append(replace(grasp, trials=trials, metrics=measure(context, grasp.grasp)))
    held = sum(grasp.verdict is Verdict.VERIFIED for grasp in grasps)
    line = f"{held} of {count} held"
    if "held" in record:
        line += f"; {record['held']} held in the benchmark, by graspd {record.get('code')}"
    show(make_session(title, hand, tuple(grasps), scene, config, session.seen, (line,)))
    report(line, 1.0)


@contextmanager
def serve_page(page: str, host: str, port: int, open_run: Callable[[str], int | None]) -> Iterator[str]:
    """Serve the page until the context ends. Yield its address.

    Args:
        page: the HTML text.
        host, port: the address to listen on.
        open_run: shows the grasps of the run with a given key. Returns the viewer's port, None if the key is unknown.

    Raises ConfigError: the address cannot be listened on.
    """
    handler = partial(_OnePage, page.encode(), host, open_run)
    try:
        server = ThreadingHTTPServer((host, port), handler)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"{host}:{port}: cannot listen ({error}); change --host or --port") from None
    thread = threading.Thread(target=server.serve_forever, name="graspd-page", daemon=True)
    thread.start()
    try:
        yield f"http://{host}:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class _OnePage(BaseHTTPRequestHandler):
    def __init__(self, content: bytes, host: str, open_run: Callable[[str], int | None], *arguments: Any) -> None:
        self._content, self._host, self._open_run = content, host, open_run
        super().__init__(*arguments)

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(self._content)))
        self.end_headers()
        self.wfile.write(self._content)

    def do_POST(self) -> None:
        """Show the grasps of a run. Redirect the browser to the viewer. Refuse requests from pages of other sites."""
        named = self.headers.get("Host", "")
        allowed = may_connect(self.headers.get("Origin"), named, self._host)
        port = self._open_run(self.path.rpartition("/")[2]) if allowed else None
        if port is None:
            self.send_error(404 if allowed else 403)
            return
        self.send_response(303)
        self.send_header("Location", f"http://{named.rpartition(':')[0] or named}:{port}")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        del format, args


_PAGE = (Path(__file__).parent / "bench_page.html").read_text(encoding="utf-8")
