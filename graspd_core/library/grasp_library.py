"""A file of verified grasps by object, hand and physics: SQLite, a transaction a record.

The journal is a write-ahead log: readers go on while one writes, and who is killed while it writes loses the record
that it was writing. Each call opens the file and closes it, so that a library takes no memory between two of them.
"""

from __future__ import annotations

import json
import os
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from urllib.parse import quote

from graspd_core.errors import ConfigError, FormatError, GraspdError
from graspd_core.formats.grasps_json import result_document
from graspd_core.formats.read_grasps import grasps_of
from graspd_core.hands.model import HandModel
from graspd_core.library.library_entry import STRICTNESS, LibraryEntry
from graspd_core.methods.plan_config import PlanConfig
from graspd_core.scene.scene import ObjectModel
from graspd_core.types import Grasp, GraspResult, Outcome, Timing, Verdict

VERSION = 1
# Marks the file as ours ("grsp"), in SQLite's header.
_APPLICATION = 0x67727370
# Grasps of a record: what a request may ask for.
MOST_GRASPS = 1024
# A writer waits so long for another one [s].
_PATIENCE = 30.0
_COLUMNS = tuple(item.name for item in fields(LibraryEntry))
_SCHEMA = f"""
CREATE TABLE records (key TEXT PRIMARY KEY, {", ".join(_COLUMNS)}, grasps INTEGER, document BLOB) WITHOUT ROWID;
CREATE INDEX by_name ON records (name);
CREATE INDEX by_file ON records (file_sha256, scale);
CREATE INDEX by_mesh ON records (mesh_sha256);
CREATE INDEX by_source ON records (source);
"""


@dataclass(frozen=True)
class GraspLibrary:
    """A library in a file; `checked` says whether it is one.

    Attributes:
        path: of the file. SQLite keeps two more beside it, of the same name with -wal and -shm, while it is in use.
    """

    path: Path

    def create(self) -> None:
        """Make an empty library where there is no file yet, or one that was left empty. Raises FormatError."""
        if self.path.exists() and self.path.stat().st_size:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._told(), _opened(self.path, "rwc") as base:
            base.execute("PRAGMA journal_mode = WAL")
            head = f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {VERSION};"
            base.executescript(f"BEGIN IMMEDIATE; {head} {_SCHEMA} COMMIT;")

    def checked(self) -> GraspLibrary:
        """This library. Raises FormatError: there is no file, it is none of this version, or it is torn."""
        with self._reading() as base:
            (told,) = base.execute("PRAGMA quick_check(1)").fetchone()
        if told != "ok":
            raise self._torn(told)
        return self

    def entries(self, **wanted: str | float) -> list[tuple[LibraryEntry, int]]:
        """Entries whose columns have the values wanted, and how many grasps each holds; by name."""
        where = " AND ".join(f"{column} = ?" for column in wanted) or "1"
        question = f"SELECT {', '.join(_COLUMNS)}, grasps FROM records WHERE {where} ORDER BY name, hand"
        with self._reading() as base:
            rows = base.execute(question, tuple(wanted.values())).fetchall()
        return [(LibraryEntry(*row[:-1]), row[-1]) for row in rows]

    def names(self) -> list[str]:
        """What its objects are called, each once."""
        with self._reading() as base:
            return [name for (name,) in base.execute("SELECT DISTINCT name FROM records ORDER BY name")]

    def of_mesh(self, wanted: LibraryEntry) -> list[LibraryEntry]:
        """Entries of the same content whose grasps held under as much as wanted, the most first."""
        same = {name: getattr(wanted, name) for name in ("mesh_sha256", "hand_content", "mass", "friction")}
        return strict_enough([entry for entry, _ in self.entries(**same)], wanted.verify)

    def grasps(self, entry: LibraryEntry, hand: HandModel) -> tuple[Grasp, ...]:
        """The verified grasps of an entry, in the object frame; none where it is not in the library.

        Raises:
            FormatError: the library is torn, or the record is.
        """
        with self._reading() as base:
            row = base.execute("SELECT document FROM records WHERE key = ?", (entry.key,)).fetchone()
        return self._read(row[0], entry, hand) if row else ()

    def add(
        self, entry: LibraryEntry, target: ObjectModel, hand: HandModel, config: PlanConfig, grasps: Sequence[Grasp]
    ) -> int:
        """Put grasps behind those that the entry has; how many it has then.

        Args:
            entry: of `target` and `hand`.
            target: what is grasped.
            hand: whose grasps they are.
            config: settings that they were found with.
            grasps: those that are not verified are left out.

        Raises:
            FormatError: the library cannot be read or written.
        """
        new = [replace(grasp, arm=None) for grasp in grasps if grasp.verdict is Verdict.VERIFIED]
        with self._reading(write=True) as base:
            row = base.execute("SELECT document FROM records WHERE key = ?", (entry.key,)).fetchone()
            kept = (*(self._read(row[0], entry, hand) if row else ()), *new)[:MOST_GRASPS]
            result = GraspResult(Outcome.SUCCEEDED, kept, Timing(), 0, config.method)
            document = result_document(result, target, hand, config) | {"link_names": hand.link_names}
            packed = zlib.compress(json.dumps(document, allow_nan=False).encode())
            # What the file was before it changed is nobody's any more.
            other = (entry.source, entry.file_sha256)
            base.execute("DELETE FROM records WHERE source != '' AND source = ? AND file_sha256 != ?", other)
            marks = ", ".join("?" * (len(_COLUMNS) + 3))
            base.execute(
                f"INSERT OR REPLACE INTO records VALUES ({marks})", (entry.key, *astuple(entry), len(kept), packed)
            )
        return len(kept)

    def _read(self, packed: bytes, entry: LibraryEntry, hand: HandModel) -> tuple[Grasp, ...]:
        try:
            document = json.loads(zlib.decompress(packed))
            grasps = grasps_of(document)
            names = dict(zip(document["link_names"], hand.link_names, strict=True))
            # The hand may be loaded with a prefix, or without the one that it had.
            contacts = [tuple(replace(c, link=names[c.link]) for c in grasp.contacts) for grasp in grasps]
        except (zlib.error, ValueError, KeyError, TypeError, FormatError) as error:
            raise self._torn(f"record {entry.name} for {entry.hand}: {error}") from None
        return tuple(replace(grasp, contacts=at) for grasp, at in zip(grasps, contacts, strict=True))

    @contextmanager
    def _reading(self, write: bool = False) -> Iterator[sqlite3.Connection]:
        """The file, seen to be a library of this version; in a transaction where it is to be written."""
        if not self.path.is_file():
            raise FormatError(f"{self.path}: no such file; `graspd library build --out {self.path}` makes a library")
        with self._told(), _opened(self.path, "rw" if os.access(self.path, os.W_OK) else "ro") as base:
            if write:
                base.execute("BEGIN IMMEDIATE")
            (application,), (version,) = (
                base.execute(f"PRAGMA {name}").fetchone() for name in ("application_id", "user_version")
            )
            if application != _APPLICATION:
                raise FormatError(f"{self.path}: no library of grasps; `graspd library build --out FILE` makes one")
            if version != VERSION:
                raise FormatError(
                    f"{self.path}: a library of version {version}, this graspd reads version {VERSION}; build another "
                    "with `graspd library build --out FILE`"
                )
            yield base
            if write:
                base.execute("COMMIT")

    @contextmanager
    def _told(self) -> Iterator[None]:
        """SQLite's errors as ours."""
        try:
            yield
        # Another process holds it for long, the disk is full, or nothing may be written there.
        except sqlite3.OperationalError as error:
            raise FormatError(f"{self.path}: the library cannot be used: {error}") from None
        except sqlite3.DatabaseError as error:
            raise self._torn(error) from None
        except OSError as error:
            raise FormatError(f"{self.path}: {error.strerror or error}") from None

    def _torn(self, told: object) -> GraspdError:
        return FormatError(
            f"{self.path}: torn or no library ({' '.join(str(told).split())[:200]}); take a whole copy, or "
            "build another with `graspd library build --out FILE`"
        )


def strict_enough(entries: Sequence[LibraryEntry], verify: str) -> list[LibraryEntry]:
    """Those whose grasps held under as much as `verify` asks, the most first. Raises ConfigError: it is unknown."""
    if verify not in STRICTNESS:
        raise ConfigError(f"verify: {verify!r}; valid: {', '.join(STRICTNESS)}")
    enough = [entry for entry in entries if STRICTNESS[entry.verify] >= STRICTNESS[verify]]
    return sorted(enough, key=lambda entry: -STRICTNESS[entry.verify])


@contextmanager
def _opened(path: Path, mode: str) -> Iterator[sqlite3.Connection]:
    # In a place that cannot be written there is no log beside the file, nor anybody who writes.
    still = "&immutable=1" if mode == "ro" and not os.access(path.parent, os.W_OK) else ""
    base = sqlite3.connect(
        f"file:{quote(str(path.absolute()))}?mode={mode}{still}", uri=True, timeout=_PATIENCE, isolation_level=None
    )
    try:
        base.execute("PRAGMA synchronous = FULL")
        yield base
    finally:
        base.close()
