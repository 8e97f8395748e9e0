"""Facts about a run: code version, commit, failures, CPU time and peak memory. Also Markdown tables."""

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
from graspd_core.optimize.plan_config import plugin_files

# Parts of graspd_core on which no recorded result depends.
_BESIDE = ("cli", "io", "doctor.py")
# Endings of hands (`load_hand`) and presets.
_HAND_ENDINGS = ("yaml", "yml", "urdf", "xml", "pkl")
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Stopwatch:
    """Stopwatch that sums CPU and wall time for each name [s]. Use `with stopwatch(name):` around the timed code.

    CPU time counts the whole process (`time.process_time`). On one thread it does not depend on the machine's load.
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
    """Reset the process's peak memory. Do nothing on systems other than Linux."""
    try:
        _CLEAR.write_text("5")
    except OSError:
        return


def peak_mb() -> float:
    """Return the peak resident memory of this process [MB], since `forget_peak` or since its start."""
    try:
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def failure(error: BaseException, kind: str = "raised") -> dict[str, Any]:
    """Return the record of a failure: its kind (raised, hung, memory, died), the error, and the traceback."""
    where = "".join(traceback.format_exception(error))
    message = " ".join(str(error).split())
    return {"failed": kind, "error": f"{type(error).__name__}: {message}", "traceback": where}


@lru_cache
def code_version(sources: tuple[str, ...] = ()) -> str:
    """Return the package's version and a hash of the sources that results depend on.

    The hash is of the plugins and of all Python and C++ files of graspd_core, except those in `_BESIDE`. `sources` are
    glob patterns of further files, relative to the parent folder of graspd_core.
    """
    root = Path(graspd_core.__file__).parent
    files = {path for pattern in ("*.py", "*.cpp", "*.h", "*.hpp") for path in root.rglob(pattern)}
    counted = {path for path in files if path.relative_to(root).parts[0] not in _BESIDE}
    counted.update(path for pattern in sources for path in root.parent.glob(pattern))
    digest = hashlib.sha256()
    for path in sorted(counted):
        digest.update(f"{path.relative_to(root.parent).as_posix()}\n".encode() + path.read_bytes())
    for path in map(Path, plugin_files()):
        digest.update(f"{path.name}\n".encode() + path.read_bytes())
    try:
        released = version("graspd")
    except PackageNotFoundError:
        released = "unreleased"
    return f"{released}+{digest.hexdigest()[:12]}"


@lru_cache
def commit() -> str:
    """Return the short hash of the current git commit, with a plus if files differ from it. Empty outside a clone."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def object_name(source: Any) -> str:
    """Return a short name of an object, hand or other value: without `shape:`, or a file's name without its ending."""
    text = f"{source:g}" if isinstance(source, float) else str(source)
    path = Path(text)
    return path.stem if path.suffix[1:].lower() in (*MESH_ENDINGS, *_HAND_ENDINGS) else text.removeprefix("shape:")


def finite(value: Any) -> Any:
    """Replace every NaN or infinity in nested values by None, because JSON has neither."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def markdown_table(headings: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown. Cells must not contain the character `|`."""
    lines = [headings, ["---"] * len(headings), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace("| --- |", "|---|").replace(" --- |", "---|")
