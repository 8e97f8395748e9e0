"""A data set looked through: every file whole, where its content says, and no grasp in it twice."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

from graspd_core.dataset.blocks import content_key
from graspd_core.dataset.dataset_stats import tables_of
from graspd_core.dataset.dataset_store import DatasetStore, block_path, key_of
from graspd_core.dataset.parquet_files import read_parquet
from graspd_core.dataset.record_schema import arrow_schema
from graspd_core.errors import FormatError

_POSTURES = tuple(f"{s}_{part}" for s in ("pregrasp", "grasp", "squeeze") for part in ("position", "quaternion_wxyz"))
_UNIT_TOLERANCE = 1e-3


def faults_of_dataset(store: DatasetStore) -> Iterator[str]:
    """What is wrong with a data set, a line each; none where all is well.

    Raises:
        FormatError: there is no data set.
    """
    paths, meshes = store.list("grasps"), {key_of(path) for path in store.list("objects")}
    if not paths:
        raise FormatError(f"{store.shown}: no data set: nothing in grasps/")
    seen: dict[bytes, str] = {}
    for path in paths:
        try:
            table, told = read_parquet(store.read(path), path)
        except FormatError as error:
            yield str(error)
            continue
        yield from (f"{path}: {fault}" for fault in _file_faults(path, table, told, meshes))
        for digest in row_digests(table):
            if digest in seen:
                yield f"{path}: a grasp that is in {seen[digest]} too"
                break
            seen[digest] = path
    for path in store.list("objects"):
        try:
            read_parquet(store.read(path), path)
        except FormatError as error:
            yield str(error)


def row_digests(table: Any) -> list[bytes]:
    """Of every row the hash of its object, hand and grasp, whatever block it is in."""
    names = ("object_sha256", "hand_sha256", "grasp_position", "grasp_quaternion_wxyz", "grasp_joint_positions")
    rows = zip(*(table[name].to_pylist() for name in names), strict=True)
    return [hashlib.sha256(repr(row).encode()).digest() for row in rows]


def count_by_content(store: DatasetStore) -> tuple[int, int]:
    """Numbers of rows, and of different ones."""
    digests = [digest for _, _, table, _ in tables_of(store) for digest in row_digests(table)]
    return len(digests), len(set(digests))


def _file_faults(path: str, table: Any, told: dict[str, Any], meshes: set[str]) -> Iterator[str]:
    """What is wrong with one block."""
    import numpy as np

    if table.schema.remove_metadata() != arrow_schema():
        names = set(table.schema.names) ^ set(arrow_schema().names)
        yield f"its columns are not those of the schema: {', '.join(sorted(names)) or 'other types'}"
        return
    if content_key(told.get("asked")) != key_of(path) or told.get("block") != key_of(path):
        yield f"it holds the block {told.get('block')}"
    if not table.num_rows:
        return
    hand, target = table["hand_name"][0].as_py(), table["object_sha256"][0].as_py()
    if path != block_path(hand, target, key_of(path)):
        yield f"it belongs in {block_path(hand, target, key_of(path))}"
    if target not in meshes:
        yield f"objects/{target}.parquet is missing"
    if table["row"].to_pylist() != list(range(table.num_rows)):
        yield "rows are missing or not in their order"
    for name in _POSTURES:
        values = np.array(table[name].to_pylist())
        if not np.isfinite(values).all():
            yield f"{name}: numbers that are not finite"
        elif name.endswith("wxyz") and (abs(np.linalg.norm(values, axis=1) - 1) > _UNIT_TOLERANCE).any():
            yield f"{name}: quaternions that are not of unit length"
    trials = table["trials"].to_pylist()
    passed = [bool(own) and all(trial["passed"] for trial in own) for own in trials]
    if passed != [verdict == "verified" for verdict in table["verdict"].to_pylist()]:
        yield "verdicts that the trials do not bear out"
