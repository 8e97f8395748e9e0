"""Finished cells on disk, a file each, and all of them in one results file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from graspd_core.bench.measurements.measurement import Cell, cell_file, cell_key
from graspd_core.errors import FormatError
from graspd_core.formats.grasps_json import save_text

FORMAT, VERSION = "graspd/bench", 1

Record = dict[str, Any]


def write_cell(folder: Path, cell: Cell, record: Record) -> None:
    """Keep a record; its file appears whole or not at all, whatever kills the process."""
    save_text(folder / cell_file(cell), json.dumps(record, indent=1, allow_nan=False) + "\n")


def read_cell(folder: Path, cell: Cell, code: str | None) -> Record | None:
    """The record of a cell that finished without error under `code` (None: under any); None where there is none."""
    return kept_record(folder / cell_file(cell), cell_key(cell), code)


def kept_record(path: Path, key: str, code: str | None) -> Record | None:
    """What a file holds under `key`, if that ended without error under `code` (None: under any)."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    good = isinstance(record, dict) and record.get("key") == key and not record.get("error")
    return record if good and (code is None or record.get("code") == code) else None


def read_cells(folder: Path, cells: Iterable[Cell], code: str | None) -> dict[Cell, Record]:
    """Those of `cells` that have finished."""
    found = ((cell, read_cell(folder, cell, code)) for cell in cells)
    return {cell: record for cell, record in found if record is not None}


def write_results(path: Path, records: Sequence[Record]) -> None:
    """All records in one file."""
    whole = {
        "format": FORMAT,
        "version": VERSION,
        "codes": sorted({record["code"] for record in records}),
        "machines": sorted({record["machine"] for record in records}),
        "cells": records,
    }
    save_text(path, json.dumps(whole, allow_nan=False) + "\n")


def read_results(path: Path) -> list[Record]:
    """The records of a results file.

    Raises:
        FormatError: it cannot be read, is of another format, or of an unknown version.
    """
    try:
        whole = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:
        raise FormatError(f"{path}: not JSON: {error}") from None
    if not isinstance(whole, dict) or whole.get("format") != FORMAT:
        raise FormatError(f"{path}: not a {FORMAT} file; `graspd bench` writes one as results.json")
    if whole.get("version") != VERSION:
        raise FormatError(f"{path}: version {whole.get('version')!r}; this reader knows {VERSION}")
    return whole["cells"]
