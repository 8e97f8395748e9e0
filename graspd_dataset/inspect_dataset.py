"""Inspect a data set: count its grasps and why they failed, and find damaged files and duplicate grasps."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from graspd_core.errors import FormatError
from graspd_dataset.block_rows import kind_of_reason
from graspd_dataset.blocks import content_key
from graspd_dataset.dataset_store import DatasetStore, block_path, file_hash, key_of, read_parquet, read_record
from graspd_dataset.record_schema import arrow_schema
from graspd_dataset.run_records import markdown_table

_REASONS = 8


@dataclass
class HandCount:
    """Counts of one hand: blocks, their size [bytes], grasps of each verdict. Also the hashes of its objects."""

    blocks: int = 0
    size: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    objects: set[str] = field(default_factory=set)


@dataclass
class DatasetStats:
    """Counts and failures of a data set, and the code versions that made it.

    Attributes:
        hands: counts of each hand, by its name.
        reasons: number of failed grasps for each text of `kind_of_reason`.
        codes: versions of the code that made the rows.
        failed: records of failed blocks and objects, except those that succeeded later.
    """

    hands: dict[str, HandCount] = field(default_factory=dict)
    reasons: Counter[str] = field(default_factory=Counter)
    codes: set[str] = field(default_factory=set)
    failed: list[dict[str, Any]] = field(default_factory=list)

    @property
    def rows(self) -> int:
        return sum(hand.verdicts.total() for hand in self.hands.values())

    @property
    def size(self) -> int:
        return sum(hand.size for hand in self.hands.values())


def tables_of(store: DatasetStore, columns: Sequence[str] | None = None) -> Iterator[tuple[str, bytes, Any, Any]]:
    """Yield path, content, pyarrow table and metadata of each block, sorted by path.

    Raises FormatError: there is no block, or a block is damaged, or lacks a column.
    """
    paths = store.list("grasps")
    if not paths:
        raise FormatError(f"{store.label}: no data set; expected .parquet files below grasps/")
    wanted = columns or arrow_schema().names
    for path in paths:
        content, where = store.read(path), f"{store.label}/{path}"
        table, header = read_parquet(content, where, columns)
        lacking = [name for name in wanted if name not in table.schema.names]
        if lacking or not isinstance(header.get("block"), str) or not isinstance(header.get("asked"), dict):
            raise FormatError(
                f"{where}: not a block of grasps: it lacks {', '.join(lacking) or 'the name of its block'}"
            )
        yield path, content, table, header


def stats_of(store: DatasetStore) -> DatasetStats:
    """Count the rows of a data set. Raises FormatError: there is no block, or a block is damaged."""
    stats, there = DatasetStats(), set[str]()
    for path, content, table, header in tables_of(store, ("object_sha256", "verdict", "code", "trials")):
        there.update((header["block"], content_key(header["asked"].get("object"))))
        stats.codes.update(table["code"].unique().to_pylist())
        # The path gives the hand, because a block may have no rows.
        hand = stats.hands.setdefault(path.split("/")[1].removeprefix("hand="), HandCount())
        hand.blocks += 1
        hand.size += len(content)
        hand.verdicts.update(table["verdict"].to_pylist())
        hand.objects.update(table["object_sha256"].to_pylist())
        for trials in table["trials"].to_pylist():
            lost = next((trial for trial in trials if not trial["passed"]), None)
            if lost is not None:
                stats.reasons[kind_of_reason(lost["name"], lost["reason"])] += 1
    records = [read_record(store, path) for path in store.list("failed")]
    stats.failed = [record for record in records if record["key"] not in there]
    return stats


def stats_table(stats: DatasetStats) -> str:
    """Return a Markdown table with a row of counts for each hand."""
    body = [
        (
            name,
            f"{len(hand.objects)}",
            f"{hand.blocks}",
            f"{hand.verdicts.total()}",
            f"{hand.verdicts['verified']}",
            f"{hand.verdicts['failed']}",
            f"{hand.verdicts['verified'] / max(hand.verdicts.total(), 1):.0%}",
            f"{hand.size / 2**20:.1f}",
        )
        for name, hand in sorted(stats.hands.items())
    ]
    return markdown_table(("hand", "objects", "blocks", "tried", "verified", "failed", "held", "MB"), body)


def reason_lines(stats: DatasetStats) -> list[str]:
    """Return lines: the 8 most frequent reasons why grasps failed, with counts, then each failed block or object."""
    lines = [f"{number} {reason}" for reason, number in stats.reasons.most_common(_REASONS)]
    return lines + [
        f"{record['failed']}: {record['asked'].get('object')}: {record['error']}" for record in stats.failed
    ]


_POSTURES = tuple(f"{s}_{part}" for s in ("pregrasp", "grasp", "squeeze") for part in ("position", "quaternion_wxyz"))
_UNIT_TOLERANCE = 1e-3


def faults_of_dataset(store: DatasetStore) -> Iterator[str]:
    """Yield a line for each fault of the files and rows of a data set. Raises FormatError: there is no data set."""
    paths, meshes = store.list("grasps"), {key_of(path) for path in store.list("objects")}
    if not paths:
        raise FormatError(f"{store.label}: no data set; expected .parquet files below grasps/")
    known: dict[str, set[str]] = {}
    try:
        known = recorded_hashes(store)
    except FormatError as error:
        yield str(error)
    there = {key_of(path) for path in paths} | meshes
    yield from (f"{path}: is missing, but a run wrote it" for path in known if key_of(path) not in there)
    seen: dict[bytes, str] = {}
    for path in (*paths, *store.list("objects")):
        content = store.read(path)
        try:
            table, header = read_parquet(content, path)
        except FormatError as error:
            yield str(error)
            continue
        if path in known and file_hash(content) not in known[path]:
            yield f"{path}: the file was changed: its SHA-256 differs from the recorded SHA-256"
        if path.startswith("objects/"):
            continue
        yield from (f"{path}: {fault}" for fault in _file_faults(path, table, header, meshes))
        for digest in row_digests(table) if table.schema.remove_metadata() == arrow_schema() else ():
            if digest in seen:
                yield f"{path}: a grasp is also in {seen[digest]}"
                break
            seen[digest] = path


def recorded_hashes(store: DatasetStore) -> dict[str, set[str]]:
    """Return by path the SHA-256 hashes that run records hold of each file. Raises FormatError: a record is damaged."""
    known: dict[str, set[str]] = {}
    for record in (read_record(store, path) for path in store.list("runs")):
        for path, digest in record.get("files", {}).items():
            known.setdefault(path, set()).add(digest)
    return known


def row_digests(table: Any) -> list[bytes]:
    """Return the SHA-256 of object, hand and grasp posture of each row. Equal grasps have equal hashes in any block."""
    names = ("object_sha256", "hand_sha256", "grasp_position", "grasp_quaternion_wxyz", "grasp_joint_positions")
    rows = zip(*(table[name].to_pylist() for name in names), strict=True)
    return [hashlib.sha256(repr(row).encode()).digest() for row in rows]


def count_by_content(store: DatasetStore) -> tuple[int, int]:
    """Return the number of rows, and the number of distinct grasps."""
    digests = [digest for _, _, table, _ in tables_of(store) for digest in row_digests(table)]
    return len(digests), len(set(digests))


def _file_faults(path: str, table: Any, header: dict[str, Any], meshes: set[str]) -> Iterator[str]:
    """Yield the faults of one block's file. `meshes` are the keys of the meshes in `objects/`."""
    import numpy as np

    if table.schema.remove_metadata() != arrow_schema():
        names = set(table.schema.names) ^ set(arrow_schema().names)
        yield f"its columns are not those of the schema: {', '.join(sorted(names)) or 'other types'}"
        return
    if content_key(header.get("asked")) != key_of(path) or header.get("block") != key_of(path):
        yield f"its metadata does not match its name: the metadata names block {header.get('block')}"
    if not table.num_rows:
        return
    hand, target = table["hand_name"][0].as_py(), table["object_sha256"][0].as_py()
    if path != block_path(hand, target, key_of(path)):
        yield f"it belongs in {block_path(hand, target, key_of(path))}"
    if target not in meshes:
        yield f"objects/{target}.parquet is missing"
    if table["row"].to_pylist() != list(range(table.num_rows)):
        yield "rows are missing or out of order"
    for name in _POSTURES:
        values = np.array(table[name].to_pylist())
        if not np.isfinite(values).all():
            yield f"{name}: numbers that are not finite"
        elif name.endswith("wxyz") and (abs(np.linalg.norm(values, axis=1) - 1) > _UNIT_TOLERANCE).any():
            yield f"{name}: quaternions that are not of unit length"
    trials = table["trials"].to_pylist()
    passed = [bool(own) and all(trial["passed"] for trial in own) for own in trials]
    if passed != [verdict == "verified" for verdict in table["verdict"].to_pylist()]:
        yield "verdicts contradict the trials"
