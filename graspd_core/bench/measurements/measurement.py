"""One cell: a kind of run, settings, an object, a hand and a seed; and the key that its result is kept under."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from graspd_core.methods.plan_config import PlanConfig, to_mapping

Kind = Literal["raw", "verified", "pace", "start"]

# Parts of the package that no figure of a cell depends on; of the benchmark itself, one folder counts.
_BESIDE = ("cli", "bags", "doctor.py", "formats", "bench", "viewer")


@dataclass(frozen=True)
class Cell:
    """One run of the benchmark.

    Attributes:
        kind: what is run: "raw" grasps each tried, "verified" ones planned, "pace" of the optimiser alone, "start":
            the first verified grasp of a fresh process.
        name: of the settings: a preset, or a sweep value.
        settings: the settings themselves.
        source: a mesh file or shape:NAME.
        object_hash: of the object's content.
        hand: name or path.
        hand_hash: of its description's content.
        seed: of the method.
        count: grasps asked for.
        trials: names of the trials of every raw grasp.
    """

    kind: Kind
    name: str
    settings: PlanConfig
    source: str
    object_hash: str
    hand: str
    hand_hash: str
    seed: int
    count: int
    trials: tuple[str, ...]

    @property
    def object(self) -> str:
        """The object's name in tables: that of the shape, or of the file."""
        return self.source.removeprefix("shape:") if self.source.startswith("shape:") else Path(self.source).stem


def cell_key(cell: Cell) -> str:
    """Hash of everything that a cell is asked, hexadecimal. The code that answers is recorded beside it."""
    asked = {
        **{name: getattr(cell, name) for name in ("kind", "name", "object_hash", "hand_hash", "seed", "count")},
        "settings": to_mapping(cell.settings),
        "trials": sorted(cell.trials),
    }
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()


def cell_file(cell: Cell) -> str:
    """Name of the file that a cell's record is kept in: for the eye, then for certain."""
    words = (cell.kind, cell.name, cell.object, f"seed{cell.seed}")
    return f"{'-'.join(re.sub(r'[^A-Za-z0-9_.=]+', '_', word) for word in words)}-{cell_key(cell)[:12]}.json"


@lru_cache
def code_version(bench: str = "measurements") -> str:
    """The package's version and a hash of the sources that figures depend on: all but command line, charts and bags.

    Of the benchmark itself only the folder `bench` counts.
    """
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        inside = path.relative_to(root)
        if inside.parts[0] not in _BESIDE or inside.parts[:2] == ("bench", bench):
            digest.update(f"{inside.as_posix()}\n".encode() + path.read_bytes())
    try:
        released = version("graspd")
    except PackageNotFoundError:
        released = "unreleased"
    return f"{released}+{digest.hexdigest()[:12]}"
