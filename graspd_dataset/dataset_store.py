"""Where a data set lies: a directory, or an address that pyarrow knows (s3://bucket/path, gs://, hdfs://).

    grasps/hand=HAND/object=CONTENT/KEY.parquet    a block each
    objects/SHA256.parquet                         a mesh each
    failed/KEY.json                                why a block or an object failed
    runs/KEY.json                                  what a command asked for and what it took
    README.md                                      the data card

A file appears whole or not at all. The same rows give the same bytes. The record of a run holds the hash of every file
that it wrote, so that a byte that changed anywhere is found.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from graspd_core.errors import FormatError, GraspdError
from graspd_core.runtime.disk_cache import save_bytes

FORMAT, SCHEMA_VERSION = "graspd/dataset", 1
# Key of graspd's own part of the metadata.
_METADATA = b"graspd"


def parquet_bytes(table: Any, metadata: Mapping[str, Any]) -> bytes:
    """Return a pyarrow table as the bytes of a Parquet file, with JSON-ready values in its metadata."""
    import pyarrow.parquet as pq

    told = json.dumps({"format": FORMAT, "version": SCHEMA_VERSION, **metadata}, sort_keys=True)
    kept = {**(table.schema.metadata or {}), _METADATA: told.encode()}
    buffer = BytesIO()
    pq.write_table(table.replace_schema_metadata(kept), buffer, compression="zstd", write_page_checksum=True)
    return buffer.getvalue()


def read_parquet(content: bytes, where: str, columns: Sequence[str] | None = None) -> tuple[Any, dict[str, Any]]:
    """Read the table of a file, of all columns or some, and its metadata.

    Raises FormatError: it is no Parquet file of graspd, of an unknown version, or its content was changed.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Without a thread of Arrow's, nor a file of Python's for it to read: one that still runs when the process ends
        # aborts it.
        file = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True, pre_buffer=False)
        table = file.read(columns, use_threads=False)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise FormatError(f"{where}: not a whole Parquet file: {' '.join(str(error).split())[:200]}") from None
    try:
        told = json.loads((table.schema.metadata or {})[_METADATA])
    except (KeyError, ValueError):
        raise FormatError(f"{where}: not a file of `graspd dataset`: it says nothing of its origin") from None
    if told.get("format") != FORMAT or told.get("version") != SCHEMA_VERSION:
        raise FormatError(f"{where}: {told.get('format')} version {told.get('version')!r}; known: {SCHEMA_VERSION}")
    return table, told


T = TypeVar("T")

# Tries of a request to a server, and the pause before the second one, which doubles [s].
_TRIES, _PAUSE = 6, 0.2
# Digits of an object's hash in the name of its directory.
_SHORT = 16


class StorageError(GraspdError):
    """A data set cannot be read or written: the disk is full, say, or its server does not answer."""


class DatasetStore:
    """Files by their path below a directory or an address. Every failure is a StorageError that names both."""

    def __init__(self, where: str) -> None:
        self.where = str(where).rstrip("/")
        self._system: Any = None

    @property
    def shown(self) -> str:
        """The address without keys and options, for messages and records."""
        kind, there, rest = self.where.partition("://")
        return f"{kind}://{rest.partition('?')[0].rpartition('@')[2]}" if there else self.where

    @property
    def local(self) -> Path | None:
        """The directory, None for an address."""
        return None if "://" in self.where else Path(self.where)

    def list(self, folder: str) -> list[str]:
        """Return the paths of all files below a folder, sorted, none if there is no such folder."""
        if self.local is not None:
            found = (self.local / folder).rglob("*")
            return sorted(path.relative_to(self.local).as_posix() for path in found if path.is_file())
        from pyarrow.fs import FileSelector, FileType

        system, root = self._arrow()
        selector = FileSelector(f"{root}/{folder}", recursive=True, allow_not_found=True)
        found = self._tried(folder, lambda: system.get_file_info(selector))
        return sorted(item.path.removeprefix(f"{root}/") for item in found if item.type is FileType.File)

    def read(self, path: str) -> bytes:
        """Read a file."""
        if self.local is not None:
            local = self.local / path
            return self._once(path, local.read_bytes)
        system, root = self._arrow()

        def read() -> bytes:
            with system.open_input_stream(f"{root}/{path}") as file:
                return file.read()

        return self._tried(path, read)

    def write(self, path: str, content: bytes) -> None:
        """Write a file, in place of one of the same path."""
        if self.local is not None:
            local = self.local / path
            return self._once(path, lambda: save_bytes(local, content))
        system, root = self._arrow()

        def write() -> None:
            with system.open_output_stream(f"{root}/{path}") as file:
                file.write(content)

        return self._tried(path, write)

    def _arrow(self) -> tuple[Any, str]:
        """Return pyarrow's file system and the path in it."""
        if self._system is None:
            from pyarrow import ArrowException
            from pyarrow.fs import FileSystem

            # One request a file, where pyarrow would make three.
            once = "allow_delayed_open=true"
            sign = "&" if "?" in self.where else "?"
            address = f"{self.where}{sign}{once}" if self.where.startswith("s3://") else self.where
            try:
                self._system = FileSystem.from_uri(address)
            except (ArrowException, OSError, ValueError) as error:
                raise StorageError(f"{self.shown}: {error}; valid: a directory, s3://bucket/path, …") from None
        return self._system

    def __getstate__(self) -> dict[str, Any]:
        return {"where": self.where, "_system": None}

    def _once(self, path: str, work: Callable[[], T]) -> T:
        try:
            return work()
        except OSError as error:
            raise StorageError(f"{self.shown}: {path}: {error.strerror or error}") from None

    def _tried(self, path: str, work: Callable[[], T]) -> T:
        """Do a request. A busy server is asked again."""
        for number in range(_TRIES):
            try:
                return work()
            except OSError as error:
                if number + 1 == _TRIES or isinstance(error, FileNotFoundError):
                    told = " ".join(str(error).split())
                    raise StorageError(f"{self.shown}: {path}: {told}") from None
                time.sleep(_PAUSE * 2**number)
        raise AssertionError("not reached")


def block_path(hand: str, object_sha256: str, key: str) -> str:
    """Return the path of a block's file."""
    return f"grasps/hand={hand}/object={object_sha256[:_SHORT]}/{key}.parquet"


def key_of(path: str) -> str:
    """Return the key in a file's name."""
    return PurePosixPath(path).stem


def file_hash(content: bytes) -> str:
    """Return the SHA-256 of a file, as records of runs hold it."""
    return hashlib.sha256(content).hexdigest()


def read_record(store: DatasetStore, path: str) -> dict[str, Any]:
    """Read the record of a run or a failure. Raises FormatError: it holds no JSON object."""
    try:
        record = json.loads(store.read(path))
    except ValueError:
        record = None
    if not isinstance(record, dict) or not isinstance(record.get("files", {}), dict):
        raise FormatError(f"{store.shown}/{path}: no record of a run or a failure: its content was changed")
    return record


def keys_below(store: DatasetStore, folder: str) -> set[str]:
    """Return the keys of the files of a folder."""
    return {key_of(path) for path in store.list(folder) if PurePosixPath(path).suffix in (".parquet", ".json")}
