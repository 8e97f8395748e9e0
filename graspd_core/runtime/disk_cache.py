"""Cache arrays by key, in the memory of this process and on disk for other processes.

Files are in `$XDG_CACHE_HOME/graspd`, by default `~/.cache/graspd`. `GRASPD_CACHE=off` disables the files. A damaged
file is replaced. On a read-only disk no file is written. The least recently used files are removed, because every cloud
is new and adds files. Files are written atomically.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import os
import tempfile
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

Arrays = dict[str, np.ndarray]

# Part of every file name. Increase `VERSION` if the arrays that are computed from one mesh or hand change.
VERSION = 9
CAPACITY = 24
# Greatest size of all files together [bytes]. The size is checked after every `LOOK_EVERY` written files.
MOST_BYTES, LOOK_EVERY = 512 * 2**20, 16

_memory: OrderedDict[str, Arrays] = OrderedDict()
_lock = threading.Lock()
_written = itertools.count(1)


def remember(key: str, build: Callable[[], Arrays], valid: Callable[[Arrays], bool]) -> Arrays:
    """Return the arrays of `key`, from memory, from the file, or from `build`.

    `build` runs if there is no file, or if `valid` rejects the file's arrays. Callers must not modify the result.
    """
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
    supply({key: arrays})
    return arrays


def contents() -> dict[str, Arrays]:
    """Return the arrays that this process has in memory, by key."""
    with _lock:
        return dict(_memory)


def supply(arrays: dict[str, Arrays]) -> None:
    """Add arrays to the memory of this process, for example arrays that another process has built."""
    with _lock:
        _memory.update(arrays)
        while len(_memory) > CAPACITY:
            _memory.popitem(last=False)


def forget() -> None:
    """Clear the memory of this process. Files are kept."""
    with _lock:
        _memory.clear()


def digest(values: Iterable[Any]) -> str:
    """Return the hexadecimal SHA-256 of arrays, tuples, dataclasses and, by their `repr`, other values."""
    found = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray):
            found.update(f"{value.dtype}{value.shape}".encode())
            # A view instead of a copy: clouds of megabytes are hashed while a request waits.
            found.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
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
    """Return the file path of `key`. None if `GRASPD_CACHE` disables files, or the user has no home directory."""
    if os.environ.get("GRASPD_CACHE", "").lower() in ("off", "0", "no"):
        return None
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "graspd" / f"{key}-v{VERSION}.npz"


def _read(path: Path) -> Arrays | None:
    try:
        # `open` also closes the file after an error. The members of an npz file have a CRC, so damage is detected.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    # zipfile raises RuntimeError or NotImplementedError if a damaged file seems encrypted or compressed.
    except (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile):
        return None
    # The file may belong to another user, or the disk may be read-only.
    with contextlib.suppress(OSError):
        os.utime(path)
    return arrays


def _write(path: Path, arrays: Arrays) -> None:
    with contextlib.suppress(OSError):
        with _written_whole(path) as file:
            np.savez(file, allow_pickle=False, **arrays)
        if next(_written) % LOOK_EVERY == 0:
            _prune(path.parent)


def _prune(directory: Path) -> None:
    """Remove the least recently used files until the remaining files have at most `MOST_BYTES`.

    Unfinished files (.part) of killed processes count too.
    """
    files = []
    for path in (path for pattern in ("*.npz", "*.part") for path in directory.glob(pattern)):
        # Another process may have removed or renamed the file.
        with contextlib.suppress(FileNotFoundError):
            about = path.stat()
            files.append((about.st_mtime, about.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= MOST_BYTES:
            break
        path.unlink(missing_ok=True)
        total -= size


def save_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically. Make missing directories."""
    with _written_whole(path) as file:
        file.write(content)
        os.chmod(file.name, 0o644)


@contextlib.contextmanager
def _written_whole(path: Path) -> Iterator[IO[bytes]]:
    """Yield a temporary file that becomes `path`. If the work inside fails, nothing is left of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as made:
        temporary = Path(made.name)
    try:
        with temporary.open("wb") as file:
            yield file
        # Renaming is atomic, so another process sees the complete file or none.
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
