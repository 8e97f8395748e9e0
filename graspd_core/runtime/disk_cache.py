"""Arrays remembered by key: in this process always, and on disk between processes.

Files lie in `$XDG_CACHE_HOME/graspd` (else `~/.cache/graspd`). `GRASPD_CACHE=off` keeps everything in memory. A file
that cannot be read back whole is built again. A disk that cannot be written is not used. The files not used for longest
are removed, because clouds are never the same twice. Every file appears whole or not at all.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import os
import tempfile
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]

# Part of every file's name: raise it when what is computed from the same mesh or hand changes.
VERSION = 8
CAPACITY = 24
# Size of all files together [bytes], and how many are written between two looks at it.
MOST_BYTES, LOOK_EVERY = 512 * 2**20, 16

_memory: OrderedDict[str, Arrays] = OrderedDict()
_lock = threading.Lock()
_written = itertools.count(1)


def remember(key: str, build: Callable[[], Arrays], valid: Callable[[Arrays], bool]) -> Arrays:
    """Return the arrays stored under `key`, built and stored if none are `valid`. Read-only by convention."""
    with _lock:
        if key in _memory:
            _memory.move_to_end(key)
            return _memory[key]
    path = cache_path(key)
    arrays = _read(path) if path else None
    if arrays is None or not valid(arrays):
        arrays = build()
        if path:
            _write(path, arrays)
    with _lock:
        _memory[key] = arrays
        while len(_memory) > CAPACITY:
            _memory.popitem(last=False)
    return arrays


def contents() -> dict[str, Arrays]:
    """Return what this process remembers in memory, by key."""
    with _lock:
        return dict(_memory)


def supply(arrays: dict[str, Arrays]) -> None:
    """Remember in memory what another process built."""
    with _lock:
        _memory.update(arrays)
        while len(_memory) > CAPACITY:
            _memory.popitem(last=False)


def forget() -> None:
    """Empty the memory of this process. Files stay."""
    with _lock:
        _memory.clear()


def digest(values: Iterable[Any]) -> str:
    """Return the SHA-256 of arrays, tuples, dataclasses and other values by their `repr`, hexadecimal."""
    found = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray):
            found.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        elif isinstance(value, tuple):
            found.update(f"({len(value)}".encode())
            for part in value:
                add(part)
        elif dataclasses.is_dataclass(value):
            add(tuple(getattr(value, item.name) for item in dataclasses.fields(value)))
        else:
            found.update(f"{value!r};".encode())

    add(tuple(values))
    return found.hexdigest()


def cache_path(key: str) -> Path | None:
    """Return the path of the file of `key`, None if the disk is not to be used."""
    if os.environ.get("GRASPD_CACHE", "").lower() in ("off", "0", "no"):
        return None
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "graspd" / f"{key}-v{VERSION}.npz"


def _read(path: Path) -> Arrays | None:
    try:
        # Opening by hand closes the file whatever happens. Members of npz carry a CRC, so a damaged one is noticed.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        os.utime(path)
        return arrays
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        return None


def _write(path: Path, arrays: Arrays) -> None:
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            temporary = Path(file.name)
            np.savez(file, allow_pickle=False, **arrays)
        # Renaming is atomic: another process sees the whole file or none.
        temporary.replace(path)
        if next(_written) % LOOK_EVERY == 0:
            _prune(path.parent)
    except OSError:
        if temporary:
            temporary.unlink(missing_ok=True)


def _prune(directory: Path) -> None:
    """Remove the files that were not used for longest until the rest is small enough."""
    files = sorted((path.stat().st_mtime, path.stat().st_size, path) for path in directory.glob("*.npz"))
    total = sum(size for _, size, _ in files)
    for _, size, path in files:
        if total <= MOST_BYTES:
            break
        path.unlink(missing_ok=True)
        total -= size


def save_bytes(path: Path, content: bytes) -> None:
    """Write a file that appears whole or not at all. Makes missing directories."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
