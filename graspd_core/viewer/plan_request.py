"""What a visitor asks to be planned: checked here, because a forged message may hold anything in any field."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspd_core.errors import ConfigError, GraspdError, shown
from graspd_core.hands.library import hand_names
from graspd_core.mesh.mesh_files import MESH_ENDINGS
from graspd_core.mesh.shapes import SHAPES
from graspd_core.methods.plan_config import preset_names
from graspd_core.planning.planning_worker import start_planning_worker
from graspd_core.planning.steering.steering import Steering
from graspd_core.pointcloud.cloud_files import CLOUD_ENDINGS
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.scene.load_scene import SHAPE_PREFIX, load_scene
from graspd_core.scene.scene import Scene
from graspd_core.viewer.session import seen_points

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
# Directions that the hand may be asked to come from, and the way that it then moves, in the object's frame.
APPROACHES = {
    "any side": None,
    "above": (0.0, 0.0, -1.0),
    "below": (0.0, 0.0, 1.0),
    "+x": (-1.0, 0.0, 0.0),
    "-x": (1.0, 0.0, 0.0),
    "+y": (0.0, -1.0, 0.0),
    "-y": (0.0, 1.0, 0.0),
}
ENDINGS = tuple(sorted({*MESH_ENDINGS, *CLOUD_ENDINGS}))
MOST_GRASPS = 64


@dataclass(frozen=True)
class Upload:
    """A file that a visitor sent: its name, which is only ever shown, and what is in it."""

    name: str
    content: bytes

    @property
    def ending(self) -> str:
        """In lower case, without a dot."""
        return self.name.rpartition(".")[2].lower() if "." in self.name else ""


@dataclass(frozen=True)
class PlanRequest:
    """One run.

    Attributes:
        shape: name of an authored shape, where no file was sent.
        upload: the object's file.
        units: of the file's coordinates, a key of `UNITS`.
        alone: a cloud shows the object and nothing else.
        hand, preset: names.
        friction: coefficient.
        approach: where the hand comes from, a key of `APPROACHES`.
        approach_angle: greatest angle between that direction and a grasp's [degrees].
        count, seed: as of `plan_grasps`.
    """

    shape: str
    upload: Upload | None
    units: str
    alone: bool
    hand: str
    preset: str
    friction: float
    count: int
    approach: str = "any side"
    approach_angle: float = 30.0
    seed: int = 0

    @property
    def restrictions(self) -> tuple[Steering, ...]:
        """What `plan_grasps` is asked to keep to. Raises ConfigError: the angle is out of its range."""
        direction = APPROACHES[self.approach]
        return () if direction is None else (Steering(direction, math.radians(self.approach_angle)),)


def check(request: PlanRequest) -> None:
    """Refuse what no honest visitor can ask for: names only, no paths. Raises ConfigError: what is valid."""
    chosen = (
        ("shape", request.shape, tuple(SHAPES)),
        ("units", request.units, tuple(UNITS)),
        ("hand", request.hand, hand_names()),
        ("preset", request.preset, preset_names()),
        ("approach", request.approach, tuple(APPROACHES)),
    )
    for name, value, valid in chosen:
        if value not in valid:
            raise ConfigError(f"{name}: {shown(value)}; valid: {', '.join(valid)}")
    if request.upload is not None and request.upload.ending not in ENDINGS:
        raise ConfigError(f"{request.upload.name[:80]}: unknown ending; valid endings: {', '.join(ENDINGS)}")
    if not (math.isfinite(request.friction) and 0.01 <= request.friction <= 2.0):
        raise ConfigError(f"friction: {shown(request.friction)}; valid: 0.01 to 2")
    if not 1.0 <= request.approach_angle <= 180.0:
        raise ConfigError(f"approach angle: {shown(request.approach_angle)} degrees; valid: 1 to 180")
    if not 1 <= request.count <= MOST_GRASPS:
        raise ConfigError(f"count: {shown(request.count)} grasps; valid here: 1 to {MOST_GRASPS}")


def load_object(request: PlanRequest) -> tuple[Scene, Any]:
    """The scene of a checked request, and the points that it was made of [m].

    A file is read by the process's child: what crashes or misleads a reader ends there.

    Raises:
        GraspdError: the object cannot be used; the message names the file as the visitor does.
    """
    if request.upload is None:
        source = f"{SHAPE_PREFIX}{request.shape}"
        return load_scene(source, friction=request.friction), seen_points(source)
    start_planning_worker()
    with tempfile.TemporaryDirectory(prefix="graspd-view-") as folder:
        # The name is ours, its ending one of ours: nothing that a visitor typed is part of a path.
        path = Path(folder) / f"object.{request.upload.ending}"
        path.write_bytes(request.upload.content)
        scale = UNITS[request.units]
        try:
            scene = run_isolated(load_scene, str(path), friction=request.friction, scale=scale, alone=request.alone)
            return scene, run_isolated(seen_points, str(path), scale)
        except GraspdError as error:
            raise type(error)(str(error).replace(str(path), request.upload.name[:80])) from None
