"""A pickle reader for MANO's files that runs nothing that a file asks for.

A pickle is a program: it names classes and functions, and calls them. Here every name that MANO's format uses stands
for an inert stand-in of this module, from which the numbers are read afterwards; neither numpy, scipy nor chumpy is
called by the file, and every other name is refused. What bounds time and memory: the size of the file, a memo that is
a dictionary (the C reader allocates as many slots as a file says), no opcode that reserves memory beforehand, few
arguments to a call, and keys that are text or small numbers: to hash a tuple of tuples takes time without bound, or
more stack than there is.

Format: protocol 0 to 4, written by Python 2 (text is bytes in disguise, hence latin-1) or by Python 3.
"""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from graspd_core.errors import HandError

# The licensed file has 3.8 MB.
MAX_BYTES = 64 * 2**20
# The most arguments of any call that the format needs is four. Each call copies its arguments.
_MOST_ARGUMENTS = 8
# Opcodes that reach outside the file or reserve memory before they read.
_REFUSED_OPCODES = (
    pickle.PERSID, pickle.BINPERSID, pickle.EXT1, pickle.EXT2, pickle.EXT4,
    pickle.BYTEARRAY8, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER,
)  # fmt: skip


class Inert:
    """An object of the file that is only kept: the arguments and the state that the file gives it.

    Attributes:
        arguments: what it was called with.
        state: what it was told to become, None where nothing.
    """

    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any) -> Any:
        """Take anything."""
        made = super().__new__(cls)
        made.arguments = arguments
        made.state = None
        return made

    def __setstate__(self, state: Any) -> None:
        """Keep anything."""
        self.state = state


class Dtype(Inert):
    """`numpy.dtype`: called with a code such as "f8"; its state's second entry is the byte order."""


class Array(Inert):
    """`numpy.ndarray`; its state is version, shape, dtype, whether in Fortran's order, and the raw bytes."""


class Scalar(Inert):
    """A numpy number: called with a dtype and the raw bytes."""


class Sparse(Inert):
    """A compressed scipy.sparse matrix; its state holds `data`, `indices`, `indptr` and the shape."""


class SparseRows(Sparse):
    """`csr_matrix`."""


class Leaf(Inert):
    """`chumpy.ch.Ch`: its value is `x`."""


class Select(Inert):
    """`chumpy.reordering.Select`: `a` flattened, taken at `idxs`, in `preferred_shape`."""


class Encoded(Inert):
    """`_codecs.encode`, by which Python 3 writes bytes into old protocols: called with text and "latin1"."""


class Ignored(Inert):
    """Something that carries no number."""


def _rebuild(made: object, *_: object) -> object:
    """`copy_reg._reconstructor`, by which protocol 0 makes objects."""
    if not (isinstance(made, type) and issubclass(made, Inert)):
        raise pickle.UnpicklingError("an object of no known class")
    return made()


def _empty_array(*_: object) -> Array:
    """`numpy.core.multiarray._reconstruct`, which makes an empty array for the state to fill."""
    return Array()


@dataclass(frozen=True)
class _Function:
    """A function that a file may call, and can do nothing else with."""

    name: str
    call: Any = field(repr=False)

    def __call__(self, *arguments: Any) -> Any:
        return self.call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError(f"{self.name} has no state")


_SPARSE = ("scipy.sparse.csc", "scipy.sparse._csc", "scipy.sparse.csr", "scipy.sparse._csr")
# Everything that a file may name. Python 2 and 3, and old and new numpy and scipy, have different names for the same.
ADMITTED: dict[tuple[str, str], Any] = {
    **{
        (f"numpy.{core}.multiarray", name): made
        for core in ("core", "_core")
        for name, made in (("_reconstruct", _Function("_reconstruct", _empty_array)), ("scalar", Scalar))
    },
    ("numpy", "ndarray"): Array,
    ("numpy", "dtype"): Dtype,
    **{(module, "csc_matrix"): Sparse for module in _SPARSE[:2]},
    **{(module, "csr_matrix"): SparseRows for module in _SPARSE[2:]},
    ("chumpy.ch", "Ch"): Leaf,
    ("chumpy", "Ch"): Leaf,
    ("chumpy.reordering", "Select"): Select,
    **{(module, "_reconstructor"): _Function("_reconstructor", _rebuild) for module in ("copy_reg", "copyreg")},
    ("_codecs", "encode"): Encoded,
    **{(module, name): Ignored for module in ("__builtin__", "builtins") for name in ("object", "set", "frozenset")},
}


def _is_plain(key: object) -> bool:
    """Whether a dictionary may have this key: hashed in a step, and no collisions by choice."""
    return isinstance(key, (str, bytes)) or (isinstance(key, int) and 0 <= key < 2**32)


class _Reader(pickle._Unpickler):
    """The stand-ins for what a file names; a name outside `ADMITTED` is refused."""

    # What the base class has, though its stubs do not say so.
    stack: list[Any]
    memo: dict[int, Any]
    readline: Any

    def _call(self) -> None:
        """REDUCE and NEWOBJ: a call, or an object of a class."""
        arguments = self.stack.pop()
        if not isinstance(arguments, tuple) or len(arguments) > _MOST_ARGUMENTS:
            raise pickle.UnpicklingError(f"a call with other than at most {_MOST_ARGUMENTS} arguments")
        self.stack[-1] = self.stack[-1](*arguments)

    def _check_key(self) -> None:
        if not _is_plain(self.stack[-2]):
            raise pickle.UnpicklingError("a dictionary whose keys are neither text nor small numbers")
        pickle._Unpickler.load_setitem(self)  # pyright: ignore[reportAttributeAccessIssue]

    def _check_keys(self) -> None:
        if not all(map(_is_plain, self.stack[::2])):
            raise pickle.UnpicklingError("a dictionary whose keys are neither text nor small numbers")

    def _set_items(self) -> None:
        self._check_keys()
        pickle._Unpickler.load_setitems(self)  # pyright: ignore[reportAttributeAccessIssue]

    def _dictionary(self) -> None:
        self._check_keys()
        pickle._Unpickler.load_dict(self)  # pyright: ignore[reportAttributeAccessIssue]

    def _put(self) -> None:
        """PUT: the one opcode that names a place in the memo by a number of any length."""
        place_points = int(self.readline()[:-1])
        if not _is_plain(place_points):
            raise pickle.UnpicklingError("a place in the memo that no file needs")
        self.memo[place_points] = self.stack[-1]

    dispatch: ClassVar[dict[int, Any]] = {
        code: act for code, act in pickle._Unpickler.dispatch.items() if bytes([code]) not in _REFUSED_OPCODES
    }
    dispatch |= {
        pickle.REDUCE[0]: _call,
        pickle.NEWOBJ[0]: _call,
        pickle.SETITEM[0]: _check_key,
        pickle.SETITEMS[0]: _set_items,
        pickle.DICT[0]: _dictionary,
        pickle.PUT[0]: _put,
        # Sets carry no numbers: kept as lists, nothing in them is hashed.
        pickle.EMPTY_SET[0]: dispatch[pickle.EMPTY_LIST[0]],
        pickle.ADDITEMS[0]: dispatch[pickle.APPENDS[0]],
        pickle.FROZENSET[0]: dispatch[pickle.LIST[0]],
    }

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in for a name."""
        try:
            return ADMITTED[module, name]
        except KeyError:
            shown = f"{module}.{name}"[:200]
            raise _RefusedError(shown if shown.isprintable() else ascii(shown)) from None


class _RefusedError(Exception):
    """A name that is not in `ADMITTED`."""


def read_pickle(path: Path) -> Any:
    """What a MANO file holds: Python's numbers, text, lists and dictionaries, and `Inert` objects.

    Raises:
        HandError: no such file, too large, not a pickle, or one that names anything but `ADMITTED`; names the culprit.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise HandError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(content) > MAX_BYTES:
        raise HandError(f"{path}: more than {MAX_BYTES // 2**20} MB, which no MANO file has")
    try:
        return _Reader(io.BytesIO(content), encoding="latin1").load()
    except _RefusedError as refused:
        raise HandError(
            f"{path}: asks for {refused}, which a MANO file does not need: refused, and nothing of it was run"
        ) from None
    # A file that is no pickle fails in whatever way its bytes happen to; the file is the culprit.
    except Exception as error:
        told = f"{type(error).__name__}: {error}".splitlines()[0]
        raise HandError(f"{path}: not a MANO pickle: {told[:200]}") from error
