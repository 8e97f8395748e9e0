"""A benchmark as one page: speed against accuracy, and behind every point the runs and the grasps that made it.

One file that needs no network and no library. Results keep figures of grasps, not their postures: beside every run
stands the command that plans it again, to be looked at.
"""

from __future__ import annotations

import html
import json
import shlex
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from graspd_core.bench.charts.speed_chart import PANELS, Point, points_of
from graspd_core.bench.figures import Row, by_name, per_verified, rows
from graspd_core.bench.names import is_preset
from graspd_core.bench.result_store import read_results
from graspd_core.bench.study import Record
from graspd_core.errors import ConfigError, FormatError
from graspd_core.formats.grasps_json import save_text
from graspd_core.mesh.shapes import SHAPES
from graspd_core.methods.method_registry import METHODS
from graspd_core.scene.load_scene import SHAPE_PREFIX

_TIMES = {"cpu_per_grasp": "CPU seconds per raw grasp", "cpu_per_verified": "CPU seconds per verified grasp"}
# Of one grasp's record: what is shown, from which part, times what.
_FIGURES = (
    ("penetration mm", "penetration", 1e3, 2),
    ("contact area cm²", "contact_area", 1e4, 1),
    ("ε", "epsilon", 1, 3),
)


def save_bench_page(folder: Path, page: Path) -> None:
    """Write the page of a benchmark's folder; it appears whole or not at all.

    Raises:
        FormatError: the folder has no results that can be read, or none of a preset.
    """
    records = read_results(folder / "results.json")
    try:
        data = page_data(records)
    except (KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{folder / 'results.json'}: a record lacks or mistakes {error}") from None
    if not data["panels"]:
        raise FormatError(f"{folder}: holds no raw grasps of a preset; `graspd bench` measures them")
    # Within a script only this sequence could end it.
    text = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    save_text(page, _PAGE.replace("@TITLE@", html.escape(folder.resolve().name)).replace("@DATA@", text))


def page_data(records: Sequence[Record]) -> dict[str, Any]:
    """What the page's script draws: panels of points, and the runs of every name."""
    presets = by_name(row for row in rows(records) if is_preset(row.name))
    panels = [
        {
            "time": label, "label": panel.label, "log": panel.log,
            "points": [_point(point, time, presets[point.name]) for point in points_of(presets, time, panel)],
        }
        for time, label in _TIMES.items()
        for panel in PANELS
    ]  # fmt: skip
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in presets}
    for record in records:
        if record.get("kind") == "raw" and not record["error"] and record["name"] in runs:
            runs[record["name"]].append(_run(record))
    return {"panels": [panel for panel in panels if panel["points"]], "runs": runs}


def _point(point: Point, time: str, group: Sequence[Row]) -> dict[str, Any]:
    method, (low, middle, high) = METHODS[point.method], point.x
    if time == "cpu_per_verified":  # as the tables have it, all objects together
        middle = per_verified(group)
    x = (low, middle, high)
    return {"name": point.name, "colour": method.colour, "method": method.label, "x": x, "y": point.y}


def _run(record: Record) -> dict[str, Any]:
    # Of a file only the name is kept.
    source = f"{SHAPE_PREFIX}{record['object']}" if record["object"] in SHAPES else record["object"]
    words = ["graspd", "synthesize", source, "--hand", record["hand"], "--preset", record["name"]]
    words += ["--seed", str(record["seed"]), "-n", str(record["count"]), "--view"]
    return {
        "object": record["object"], "seed": record["seed"], "asked": record["count"], "held": record["held"],
        "command": shlex.join(words), "grasps": [_grasp(grasp) for grasp in record["grasps"]],
    }  # fmt: skip


def _grasp(grasp: dict[str, Any]) -> dict[str, Any]:
    measured, tried = grasp.get("metrics") or {}, grasp.get("standard") or {}
    values = [(name, measured.get(key), scale, digits) for name, key, scale, digits in _FIGURES]
    figures = {name: f"{value * scale:.{digits}f}" for name, value, scale, digits in values if value is not None}
    return {"held": bool(tried.get("passed")), "reason": str(tried.get("reason", "")), "figures": figures}


@contextmanager
def serve_page(page: Path, host: str, port: int) -> Iterator[str]:
    """Serve one file, whatever is asked for, until the end. Raises ConfigError: the address cannot be had."""
    handler = partial(_OnePage, page.read_bytes())
    try:
        server = ThreadingHTTPServer((host, port), handler)
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"{host}:{port} cannot be listened on ({error}); choose another with --host and --port"
        ) from None
    thread = threading.Thread(target=server.serve_forever, name="graspd-page", daemon=True)
    thread.start()
    try:
        yield f"http://{host}:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class _OnePage(BaseHTTPRequestHandler):
    def __init__(self, content: bytes, *arguments: Any) -> None:
        self._content = content
        super().__init__(*arguments)

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(self._content)))
        self.end_headers()
        self.wfile.write(self._content)

    def log_message(self, format: str, *args: Any) -> None:
        del format, args


_PAGE = (Path(__file__).parent / "bench_page.html").read_text(encoding="utf-8")
