"""Records of runs: the code, the commit, the failure, the cost. And tables in Markdown."""

from __future__ import annotations

import hashlib
import math
import resource
import subprocess
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import graspd_core
from graspd_core.mesh.mesh_files import MESH_ENDINGS

# Parts of graspd_core that no figure depends on.
_BESIDE = ("cli", "io", "doctor.py")
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Stopwatch:
    """Seconds by name, summed over all stretches of that name.

    CPU seconds are of the whole process (`time.process_time`). On one thread they measure the work, however busy the
    machine is.
    """

    def __init__(self) -> None:
        self.cpu: dict[str, float] = {}
        self.wall: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        cpu, wall = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            self.cpu[name] = self.cpu.get(name, 0.0) + time.process_time() - cpu
            self.wall[name] = self.wall.get(name, 0.0) + time.perf_counter() - wall


def forget_peak() -> None:
    """Start the process's peak of memory anew, if the system can (Linux)."""
    try:
        _CLEAR.write_text("5")
    except OSError:
        return


def peak_mb() -> float:
    """Return the peak of this process's resident memory since `forget_peak` or its start [MB]."""
    try:
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def failure(error: BaseException, kind: str = "raised") -> dict[str, Any]:
    """Return the record of a case that raised, died or hung."""
    where = "".join(traceback.format_exception(error))
    told = " ".join(str(error).split())
    return {"failed": kind, "error": f"{type(error).__name__}: {told}", "traceback": where}


@lru_cache
def code_version(sources: tuple[str, ...] = ()) -> str:
    """Return the package's version and a hash of the sources that figures depend on.

    They are those of graspd_core but for `_BESIDE`, the kernel's C++ among them, and the files that the globs `sources`
    name beside graspd_core.
    """
    root = Path(graspd_core.__file__).parent
    files = {path for pattern in ("*.py", "*.cpp", "*.h", "*.hpp") for path in root.rglob(pattern)}
    counted = {path for path in files if path.relative_to(root).parts[0] not in _BESIDE}
    counted.update(path for pattern in sources for path in root.parent.glob(pattern))
    digest = hashlib.sha256()
    for path in sorted(counted):
        digest.update(f"{path.relative_to(root.parent).as_posix()}\n".encode() + path.read_bytes())
    try:
        released = version("graspd")
    except PackageNotFoundError:
        released = "unreleased"
    return f"{released}+{digest.hexdigest()[:12]}"


@lru_cache
def commit() -> str:
    """Return the short name of the current commit, with a plus for changed files, empty outside a clone."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def thing_name(source: Any) -> str:
    """Return an object's name: the shape, or the file without its ending. Other values stay as they are."""
    text = f"{source:g}" if isinstance(source, float) else str(source)
    path = Path(text)
    return path.stem if path.suffix[1:].lower() in (*MESH_ENDINGS, "yaml", "yml") else text.removeprefix("shape:")


def finite(value: Any) -> Any:
    """Return the same values, with None for every number that JSON does not know."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def markdown_table(headings: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown. Cells must not have bars of their own."""
    lines = [headings, ["---"] * len(headings), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace("| --- |", "|---|").replace(" --- |", "---|")
