"""Storage of a data set: a directory, or an address that pyarrow can open (s3://bucket/path, gs://, hdfs://).

    grasps/hand=HAND/object=CONTENT/KEY.parquet    one block per file
    objects/SHA256.parquet                         one mesh per file
    failed/KEY.json                                why a block or an object failed
    runs/KEY.json                                  run record of a command: the command and its cost
    README.md                                      the data card: a description of the data set

Every file is written completely or not at all. The same rows give the same bytes. A run record holds the SHA-256 of
every file that the run wrote. So `graspd dataset validate` finds any changed byte.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from graspd_core.errors import FormatError, GraspdError
from graspd_core.runtime.disk_cache import save_bytes

FORMAT, SCHEMA_VERSION = "graspd/dataset", 1
# Name of graspd's entry in the metadata of a Parquet file.
_METADATA = b"graspd"


def parquet_bytes(table: Any, metadata: Mapping[str, Any]) -> bytes:
    """Convert a pyarrow table to the bytes of a Parquet file. The file also stores `metadata`, as JSON."""
    import pyarrow.parquet as pq

    text = json.dumps({"format": FORMAT, "version": SCHEMA_VERSION, **metadata}, sort_keys=True)
    kept = {**(table.schema.metadata or {}), _METADATA: text.encode()}
    buffer = BytesIO()
    pq.write_table(table.replace_schema_metadata(kept), buffer, compression="zstd", write_page_checksum=True)
    return buffer.getvalue()


def read_parquet(content: bytes, where: str, columns: Sequence[str] | None = None) -> tuple[Any, dict[str, Any]]:
    """Return the pyarrow table and graspd's metadata of a Parquet file. If `columns` is None, read all columns.

    Raises FormatError: the file is not from graspd, has an unknown version, or is damaged. `where` names the file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Use no thread of Arrow and no Python file object. If an Arrow thread still runs when the process ends, it
        # aborts the process.
        file = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True, pre_buffer=False)
        table = file.read(columns, use_threads=False)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise FormatError(f"{where}: not a complete Parquet file: {' '.join(str(error).split())[:200]}") from None
    try:
        told = json.loads((table.schema.metadata or {})[_METADATA])
    except (KeyError, ValueError):
        raise FormatError(f"{where}: not written by `graspd dataset`: its metadata has no graspd entry") from None
    if told.get("format") != FORMAT or told.get("version") != SCHEMA_VERSION:
        raise FormatError(f"{where}: {told.get('format')} version {told.get('version')!r}; known: {SCHEMA_VERSION}")
    return table, told


T = TypeVar("T")

# Number of attempts of a server request, and the pause before the second attempt [s]. The pause doubles each time.
_TRIES, _PAUSE = 6, 0.2
# Endings of the listed files.
_ENDINGS = (".parquet", ".json")
# Number of digits of an object's hash in the name of its directory.
_SHORT = 16


class StorageError(GraspdError):
    """A data set cannot be read or written. For example, the disk is full or the server does not answer."""


class DatasetStore:
    """Files below a directory or an address. If access fails, every method raises StorageError with place and file."""

    def __init__(self, where: str) -> None:
        self.where = str(where).rstrip("/")
        self._system: Any = None

    @property
    def label(self) -> str:
        """Return the directory, or the address without access keys and options. Messages and records contain it."""
        kind, there, rest = self.where.partition("://")
        return f"{kind}://{rest.partition('?')[0].rpartition('@')[2]}" if there else self.where

    @property
    def local(self) -> Path | None:
        """Return the directory of the data set. None if the data set is at an address."""
        return None if "://" in self.where else Path(self.where)

    def list(self, folder: str) -> list[str]:
        """Return the sorted paths of all Parquet and JSON files below a folder. Empty if there is no such folder.

        A killed process leaves the file that it was writing, with letters after the ending. Such files do not count.
        """
        if self.local is not None:
            found = (path for path in (self.local / folder).rglob("*") if path.suffix in _ENDINGS and path.is_file())
            return sorted(path.relative_to(self.local).as_posix() for path in found)
        from pyarrow.fs import FileSelector, FileType

        system, root = self._arrow()
        selector = FileSelector(f"{root}/{folder}", recursive=True, allow_not_found=True)
        found = self._tried(folder, lambda: system.get_file_info(selector))
        files = (item.path.removeprefix(f"{root}/") for item in found if item.type is FileType.File)
        return sorted(path for path in files if PurePosixPath(path).suffix in _ENDINGS)

    def read(self, path: str) -> bytes:
        if self.local is not None:
            return self._once(path, (self.local / path).read_bytes)
        system, root = self._arrow()

        def read() -> bytes:
            with system.open_input_stream(f"{root}/{path}") as file:
                return file.read()

        return self._tried(path, read)

    def write(self, path: str, content: bytes) -> None:
        """Write a file. An existing file of the same path is replaced."""
        if self.local is not None:
            return self._once(path, partial(save_bytes, self.local / path, content))
        system, root = self._arrow()

        def write() -> None:
            with system.open_output_stream(f"{root}/{path}") as file:
                file.write(content)

        return self._tried(path, write)

    def remove(self, path: str) -> None:
        """Remove a file. Do nothing if there is no such file."""
        if self.local is not None:
            return self._once(path, partial((self.local / path).unlink, missing_ok=True))
        system, root = self._arrow()

        def remove() -> None:
            with contextlib.suppress(FileNotFoundError):
                system.delete_file(f"{root}/{path}")

        return self._tried(path, remove)

    def _arrow(self) -> tuple[Any, str]:
        """Return pyarrow's file system, and the path of the data set in it."""
        if self._system is None:
            from pyarrow import ArrowException
            from pyarrow.fs import FileSystem

            # This option makes pyarrow send one request per file instead of three.
            once = "allow_delayed_open=true"
            sign = "&" if "?" in self.where else "?"
            address = f"{self.where}{sign}{once}" if self.where.startswith("s3://") else self.where
            try:
                self._system = FileSystem.from_uri(address)
            except (ArrowException, OSError, ValueError) as error:
                raise StorageError(f"{self.label}: {error}; valid: a directory, s3://bucket/path, …") from None
        return self._system

    def __getstate__(self) -> dict[str, Any]:
        return {"where": self.where, "_system": None}

    def _once(self, path: str, work: Callable[[], T]) -> T:
        try:
            return work()
        except OSError as error:
            raise StorageError(f"{self.label}: {path}: {error.strerror or error}") from None

    def _tried(self, path: str, work: Callable[[], T]) -> T:
        """Call `work`, a request to the server. Repeat a failed request after growing pauses."""
        for number in range(_TRIES):
            try:
                return work()
            except OSError as error:
                if number + 1 == _TRIES or isinstance(error, FileNotFoundError):
                    text = " ".join(str(error).split())
                    raise StorageError(f"{self.label}: {path}: {text}") from None
                time.sleep(_PAUSE * 2**number)
        raise AssertionError("not reached")


def block_path(hand: str, object_sha256: str, key: str) -> str:
    """Return the path of a block's file within the data set."""
    return f"grasps/hand={hand}/object={object_sha256[:_SHORT]}/{key}.parquet"


def key_of(path: str) -> str:
    """Return the key of a block, object or record: the name of its file without ending."""
    return PurePosixPath(path).stem


def file_hash(content: bytes) -> str:
    """Return the SHA-256 of a file's content in hexadecimal, as in run records."""
    return hashlib.sha256(content).hexdigest()


# Entries that every record in a folder has, with their types.
_ENTRIES: dict[str, dict[str, Any]] = {
    "runs": {"command": str, "code": str, "commit": str, "made": str, "machine": str, "blocks": int},
    "failed": {"key": str, "failed": str, "error": str, "asked": dict},
}


def read_record(store: DatasetStore, path: str) -> dict[str, Any]:
    """Read the record of a run or of a failure. Raises FormatError: the file is not a valid record in JSON."""
    try:
        record = json.loads(store.read(path))
    except (ValueError, RecursionError):
        record = None
    given = {"files": {}, **record} if isinstance(record, dict) else {}
    entries = {**_ENTRIES[path.partition("/")[0]], "files": dict}
    if not isinstance(record, dict) or not all(isinstance(given.get(key), kind) for key, kind in entries.items()):
        raise FormatError(f"{store.label}/{path}: not a record of a run or a failure; expected a JSON object")
    return record


def keys_below(store: DatasetStore, folder: str) -> set[str]:
    """Return the keys of all files below a folder."""
    return {key_of(path) for path in store.list(folder)}
