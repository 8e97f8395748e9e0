"""Let the compiled kernel compute distances to a mesh, and overlaps of hand and mesh. Other threads run meanwhile.

Functions in `mesh/surface_queries` and `prepared_grasp` compute the same values in Python, up to rounding. Tests
compare both. Without a compiled kernel, planning uses the Python functions.
"""

from __future__ import annotations

from ctypes import CDLL, byref
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int, UInt8

from graspd_core.hands.link_distance import core_of, hull_planes
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.mesh.surface_queries import DistanceQuery, make_distance_query
from graspd_core.mesh.surface_queries import signed_distance as python_distance
from graspd_core.mesh.topology import cut_long_faces
from graspd_core.optimize.kernel.builds import Bodies, Surface, kernel
from graspd_core.types import TriangleMesh

# Size of one node of the kernel's surface tree, in doubles. The tree has fewer than two nodes per face.
_NODE = 15


@dataclass(frozen=True, eq=False)
class CompiledQuery:
    """A mesh in the form that the kernel needs for distance queries. Several threads may use it at the same time.

    `surface` holds the addresses of the arrays `nodes` and `triangles`. The kernel reads the arrays at these addresses.
    """

    library: CDLL
    surface: Surface
    nodes: Float[np.ndarray, "nodes 15"]
    triangles: Float[np.ndarray, "faces 9"]


def make_query(mesh: TriangleMesh) -> CompiledQuery | DistanceQuery:
    """Prepare a mesh for distance queries with the kernel. If there is no kernel, prepare the mesh for libigl."""
    library = kernel().library
    if library is None:
        return make_distance_query(mesh)
    # Long faces make wide tree nodes. Queries near a node visit each of its faces, which is slow. So cut long faces.
    cut = cut_long_faces(mesh, float(np.ptp(mesh.vertices, axis=0).max()) / 3)
    corners = np.ascontiguousarray(cut.vertices[cut.faces], dtype=float).reshape(-1, 9)
    nodes, triangles = np.zeros((2 * len(corners), _NODE)), np.empty_like(corners)
    if library.graspd_build_surface(len(corners), corners.ctypes.data, nodes.ctypes.data, triangles.ctypes.data):
        raise MemoryError(f"not enough memory to prepare a mesh of {len(corners)} triangles for distance queries")
    return CompiledQuery(library, Surface(nodes.ctypes.data, triangles.ctypes.data), nodes, triangles)


def signed_distance(
    query: CompiledQuery | DistanceQuery,
    points: Float[np.ndarray, "n 3"],
    *,
    order: Int[np.ndarray, "n"] | None = None,
    reach: float = np.inf,
) -> Float[np.ndarray, "n"]:
    """Return each point's distance [m] to the mesh, negative inside. Beyond `reach` [m], return a lower bound.

    Pass `order` for a faster query: the int32 indices of the points, with near points next to each other.
    """
    if isinstance(query, DistanceQuery):
        return python_distance(query, points, reach=reach)
    points, distance = np.ascontiguousarray(points, dtype=float), np.empty(len(points))
    arguments = len(points), points.ctypes.data, None if order is None else order.ctypes.data, reach
    if query.library.graspd_signed_distance(byref(query.surface), *arguments, distance.ctypes.data):
        raise MemoryError(f"not enough memory for the distances of {len(points)} points to a mesh")
    return distance


@dataclass(frozen=True, eq=False)
class CompiledHand:
    """The collision primitives of a hand in the kernel's layout.

    Attributes:
        bodies: number of primitives, number of links, and the memory addresses at which the kernel reads `arrays`.
        arrays: poses, bounding spheres, sizes, kinds, links and hull planes of the primitives.
        apart: 1 for each pair of links that must not touch, else 0.
    """

    bodies: Bodies
    arrays: tuple[np.ndarray, ...]
    apart: UInt8[np.ndarray, "links links"]


@lru_cache(maxsize=8)
def compiled_hand(hand: HandModel) -> CompiledHand:
    """Return the collision primitives of a hand in the kernel's layout."""
    solids = sorted(hand.primitives, key=lambda primitive: primitive.link)
    poses = [np.column_stack([solid.rotation, solid.translation]).ravel() for solid in solids]
    planes = [np.column_stack(hull_planes(solid)) if solid.kind == "hull" else np.zeros((0, 4)) for solid in solids]
    starts = np.cumsum([0, *(len(some) for some in planes)])
    cores = [core_of(solid) for solid in solids]
    arrays = (
        _doubles(poses),
        _doubles([_ball(solid) for solid in solids]),
        _doubles([core for core, _ in cores]),
        _doubles([radius for _, radius in cores]),
        *(
            np.array(values, dtype=np.int32)
            for values in ([solid.kind == "cylinder" for solid in solids], [solid.link for solid in solids], starts)
        ),
        _doubles(np.concatenate([np.zeros((0, 4)), *planes])),
    )
    bodies = Bodies(len(solids), hand.num_links, *(array.ctypes.data for array in arrays))
    return CompiledHand(bodies, arrays, np.ascontiguousarray(~hand.adjacent, dtype=np.uint8))


def _doubles(values: object) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=float)


def _ball(solid: Primitive) -> tuple[float, ...]:
    """Return centre and radius of a primitive's bounding sphere, in the primitive's own frame [m]."""
    if solid.kind == "hull":
        center = (solid.vertices.min(0) + solid.vertices.max(0)) / 2
        return (*center, float(np.linalg.norm(solid.vertices - center, axis=1).max()))
    reach = sum(solid.size) if solid.kind in ("sphere", "capsule") else float(np.linalg.norm(solid.size))
    return (0.0, 0.0, 0.0, reach)


# Link poses. Each row is a flattened 3 x 4 matrix: rotation and translation [m].
_Links = Float[np.ndarray, "links 12"]


def depth_in_hand(
    query: CompiledQuery,
    hand: HandModel,
    links: _Links,
    points: Float[np.ndarray, "n 3"],
    link_of: Int[np.ndarray, "n"] | None = None,
) -> float:
    """Return the greatest depth of any point inside the hand's primitives [m], 0 if no point is inside.

    `links` are link poses in the frame of `points`. For points on the hand, `link_of` holds the link index of each
    point. Then a point's own link and adjacent links do not count.
    """
    compiled, depth, points = compiled_hand(hand), np.empty(1), _doubles(points)
    of = None if link_of is None else np.ascontiguousarray(link_of, dtype=np.int32)
    apart = None if of is None else compiled.apart.ctypes.data
    of_at = None if of is None else of.ctypes.data
    arguments = len(points), points.ctypes.data, of_at, apart, depth.ctypes.data
    if query.library.graspd_hand_depth(byref(compiled.bodies), links.ctypes.data, *arguments):
        raise MemoryError(f"not enough memory for the depth of {len(points)} points in the hand")
    return float(depth[0])


def shared_volume(query: CompiledQuery, hand: HandModel, links: _Links, cell: float) -> float:
    """Return the volume of the hand's part inside a mesh [m³], summed over grid cells of width `cell` [m]."""
    volume = np.empty(1)
    arguments = links.ctypes.data, byref(query.surface), cell, volume.ctypes.data
    if query.library.graspd_shared_volume(byref(compiled_hand(hand).bodies), *arguments):
        raise MemoryError("not enough memory for the overlap volume of hand and object")
    return float(volume[0])
