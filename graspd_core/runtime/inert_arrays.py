"""Arrays of numbers from the inert objects of a pickle (`inert_pickle`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from graspd_core.runtime.inert_pickle import Inert

# Types of numbers that an array may hold: booleans, integers, floats.
_NUMERIC = {"b1", *(kind + size for kind in "iu" for size in "1248"), "f2", "f4", "f8"}
# More axes than any array has.
_MOST_AXES = 8


def array_of(value: Inert) -> np.ndarray:
    """The array of numbers that an inert one stands for, native byte order. Raises ValueError: it stands for none."""
    state = value.state
    if not isinstance(state, tuple) or len(state) != 5:
        raise ValueError("holds an array without content")
    _, shape, dtype, fortran, raw = state
    kind = _dtype(dtype)
    if isinstance(raw, Inert) and raw.kind == "encoded" and raw.arguments[1:] in ((), ("latin1",), ("latin-1",)):
        raw = raw.arguments[0] if raw.arguments else None
    raw = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(raw, bytes) or not is_shape(shape):
        raise ValueError("holds an array whose content is no block of numbers")
    flat = np.frombuffer(raw, dtype=kind)
    # Of Python's integers, which cannot overflow.
    if math.prod(shape) != len(flat):
        raise ValueError(f"holds {len(flat)} numbers for an array of shape {shape}")
    return flat.astype(kind.newbyteorder("=")).reshape(shape, order="F" if fortran else "C")


def _dtype(value: Any) -> np.dtype:
    code = value.arguments[0] if isinstance(value, Inert) and value.kind == "dtype" and value.arguments else None
    if not isinstance(code, str) or code not in _NUMERIC:
        raise ValueError(f"holds an array of {_shown(code)}, which is no type of numbers")
    order = value.state[1] if isinstance(value.state, tuple) and len(value.state) > 1 else "="
    if order not in ("<", ">", "|", "="):
        raise ValueError(f"holds an array in byte order {_shown(order)}")
    return np.dtype(("<" if order in ("|", "=") else order) + code)


def _shown(value: object) -> str:
    """A value for an error. What is not text is not written out: lists in lists can be endless."""
    return repr(value[:40]) if isinstance(value, str) else f"a {type(value).__name__}"


def is_shape(value: object) -> bool:
    """Whether it is a shape that an array can have."""
    return (
        isinstance(value, tuple) and len(value) <= _MOST_AXES and all(type(n) is int and 0 <= n < 2**40 for n in value)
    )
