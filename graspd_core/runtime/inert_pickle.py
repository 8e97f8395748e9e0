"""Read pickles without running any code that a file names.

A pickle is a program that names classes and functions and calls them. This reader replaces every admitted name by an
inert object of this module, and refuses any other name. No library is called. `array_of` reads the numbers of an inert
object. Limits on file size, call arguments and dictionary keys (text or small numbers) bound time and memory. The memo,
pickle's store of read objects, is a dictionary. Opcodes that reserve memory in advance are refused.

Pickles may have protocol 0 to 4, from Python 3 or Python 2. Text of Python 2 is stored as bytes and read as latin-1.
"""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

# Greatest size of a file [bytes]. The licensed file of MANO has 3.8 MB.
MAX_BYTES = 64 * 2**20
# Greatest number of arguments of a call. The formats need four. Each call copies its arguments, which takes memory.
_MOST_ARGUMENTS = 8
# Opcodes that refer to data outside the file, or that reserve memory before reading.
_REFUSED_OPCODES = (
    pickle.PERSID, pickle.BINPERSID, pickle.EXT1, pickle.EXT2, pickle.EXT4,
    pickle.BYTEARRAY8, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER,
)  # fmt: skip


@dataclass(eq=False)
class Inert:
    """An object that the file constructs, kept as data. None of its code runs.

    Attributes:
        kind: kind of the object in the file, such as "array".
        arguments: arguments with which the file constructs the object.
        state: argument of the object's `__setstate__`. None if the file does not call `__setstate__`.
    """

    kind: str
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


@dataclass(frozen=True)
class Maker:
    """A replacement for a class or function that a file names. A call only returns an `Inert`."""

    kind: str

    def __call__(self, *arguments: Any) -> Inert:
        # In protocol 0, `copy_reg._reconstructor` constructs an object of the class in its first argument.
        if self.kind == "rebuilt":
            if not arguments or not isinstance(arguments[0], Maker):
                raise pickle.UnpicklingError("an object has no known class")
            return arguments[0]()
        return Inert(self.kind, arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError(f"{self.kind}: a state is given, but this type has none")


def makers(*rows: tuple[str, tuple[str, ...], tuple[str, ...]]) -> dict[tuple[str, str], Maker]:
    """Return a maker for each (module, name). A row (kind, modules, names) covers each module with each name."""
    return {(module, name): Maker(kind) for kind, modules, names in rows for module in modules for name in names}


# Names in pickles of numpy arrays. An array's state is version, shape, type, Fortran order, and the raw bytes. In old
# protocols Python 3 writes bytes as "encoded" text. Old and new numpy have these functions in different modules.
NUMPY_NAMES = makers(
    ("array", ("numpy.core.multiarray", "numpy._core.multiarray"), ("_reconstruct",)),
    ("array", ("numpy",), ("ndarray",)),
    ("dtype", ("numpy",), ("dtype",)),
    ("scalar", ("numpy.core.multiarray", "numpy._core.multiarray"), ("scalar",)),
    ("encoded", ("_codecs",), ("encode",)),
)


def _is_plain(key: object) -> bool:
    return isinstance(key, (str, bytes)) or (isinstance(key, int) and 0 <= key < 2**32)


def _with_plain_keys(name: str, keys: slice) -> Callable[[Any], None]:
    """Return an opcode's handler. It checks dictionary keys at `keys` of the stack, then calls the method `name`."""

    def act(reader: Any) -> None:
        wrong = [key for key in reader.stack[keys] if not _is_plain(key)]
        if wrong:
            given = f"dictionary key {_short_text(wrong[0])}"
            raise pickle.UnpicklingError(f"{given}; valid: text, bytes, integers from 0 to 2**32 - 1")
        getattr(pickle._Unpickler, name)(reader)

    return act


class _Reader(pickle._Unpickler):
    """An unpickler that returns an inert object for an admitted name and refuses every other name."""

    # The base class has these attributes, but its type stubs lack them.
    stack: list[Any]
    memo: dict[int, Any]
    readline: Any

    def _call(self) -> None:
        arguments = self.stack.pop()
        if not isinstance(arguments, tuple) or len(arguments) > _MOST_ARGUMENTS:
            given = f"a call with arguments {_short_text(arguments)}"
            raise pickle.UnpicklingError(f"{given}; valid: a tuple of at most {_MOST_ARGUMENTS}")
        self.stack[-1] = self.stack[-1](*arguments)

    def _put(self) -> None:
        place = int(self.readline()[:-1])
        if not _is_plain(place):
            raise pickle.UnpicklingError(f"memo index {place}; valid: 0 to 2**32 - 1")
        self.memo[place] = self.stack[-1]

    dispatch: ClassVar[dict[int, Any]] = {
        code: act for code, act in pickle._Unpickler.dispatch.items() if bytes([code]) not in _REFUSED_OPCODES
    }
    dispatch |= {
        pickle.REDUCE[0]: _call,
        pickle.NEWOBJ[0]: _call,
        pickle.SETITEM[0]: _with_plain_keys("load_setitem", slice(-2, None, 2)),
        pickle.SETITEMS[0]: _with_plain_keys("load_setitems", slice(0, None, 2)),
        pickle.DICT[0]: _with_plain_keys("load_dict", slice(0, None, 2)),
        pickle.PUT[0]: _put,
        # Read sets as lists, so that their items are not hashed. No needed number is in a set.
        pickle.EMPTY_SET[0]: dispatch[pickle.EMPTY_LIST[0]],
        pickle.ADDITEMS[0]: dispatch[pickle.APPENDS[0]],
        pickle.FROZENSET[0]: dispatch[pickle.LIST[0]],
    }

    def __init__(self, content: bytes, admitted: Mapping[tuple[str, str], Maker]) -> None:
        super().__init__(io.BytesIO(content), encoding="latin1")
        self._admitted = admitted

    def find_class(self, module: str, name: str) -> Any:
        """Return the maker of a name. Raises _RefusedError: the name is not admitted."""
        try:
            return self._admitted[module, name]
        except KeyError:
            full_name = f"{module}.{name}"[:200]
            raise _RefusedError(full_name if full_name.isprintable() else ascii(full_name)) from None


class _RefusedError(Exception):
    """A pickle contains a name that is not admitted."""


def read_bounded(path: Path, what: str) -> bytes:
    """Read a file. Raises ValueError: the file is unreadable or too large. `what` is the format, e.g. "MANO file"."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error
    if len(content) > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES // 2**20} MB, the limit of a {what}")
    return content


def load_inert(content: bytes, admitted: Mapping[tuple[str, str], Maker], what: str) -> Any:
    """Return the content of a pickle: Python's numbers, text, lists and dictionaries, and `Inert` objects.

    Raises ValueError: `content` is not a pickle, or names a class or function that is not in `admitted`.
    """
    try:
        return _Reader(content, admitted).load()
    except _RefusedError as refused:
        reason = f"asks for {refused}, which a {what} does not need; the file is refused, and nothing was run"
        raise ValueError(reason) from None
    # The base class may raise any exception for a file that is no pickle.
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ValueError(f"not the pickle of a {what}: {reason[:200]}") from error


# Valid types of array entries: booleans, integers, floats.
_NUMERIC = {"b1", *(kind + size for kind in "iu" for size in "1248"), "f2", "f4", "f8"}
# Greatest number of axes of an array.
_MOST_AXES = 8


def array_of(value: Inert) -> np.ndarray:
    """Return the numeric array of an inert object, in native byte order. Raises ValueError: no numeric array."""
    state = value.state
    if not isinstance(state, tuple) or len(state) != 5:
        raise ValueError("its array has no content")
    _, shape, dtype, fortran, raw = state
    kind = _dtype(dtype)
    if isinstance(raw, Inert) and raw.kind == "encoded" and raw.arguments[1:] in ((), ("latin1",), ("latin-1",)):
        raw = raw.arguments[0] if raw.arguments else None
    raw = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(raw, bytes) or not is_shape(shape):
        raise ValueError("the shape or the content of its array is not numeric")
    flat = np.frombuffer(raw, dtype=kind)
    # `math.prod` uses Python's integers, which cannot overflow.
    if math.prod(shape) != len(flat):
        raise ValueError(f"its array has {len(flat)} numbers, but shape {shape}")
    return flat.astype(kind.newbyteorder("=")).reshape(shape, order="F" if fortran else "C")


def _dtype(value: Any) -> np.dtype:
    code = value.arguments[0] if isinstance(value, Inert) and value.kind == "dtype" and value.arguments else None
    if not isinstance(code, str) or code not in _NUMERIC:
        raise ValueError(f"its array has type {_short_text(code)}; valid: booleans, integers, floats")
    order = value.state[1] if isinstance(value.state, tuple) and len(value.state) > 1 else "="
    if order not in ("<", ">", "|", "="):
        raise ValueError(f"its array has byte order {_short_text(order)}; valid: <, >, |, =")
    return np.dtype(("<" if order in ("|", "=") else order) + code)


def _short_text(value: object) -> str:
    return repr(value[:40]) if isinstance(value, str) else f"a {type(value).__name__}"


def is_shape(value: object) -> bool:
    """Return True if a value is a valid shape of an array."""
    return (
        isinstance(value, tuple) and len(value) <= _MOST_AXES and all(type(n) is int and 0 <= n < 2**40 for n in value)
    )
