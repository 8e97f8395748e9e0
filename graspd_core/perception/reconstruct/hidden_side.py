"""An object's hidden side: the next best view of it, and its other possible shapes.

Other shapes are guessed by the rules that the reconstruction did not choose.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from graspd_core.errors import GraspdError
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.surface_queries import first_hits, make_surface, surface_distance
from graspd_core.mesh.topology import moved_mesh
from graspd_core.perception.cloud.point_cloud import Points, Vector
from graspd_core.perception.reconstruct.merge_views import Evidence, thin
from graspd_core.perception.reconstruct.poisson import grid_poisson_field
from graspd_core.perception.reconstruct.reconstruct import closed_mesh
from graspd_core.perception.reconstruct.shape_completion import RULES, guess_by
from graspd_core.se3 import perpendicular
from graspd_core.types import TriangleMesh

# Heights above the support that a camera may look from, and directions around the object.
_ELEVATIONS, _AZIMUTHS = np.deg2rad([25.0, 50.0, 75.0]), 12
# Places on a surface that is looked at or compared.
_SAMPLES = 1500
# Surface that a camera sees flatter than this [cosine] it hardly sees.
_FLAT = 0.2
# A ray meets the sample's own face within this share of its length.
_NEAR = 0.98
# A trial feels no finer detail: spacing of points, cells along the longest side, faces.
_STEP_M, _CELLS, _FACES = 0.003, 40, 4000
# Two shapes nearer to each other than this are one [m].
_SAME_M = 5e-4


def next_view(evidence: Evidence, mesh: TriangleMesh, shift: Vector) -> Float[np.ndarray, "4 4"] | None:
    """Return `T_views_camera` [m] (z forward, y down) of the further view that shows most of the hidden side.

    Candidates lie around the object, above its support, as far away as the first camera. The surface counts as hidden
    if it is farther from all seen points than the cameras' precision.

    Args:
        evidence: what was seen.
        mesh: the object as reconstructed, in the frame of the views [m].
        shift: added to the camera's position [m].

    Returns:
        None if no candidate shows anything new, or if no camera position is known.
    """
    from scipy.spatial import KDTree

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
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-9 else perpendicular(forward)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(forward, right), forward, eye])
    return pose


def other_rules(evidence: Evidence) -> tuple[str, ...]:
    """Return the rules that the reconstruction did not take, the quickest first, none if nothing was hidden."""
    # The later in `RULES`, the less is looked for in what was seen.
    return tuple(rule for rule in reversed(RULES) if rule != evidence.chosen) if evidence.hidden else ()


def other_shape(evidence: Evidence, rule: str, than: TriangleMesh) -> TriangleMesh | None:
    """Return the object with its hidden side guessed by a rule, in the frame of the views [m].

    None if the rule makes no guess, no closed surface fits it, or the surface is that of `than`.
    """
    step = max(evidence.step, _STEP_M)
    seen = thin(evidence.seen, step)
    guess = guess_by(rule, seen, evidence.free_space, step)
    if guess is None:
        return None
    settings = replace(evidence.settings, max_faces=min(evidence.settings.max_faces, _FACES))
    try:
        mesh = closed_mesh(seen, guess, evidence.free_space, step, settings, grid_poisson_field, _CELLS)
    except GraspdError:
        return None
    mesh = TriangleMesh(mesh.vertices @ evidence.rotation.T + evidence.origin, mesh.faces)
    apart = surface_distance(make_surface(than), surface_samples(mesh, _SAMPLES, seed=0)[0])
    return None if float(np.mean(apart)) < _SAME_M else mesh
