"""What a data set holds: numbers by hand, and why grasps failed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from graspd_core.bench.report import markdown_table
from graspd_core.dataset.block_rows import kind_of_reason
from graspd_core.dataset.dataset_store import DatasetStore
from graspd_core.dataset.parquet_files import read_parquet
from graspd_core.errors import FormatError

_REASONS = 8


@dataclass
class HandCount:
    """Numbers of one hand's rows: by verdict, of blocks, and the objects' hashes."""

    blocks: int = 0
    size: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    objects: set[str] = field(default_factory=set)


@dataclass
class DatasetStats:
    """What a data set holds.

    Attributes:
        hands: numbers by hand.
        reasons: numbers of failed grasps by trial and kind of reason.
        codes: versions of the code that made rows.
        failed: records of blocks and objects that failed and have no file.
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
    """Path, bytes, table and metadata of every block, in the order of their paths.

    Raises:
        FormatError: there is no block, or one of them is spoilt.
    """
    paths = store.list("grasps")
    if not paths:
        raise FormatError(f"{store.shown}: no data set: nothing in grasps/")
    for path in paths:
        content = store.read(path)
        yield path, content, *read_parquet(content, f"{store.shown}/{path}", columns)


def stats_of(store: DatasetStore) -> DatasetStats:
    """Count. Raises FormatError: as `tables_of`."""
    stats, there = DatasetStats(), set[str]()
    for path, content, table, told in tables_of(store, ("object_sha256", "verdict", "code", "trials")):
        there.add(told["block"])
        stats.codes.update(table["code"].unique().to_pylist())
        # By its path: a block without a candidate is one too.
        hand = stats.hands.setdefault(path.split("/")[1].removeprefix("hand="), HandCount())
        hand.blocks += 1
        hand.size += len(content)
        hand.verdicts.update(table["verdict"].to_pylist())
        hand.objects.update(table["object_sha256"].to_pylist())
        for trials in table["trials"].to_pylist():
            lost = next((trial for trial in trials if not trial["passed"]), None)
            if lost is not None:
                stats.reasons[kind_of_reason(lost["name"], lost["reason"])] += 1
    records = [json.loads(store.read(path)) for path in store.list("failed")]
    stats.failed = [record for record in records if record["key"] not in there]
    return stats


def stats_table(stats: DatasetStats) -> str:
    """Numbers by hand, in Markdown."""
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
    """The most frequent reasons, a line each, and what failed as a whole."""
    lines = [f"{number} {reason}" for reason, number in stats.reasons.most_common(_REASONS)]
    return lines + [f"{record['failed']}: {record['asked']['object']}: {record['error']}" for record in stats.failed]
