"""Which side of a surface points are on, by the generalised winding number (Barill et al. 2018). No gradient.

Needs no closed, oriented or single surface: open, overlapping, doubled and inverted ones have an inside too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.mesh.topology import cut_long_faces
from graspd_core.types import TriangleMesh

# Points per call: igl holds Python's lock during one, so this bounds how long other threads wait (about 2 ms).
_CHUNK = 256
# Accuracy scales of the tree: at the coarse one numbers are off by up to 0.3 at a quarter of the fine one's cost.
_COARSE, _FINE = 1.0, 2.0
# A coarse number this near to one half is asked for again. Far from holes the true number is whole, so that a wrong
# answer would take an error of 0.8.
_DOUBT = 0.3


@dataclass(frozen=True, eq=False)
class WindingTree:
    """A mesh prepared for many questions.

    Attributes:
        low, high: corners of the bounding box [m].
        centre: what the tree's coordinates are about [m].
        tree: the `igl.FastWindingNumberBVH`.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    centre: Float[np.ndarray, "3"]
    tree: Any


def make_winding_tree(mesh: TriangleMesh) -> WindingTree:
    """Prepare a mesh: some 20 ms for 16,000 faces."""
    import igl

    low, high, centre = mesh.vertices.min(0), mesh.vertices.max(0), mesh.vertices.mean(0)
    # Centred, because the tree's expansion loses digits far from the origin; cut up, because the tree sums every face
    # that is long for its distance, which makes slivers ten times slower.
    cut = cut_long_faces(TriangleMesh(mesh.vertices - centre, mesh.faces), float((high - low).max()) / 10)
    tree = igl.FastWindingNumberBVH()
    tree.init(np.asarray(cut.vertices, dtype=float), np.asarray(cut.faces, dtype=np.int64))
    return WindingTree(low, high, centre, tree)


def is_inside(tree: WindingTree, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """Whether points lie inside: a winding number beyond one half, of either sign; outside the bounding box, never."""
    inside = np.all((points >= tree.low) & (points <= tree.high), axis=1)
    asked = points[inside] - tree.centre
    number = _numbers(tree, asked, _COARSE)
    doubtful = np.abs(number - 0.5) < _DOUBT
    number[doubtful] = _numbers(tree, asked[doubtful], _FINE)
    inside[inside] = number > 0.5
    return inside


def winding_inside(mesh: TriangleMesh, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """`is_inside` for one set of points; for several, keep the mesh's tree."""
    return is_inside(make_winding_tree(mesh), points)


def _numbers(tree: WindingTree, points: Float[np.ndarray, "n 3"], accuracy: float) -> Float[np.ndarray, "n"]:
    """Absolute winding numbers of points about the tree's centre."""
    chunks = [points[i : i + _CHUNK] for i in range(0, len(points), _CHUNK)]
    numbers = [np.abs(tree.tree.winding_number(np.ascontiguousarray(chunk), accuracy)) for chunk in chunks]
    return np.concatenate(numbers) if numbers else np.zeros(0)
