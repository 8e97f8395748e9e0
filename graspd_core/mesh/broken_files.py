"""Files that hold no mesh, or half of one: a pointer, a picture, an archive, what a transfer cut off."""

from __future__ import annotations

import os
from pathlib import Path

from graspd_core.errors import MeshError

# How other things begin that come under a mesh's name.
_OTHERS = (
    (b"version https://git-lfs", "a git-LFS pointer to the mesh, not the mesh; `git lfs pull` fetches it"),
    (b"\x89PNG", "a PNG picture, not a mesh"),
    (b"\xff\xd8\xff", "a JPEG picture, not a mesh"),
    (b"GIF8", "a GIF picture, not a mesh"),
    (b"%PDF", "a PDF document, not a mesh"),
    (b"PK\x03\x04", "a ZIP archive, not a mesh; unpack it first"),
    (b"\x1f\x8b", "a gzip archive, not a mesh; unpack it first"),
    (b"<!doctype html", "a page of HTML, not a mesh"),
    (b"<html", "a page of HTML, not a mesh"),
)
# What is looked at of either end [bytes].
_LOOK = 4096
# A binary STL: its header with the number of triangles, and each triangle [bytes]; more of them nobody writes.
_HEADER, _TRIANGLE, _MOST_TRIANGLES = 84, 50, 10**8


def refuse_broken(path: Path) -> None:
    """Raise MeshError for a file that is something else than a mesh, or an STL or OBJ that was cut off."""
    with path.open("rb") as file:
        head = file.read(_LOOK)
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _LOOK))
        tail = file.read()
    if size == 0:
        raise MeshError(f"{path}: an empty file")
    for begins, what in _OTHERS:
        if head.lstrip()[: len(begins)].lower() == begins.lower():
            raise MeshError(f"{path}: {what}")
    ending = path.suffix.lower()
    cut = _cut_stl(head, tail, size) if ending == ".stl" else _cut_obj(tail) if ending == ".obj" else ""
    if cut:
        raise MeshError(f"{path}: cut off: {cut}")


def _cut_stl(head: bytes, tail: bytes, size: int) -> str:
    if head.lstrip().lower().startswith(b"solid") and (b"facet" in head or size < _HEADER):
        return "" if b"endsolid" in tail.lower() else "it has no endsolid"
    if size < _HEADER:
        return f"{size} bytes, less than the header of an STL"
    triangles = int.from_bytes(head[_HEADER - 4 : _HEADER], "little")
    there = (size - _HEADER) // _TRIANGLE
    return f"{there} of {triangles} triangles are there" if there < triangles <= _MOST_TRIANGLES else ""


def _cut_obj(tail: bytes) -> str:
    """What of its last line is missing, where it has no end; a file may leave out the last line's end alone."""
    line = tail.replace(b"\r", b"\n").rpartition(b"\n")[2].decode("utf-8", errors="replace")
    words = line.split()
    if not words or words[0] not in ("v", "vn", "f"):
        return ""
    whole = len(words) >= 4 and (words[0] == "f" or all(map(_is_number, words[1:])))
    return "" if whole else f"it ends in the middle of a line, {line.strip()[:60]!r}"


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
