"""The parsers of benchmarks/fuzz_targets.py, and ways to spoil their inputs."""

import copy
import importlib
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import strategies as st

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
NASTY = (
    *("nan", "NaN", "inf", "-inf", ".nan", "1e400", "1e308", "-1e308", "1e-320", "-1", "0", "", " ", "x", "null"),
    *("true", "99999999999999999999", "-9223372036854775808", "4294967295", "1" + 400 * "0", 5000 * "1", "٣", "\x00"),
    *("[", "{", "[[1, 2], [3]]", "\n", "<a/>", "&x;", "<!DOCTYPE a>", "*a", "&a [1]", "0x" + 5000 * "f", '"', "../x"),
)  # fmt: skip


@pytest.fixture(scope="session")
def fuzz() -> Iterator[ModuleType]:
    """The module fuzz_targets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module("fuzz_targets")


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where inputs are written."""
    return tmp_path_factory.mktemp("inputs")


@pytest.fixture(scope="session")
def spoilt() -> Callable[[bytes], st.SearchStrategy[bytes]]:
    """Inputs with one to four things wrong with them: words and numbers replaced, bytes flipped, cut or repeated."""
    return _spoilt


@st.composite
def _spoilt(draw: st.DrawFn, data: bytes) -> bytes:
    if draw(st.booleans()):
        data = draw(_regrown(data))
    for _ in range(draw(st.integers(1, 4))):
        words = [found.span() for found in re.finditer(rb"[\w.+-]+", data)]
        action = draw(st.sampled_from(["word", "word", "word", "flip", "cut", "repeat", "drop"]))
        if action == "word" and words:
            first, last = draw(st.sampled_from(words))
            data = data[:first] + draw(st.sampled_from(NASTY)).encode() + data[last:]
            continue
        first = draw(st.integers(0, len(data)))
        last = min(len(data), first + draw(st.integers(1, 40)))
        if action == "flip" and data[first:last]:
            data = data[:first] + bytes([data[first] ^ draw(st.integers(1, 255))]) + data[first + 1 :]
        elif action == "cut":
            data = data[:first]
        elif action == "repeat":
            data = data[:last] + data[first:last] * draw(st.integers(1, 5)) + data[last:]
        elif action == "drop":
            data = data[:first] + data[last:]
    return data


@st.composite
def _regrown(draw: st.DrawFn, data: bytes) -> bytes:
    """An XML file of which up to three elements were removed, moved, repeated, renamed or given another attribute."""
    try:
        root = ET.fromstring(data)
    except ET.ParseError:
        return data
    for _ in range(draw(st.integers(1, 3))):
        elements = list(root.iter())
        above = {child: parent for parent in elements for child in parent}
        element, other = draw(st.sampled_from(elements)), draw(st.sampled_from(elements))
        action = draw(st.sampled_from(["set", "drop", "rename", "remove", "move", "repeat"]))
        if action in ("set", "drop") and element.attrib:
            key = draw(st.sampled_from(sorted(element.attrib)))
            element.attrib.update({key: draw(st.sampled_from(sorted(other.attrib.values()) or [""]))})
            if action == "drop":
                del element.attrib[key]
        elif action == "rename":
            element.tag = other.tag
        elif action in ("remove", "move") and element in above:
            above[element].remove(element)
        if action in ("move", "repeat"):
            draw(st.sampled_from(list(root.iter()))).append(copy.deepcopy(element))
    return ET.tostring(root)
