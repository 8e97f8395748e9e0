"""Which entry of a library a name or a mesh file means, and what is told where there is none."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from graspd_core.errors import ConfigError, MeshError
from graspd_core.hands.model import HandModel
from graspd_core.library.grasp_library import GraspLibrary, strict_enough
from graspd_core.library.library_entry import LibraryEntry, absolute, hand_hash, source_hash

_MOST_NAMED = 8


@dataclass(frozen=True)
class Physics:
    """What grasps are to hold under: mass [kg] and friction of the object, and the trials."""

    mass: float
    friction: float
    verify: str = "standard"


def entry_by_name(library: GraspLibrary, hand: HandModel | None, name: str, physics: Physics) -> LibraryEntry:
    """The entry of an object that the library calls so, for a hand; None: for any.

    Of several masses and frictions the one asked for; where there is but one, that, since the object is known.

    Raises:
        ConfigError: the library does not know the name, or not with this hand or physics, or several objects have it.
        MeshError: the object's file has changed since.
    """
    called = [entry for entry, _ in library.entries(name=name)]
    if not called:
        names = library.names()
        shown = (difflib.get_close_matches(name, names, _MOST_NAMED) or names)[:_MOST_NAMED]
        raise ConfigError(f"{name[:128]!r} is not in the library {library.path}; it has {_listed(shown, names)}")
    same = _with_hand(library, hand, called, name)
    if len({entry.mesh_sha256 for entry in same}) > 1:
        sources = ", ".join(sorted({entry.source for entry in same}))
        raise ConfigError(f"{name}: the library {library.path} has several: {sources}; name the mesh file")
    there = [e for e in same if (e.mass, e.friction) == (physics.mass, physics.friction)]
    if not there and len({(entry.mass, entry.friction) for entry in same}) == 1:
        there = same
    entry = _held(library, there, same, name, physics)
    if entry.source and Path(entry.source).is_file() and source_hash(entry.source) != entry.file_sha256:
        raise _changed(library, entry)
    return entry


def entry_by_file(
    library: GraspLibrary,
    hand: HandModel | None,
    source: str | Path,
    scale: float,
    physics: Physics,
    *,
    required: bool = True,
) -> LibraryEntry | None:
    """The entry of a mesh file, or shape:NAME, at a scale; None where the library lacks it and it is not required.

    Raises:
        ConfigError: the library does not know its content, or not at this scale, with this hand or this physics.
        MeshError: it cannot be read, or has changed since the library was made.
    """
    path = absolute(str(source))
    content = [entry for entry, _ in library.entries(file_sha256=source_hash(path))]
    if not required:
        content = [entry for entry in content if hand is None or entry.hand_content == hand_hash(hand)]
        same = [e for e in content if (e.scale, e.mass, e.friction) == (scale, physics.mass, physics.friction)]
        return next(iter(strict_enough(same, physics.verify)), None)
    if not content:
        before = [entry for entry, _ in library.entries(source=path)]
        if before:
            raise _changed(library, before[0])
        raise ConfigError(f"{path}: its mesh is not in the library {library.path}; `graspd library build` adds it")
    sized = [entry for entry in content if entry.scale == scale]
    if not sized:
        scales = ", ".join(sorted({f"{entry.scale:g}" for entry in content}))
        raise ConfigError(f"{path}: not at scale {scale:g} in the library {library.path}; it has it at {scales}")
    same = _with_hand(library, hand, sized, path)
    there = [e for e in same if (e.mass, e.friction) == (physics.mass, physics.friction)]
    return _held(library, there, same, path, physics)


def _with_hand(
    library: GraspLibrary, hand: HandModel | None, entries: Sequence[LibraryEntry], what: str
) -> list[LibraryEntry]:
    if hand is None:
        return list(entries)
    same = [entry for entry in entries if entry.hand_content == hand_hash(hand)]
    if same:
        return same
    hands = sorted({entry.hand for entry in entries})
    told = f"for {', '.join(hands)}, not for {hand.name}" if hand.name not in hands else "for another make of this hand"
    raise ConfigError(f"{what}: in the library {library.path} {told}; `graspd library build --hand` adds it")


def _held(
    library: GraspLibrary,
    entries: Sequence[LibraryEntry],
    others: Sequence[LibraryEntry],
    what: str,
    physics: Physics,
) -> LibraryEntry:
    enough = strict_enough(entries, physics.verify)
    if enough:
        return enough[0]
    had = ", ".join(sorted({f"{e.mass:g} kg, friction {e.friction:g}, {e.verify} trials" for e in others}))
    asked = f"{physics.mass:g} kg, friction {physics.friction:g}, {physics.verify} trials"
    raise ConfigError(f"{what}: not with {asked} in the library {library.path}; it has {had}")


def _changed(library: GraspLibrary, entry: LibraryEntry) -> MeshError:
    return MeshError(
        f"{entry.source}: the mesh has changed since {entry.name} came into the library {library.path}; build it again "
        f"with `graspd library build {entry.source} --out {library.path}`, or put the old file back"
    )


def _listed(shown: Sequence[str], names: Sequence[str]) -> str:
    more = len(names) - len(shown)
    return (", ".join(shown) or "none") + (f" and {more} more" if more else "")
