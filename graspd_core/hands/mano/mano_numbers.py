"""What a MANO file may name, and the numbers that its inert objects stand for: arrays, sparse matrices, expressions.

Every other name is refused, and none is called (`runtime/inert_pickle`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.errors import HandError
from graspd_core.runtime.inert_arrays import array_of, is_shape
from graspd_core.runtime.inert_pickle import NUMPY_NAMES, Inert, load_inert, makers, read_bounded

# A sparse matrix's state holds data, indices, indptr and the shape. A leaf of chumpy's has the value `x`; a selection
# is `a` flattened, taken at `idxs`, in `preferred_shape`. Python 2 and 3, old and new scipy have different names for
# the same.
ADMITTED = NUMPY_NAMES | makers(
    ("sparse columns", ("scipy.sparse.csc", "scipy.sparse._csc"), ("csc_matrix",)),
    ("sparse rows", ("scipy.sparse.csr", "scipy.sparse._csr"), ("csr_matrix",)),
    ("leaf", ("chumpy.ch", "chumpy"), ("Ch",)),
    ("selection", ("chumpy.reordering",), ("Select",)),
    ("rebuilt", ("copy_reg", "copyreg"), ("_reconstructor",)),
    ("object", ("__builtin__", "builtins"), ("object", "set", "frozenset")),
)
# The most numbers that a sparse matrix may stand for, and the deepest nesting of expressions; MANO needs 12448 and 2.
_MAX_DENSE, _MAX_DEPTH = 2**22, 8


def read_pickle(path: Path) -> Any:
    """What a MANO file holds: Python's numbers, text, lists and dictionaries, and `Inert` objects.

    Raises:
        HandError: no such file, too large, not a pickle, or one that names anything but `ADMITTED`; names the culprit.
    """
    try:
        return load_inert(read_bounded(path, "MANO file"), ADMITTED, "MANO file")
    except ValueError as error:
        raise HandError(f"{path}: {error}") from error


def numbers(value: Any, depth: int = 0) -> np.ndarray:
    """The dense array of numbers that a value of the file stands for, native byte order.

    `depth` counts the expressions around it.

    Raises:
        ValueError: it stands for none; says why.
    """
    if depth > _MAX_DEPTH:
        raise ValueError(f"holds an expression nested more than {_MAX_DEPTH} deep")
    kind = value.kind if isinstance(value, Inert) else ""
    if kind == "array":
        return array_of(value)
    if kind.startswith("sparse"):
        return _dense(value, depth + 1)
    if kind == "leaf":
        return numbers(_entry(value, "x"), depth + 1)
    if kind == "selection":
        return _selected(value, depth + 1)
    if _is_number(value) or (isinstance(value, (list, tuple)) and all(map(_is_number, value))):
        return np.asarray(value)
    raise ValueError(f"holds {kind or type(value).__name__} where numbers are expected")


def _is_number(value: object) -> bool:
    """Whether a value of Python is a number that numpy has a type for."""
    return isinstance(value, float) or (isinstance(value, int) and -(2**63) <= value < 2**63)


def _dense(value: Inert, depth: int) -> np.ndarray:
    data, indices, starts = (numbers(_entry(value, key), depth).ravel() for key in ("data", "indices", "indptr"))
    if indices.dtype.kind not in "iu" or starts.dtype.kind not in "iu":
        raise ValueError("holds a sparse matrix whose indices are no integers")
    # Signed: of unsigned ones the difference is never negative, and may be huge.
    indices, starts = indices.astype(np.int64), starts.astype(np.int64)
    shape = value.state.get("_shape", value.state.get("shape"))
    if not is_shape(shape) or len(shape) != 2 or 0 in shape:
        raise ValueError("holds a sparse matrix of shape other than two numbers")
    if shape[0] * shape[1] > _MAX_DENSE:
        raise ValueError(f"holds a sparse matrix of shape {shape!r}, larger than any of MANO's")
    major, minor = shape if value.kind == "sparse rows" else shape[::-1]
    consistent = len(starts) == major + 1 and starts[0] == 0 and starts[-1] == len(data) == len(indices)
    if (
        not consistent
        or (np.diff(starts) < 0).any()
        or (len(indices) and not 0 <= indices.min() <= indices.max() < minor)
    ):
        raise ValueError("holds a sparse matrix that does not fit together")
    dense = np.zeros((major, minor))
    np.add.at(dense, (np.repeat(np.arange(major), np.diff(starts)), indices), data)
    return dense if value.kind == "sparse rows" else dense.T


def _selected(value: Inert, depth: int) -> np.ndarray:
    source, index = (numbers(_entry(value, key), depth).ravel() for key in ("a", "idxs"))
    if index.dtype.kind not in "iu" or (len(index) and not 0 <= index.min() <= index.max() < len(source)):
        raise ValueError("holds a selection outside its array")
    shape = value.state.get("preferred_shape")
    chosen = source[index]
    return chosen if shape is None else chosen.reshape(numbers(shape, depth).astype(np.int64))


def _entry(value: Inert, key: str) -> Any:
    if not isinstance(value.state, dict) or key not in value.state:
        raise ValueError(f"holds a {value.kind} without {key!r}")
    return value.state[key]
