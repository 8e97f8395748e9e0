"""`graspd methods`, `graspd presets` and `graspd metrics`: list names with a one-line description of each."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from functools import partial
from typing import Any

from graspd_core.cli.options import add_plugin_option
from graspd_core.cli.output import answer
from graspd_core.cli.running import EXIT_OK
from graspd_core.optimize.plan_config import method_names, method_row, preset_names, run_plugins
from graspd_core.paths import config_dir


def add_command(commands: Any) -> None:
    """Add the commands `methods`, `presets` and `metrics` to the parsers in `commands`."""
    for name, rows in _TABLES.items():
        parser = commands.add_parser(name)
        parser.set_defaults(run=partial(run, rows))
        if rows is not _presets:
            add_plugin_option(parser)


def run(rows: Callable[[], dict[str, str]], options: argparse.Namespace) -> int:
    """Print each name with its description."""
    found = rows()
    width = max(map(len, found))
    for name, about in found.items():
        print(f"{name:{width}}  {about}")
    answer([{"name": name, "about": about} for name, about in found.items()])
    return EXIT_OK


def _methods() -> dict[str, str]:
    return {name: _first_sentence(method_row(name).config.__doc__ or "") for name in method_names()}


def _presets() -> dict[str, str]:
    files = {name: config_dir() / "presets" / f"{name}.yaml" for name in preset_names()}
    return {name: _first_sentence(path.read_text(encoding="utf-8").lstrip("# ")) for name, path in files.items()}


def _metrics() -> dict[str, str]:
    from graspd_core.verify.metrics import METRICS

    run_plugins()
    rows = ((row, _first_sentence(row.description)) for row in METRICS.values())
    return {row.name: f"{about} [{row.unit}]" if row.unit else about for row, about in rows}


def _first_sentence(text: str) -> str:
    # A preset's file begins with a comment, which may have several lines. Join these lines.
    return re.split(r"[.;](?: |$)", re.sub(r"\s*\n[#\s]*", " ", text))[0]


_TABLES = {"methods": _methods, "presets": _presets, "metrics": _metrics}
