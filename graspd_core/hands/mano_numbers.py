"""The numbers that the inert objects of a MANO file stand for: arrays, sparse matrices, chumpy's expressions."""

from __future__ import annotations

from typing import Any

import numpy as np

from graspd_core.hands.mano_pickle import Array, Dtype, Inert, Leaf, Select, Sparse, SparseRows

# The most numbers that a sparse matrix may stand for, and the deepest nesting of expressions; MANO needs 12448 and 2.
_MAX_DENSE, _MAX_DEPTH = 2**22, 8
# Kinds of numbers that an array may hold: booleans, integers, floats.
_NUMERIC = "biuf"


def numbers(value: Any, depth: int = 0) -> np.ndarray:
    """The dense array of numbers that a value of the file stands for, native byte order.

    `depth` counts the expressions around it.

    Raises:
        ValueError: it stands for none; says why.
    """
    if depth > _MAX_DEPTH:
        raise ValueError(f"holds an expression nested more than {_MAX_DEPTH} deep")
    if isinstance(value, Array):
        return _array(value)
    if isinstance(value, Sparse):
        return _dense(value, depth + 1)
    if isinstance(value, Leaf):
        return numbers(_entry(value, "x"), depth + 1)
    if isinstance(value, Select):
        return _selected(value, depth + 1)
    if isinstance(value, (bool, int, float)):
        return np.asarray(value)
    if isinstance(value, (list, tuple)) and all(isinstance(x, (bool, int, float)) for x in value):
        return np.asarray(value)
    raise ValueError(f"holds {type(value).__name__} where numbers are expected")


def _array(value: Array) -> np.ndarray:
    state = value.state
    if not isinstance(state, tuple) or len(state) != 5:
        raise ValueError("holds an array without content")
    _, shape, dtype, fortran, raw = state
    kind = _dtype(dtype)
    raw = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(raw, bytes) or not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("holds an array whose content is no block of numbers")
    flat = np.frombuffer(raw, dtype=kind)
    # Checked in Python's integers, which cannot overflow.
    count = 1
    for n in shape:
        count *= n
    if count != len(flat):
        raise ValueError(f"holds {len(flat)} numbers for an array of shape {shape}")
    return flat.astype(kind.newbyteorder("=")).reshape(shape, order="F" if fortran else "C")


def _dtype(value: Any) -> np.dtype:
    code = value.arguments[0] if isinstance(value, Dtype) and value.arguments else None
    if not isinstance(code, str) or len(code) > 3 or code[:1] not in _NUMERIC or not code[1:].isdigit():
        raise ValueError(f"holds an array of {code!r}, which is no type of numbers")
    order = value.state[1] if isinstance(value.state, tuple) and len(value.state) > 1 else "="
    if order not in ("<", ">", "|", "="):
        raise ValueError(f"holds an array in byte order {order!r}")
    return np.dtype(("<" if order in ("|", "=") else order) + code)


def _dense(value: Sparse, depth: int) -> np.ndarray:
    data, indices, starts = (numbers(_entry(value, key), depth).ravel() for key in ("data", "indices", "indptr"))
    state = value.state
    shape = state.get("_shape", state.get("shape"))
    if not isinstance(shape, tuple) or len(shape) != 2 or not all(type(n) is int and n > 0 for n in shape):
        raise ValueError(f"holds a sparse matrix of shape {shape!r}")
    if shape[0] * shape[1] > _MAX_DENSE:
        raise ValueError(f"holds a sparse matrix of shape {shape!r}, larger than any of MANO's")
    major, minor = shape if isinstance(value, SparseRows) else shape[::-1]
    consistent = len(starts) == major + 1 and starts[0] == 0 and starts[-1] == len(data) == len(indices)
    if (
        not consistent
        or (np.diff(starts) < 0).any()
        or (len(indices) and not 0 <= indices.min() <= indices.max() < minor)
    ):
        raise ValueError("holds a sparse matrix that does not fit together")
    dense = np.zeros((major, minor))
    np.add.at(dense, (np.repeat(np.arange(major), np.diff(starts)), indices), data)
    return dense if isinstance(value, SparseRows) else dense.T


def _selected(value: Select, depth: int) -> np.ndarray:
    source, index = (numbers(_entry(value, key), depth).ravel() for key in ("a", "idxs"))
    if index.dtype.kind not in "iu" or (len(index) and not 0 <= index.min() <= index.max() < len(source)):
        raise ValueError("holds a selection outside its array")
    shape = value.state.get("preferred_shape")
    chosen = source[index]
    return chosen if shape is None else chosen.reshape(numbers(shape, depth).astype(np.int64))


def _entry(value: Inert, key: str) -> Any:
    if not isinstance(value.state, dict) or key not in value.state:
        raise ValueError(f"holds a {type(value).__name__} without {key!r}")
    return value.state[key]
