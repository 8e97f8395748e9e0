"""Grasps of others from a file or a folder: which format it is goes by the ending."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from graspd_core.errors import FormatError
from graspd_core.formats.foreign.dexgraspbench_npy import read_dexgraspbench
from graspd_core.formats.foreign.imported_grasp import ImportedGrasp
from graspd_core.formats.foreign.posed_grasps import read_graspgen, read_isaac
from graspd_core.hands.model import HandModel
from graspd_core.runtime.inert_pickle import read_bounded

# Endings, in the order in which a folder is searched: what describes objects beside npy files is JSON, too.
FORMATS = {".npy": "dexgraspbench", ".yaml": "isaac", ".yml": "isaac", ".json": "graspgen"}


def read_foreign(
    place: Path, hand: HandModel, *, mesh: str | None = None, order: Sequence[str] = ()
) -> tuple[ImportedGrasp, ...]:
    """All grasps of a file, or of the files of one format below a folder, in the order of their names.

    Args:
        hand: whose grasps they are.
        mesh: of the object, instead of what the files name.
        order: joints of an npy's rows of numbers, by name; () where the hand's is known.

    Raises:
        ConfigError: the order is not known, or does not fit the hand.
        FormatError: there is no such file, or one is malformed.
    """
    found: list[ImportedGrasp] = []
    for path in foreign_files(place):
        try:
            content = read_bounded(path, "file of grasps")
        except ValueError as error:
            raise FormatError(f"{path}: {error}") from None
        if path.suffix == ".npy":
            found += read_dexgraspbench(path, content, hand, mesh, order)
        else:
            found += (read_graspgen if path.suffix == ".json" else read_isaac)(path, content, hand, mesh)
    return tuple(found)


def foreign_files(place: Path) -> tuple[Path, ...]:
    """The files of grasps at a place, which share a format. Raises FormatError: there are none."""
    endings = ", ".join(FORMATS)
    if place.is_file():
        if place.suffix not in FORMATS:
            raise FormatError(f"{place}: unknown ending {place.suffix!r}; valid: {endings}")
        return (place,)
    if not place.is_dir():
        raise FormatError(f"{place}: no such file or folder")
    for kind in dict.fromkeys(FORMATS.values()):
        files = [path for path in place.rglob("*") if FORMATS.get(path.suffix) == kind and path.is_file()]
        if files:
            return tuple(sorted(files, key=_natural))
    raise FormatError(f"{place}: no file of grasps in this folder; valid endings: {endings}")


def _natural(path: Path) -> list[tuple[int, str]]:
    """By which 2.npy comes before 10.npy."""
    return [(int(part), "") if odd % 2 else (0, part) for odd, part in enumerate(re.split(r"([0-9]+)", str(path)))]
