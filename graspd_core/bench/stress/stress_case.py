"""What a stress case is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from graspd_core.scene.scene import Scene
from graspd_core.types import TriangleMesh

Family = Literal["mesh", "cloud", "physics", "numbers", "hand"]

# An ending that is a verified grasp; the others are names of `Outcome` or of a `GraspdError`.
GRASP = "grasp"


@dataclass(frozen=True, eq=False)
class Case:
    """One thing that breaks methods.

    Attributes:
        name: unique, words joined by dashes.
        family: what of it is broken.
        about: what is wrong, one line.
        scene: makes the input in a folder of its own and loads it as a user would; may raise a GraspdError.
        expect: the endings that are right: "grasp", names of `Outcome` ("TOO_FEW") or of an error ("MeshError").
        whole: a meaningful solid, or an object that can be seen: counted in the share that ends in a verified grasp.
        hand: by name or path.
        deadline: seconds that planning is given.
        loading: seconds that loading may take.
        memory: most that the process may use at its peak, the libraries' own included [MB].
        options: further arguments of `plan_grasps`.
        told: words that the user must read.
        truth: the true object, in the scene's frame, where the scene is only what cameras saw of it.
    """

    name: str
    family: Family
    about: str
    scene: Callable[[Path], Scene]
    expect: tuple[str, ...] = (GRASP,)
    whole: bool = True
    hand: str = "allegro_right"
    deadline: float = 20.0
    loading: float = 15.0
    memory: float = 2000.0
    options: dict[str, Any] = field(default_factory=dict)
    told: str = ""
    truth: Callable[[], TriangleMesh] | None = None
