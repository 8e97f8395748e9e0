"""What the guesses of an object's hidden side are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspd_core.config import ReconstructionConfig
from graspd_core.pointcloud.free_space import FreeSpace
from graspd_core.reconstruction.merge_views import Surfels


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was seen of an object: other guesses of what was hidden are made of it.

    Attributes:
        seen, free_space, step: the surface, what speaks against guesses, and the spacing [m], in a frame of its own.
        rotation, origin: of that frame in the views' [m].
        chosen: the rule that the reconstruction took; empty where none applied.
        settings: of the reconstruction.
        hidden: whether a good part of the surface was.
    """

    seen: Surfels
    free_space: FreeSpace
    step: float
    rotation: Float[np.ndarray, "3 3"]
    origin: Float[np.ndarray, "3"]
    chosen: str
    settings: ReconstructionConfig
    hidden: bool
