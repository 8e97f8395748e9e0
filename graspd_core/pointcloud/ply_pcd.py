"""Points of ply files and of pcd files, text or binary.

Read here and not by Open3D, which makes room for as many points as a header promises, and where the file ends before
them hands out what happened to lie in that memory. Formats: "The PLY Polygon File Format" (Turk, 1994); "The PCD file
format", version 0.7 (Point Cloud Library).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

# The most that a byte of LZF, the method of compressed pcd, can stand for: 264 bytes by three.
_DENSEST = 88
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}


@dataclass
class _Element:
    """One element of a ply header: how often it comes, its properties and their types; "" is the type of a list."""

    name: str
    count: int
    names: list[str] = field(default_factory=list)
    codes: list[str] = field(default_factory=list)


def read_ply_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """The vertices of a ply file, text or binary in either byte order; NaN is kept.

    Raises:
        ValueError: it is no ply file, lacks x, y or z, is cut short, or has lists before its vertices end.
    """
    # At the start of a line: a comment may hold the word.
    head, *more = re.split(rb"[\r\n]end_header", path.read_bytes(), maxsplit=1)
    rest = more[0] if more else b""
    body = rest[rest.find(b"\n") + 1 :]
    order, elements = _ply_header(head.decode("ascii", errors="replace").splitlines())
    start = 0
    for element in elements:
        if "" in element.codes:
            raise ValueError(f"element {element.name!r} has a list, and stands in or before the vertices")
        if element.name == "vertex":
            break
        start += element.count * sum(np.dtype(code).itemsize if order else 1 for code in element.codes)
    else:
        raise ValueError("it has no element 'vertex'")
    missing = [name for name in "xyz" if name not in element.names]
    if missing:
        raise ValueError(f"its vertices have no {missing[0]!r}")
    if not order:
        columns = [element.names.index(name) for name in "xyz"]
        return _numbers_of_text(body, start, element.count, len(element.names))[:, columns]
    sizes = [np.dtype(code).itemsize for code in element.codes]
    places = [element.names.index(name) for name in "xyz"]
    return _rows(body, _packed([order + element.codes[k] for k in places], places, sizes), element.count, start)


def read_pcd_points(path: Path) -> Float[np.ndarray, "n 3"] | None:
    """The points of a pcd file, text or binary; NaN is kept. None where its data is compressed.

    Raises:
        ValueError: its header lacks what is needed, or it is cut short.
    """
    header: dict[str, list[str]] = {}
    data, at = path.read_bytes(), 0
    while at < len(data) and "DATA" not in header:
        end = data.find(b"\n", at)
        end = len(data) if end < 0 else end
        words = data[at:end].decode("ascii", errors="replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA") if not header.get(key)]
    if missing:
        raise ValueError(f"its header has no {missing[0]}")
    fields = header["FIELDS"]
    # Not all writers say again what width and height say.
    points = int(header["POINTS"][0]) if header.get("POINTS") else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(fields))]
    if {len(counts), len(header["SIZE"]), len(header["TYPE"])} != {len(fields)} or min(counts) < 1 or points < 0:
        raise ValueError("its header has not as many SIZE, TYPE and COUNT as FIELDS, or less than none of something")
    lost = [name for name in "xyz" if name not in fields]
    if lost:
        raise ValueError(f"its points have no {lost[0]!r}")
    places = [fields.index(name) for name in "xyz"]
    if header["DATA"][0] == "ascii":
        columns = [sum(counts[:place]) for place in places]
        return _numbers_of_text(data[at:], 0, points, sum(counts))[:, columns]
    if header["DATA"][0] not in ("binary", "binary_compressed"):
        raise ValueError(f"its DATA {header['DATA'][0][:40]!r} is none of ascii, binary and binary_compressed")
    # Whatever else numpy would take for a type, or for a page of Python.
    odd = [kind for kind in header["TYPE"] if kind.upper() not in ("F", "I", "U")]
    if odd:
        raise ValueError(f"its TYPE {odd[0][:40]!r} is none of F, I and U")
    sizes = [int(word) * count for word, count in zip(header["SIZE"], counts, strict=True)]
    if header["DATA"][0] == "binary_compressed":
        _refuse_false_sizes(data[at:], points * sum(sizes))
        return None
    codes = ["<" + header["TYPE"][place].lower() + header["SIZE"][place] for place in places]
    return _rows(data, _packed(codes, places, sizes), points, at)


def _refuse_false_sizes(packed: bytes, needed: int) -> None:
    """Raise ValueError where compressed points are not what the header says: Open3D would read past their end."""
    size, unpacked = np.frombuffer(packed[:8].ljust(8, b"\0"), "<u4").tolist()
    if unpacked != needed or size > len(packed) - 8 or unpacked > _DENSEST * size:
        there = f"{size} bytes that unpack to {unpacked}, {max(len(packed) - 8, 0)} are there"
        raise ValueError(f"its header promises points of {needed} bytes, its data {there}")


def _ply_header(lines: list[str]) -> tuple[str, list[_Element]]:
    """Byte order, empty for text, and the elements in their order."""
    order, elements = None, []
    for words in (line.split() for line in lines[1:]):
        match words:
            case ["format", kind, *_]:
                order = _ORDERS.get(kind)
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
                if elements[-1].count < 0:
                    raise ValueError(f"element {name!r} comes {count} times")
            case ["property", "list", _, _, name] if elements:
                elements[-1].names.append(name)
                elements[-1].codes.append("")
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].names.append(name)
                elements[-1].codes.append(_TYPES[kind])
            case [("property" | "element"), *_]:
                raise ValueError(f"header line {' '.join(words)[:80]!r} is not understood")
    if not lines or lines[0].strip() != "ply" or order is None:
        raise ValueError("it has no header of a ply file")
    return order, elements


def _packed(codes: list[str], places: list[int], sizes: list[int]) -> np.dtype:
    """Rows whose fields have `sizes` [bytes], and x, y and z of types `codes` at `places`."""
    starts = [sum(sizes[:place]) for place in places]
    return np.dtype({"names": list("xyz"), "formats": codes, "offsets": starts, "itemsize": sum(sizes)})


def _rows(data: bytes, dtype: np.dtype, count: int, start: int) -> Float[np.ndarray, "count 3"]:
    there = max(len(data) - start, 0) // dtype.itemsize
    if there < count:
        raise ValueError(f"cut short: {there} of {count} points")
    rows = np.frombuffer(data, dtype, count, start)
    # A NaN of any kind stays one: numpy would warn of those that signal.
    with np.errstate(invalid="ignore"):
        return np.stack([rows[name].astype(float) for name in "xyz"], axis=1)


def _numbers_of_text(body: bytes, start: int, rows: int, width: int) -> Float[np.ndarray, "rows width"]:
    words = body.split()
    there = max(len(words) - start, 0) // width
    if not 0 <= rows <= there:
        raise ValueError(f"cut short: {there} of {rows} points")
    return np.array(words[start : start + rows * width], dtype=float).reshape(rows, width)
