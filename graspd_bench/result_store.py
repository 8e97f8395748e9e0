"""Records on disk, a file each, kept under everything that was asked for; and all of a run in one results file."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import subprocess
import traceback
from collections.abc import Sequence
from datetime import date
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from graspd_bench.study import Case, Record
from graspd_core.errors import FormatError
from graspd_core.io.grasps_json import save_text

FORMAT, VERSION = "graspd/bench", 2
# Parts of the package that no figure depends on; of the benchmark itself, a study names its own.
_BESIDE = ("cli", "bags", "doctor.py", "formats", "bench", "viewer", "dataset")


def case_key(study: str, case: Case) -> str:
    """Hash of everything that a case asks, hexadecimal. The code that answers is recorded beside it."""
    return hashlib.sha256(json.dumps({"study": study, **case.asked()}, sort_keys=True).encode()).hexdigest()


def case_file(study: str, case: Case) -> str:
    """Name of the file that a record is kept in: for the eye, then for certain."""
    words = re.sub(r"[^A-Za-z0-9_.=-]+", "_", f"{study}-{case.label}")
    return f"{words[:120]}-{case_key(study, case)[:12]}.json"


def head(study: str, case: Case, code: str) -> Record:
    """The part of a record that is known before the run."""
    return {
        **case.shown(),
        "study": study,
        "label": case.label,
        "key": case_key(study, case),
        "code": code,
        "commit": commit(),
        "made": date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "error": "",
    }


def failure(error: BaseException, kind: str = "raised") -> Record:
    """What is written of a case that raised, died or hung: the only failure record there is."""
    where = "".join(traceback.format_exception(error))
    told = " ".join(str(error).split())
    return {"failed": kind, "error": f"{type(error).__name__}: {told}", "traceback": where}


def write_record(folder: Path, study: str, case: Case, record: Record) -> None:
    """Keep a record; its file appears whole or not at all, whatever kills the process."""
    save_text(folder / case_file(study, case), json.dumps(finite(record), indent=1, allow_nan=False) + "\n")


def read_record(folder: Path, study: str, case: Case, code: str | None, *, failed: bool = False) -> Record | None:
    """The record of a case under `code` (None: under any), where it failed only with `failed`; None: there is none."""
    try:
        record = json.loads((folder / case_file(study, case)).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(record, dict) or record.get("key") != case_key(study, case):
        return None
    return record if (failed or not record.get("error")) and code in (None, record.get("code")) else None


def write_results(path: Path, records: Sequence[Record]) -> None:
    """All records in one file."""
    save_text(path, json.dumps({"format": FORMAT, "version": VERSION, "records": records}, allow_nan=False) + "\n")


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
    return whole["records"]


@lru_cache
def code_version(sources: tuple[str, ...] = ()) -> str:
    """The package's version and a hash of the sources that figures depend on: all but those of `_BESIDE`.

    The kernel's C++ counts. Of the benchmark itself only the files that the globs `sources` name below `bench` do.
    """
    root = Path(__file__).parents[1]
    files = {path for pattern in ("*.py", "*.cpp", "*.h", "*.hpp") for path in root.rglob(pattern)}
    counted = {path for path in files if path.relative_to(root).parts[0] not in _BESIDE}
    counted.update(path for pattern in sources for path in (root / "bench").glob(pattern))
    digest = hashlib.sha256()
    for path in sorted(counted):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    try:
        released = version("graspd")
    except PackageNotFoundError:
        released = "unreleased"
    return f"{released}+{digest.hexdigest()[:12]}"


@lru_cache
def commit() -> str:
    """Short name of the commit that is checked out, with a plus where files differ from it; nothing outside a clone."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def finite(value: Any) -> Any:
    """The same, with None for every number that JSON does not know."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
