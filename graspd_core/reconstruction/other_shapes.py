"""Other shapes that what was seen allows: its hidden side guessed by the rules that were not chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graspd_core.errors import GraspdError
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.reconstruction.evidence import Evidence
from graspd_core.reconstruction.grid_poisson import grid_poisson_field
from graspd_core.reconstruction.merge_views import thin
from graspd_core.reconstruction.reconstruct import closed_mesh
from graspd_core.reconstruction.shape_completion import RULES, guess_by
from graspd_core.types import TriangleMesh

# A trial feels no finer detail: spacing of points, cells along the longest side, faces.
_STEP_M, _CELLS, _FACES = 0.003, 40, 4000
# Two shapes nearer to each other than this are one [m].
_SAME_M = 5e-4
_SAMPLES = 1500


def other_rules(evidence: Evidence) -> tuple[str, ...]:
    """The rules that the reconstruction did not take, the quickest first; none where nothing was hidden."""
    # The later in `RULES`, the less is looked for in what was seen.
    return tuple(rule for rule in reversed(RULES) if rule != evidence.chosen) if evidence.hidden else ()


def other_shape(evidence: Evidence, rule: str, than: TriangleMesh) -> TriangleMesh | None:
    """The object with its hidden side guessed by a rule, in the frame of the views [m].

    None where the rule says nothing, no closed surface fits what it says, or the surface is that of `than`.
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
