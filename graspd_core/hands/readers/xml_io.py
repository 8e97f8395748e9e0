"""Read XML files of hands. Harmless mistakes are accepted, dangerous content is refused.

Namespaces are not resolved, so undeclared prefixes are accepted. Comments may come before the XML header. A document
type declaration is refused, because its entities can use unlimited memory or read other files.
"""

from __future__ import annotations

import codecs
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import cast
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from graspd_core.errors import HandError

# Error messages are cut to this length, because a file may contain a word of megabytes.
_LONGEST = 1000
_LARGEST_FILE = 32 * 2**20
DEEPEST = 150
# The largest known hand has about 1000 elements. Each element needs half a kilobyte of memory.
_MOST_ELEMENTS, _MOST_ATTRIBUTES = 20_000, 200
# Greatest valid distance of a link, joint or shape from its reference frame [m].
FARTHEST = 10.0
# Error messages name the innermost of these elements.
_OWNERS = ("link", "joint", "body", "geom", "mesh")


class Element(ET.Element):
    """An XML element with its `line` in the file. `owner`: tag and name of the enclosing link, body or joint."""

    line = 0
    owner = ""


def read_xml(path: Path) -> Element:
    """Read the root element of an XML file.

    Raises HandError: the file cannot be read, is not well-formed, has a document type declaration, or is too large.
    """
    try:
        # The size is checked by reading, because a device file has no size and no end.
        with path.open("rb") as file:
            data = file.read(_LARGEST_FILE + 1)
        if len(data) > _LARGEST_FILE:
            raise HandError(f"{path}: the hand file is too large; valid: at most {_LARGEST_FILE >> 20} MiB")
        text = _decoded(data)
    except (OSError, ValueError) as error:
        raise HandError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    return parse_xml(path, text)


def parse_xml(path: Path, text: str) -> Element:
    """Parse the root element from the text of a file. Raises HandError: see `read_xml`."""
    text = _blanked(text, "<!--", "-->")
    for space in " \t\r\n":
        text = _blanked(text, f"<?xml{space}", "?>")
    document, count = Element(""), 0
    stack = [document]
    parser = expat.ParserCreate(encoding="utf-8")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        element = Element(tag, attributes)
        element.line, element.owner = parser.CurrentLineNumber, stack[-1].owner
        if tag in _OWNERS and "name" in attributes:
            element.owner = f"{tag} {attributes['name']!r}"
        if tag in _OWNERS and not attributes.get("name", "").isprintable():
            raise wrong(path, element, "has a name with a line break or an unprintable character; use another name")
        if len(stack) > DEEPEST:
            raise wrong(path, element, f"<{tag}> is nested more than {DEEPEST} deep")
        if count > _MOST_ELEMENTS or len(attributes) > _MOST_ATTRIBUTES:
            limits = f"{_MOST_ELEMENTS} elements, nor more than {_MOST_ATTRIBUTES} attributes of one element"
            raise wrong(path, element, f"a hand file must not have more than {limits}")
        stack[-1].append(element)
        stack.append(element)

    def refuse(*_: object) -> None:
        raise HandError(f"{path}:{parser.CurrentLineNumber}: a <!DOCTYPE> is refused, because it may define entities")

    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, refuse
    parser.EndElementHandler = lambda _: stack.pop()
    try:
        body = text.lstrip()
        # The leading line breaks are kept, so that line numbers stay correct.
        before = text.count("\n", 0, len(text) - len(body))
        parser.Parse(("\n" * before + body).encode("utf-8", errors="replace"), True)
    except expat.ExpatError as error:
        raise HandError(f"{path}: not well-formed XML: {error}") from error
    return cast(Element, document[0])


def as_text(root: ET.Element) -> str:
    """Return the elements as XML text without comments. Each element keeps its line number."""
    pieces, line = [], 1
    # An entry (None, tag) means that only the end tag is left to write.
    ahead: list[tuple[ET.Element | None, str]] = [(root, root.tag)]
    while ahead:
        element, tag = ahead.pop()
        if element is None:
            pieces.append(f"</{tag}>")
            continue
        pieces.append("\n" * (getattr(element, "line", line) - line))
        line = max(line, getattr(element, "line", line))
        pieces.append("".join([f"<{tag}", *(f" {key}={quoteattr(text)}" for key, text in element.items()), ">"]))
        ahead += [(None, tag), *((child, child.tag) for child in reversed(element))]
    return "".join(pieces)


def wrong(path: Path, element: ET.Element, message: str) -> HandError:
    """Return an error about an element. The message names the file, the line, and the enclosing link or joint."""
    line, owner = getattr(element, "line", 0), getattr(element, "owner", "")
    where = f"{path}:{line}" if line else f"{path}"
    if owner:
        message = f"{owner} {message}" if message.startswith(("is ", "has ")) else f"{owner}: {message}"
    if len(message) > _LONGEST:
        message = f"{message[: _LONGEST // 2]} ... {message[-_LONGEST // 2 :]}"
    return HandError(f"{where}: {message}")


def _decoded(data: bytes) -> str:
    for mark, encoding in (
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if data.startswith(mark):
            return data.decode(encoding, errors="replace").lstrip("\ufeff")
    declared = re.search(rb"<\?xml[^>]*?encoding=[\"']([\w.-]+)", data[:2000])
    try:
        name = codecs.lookup(declared.group(1).decode() if declared else "utf-8").name
        # Punycode (for host names) is not decoded, because its decoder takes quadratic time.
        return data.decode("utf-8" if name == "punycode" else name, errors="replace")
    except LookupError:
        return data.decode("utf-8", errors="replace")


def _blanked(text: str, start: str, end: str) -> str:
    """Replace all text between `start` and `end` by its line breaks, in linear time. Line numbers do not change."""
    pieces, at = [], 0
    while (first := text.find(start, at)) >= 0 and (last := text.find(end, first + len(start))) >= 0:
        pieces += [text[at:first], "\n" * text.count("\n", first, last)]
        at = last + len(end)
    return "".join([*pieces, text[at:]])


def read_origin(path: Path, element: ET.Element) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return rotation and translation [m] of an element's `<origin>`. Without `<origin>` the pose is the identity.

    Raises HandError: a value is not a finite number, or a translation is longer than `FARTHEST`.
    """
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    rpy, position = (read_numbers(path, origin, key, 3, "0 0 0") for key in ("rpy", "xyz"))
    if np.abs(position).max() > FARTHEST:
        text = f"<{origin.tag} xyz={origin.get('xyz')!r}>"
        raise wrong(path, origin, f"{text}: exceeds {FARTHEST:g} m; lengths are in metres")
    return rotation_from_rpy(rpy), position


def read_numbers(path: Path, element: ET.Element, key: str, count: int, default: str) -> Float[np.ndarray, "n"]:
    """Read an attribute of `count` finite numbers. Raises HandError: the attribute has other content."""
    text = element.get(key) or default
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise wrong(path, element, f"<{element.tag} {key}={text!r}>: expected {count} finite number(s)")
    return values


def rotation_from_rpy(rpy: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return `Rz(yaw) Ry(pitch) Rx(roll)`: URDF's fixed-axis convention [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
