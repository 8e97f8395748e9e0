"""Read a MANO file: template, blend shapes, weights and tree (Romero, Tzionas and Black 2017).

The file is licensed and not part of graspd. Users download it from https://mano.is.tue.mpg.de. The pickle may contain
only data, arrays, sparse matrices and chumpy expressions. No code of the pickle runs (`runtime/inert_pickle`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from graspd_core.errors import HandError
from graspd_core.runtime.inert_pickle import NUMPY_NAMES, Inert, array_of, is_shape, load_inert, makers, read_bounded

# The state of a sparse matrix has data, indices, indptr and the shape. A leaf of chumpy has the value `x`. A selection
# of chumpy has the entries `idxs` of the flattened array `a`, reshaped to `preferred_shape`. The same class has
# different names in Python 2 and 3, and in old and new scipy.
ADMITTED = NUMPY_NAMES | makers(
    ("sparse columns", ("scipy.sparse.csc", "scipy.sparse._csc"), ("csc_matrix",)),
    ("sparse rows", ("scipy.sparse.csr", "scipy.sparse._csr"), ("csr_matrix",)),
    ("leaf", ("chumpy.ch", "chumpy"), ("Ch",)),
    ("selection", ("chumpy.reordering",), ("Select",)),
    ("rebuilt", ("copy_reg", "copyreg"), ("_reconstructor",)),
    ("object", ("__builtin__", "builtins"), ("object", "set", "frozenset")),
)
# Greatest number of entries of a sparse matrix, and deepest nesting of expressions. MANO needs 12448 and 2.
_MAX_DENSE, _MAX_DEPTH = 2**22, 8


def read_pickle(path: Path) -> Any:
    """Return the content of a MANO file: numbers, text, lists, dictionaries, and class instances as `Inert` data.

    Raises HandError: the file is missing, is too large, is not a pickle, or has a class or function not in `ADMITTED`.
    """
    try:
        return load_inert(read_bounded(path, "MANO file"), ADMITTED, "MANO file")
    except ValueError as error:
        raise HandError(f"{path}: {error}") from error


def numbers(value: Any, depth: int = 0) -> np.ndarray:
    """Return the dense array of numbers that a value of the file represents.

    `depth` is the number of values in which the value is nested. Raises ValueError: the value is not numeric.
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
    return isinstance(value, float) or (isinstance(value, int) and -(2**63) <= value < 2**63)


def _dense(value: Inert, depth: int) -> np.ndarray:
    data, indices, starts = (numbers(_entry(value, key), depth).ravel() for key in ("data", "indices", "indptr"))
    if indices.dtype.kind not in "iu" or starts.dtype.kind not in "iu":
        raise ValueError("holds a sparse matrix whose indices are not integers")
    # Indices become signed, because differences of unsigned numbers wrap around.
    indices, starts = indices.astype(np.int64), starts.astype(np.int64)
    shape = value.state.get("_shape", value.state.get("shape"))
    if not is_shape(shape) or len(shape) != 2 or 0 in shape:
        raise ValueError("holds a sparse matrix whose shape is not two positive numbers")
    if shape[0] * shape[1] > _MAX_DENSE:
        raise ValueError(f"holds a sparse matrix of shape {shape!r}; valid: at most {_MAX_DENSE} entries")
    major, minor = shape if value.kind == "sparse rows" else shape[::-1]
    consistent = len(starts) == major + 1 and starts[0] == 0 and starts[-1] == len(data) == len(indices)
    if (
        not consistent
        or (np.diff(starts) < 0).any()
        or (len(indices) and not 0 <= indices.min() <= indices.max() < minor)
    ):
        raise ValueError("holds a sparse matrix whose indices do not fit its shape and data")
    dense = np.zeros((major, minor))
    np.add.at(dense, (np.repeat(np.arange(major), np.diff(starts)), indices), data)
    return dense if value.kind == "sparse rows" else dense.T


def _selected(value: Inert, depth: int) -> np.ndarray:
    source, index = (numbers(_entry(value, key), depth).ravel() for key in ("a", "idxs"))
    if index.dtype.kind not in "iu":
        raise ValueError(f"holds indices of type {index.dtype}; valid: integers")
    if len(index) and not 0 <= index.min() <= index.max() < len(source):
        given = f"indices from {index.min()} to {index.max()} into an array of {len(source)} numbers"
        raise ValueError(f"holds {given}; valid: 0 to {len(source) - 1}")
    shape = value.state.get("preferred_shape")
    chosen = source[index]
    return chosen if shape is None else chosen.reshape(numbers(shape, depth).astype(np.int64))


def _entry(value: Inert, key: str) -> Any:
    if not isinstance(value.state, dict) or key not in value.state:
        raise ValueError(f"holds a {value.kind} without {key!r}")
    return value.state[key]


# The sixteen bodies, each named after its bone. 1 is the knuckle, 3 the last joint. In MANO's order the little finger
# comes before the ring finger.
FINGERS = ("index", "middle", "pinky", "ring", "thumb")
BODIES = ("wrist", *(f"{finger}{number}" for finger in FINGERS for number in (1, 2, 3)))
PARENTS = (-1, *(0 if number == 1 else 3 * finger + number - 1 for finger in range(5) for number in (1, 2, 3)))
# Number of inputs of the pose blend shapes: the entries of fifteen rotation matrices.
POSE_FEATURES = 9 * 15


@dataclass(frozen=True, eq=False)
class ManoData:
    """A MANO model in float64.

    Attributes:
        path: path of the file.
        template: vertices of the mean shape at rest [m].
        shape_directions: displacement of each vertex per unit of each shape coefficient [m].
        pose_directions: displacement of each vertex per entry of R − I, row by row [m]. R is the rotation of a body.
        joint_regressor: weights of the vertices in the weighted sum that gives each joint position.
        weights: skinning weights. Each row sums to one.
        faces: triangles, counter-clockwise seen from outside. The mesh is open at the wrist.
        mean: mean pose, as axis-angle vectors of bodies 1 to 15 [rad].
    """

    path: Path
    template: Float[np.ndarray, "vertices 3"]
    shape_directions: Float[np.ndarray, "vertices 3 shapes"]
    pose_directions: Float[np.ndarray, "vertices 3 135"]
    joint_regressor: Float[np.ndarray, "16 vertices"]
    weights: Float[np.ndarray, "vertices 16"]
    faces: Int[np.ndarray, "faces 3"]
    mean: Float[np.ndarray, "45"]


def read_mano(path: Path) -> ManoData:
    """Read and check a MANO file (.pkl) as downloaded.

    Raises HandError: the file cannot be read, would run code, or has a wrong entry. The message names file and entry.
    """
    content = read_pickle(path)
    if not isinstance(content, Mapping):
        raise HandError(f"{path}: holds {type(content).__name__}; valid: a dictionary, as in a MANO file")
    template = _read(path, content, "v_template", (None, 3))
    count = len(template)
    data = ManoData(
        path=path,
        template=template,
        shape_directions=_read(path, content, "shapedirs", (count, 3, None)),
        pose_directions=_read(path, content, "posedirs", (count, 3, POSE_FEATURES)),
        joint_regressor=_read(path, content, "J_regressor", (len(BODIES), count)),
        weights=_read(path, content, "weights", (count, len(BODIES))),
        faces=_read(path, content, "f", (None, 3)).astype(np.int64),
        mean=_read(path, content, "hands_mean", (45,)),
    )
    tree = _read(path, content, "kintree_table", (2, len(BODIES))).astype(np.int64)
    # The root's parent is -1, which is the largest number in an unsigned table. So the root's entry is not compared.
    if not np.array_equal(tree[1], range(len(BODIES))) or tuple(tree[0, 1:]) != PARENTS[1:]:
        raise HandError(f"{path}: kintree_table is not MANO's tree of a wrist and five fingers of three joints")
    for key, rows in (("weights", data.weights), ("J_regressor", data.joint_regressor)):
        if np.abs(rows.sum(1) - 1.0).max() > 0.01:
            raise HandError(f"{path}: {key}: rows do not sum to one; valid: 1 within 0.01")
    if len(data.faces) == 0 or data.faces.min() < 0 or data.faces.max() >= count:
        raise HandError(f"{path}: f: no faces, or vertex indices outside 0 to {count - 1}")
    bare = set(range(len(BODIES))) - set(data.weights.argmax(1).tolist())
    if bare:
        raise HandError(f"{path}: weights: no vertex belongs to {', '.join(BODIES[i] for i in sorted(bare))}")
    return data


def _read(path: Path, content: Mapping[str, Any], key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return an entry as float64. A None in `shape` allows any positive size."""
    if key not in content:
        known = ", ".join(sorted(str(name)[:40] for name in content)[:20])
        raise HandError(f"{path}: {key} is missing; the file has {known}")
    try:
        # NaN values are detected below. Here numpy would warn of signalling NaNs.
        with np.errstate(invalid="ignore"):
            array = numbers(content[key]).astype(np.float64)
    except ValueError as error:
        raise HandError(f"{path}: {key}: {error}") from error
    fits = len(array.shape) == len(shape) and all(
        n == m or (m is None and n) for n, m in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted = " x ".join("any" if n is None else str(n) for n in shape)
        raise HandError(f"{path}: {key} has shape {' x '.join(map(str, array.shape))}; valid: {wanted}")
    if not np.isfinite(array).all():
        raise HandError(f"{path}: {key} has entries that are not finite")
    return array
