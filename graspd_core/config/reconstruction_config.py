"""Settings of the reconstruction of objects."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReconstructionConfig:
    """How the views of an object become a closed mesh.

    Attributes:
        max_points: points of all views together that are used; this bounds the time.
        neighbours: points that each local plane is fitted to; more of them smooth noise and detail alike.
        stray_distance: points farther than this from their neighbours' plane are flying pixels [m].
        outline_slack: cameras see outlines and surfaces to within this [m].
        surface_tolerance: a guessed point this near to a seen surface confirms the guess [m].
        open_share: a surface with a smaller share missing is not completed.
        revolution_share: a body of revolution explains this share of what was seen, at least.
        symmetry_worth: a symmetry of a lower score is chance; the highest score is 2.6.
        poisson_cell: the finest cells of the Poisson surface are wider than this: twice the camera's noise [m].
        min_cell: least cell of the grid that the surface is closed on [m].
        fit_distance: 85 % of the seen points lie this near to the mesh, or it is refused [m].
        max_faces: faces of the mesh, at most.
        seen_distance: surface this near to a seen point has confidence 1 [m].
        guessed_distance: surface farther than this from all seen points has confidence 0 [m].
    """

    max_points: int = 160_000
    neighbours: int = 28
    stray_distance: float = 0.006
    outline_slack: float = 0.003
    surface_tolerance: float = 0.004
    open_share: float = 0.12
    revolution_share: float = 0.8
    symmetry_worth: float = 0.5
    poisson_cell: float = 0.0022
    min_cell: float = 0.0017
    fit_distance: float = 0.004
    max_faces: int = 16_000
    seen_distance: float = 0.004
    guessed_distance: float = 0.02
