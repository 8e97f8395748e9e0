"""Sessions. A session is what the viewer shows: grasps, their hand, and the object if it can be loaded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import FormatError, GraspdError, short_repr
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.hands.model import HandModel, all_joint_names
from graspd_core.io.grasps_json import grasps_of, load_document
from graspd_core.optimize.plan_config import PlanConfig, plan_config
from graspd_core.perception.cloud.cloud_files import is_cloud_file
from graspd_core.perception.load_scene import SHAPE_PREFIX, load_scene, scaled_views
from graspd_core.perception.scene import Scene, moved_grasp
from graspd_core.planning.plan_grasps import planning_scene
from graspd_core.types import Grasp, TriangleMesh


@dataclass(frozen=True, eq=False)
class Session:
    """What the viewer shows at a time.

    Attributes:
        title: title of the page.
        hand: the hand of the grasps.
        grasps: grasps in rank order.
        scene: scene of the object. None if the object cannot be loaded. Then only the grasps are shown.
        seen: camera points in the object's frame [m]. Empty for a mesh.
        notes: warnings for visitors, one sentence each.
        origin: the session's origin in the file's frame [m]. Zero unless the object is far from the file's origin.
    """

    title: str
    hand: HandModel
    grasps: tuple[Grasp, ...]
    scene: Scene | None = None
    seen: Float[np.ndarray, "points 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    notes: tuple[str, ...] = ()
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))


def open_grasps(path: Path, *, object_source: str | None = None, hand: str | None = None) -> Session:
    """Open a grasps file with its object and hand.

    The session gets a note if the file's object cannot be read, or differs from the planned object.

    Args:
        path: path of a file in the format graspd/grasps.
        object_source: mesh file, cloud file or shape:NAME. If None, the object that the file names.
        hand: name or path of a hand. If None, the hand that the file names.

    Raises:
        FormatError: the file cannot be read, or its joints or its base link are not those of the hand.
        HandError: the hand cannot be read.
        GraspdError: `object_source` cannot be read.
    """
    document = load_document(path)
    grasps = grasps_of(document, str(path))
    model = _hand_of(document, path, hand)
    config = plan_config(document.get("config") or {}, f"{path}: config")
    scene, seen, notes = _object_of(document, path, object_source, config)
    # Among the planner's warnings are its assumptions, such as the object's mass.
    outcome = document.get("outcome")
    warnings = outcome.get("warnings") if isinstance(outcome, dict) else None
    notes = tuple(dict.fromkeys((*notes, *map(str, warnings if isinstance(warnings, list) else ()))))
    if scene is None:
        return Session(path.name, model, grasps, notes=notes)
    return make_session(path.name, model, grasps, scene, config, seen, notes)


def make_session(
    title: str,
    hand: HandModel,
    grasps: tuple[Grasp, ...],
    scene: Scene,
    config: PlanConfig,
    seen: Float[np.ndarray, "points 3"],
    notes: tuple[str, ...],
    *,
    mass: float | None = None,
) -> Session:
    """Make a session. Move a distant object to the origin, as a browser's float32 is coarse for large coordinates.

    `mass` is the object's mass in the trials of the grasps [kg]. None: the scene's.
    """
    scene, far = planning_scene(scene, config.resolution)
    scene = replace(scene, object=scene.object.at_mass(mass or scene.object.mass))
    return Session(title, hand, tuple(moved_grasp(g, -far) for g in grasps), scene, seen - far, notes, far)


def seen_points(
    source: str | TriangleMesh, scale: float = 1.0, camera: str | Path | None = None
) -> Float[np.ndarray, "points 3"]:
    """Return the points of a cloud file, or of a depth image with its `camera` file [m]. Other sources have none."""
    if isinstance(source, TriangleMesh) or (camera is None and not is_cloud_file(source)):
        return np.zeros((0, 3))
    points = np.concatenate([view.points for view in scaled_views(source, camera, scale)])
    return points[np.isfinite(points).all(1)]


def _hand_of(document: dict[str, Any], path: Path, wanted: str | None) -> HandModel:
    named = document.get("hand")
    named = named if isinstance(named, dict) else {}
    source = wanted or (named.get("name") if named.get("name") in hand_names() else named.get("urdf"))
    if not isinstance(source, str):
        raise FormatError(f"{path}: names no hand; give the hand with --hand")
    hand = load_hand(source)
    if list(all_joint_names(hand)) != named.get("joint_names"):
        raise FormatError(f"{path}: its joints are not those of {source}; name the hand with --hand")
    # The file names a hand's URDF, not its description, which may begin the hand at a later link (`root`).
    if (base := named.get("base_link", hand.base_link)) != hand.base_link:
        told = f"{path}: its poses are those of link {short_repr(base)}"
        raise FormatError(f"{told}, but the base link of {source} is {hand.base_link!r}; name the hand with --hand")
    return hand


def _object_of(
    document: dict[str, Any], path: Path, wanted: str | None, config: PlanConfig
) -> tuple[Scene | None, Float[np.ndarray, "points 3"], tuple[str, ...]]:
    """Return the scene of the object `wanted` (None: the file's), its camera points [m], and notes for visitors."""
    told = document.get("object")
    told = told if isinstance(told, dict) else {}
    source = wanted or _beside(str(told.get("source")), path)
    given = {key: told[key] for key in ("mass", "friction", "scale") if isinstance(told.get(key), int | float)}
    try:
        # The file does not state `alone`. An object without a support was planned with `alone`.
        alone = told.get("support") is None
        scene = load_scene(source, **given, resolution=config.resolution, alone=alone)
        seen = seen_points(source, given.get("scale", 1.0))
    except GraspdError as error:
        if wanted:
            raise
        note = f"the object is not shown ({error}); give the object with --object"
        return None, np.zeros((0, 3)), (note,)
    if scene.object.sha256 == told.get("sha256"):
        return scene, seen, scene.object.warnings
    note = f"these grasps were planned on another object than {short_repr(source)}: contacts may lie off its surface"
    return scene, seen, (note, *scene.object.warnings)


def _beside(source: str, path: Path) -> str:
    beside = path.parent / Path(source).name
    if source.startswith(SHAPE_PREFIX) or Path(source).exists() or not beside.is_file():
        return source
    return str(beside)
