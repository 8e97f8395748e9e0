"""Any cell to its record: what was asked, what came of it, by which code on which machine."""

from __future__ import annotations

import math
import os
import platform
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from graspd_core.bench.measurements.measurement import Cell, Kind, cell_key
from graspd_core.bench.measurements.stopwatch import forget_peak, peak_mb
from graspd_core.bench.measurements.throughput import run_pace, run_start
from graspd_core.bench.measurements.unfiltered import run_raw
from graspd_core.bench.measurements.verified import run_verified
from graspd_core.methods.plan_config import to_mapping
from graspd_core.runtime import disk_cache as cache

FORMAT, VERSION = "graspd/bench-cell", 1

KINDS: Mapping[Kind, Callable[[Cell], dict[str, Any]]] = {
    "raw": run_raw,
    "verified": run_verified,
    "pace": run_pace,
    "start": run_start,
}


def run_cell(cell: Cell, code: str) -> dict[str, Any]:
    """The record of one cell. What it raises is written down in it: one bad cell ends no benchmark.

    Everything is built anew, so that no cell lives on what another left in memory.
    """
    cache.forget()
    forget_peak()
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        figures = KINDS[cell.kind](cell)
    except Exception as error:
        figures = failure(error)
    return {
        **asked(cell, code),
        **finite(figures),
        "cell_cpu": time.process_time() - cpu,
        "cell_wall": time.perf_counter() - wall,
        "peak_mb": peak_mb(),
    }


def asked(cell: Cell, code: str) -> dict[str, Any]:
    """The part of a record that is known before the run."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "key": cell_key(cell),
        "code": code,
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "kind": cell.kind,
        "name": cell.name,
        "method": cell.settings.method,
        "object": cell.object,
        "hand": cell.hand,
        "seed": cell.seed,
        "asked": cell.count,
        "settings": to_mapping(cell.settings),
        "error": "",
    }


def failure(error: BaseException) -> dict[str, Any]:
    """What is written of a cell that raised."""
    where = "".join(traceback.format_exception(error))
    return {"error": f"{type(error).__name__}: {' '.join(str(error).split())}", "traceback": where}


def finite(value: Any) -> Any:
    """The same, with None for every number that JSON does not know."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
