"""What a MANO file may name; every other name is refused, and none is called (`runtime/inert_pickle`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graspd_core.errors import HandError
from graspd_core.runtime.inert_pickle import NUMPY_NAMES, load_inert, makers, read_bounded

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


def read_pickle(path: Path) -> Any:
    """What a MANO file holds: Python's numbers, text, lists and dictionaries, and `Inert` objects.

    Raises:
        HandError: no such file, too large, not a pickle, or one that names anything but `ADMITTED`; names the culprit.
    """
    try:
        return load_inert(read_bounded(path, "MANO file"), ADMITTED, "MANO file")
    except ValueError as error:
        raise HandError(f"{path}: {error}") from error
