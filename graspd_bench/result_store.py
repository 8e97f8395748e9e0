"""Records of cases on disk: a file for each case, and results.json with all. A record's key is a hash of its case."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
from collections.abc import Sequence
from datetime import date
from pathlib import Path

from graspd_bench.study import Case, Record
from graspd_core.errors import FormatError
from graspd_core.io.grasps_json import save_text
from graspd_dataset.run_records import code_version, commit, finite

FORMAT, VERSION = "graspd/bench", 2
# Files of graspd_bench on which the results of every study depend.
_COUNTED = ("baselines/*.py", "rendering/*.py", "trials.py")


def case_key(study: str, case: Case) -> str:
    """Return the SHA-256 of a study's name and all inputs of a case, except the code version, in hexadecimal."""
    return hashlib.sha256(json.dumps({"study": study, **case.inputs()}, sort_keys=True).encode()).hexdigest()


def case_file(study: str, case: Case) -> str:
    """Return the file name of a case's record: the study, the case's label, and the first 12 digits of the key."""
    words = re.sub(r"[^A-Za-z0-9_.=-]+", "_", f"{study}-{case.label}")
    return f"{words[:120]}-{case_key(study, case)[:12]}.json"


def head(study: str, case: Case, code: str) -> Record:
    """Return the fields of a record that are known before the case runs."""
    return {
        **case.recorded(),
        "study": study,
        "label": case.label,
        "key": case_key(study, case),
        "code": code,
        "commit": commit(),
        "made": date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "error": "",
    }


def write_record(folder: Path, study: str, case: Case, record: Record) -> None:
    """Write the record of a case. The file is written completely or not at all, even if the process is killed."""
    save_text(folder / case_file(study, case), json.dumps(finite(record), indent=1, allow_nan=False) + "\n")


def read_record(folder: Path, study: str, case: Case, code: str | None, *, failed: bool = False) -> Record | None:
    """Return a case's record made by code version `code` (None: any), or None. `failed` also allows a failed case."""
    try:
        record = json.loads((folder / case_file(study, case)).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(record, dict) or record.get("key") != case_key(study, case):
        return None
    return record if (failed or not record.get("error")) and code in (None, record.get("code")) else None


def results_document(records: Sequence[Record]) -> Record:
    """Return the content of results.json, JSON-ready."""
    return {"format": FORMAT, "version": VERSION, "records": records}


def write_results(path: Path, records: Sequence[Record]) -> None:
    save_text(path, json.dumps(results_document(records), allow_nan=False) + "\n")


def read_results(path: Path) -> list[Record]:
    """Return the records of a results file.

    Raises:
        FormatError: the file cannot be read, has another format, or has an unknown version.
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
    records = whole.get("records")
    if not isinstance(records, list) or not all(isinstance(record, dict) and "error" in record for record in records):
        raise FormatError(f"{path}: its records are incomplete; `graspd bench` writes them anew")
    return records


def bench_version(sources: tuple[str, ...]) -> str:
    """Return a study's code version: package version, and a hash of graspd_core and the files `_COUNTED`, `sources`."""
    return code_version(tuple(f"graspd_bench/{pattern}" for pattern in (*_COUNTED, *sources)))
