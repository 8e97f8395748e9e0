"""Merge data sets block by block. Draw random rows of a data set."""

from __future__ import annotations

import hashlib
import heapq
import json
from collections.abc import Sequence
from typing import Any

from graspd_core.errors import ConfigError, FormatError
from graspd_dataset.dataset_store import DatasetStore, keys_below, parquet_bytes, read_parquet, read_record
from graspd_dataset.inspect_dataset import tables_of
from graspd_dataset.record_schema import arrow_schema

# Columns that may differ between two files of the same block: names, and the code that made the block.
_NAMES = ("object_source", "preset", "code")


def merge(sources: Sequence[DatasetStore], out: DatasetStore) -> tuple[int, int]:
    """Copy all blocks, meshes, and records of failures and runs to `out`.

    Return how many blocks were copied, and how many `out` already had. A block that `out` has is compared and not
    replaced, so an interrupted merge can be repeated.
    Raises FormatError: a file is damaged, or two blocks with the same key have different rows.
    """
    there = {path.rpartition("/")[2]: path for path in out.list("grasps")}
    copied = common = 0
    for source in sources:
        for path, content, table, _ in tables_of(source):
            name = path.rpartition("/")[2]
            if name in there:
                _refuse_conflict(table, out, there[name], f"{source.label}/{path}")
                common += 1
                continue
            out.write(path, content)
            there[name] = path
            copied += 1
        for folder in ("objects", "failed", "runs"):
            present = keys_below(out, folder)
            for path in source.list(folder):
                if path.rpartition("/")[2].partition(".")[0] not in present:
                    out.write(path, source.read(path))
                elif folder == "runs":
                    record = read_record(source, path)
                    # The hashes of `out` win, because its files are not replaced.
                    files = record.get("files", {}) | read_record(out, path).get("files", {})
                    out.write(path, (json.dumps({**record, "files": files}, indent=1) + "\n").encode())
    return copied, common


def _refuse_conflict(table: Any, out: DatasetStore, path: str, where: str) -> None:
    other, _ = read_parquet(out.read(path), f"{out.label}/{path}")
    if not table.drop_columns(list(_NAMES)).equals(other.drop_columns(list(_NAMES))):
        raise FormatError(f"{where}: rows differ from {out.label}/{path}, which has the same key; keep only one")


def sample(store: DatasetStore, count: int, seed: int, verdict: str | None = None) -> tuple[bytes, int]:
    """Draw up to `count` rows at random. Return the content of a Parquet file with them, and their number.

    If `verdict` is given, draw only from rows with this verdict. The same rows and seed give the same sample.

    Raises ConfigError if `count` is less than 1, FormatError if there is no data set or a file is damaged.
    """
    import pyarrow as pa

    if count < 1:
        raise ConfigError(f"count: {count} rows; valid: 1 or more")
    drawn: list[tuple[int, str, int]] = []
    # The first pass reads two columns and draws rows. The second pass reads the files that hold drawn rows.
    for path, _, table, header in tables_of(store, ("row", "verdict")):
        for row, said in zip(table["row"].to_pylist(), table["verdict"].to_pylist(), strict=True):
            if verdict in (None, said):
                digest = hashlib.sha256(f"{seed} {header['block']} {row}".encode()).digest()
                item = (-int.from_bytes(digest[:8]), path, row)
                heapq.heappush(drawn, item) if len(drawn) < count else heapq.heappushpop(drawn, item)
    rows: dict[str, list[int]] = {}
    for _, path, row in drawn:
        rows.setdefault(path, []).append(row)
    parts = [read_parquet(store.read(path), path)[0].take(sorted(rows[path])) for path in sorted(rows)]
    table = pa.concat_tables([part.replace_schema_metadata(None) for part in parts] or [arrow_schema().empty_table()])
    return parquet_bytes(table, {"sample": {"count": count, "seed": seed, "verdict": verdict}}), table.num_rows
