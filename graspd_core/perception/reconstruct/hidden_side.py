"""Find the camera view that would show most of an object's hidden side, and other shapes that this side may have.

The other shapes are a mirrored one and a body of revolution. On views of `benchmarks/held_shares.py`, they tell grasps
that hold on the true object from those that do not. Extrusion, point symmetry and smooth closing told next to nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_core.errors import GraspdError
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.surface_queries import first_hits, make_surface, surface_distance
from graspd_core.mesh.topology import moved_mesh
from graspd_core.perception.cloud.point_cloud import Points, Vector
from graspd_core.perception.reconstruct.merge_views import Evidence, thin
from graspd_core.perception.reconstruct.poisson import grid_poisson_field
from graspd_core.perception.reconstruct.reconstruct import closed_mesh
from graspd_core.perception.reconstruct.shape_completion import MIRROR, REVOLUTION, guess_by
from graspd_core.types import TriangleMesh

# Elevations above the support [rad], and number of azimuths, of the candidate views.
_ELEVATIONS, _AZIMUTHS = np.deg2rad([25.0, 50.0, 75.0]), 12
# Number of points on a surface that is viewed or compared.
_SAMPLES = 1500
# A surface is visible only if the cosine between its normal and the direction to the camera is above this.
_FLAT = 0.2
# A ray reaches a sample if its first hit is beyond this fraction of the distance to the sample.
_NEAR = 0.98
# Of the other shapes: point spacing [m], cells along the longest side, and faces. Trials need no finer detail.
_STEP_M, _CELLS, _FACES = 0.003, 40, 4000
# Two shapes count as equal if their mean distance is below this [m].
_SAME_M = 5e-4


def next_view(evidence: Evidence, mesh: TriangleMesh, shift: Vector) -> Float[np.ndarray, "4 4"] | None:
    """Return the camera pose that would show most of the hidden side, as `T_views_camera` [m] (z forward, y down).

    Candidate poses lie around the object, above its support, as far away as the first camera. Surface is hidden if it
    is farther from all seen points than the setting `seen_distance` plus the point spacing.

    Args:
        evidence: what the cameras saw.
        mesh: the reconstructed object, in the frame of the views [m].
        shift: offset that is added to the position of the returned pose [m].

    Returns:
        The pose. None if no candidate shows any hidden surface, or if no camera position is known.
    """
    if not evidence.free_space.view_depths:
        return None
    points, normals = surface_samples(mesh, _SAMPLES, seed=0)
    local = (points - evidence.origin) @ evidence.rotation
    hidden = KDTree(evidence.seen.points).query(local)[0] > evidence.settings.seen_distance + evidence.step
    points, normals = points[hidden], normals[hidden]
    centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    first = evidence.free_space.view_depths[0].eye @ evidence.rotation.T + evidence.origin
    ways = _ways(evidence.rotation)
    eyes = centre + float(np.linalg.norm(first - centre)) * ways
    shown = [_visible(mesh, eye, points, normals) for eye in eyes]
    best = int(np.argmax(shown))
    return _looking(eyes[best] + shift, -ways[best], evidence.rotation[:, 2]) if shown[best] > 0 else None


def _ways(rotation: Float[np.ndarray, "3 3"]) -> Points:
    azimuth, elevation = np.meshgrid(2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS, _ELEVATIONS)
    level = np.cos(elevation)
    way = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    return way @ rotation.T


def _visible(mesh: TriangleMesh, eye: Vector, points: Points, normals: Points) -> int:
    sight = points - eye
    faces = -(sight * normals).sum(1) > _FLAT * np.linalg.norm(sight, axis=1)
    return int((first_hits(moved_mesh(mesh, -eye), sight[faces])[0] > _NEAR).sum())


def _looking(eye: Vector, forward: Vector, up: Vector) -> Float[np.ndarray, "4 4"]:
    # No candidate looks straight down, so the two are never parallel.
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(forward, right), forward, eye])
    return pose


def other_rules(evidence: Evidence) -> tuple[str, ...]:
    """Return the rules of the other shapes, without the rule that was used. Empty if nothing was hidden."""
    return tuple(rule for rule in (MIRROR, REVOLUTION) if rule != evidence.chosen) if evidence.hidden else ()


def other_shape(evidence: Evidence, rule: str, than: TriangleMesh) -> TriangleMesh | None:
    """Return the object's mesh with its hidden side guessed by `rule`, in the frame of the views [m].

    Return None if the rule makes no guess, if no closed surface fits, or if the shape is almost that of `than`.
    """
    step = max(evidence.step, _STEP_M)
    settings = replace(evidence.settings, max_faces=min(evidence.settings.max_faces, _FACES))
    evidence = replace(evidence, seen=thin(evidence.seen, step), step=step, settings=settings)
    guess = guess_by(rule, evidence.seen, evidence.free_space, step)
    if guess is None:
        return None
    try:
        mesh = closed_mesh(evidence, guess, grid_poisson_field, _CELLS)
    except GraspdError:
        return None
    mesh = TriangleMesh(mesh.vertices @ evidence.rotation.T + evidence.origin, mesh.faces)
    apart = surface_distance(make_surface(than), surface_samples(mesh, _SAMPLES, seed=0)[0])
    return None if float(np.mean(apart)) < _SAME_M else mesh
