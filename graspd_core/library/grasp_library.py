"""Store verified grasps in an SQLite file. Each entry is one record, written in one transaction.

The key of an entry is a hash of the mesh, the hand and the physics of the trials. A write-ahead log lets other
processes read while a process writes. A killed writer loses only the record that it was writing.
"""

from __future__ import annotations

import json
import os
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from graspd_core.config.planning_config import light_end
from graspd_core.errors import ConfigError, FormatError, GraspdError
from graspd_core.hands.model import HandModel
from graspd_core.io.grasps_json import grasps_of, result_document
from graspd_core.mesh.shapes import file_state, source_hash
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.perception.load_scene import SHAPE_PREFIX
from graspd_core.perception.scene import ObjectModel, heavy_mass
from graspd_core.planning.plan_grasps import MOST_GRASPS
from graspd_core.runtime.disk_cache import digest
from graspd_core.types import Grasp, GraspResult, Outcome, Timing, Verdict

# Strictness of each kind of trials. A grasp that passed stricter trials is also valid for less strict trials.
STRICTNESS = {"none": 0, "standard": 1, "full": 1, "hard": 2, "hard_full": 2}
# Fields that `hand_hash` leaves out: names, mount, and contact candidates, which are drawn anew for each plan.
_NO_CONTENT = {"name", "urdf", "link_names", "joint_names", "warnings", "mount", "mimics", "base_place"}
_NO_CONTENT |= {"candidate_points", "candidate_normals", "candidate_link"}


@dataclass(frozen=True)
class LibraryEntry:
    """The object, hand and physics of stored grasps.

    Attributes:
        name: name of the object. The default is the file's name, followed by the scale if the scale is not 1.
        source: absolute path of the mesh file, or shape:NAME. Empty if the mesh has no file, or the file has changed.
        file_sha256: hash of the file's content. Empty for a mesh without a file.
        mesh_sha256: hash of the cleaned mesh in metres.
        scale: metres per unit of the file.
        mass: mass of the object in the trials [kg].
        mass_assumed: True if no mass was given.
        volume: enclosed volume of the object [m³].
        friction: Coulomb friction coefficient.
        verify: name of the trials that the grasps passed, a key of `STRICTNESS`.
        hand: name of the hand.
        hand_content: hash of the hand's kinematics and collision shapes.
    """

    name: str
    source: str
    file_sha256: str
    mesh_sha256: str
    scale: float
    mass: float
    mass_assumed: bool
    volume: float
    friction: float
    verify: str
    hand: str
    hand_content: str

    @property
    def is_heavy_enough(self) -> bool:
        """True if the grasps may count as verified for an object of the same mesh and of unknown mass."""
        # If trials used less than an assumed mass, only grasps that lift `light_end` were verified.
        return self.mass_assumed or self.mass >= light_end(heavy_mass(self.volume))

    @property
    def key(self) -> str:
        """Hash of the content. It does not depend on the names of object and hand."""
        content = (self.mesh_sha256, self.hand_content, self.mass, self.friction, self.verify)
        return digest(content)[:32]


def entry_of(target: ObjectModel, hand: HandModel, verify: str, name: str = "") -> LibraryEntry:
    """Return the library entry of a loaded object. An empty `name` becomes the name of the object's file."""
    shape = target.source.startswith(SHAPE_PREFIX)
    # If the file has changed since it was loaded, only the mesh identifies the object.
    same = shape or (target.file_state and target.file_state == file_state(target.source))
    source = absolute(target.source) if same else ""
    called = target.source.removeprefix(SHAPE_PREFIX) if shape else Path(target.source).stem
    return LibraryEntry(
        name=name or (called if target.scale == 1.0 else f"{called}@{target.scale:g}"),
        source=source,
        file_sha256=source_hash(source) if source else "",
        mesh_sha256=target.sha256,
        scale=target.scale,
        mass=target.mass,
        mass_assumed=target.mass_assumed,
        volume=target.volume,
        friction=target.friction,
        verify=verify,
        hand=hand.name,
        hand_content=hand_hash(hand),
    )


def absolute(source: str) -> str:
    """Return the absolute path of a mesh file. Return shape:NAME unchanged."""
    return source if source.startswith(SHAPE_PREFIX) else str(Path(source).resolve())


@lru_cache(maxsize=8)
def hand_hash(hand: HandModel) -> str:
    """Return the hash of all hand data that grasps and trials depend on. Names are left out."""
    mimics = tuple((m.link, m.joint, m.multiplier, m.offset) for m in hand.mimics)
    content = (getattr(hand, item.name) for item in fields(hand) if item.name not in _NO_CONTENT)
    return digest((*content, mimics))


VERSION = 2
# Application id in SQLite's header ("grsp"). It marks the file as a library of graspd.
_APPLICATION = 0x67727370
# Greatest time that a writer waits for another writer [s].
_PATIENCE = 30.0
_COLUMNS = tuple(item.name for item in fields(LibraryEntry))
_SCHEMA = f"""
CREATE TABLE IF NOT EXISTS records
(key TEXT PRIMARY KEY, {", ".join(_COLUMNS)}, grasps INTEGER, document BLOB) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS by_name ON records (name);
CREATE INDEX IF NOT EXISTS by_file ON records (file_sha256, scale);
CREATE INDEX IF NOT EXISTS by_mesh ON records (mesh_sha256);
CREATE INDEX IF NOT EXISTS by_source ON records (source);
"""


@dataclass(frozen=True)
class GraspLibrary:
    """A library of grasps in a file. Call `checked` to verify the file.

    Attributes:
        path: path of the file. While it is open, SQLite keeps two more files beside it, ending in -wal and -shm.
    """

    path: Path

    def create(self) -> None:
        """Create an empty library if the file is missing or empty. Raises FormatError: the file cannot be written."""
        if self.path.exists() and self.path.stat().st_size:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._opened("rwc") as base:
            base.execute("PRAGMA journal_mode = WAL")
            head = f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {VERSION};"
            base.executescript(f"BEGIN IMMEDIATE; {head} {_SCHEMA} COMMIT;")

    def checked(self) -> GraspLibrary:
        """Check the file and return the library. Raises FormatError: no file, a damaged file, or another version."""
        with self._reading() as base:
            (state,) = base.execute("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise self._torn(state)
        return self

    def entries(self, **wanted: str | float) -> list[tuple[LibraryEntry, int]]:
        """Return the entries whose fields have the `wanted` values, sorted by name, each with its number of grasps."""
        where = " AND ".join(f"{column} = ?" for column in wanted) or "1"
        question = f"SELECT {', '.join(_COLUMNS)}, grasps FROM records WHERE {where} ORDER BY name, hand"
        with self._reading() as base:
            rows = base.execute(question, tuple(wanted.values())).fetchall()
        return [(_entry_of_row(row[:-1]), row[-1]) for row in rows]

    def names(self) -> list[str]:
        """Return the distinct names of the objects in the library."""
        with self._reading() as base:
            return [name for (name,) in base.execute("SELECT DISTINCT name FROM records ORDER BY name")]

    def of_mesh(self, wanted: LibraryEntry) -> list[LibraryEntry]:
        """Return the entries with mesh, hand, friction and mass of `wanted`. For an assumed mass, see `with_mass`.

        Only entries with trials at least as strict as those of `wanted` count. Order: strictest first, then heaviest.
        """
        same = {name: getattr(wanted, name) for name in ("mesh_sha256", "hand_content", "friction")}
        mass = None if wanted.mass_assumed else wanted.mass
        return strict_enough(with_mass((entry for entry, _ in self.entries(**same)), mass), wanted.verify)

    def grasps(self, entry: LibraryEntry, hand: HandModel) -> tuple[Grasp, ...]:
        """Return the verified grasps of an entry, object frame. Return no grasps for an unknown entry.

        Raises FormatError: the library or the record is damaged.
        """
        with self._reading() as base:
            return self._read(base, entry, hand)

    def add(
        self, entry: LibraryEntry, target: ObjectModel, hand: HandModel, config: PlanConfig, grasps: Sequence[Grasp]
    ) -> int:
        """Append the verified grasps, object frame, to an entry of `target` and `hand`. Ignore all other grasps.

        `config` holds the settings that found the grasps. Return how many grasps the entry has then. Raises
        FormatError: the library cannot be read or written.
        """
        new = [replace(grasp, arm=None) for grasp in grasps if grasp.verdict is Verdict.VERIFIED]
        with self._reading(write=True) as base:
            kept = (*self._read(base, entry, hand), *new)[:MOST_GRASPS]
            result = GraspResult(Outcome.SUCCEEDED, kept, Timing(), 0, config.method)
            document = result_document(result, target, hand, config) | {"link_names": hand.link_names}
            packed = zlib.compress(json.dumps(document, allow_nan=False).encode())
            # The mesh file may have changed. Then delete the entries of its earlier content.
            other = (entry.source, entry.file_sha256)
            base.execute("DELETE FROM records WHERE source != '' AND source = ? AND file_sha256 != ?", other)
            marks = ", ".join("?" * (len(_COLUMNS) + 3))
            base.execute(
                f"INSERT OR REPLACE INTO records VALUES ({marks})", (entry.key, *astuple(entry), len(kept), packed)
            )
        return len(kept)

    def _read(self, base: sqlite3.Connection, entry: LibraryEntry, hand: HandModel) -> tuple[Grasp, ...]:
        row = base.execute("SELECT document FROM records WHERE key = ?", (entry.key,)).fetchone()
        if row is None:
            return ()
        try:
            document = json.loads(zlib.decompress(row[0]))
            grasps = grasps_of(document)
            names = dict(zip(document["link_names"], hand.link_names, strict=True))
            # The hand's link names may have another prefix now than when the record was written.
            contacts = [tuple(replace(c, link=names[c.link]) for c in grasp.contacts) for grasp in grasps]
        except (zlib.error, ValueError, KeyError, TypeError, FormatError) as error:
            raise self._torn(f"record {entry.name} for {entry.hand}: {error}") from None
        return tuple(replace(grasp, contacts=at) for grasp, at in zip(grasps, contacts, strict=True))

    @contextmanager
    def _reading(self, write: bool = False) -> Iterator[sqlite3.Connection]:
        """Open the file, check its version, yield the connection. With `write`, the work inside is one transaction."""
        if not self.path.is_file():
            raise FormatError(f"{self.path}: no such file; `graspd library build --out {self.path}` creates a library")
        with self._opened("rw" if os.access(self.path, os.W_OK) else "ro") as base:
            if write:
                base.execute("BEGIN IMMEDIATE")
            (application,), (version,) = (
                base.execute(f"PRAGMA {name}").fetchone() for name in ("application_id", "user_version")
            )
            if application != _APPLICATION:
                raise FormatError(f"{self.path}: not a library of grasps; `graspd library build --out FILE` makes one")
            if version != VERSION:
                raise FormatError(
                    f"{self.path}: library version {version} is unknown; valid: {VERSION}; build another with "
                    "`graspd library build --out FILE`"
                )
            yield base
            if write:
                base.execute("COMMIT")

    @contextmanager
    def _opened(self, mode: str) -> Iterator[sqlite3.Connection]:
        """Open the file. Convert errors of SQLite and of the file system to FormatError."""
        # In a read-only folder SQLite cannot keep its log beside the file. No other process writes, so none is needed.
        still = "&immutable=1" if mode == "ro" and not os.access(self.path.parent, os.W_OK) else ""
        file = f"file:{quote(str(self.path.absolute()))}?mode={mode}{still}"
        try:
            with closing(sqlite3.connect(file, uri=True, timeout=_PATIENCE, isolation_level=None)) as base:
                base.execute("PRAGMA synchronous = FULL")
                yield base
        # Causes: another process locks the file for long, the disk is full, or the file is read-only.
        except sqlite3.OperationalError as error:
            raise FormatError(f"{self.path}: the library cannot be used: {error}") from None
        except sqlite3.DatabaseError as error:
            raise self._torn(error) from None
        except OSError as error:
            raise FormatError(f"{self.path}: {error.strerror or error}") from None

    def _torn(self, detail: object) -> GraspdError:
        return FormatError(
            f"{self.path}: damaged or not a library ({' '.join(str(detail).split())[:200]}); use an intact copy, or "
            "build another with `graspd library build --out FILE`"
        )


def _entry_of_row(row: Sequence[Any]) -> LibraryEntry:
    values: dict[str, Any] = dict(zip(_COLUMNS, row, strict=True))
    # SQLite has no type for truth values.
    values["mass_assumed"] = bool(values["mass_assumed"])
    return LibraryEntry(**values)


def with_mass(entries: Iterable[LibraryEntry], mass: float | None) -> list[LibraryEntry]:
    """Return the entries with this mass [kg], heaviest first. If None (unknown), return all that are heavy enough."""
    same = (entry for entry in entries if (entry.is_heavy_enough if mass is None else entry.mass == mass))
    return sorted(same, key=lambda entry: -entry.mass)


def strict_enough(entries: Sequence[LibraryEntry], verify: str) -> list[LibraryEntry]:
    """Return entries with trials at least as strict as `verify`, strictest first. Raises ConfigError: bad `verify`."""
    if verify not in STRICTNESS:
        raise ConfigError(f"verify: {verify!r}; valid: {', '.join(STRICTNESS)}")
    enough = [entry for entry in entries if STRICTNESS[entry.verify] >= STRICTNESS[verify]]
    return sorted(enough, key=lambda entry: -STRICTNESS[entry.verify])
