"""Settings: nested frozen dataclasses, one field list for YAML presets, the command line and ROS parameters."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from graspd_core.errors import ConfigError
from graspd_core.paths import config_dir

Method = Literal["closed_form"]
Verify = Literal["standard", "hard", "none"]
METHODS: tuple[str, ...] = typing.get_args(Method)
VERIFICATIONS: tuple[str, ...] = typing.get_args(Verify)


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms; every term is scaled so that one is a sensible weight.

    Attributes:
        task: resistance against the worst disturbances.
        distance: attraction of the fingers to the surface.
        penetration: depth below the padded surface.
        self_collision: overlap of the hand with itself.
        posture: joints away from the middle of their range.
        obstacle: depth in the support or in a neighbour; scenes without any have no such term.
    """

    task: float = 3.0
    distance: float = 1.0
    penetration: float = 1.0
    self_collision: float = 1.0
    posture: float = 0.02
    obstacle: float = 1.0


@dataclass(frozen=True)
class ClosedFormConfig:
    """The closed-form relaxation (docs/method.md).

    Attributes:
        starts_per_grasp: starts tried for each grasp asked for; hopeless ones are dropped on the way.
        explore_steps: steps with all starts, before the hopeless ones are dropped.
        refine_steps: steps with those that are kept.
        polish_steps: last steps, with all candidates and the object's sharp points.
        keep_per_grasp: starts kept after exploring, for each grasp asked for.
        candidates: contact candidates looked at by most steps.
        fine_candidates: contact candidates looked at while polishing.
        features: sharp points of the object looked at while polishing.
        directions: disturbance wrenches.
        friction: coefficient planned with; below the object's own, so that contacts keep a margin.
        delta_start: width of the soft contact at the start [m].
        delta_end: width of the soft contact at the end [m].
        radius_start: greatest padding of the object at the start [m].
        translation_rate: step size of the base position [m].
        rotation_rate: step size of the base quaternion [half rad].
        joint_rate: step size of the joints [rad].
        weights: of the loss terms while exploring and refining.
        polish_weights: of the loss terms while polishing.
        obstacle_factor: times as many starts are tried and kept where there is a support or a neighbour, which rule
            out most ways to grasp a thing.
        trust_floor: what a contact counts on surface that was only guessed; one where it was seen.
    """

    starts_per_grasp: float = 4.0
    explore_steps: int = 50
    refine_steps: int = 80
    polish_steps: int = 50
    keep_per_grasp: float = 2.0
    candidates: int = 256
    fine_candidates: int = 600
    features: int = 128
    directions: int = 24
    friction: float = 0.4
    delta_start: float = 0.02
    delta_end: float = 0.004
    radius_start: float = 0.03
    translation_rate: float = 0.003
    rotation_rate: float = 0.03
    joint_rate: float = 0.03
    obstacle_factor: float = 2.0
    trust_floor: float = 0.4
    weights: LossWeights = field(default_factory=LossWeights)
    polish_weights: LossWeights = field(
        default_factory=lambda: LossWeights(
            task=6.0, distance=300.0, penetration=10.0, self_collision=100.0, obstacle=10.0
        )
    )


@dataclass(frozen=True)
class PostureConfig:
    """Pregrasp and squeeze.

    Attributes:
        touch_reach: links this near to the object count as touching [m].
        grip_force: sum of the normal forces of the squeeze [N].
        stiffness: position gain of the hand's joint controllers [N·m/rad].
        effort_share: share of a joint's effort limit that the squeeze may use.
        clearance: distance from the object that the pregrasp opens to [m].
        open_steps: steps of the search for the pregrasp.
        open_joint_rate: its step size of the joints [rad].
        open_base_rate: its step size of the base [m].
    """

    touch_reach: float = 0.002
    grip_force: float = 40.0
    stiffness: float = 5.0
    effort_share: float = 1.0
    clearance: float = 0.012
    open_steps: int = 40
    open_joint_rate: float = 0.04
    open_base_rate: float = 0.002


@dataclass(frozen=True)
class PlanConfig:
    """Everything a run of `plan_grasps` is set by, apart from the scene, the hand and the seed.

    Attributes:
        resolution: cells of the signed distance grid along the object's longest side.
        method: the optimiser.
        closed_form: settings of that method.
        postures: pregrasp and squeeze.
    """

    resolution: int = 48
    method: Method = "closed_form"
    closed_form: ClosedFormConfig = field(default_factory=ClosedFormConfig)
    postures: PostureConfig = field(default_factory=PostureConfig)


@dataclass(frozen=True)
class SegmentConfig:
    """How an object is cut out of a scene that depth cameras saw.

    Attributes:
        roi_low: lower corner of the workspace, in the cloud's frame [m]; None: no bound.
        roi_high: upper corner of the workspace, in the cloud's frame [m]; None: no bound.
        max_range: points farther than this from their camera are ignored [m].
        voxel: side of the voxels that the scene is thinned by; finer than half of `gap` [m].
        plane_tolerance: least height above the support that counts as above it, more where the camera is noisier [m].
        support_size: the smaller side of a support's visible part is at least this [m].
        contact: what stands on a support comes at least this near to it, occlusion and noise considered [m].
        gap: things at least this far apart are two [m].
        smallest_object: things smaller than this are noise [m].
        largest_object: things larger than this are background: walls, floors, furniture [m].
        min_points: things seen by fewer points than this are noise.
        target_reach: a target point this near to a thing means that thing [m].
        neighbour_reach: other things are reported as far as this from the object [m].
    """

    roi_low: tuple[float, float, float] | None = None
    roi_high: tuple[float, float, float] | None = None
    max_range: float = 2.0
    voxel: float = 0.003
    plane_tolerance: float = 0.004
    support_size: float = 0.1
    contact: float = 0.02
    gap: float = 0.008
    smallest_object: float = 0.008
    largest_object: float = 0.35
    min_points: int = 30
    target_reach: float = 0.05
    neighbour_reach: float = 0.3


T = TypeVar("T")


def from_mapping(cls: type[T], values: Any, where: str = "config") -> T:
    """Build a config dataclass from nested mappings.

    Raises:
        ConfigError: an unknown key or a value of the wrong type, by its dotted name, with the valid choices.
    """
    hints = typing.get_type_hints(cls)
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected a mapping of {sorted(hints)}, got {values!r}")
    unknown = sorted(set(values) - set(hints), key=str)
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}; valid keys: {', '.join(sorted(hints))}")
    return cls(**{key: _coerce(hints[key], value, f"{where}.{key}") for key, value in values.items()})


def _coerce(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_mapping(typing.cast(type, hint), value, where)
    origin = typing.get_origin(hint)
    if origin is Literal:
        if value not in typing.get_args(hint):
            raise ConfigError(f"{where}: {value!r} is not one of {', '.join(map(str, typing.get_args(hint)))}")
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in typing.get_args(hint):
            return None
        hint = next(h for h in typing.get_args(hint) if h is not type(None))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{where}: expected {hint.__name__}, got {value!r}")
    if isinstance(value, int | float) and not 0 <= value < float("inf"):
        raise ConfigError(f"{where}: {value!r} must be a finite number, zero or more")
    return value


def preset_names() -> tuple[str, ...]:
    """Names of the boxed presets."""
    return tuple(sorted(path.stem for path in (config_dir() / "presets").glob("*.yaml")))


def load_preset(name: str) -> PlanConfig:
    """A boxed preset by name, or a preset file by path.

    Raises:
        ConfigError: no such preset (the valid ones are listed), malformed YAML, or a bad key or value.
    """
    import yaml

    path = Path(name) if Path(name).suffix in (".yaml", ".yml") else config_dir() / "presets" / f"{name}.yaml"
    if not path.is_file():
        raise ConfigError(f"unknown preset {name!r}; valid presets: {', '.join(preset_names())}, or a .yaml file")
    try:
        values = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    return from_mapping(PlanConfig, {} if values is None else values, where=path.name)
