"""Write files of the format `graspd/grasps` in version 2, and read versions 1 and 2 (docs/format.md)."""

from __future__ import annotations

import dataclasses
import json
import math
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.errors import ConfigError, FormatError, short_repr
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.optimize.plan_config import PlanConfig, to_mapping
from graspd_core.perception.scene import ObjectModel
from graspd_core.runtime.disk_cache import save_bytes
from graspd_core.types import ARM_STAGES, ArmPath, Contact, Grasp, GraspMetrics, GraspResult, Posture, TrialResult
from graspd_core.verify.metrics import METRICS

FORMAT, VERSION, _UNITS = "graspd/grasps", 2, "m, rad, N"
_LIBRARIES = ("graspd", "torch", "mujoco", "open3d", "numpy")


def result_document(result: GraspResult, target: ObjectModel, hand: HandModel, config: PlanConfig) -> dict[str, Any]:
    """Return a result as JSON-ready values, in m, rad and N. Values in other units have the unit in their key."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "units": _UNITS,
        "outcome": {
            "name": result.outcome.name,
            "message": result.message or result.outcome.value,
            "warnings": list(result.warnings),
            "next_view": result.next_view if result.next_view is None else result.next_view.tolist(),
        },
        "hand": _hand(hand),
        "object": {
            "source": target.source,
            "sha256": target.sha256,
            "center_of_mass": target.center_of_mass.tolist(),
            "mass": target.mass if result.mass is None else result.mass,
            "mass_assumed": target.mass_assumed,
            "friction": target.friction,
            "scale": target.scale,
            "support": result.support
            and {"normal": _list(result.support.normal), "offset": float(result.support.offset)},
        },
        "config": to_mapping(config),
        "seed": result.seed,
        "method": result.method,
        "versions": _versions(),
        "timing": dataclasses.asdict(result.timing),
        "audits": dataclasses.asdict(result.audits),
        "refused": dict(result.refused),
        "grasps": [_grasp(rank, grasp, hand) for rank, grasp in enumerate(result.tried)],
    }


def _hand(hand: HandModel) -> dict[str, Any]:
    """Return the hand's names, joints, joint couplings and mount on an arm as JSON-ready values."""
    return {
        "name": hand.name,
        "urdf": hand.urdf,
        "base_link": hand.base_link,
        "joint_names": list(all_joint_names(hand)),
        "mimic": [
            {"joint": m.name, "of": hand.joint_names[m.joint], "multiplier": m.multiplier, "offset": m.offset}
            for m in hand.mimics
        ],
        "mount": hand.mount and dataclasses.asdict(hand.mount),
    }


def check_writable(path: Path) -> None:
    """Check before long work that a file can be written. Make missing directories.

    Raises ConfigError: the path is a directory, or its parent directory cannot be made or cannot be written to.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a directory; give the name of a file to write")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from None


def save_result(
    path: str | Path,
    result: GraspResult,
    target: ObjectModel,
    hand: HandModel,
    config: PlanConfig,
    *,
    frame: str = "",
    stamp: float | None = None,
) -> None:
    """Write a result to a file atomically. `frame` is the frame of all poses, and `stamp` is their time [s]."""
    document = result_document(result, target, hand, config)
    document |= {"frame": frame} if frame else {}
    document |= {"stamp": stamp} if stamp is not None else {}
    # NaN is not valid JSON, so refuse to write a document with NaN.
    save_text(Path(path), json.dumps(document, indent=1, allow_nan=False) + "\n")


def save_text(path: Path, text: str) -> None:
    """Write a text file atomically. Make missing directories."""
    save_bytes(path, text.encode())


def _grasp(rank: int, grasp: Grasp, hand: HandModel) -> dict[str, Any]:
    def joints(posture: Posture) -> list[float]:
        return _list(all_joint_positions(hand, posture.joint_positions))

    return {
        "rank": rank,
        "verdict": str(grasp.verdict),
        "reason": grasp.reason,
        "score": grasp.score,
        "probability": grasp.probability,
        "position": _list(grasp.grasp.position),
        "quaternion_wxyz": _list(grasp.grasp.quaternion_wxyz),
        "joint_positions": joints(grasp.grasp),
        "pregrasp_joint_positions": joints(grasp.pregrasp),
        "squeeze_joint_positions": joints(grasp.squeeze),
        "pregrasp_position": _list(grasp.pregrasp.position),
        "pregrasp_quaternion_wxyz": _list(grasp.pregrasp.quaternion_wxyz),
        "contacts": [
            {"link": c.link, "position": list(c.position), "normal": list(c.normal), "force": c.force and list(c.force)}
            for c in grasp.contacts
        ],
        "arm": grasp.arm and _arm(grasp.arm),
        **grasp_figures(grasp),
    }


def _arm(path: ArmPath) -> dict[str, Any]:
    stages = dict(zip(ARM_STAGES, path.stages, strict=True))
    return {"joint_names": list(path.joint_names), "positions": path.positions.tolist(), "stages": stages}


def grasp_figures(grasp: Grasp) -> dict[str, Any]:
    """Return metrics and trials of a grasp as JSON-ready values.

    Values that were not measured or are not finite are None. The key of every metric names its unit. The values of
    trials are in [m] and [rad].
    """
    metrics = grasp.metrics or {}
    return {
        "metrics": {row.key: _finite(metrics.get(name), row.scale) for name, row in METRICS.items()},
        "trials": [
            {**dataclasses.asdict(t), "displacement": _finite(t.displacement), "rotation": _finite(t.rotation)}
            for t in grasp.trials
        ],
    }


def _finite(value: float | None, scale: float = 1.0) -> float | None:
    return value * scale if value is not None and np.isfinite(value) else None


def _list(values: np.ndarray) -> list[float]:
    return [float(v) for v in values]


def _versions() -> dict[str, str]:
    versions = {}
    for name in _LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def load_grasps(path: str | Path) -> tuple[Grasp, ...]:
    """Read the grasps of a file that `save_result` wrote, in rank order.

    Raises:
        FormatError: the file is missing, has another format or version, or holds a malformed grasp.
    """
    return grasps_of(load_document(path), str(path))


def load_document(path: str | Path) -> dict[str, Any]:
    """Read a grasps file. Raises FormatError: the file is missing, not JSON, or of an unknown format or version."""
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not JSON: {error}") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise FormatError(f"{path}: not a {FORMAT} file")
    if document.get("version") not in (1, VERSION):
        version = short_repr(document.get("version"))
        raise FormatError(f"{path}: version {version} is unknown; this reader knows 1 and {VERSION}")
    if (units := document.get("units", _UNITS)) != _UNITS:
        raise FormatError(f"{path}: units {short_repr(units)}; valid: {_UNITS!r}")
    return document


def grasps_of(document: dict[str, Any], where: str = "grasps") -> tuple[Grasp, ...]:
    """Return the grasps of a document that `load_document` read, in rank order. `where` begins the error messages.

    The squeeze posture gets the base pose of the grasp posture. Postures hold actuated joints only. Unknown metrics are
    ignored. Raises FormatError: a grasp lacks a key, or a value has the wrong type or is not finite.
    """
    try:
        hand = document["hand"]
        # Files from before coupled joints do not have the key "mimic".
        coupled = {mimic["joint"] for mimic in hand.get("mimic", ())}
        actuated = np.array([name not in coupled for name in hand["joint_names"]], dtype=bool)
        upgrade = _from_version_1 if document.get("version") == 1 else dict
        return tuple(_grasp_of(upgrade(values), actuated) for values in document["grasps"])
    except KeyError as error:
        raise FormatError(f"{where}: a grasp lacks the key {short_repr(error.args[0])}") from None
    # A JSON number may be too large for a float.
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{where}: {' '.join(str(error).split())[:300]}") from None


def _grasp_of(values: dict[str, Any], actuated: Bool[np.ndarray, "movable"]) -> Grasp:
    def posture(*keys: str) -> Posture:
        if len(values[keys[2]]) != actuated.size:
            raise ValueError(f"{keys[2]}: {len(values[keys[2]])} values; expected {actuated.size}")
        sizes = (3, 4, actuated.size)
        position, quaternion, joints = (_numbers_of(values, key, n) for key, n in zip(keys, sizes, strict=True))
        if abs(np.linalg.norm(quaternion.clip(-2, 2)) - 1) > 0.01:
            raise ValueError(f"{keys[1]}: {quaternion.tolist()}; expected a unit quaternion")
        return Posture(position, quaternion, joints[actuated])

    grasp = Grasp(
        pregrasp=posture("pregrasp_position", "pregrasp_quaternion_wxyz", "pregrasp_joint_positions"),
        grasp=posture("position", "quaternion_wxyz", "joint_positions"),
        squeeze=posture("position", "quaternion_wxyz", "squeeze_joint_positions"),
        contacts=tuple(_contact_of(contact) for contact in values["contacts"]),
        score=float(_numbers_of(values, "score")),
        metrics=_metrics_of(values["metrics"]),
        trials=tuple(_trial_of(trial) for trial in values["trials"]),
        # Files from before probabilities do not have the key "probability".
        probability=_probability_of(values),
        # Files from before arms do not have the key "arm".
        arm=_arm_of(values["arm"]) if values.get("arm") is not None else None,
    )
    if values["verdict"] != grasp.verdict:
        raise ValueError(f"verdict: {short_repr(values['verdict'])}; expected {grasp.verdict}, by the trials")
    return grasp


def _probability_of(values: dict[str, Any]) -> float | None:
    probability = _scaled(values, "probability", 1.0)
    if probability is not None and not 0 <= probability <= 1:
        raise ValueError(f"probability: {probability:g}; expected 0 to 1")
    return probability


def _from_version_1(values: dict[str, Any]) -> dict[str, Any]:
    """Convert a grasp from version 1 to version 2. The grasp's `reason` becomes the reason of its last trial."""
    # Files from before the lift trial do not have the key "lift".
    tried = {name: values["metrics"].get(name) for name in ("hold", "lift")}
    tried = {name: trial for name, trial in tried.items() if trial is not None}
    trials = [
        {
            "name": name,
            "passed": passed,
            "displacement": _scaled(trial, "max_displacement_cm", 0.01),
            "rotation": _scaled(trial, "max_rotation_deg", math.radians(1)),
            "reason": "" if passed else values["reason"],
        }
        for name, trial in tried.items()
        for passed in [values["verdict"] == "verified" or name != list(tried)[-1]]
    ]
    return {**values, "trials": trials}


def _metrics_of(values: dict[str, Any]) -> GraspMetrics | None:
    read = {name: _scaled(values, row.key, 1 / row.scale) for name, row in METRICS.items()}
    return None if set(read.values()) <= {None} else GraspMetrics(read)


def _trial_of(values: dict[str, Any]) -> TrialResult:
    if not isinstance(values["passed"], bool):
        raise ValueError(f"passed: {short_repr(values['passed'])}; expected true or false")
    # `save_result` writes values that are not finite as null.
    moved = [_scaled(values, key, 1.0) for key in ("displacement", "rotation")]
    displacement, rotation = (math.inf if value is None else value for value in moved)
    return TrialResult(str(values["name"]), values["passed"], displacement, rotation, str(values["reason"]))


def _scaled(values: dict[str, Any], key: str, factor: float) -> float | None:
    return None if values.get(key) is None else float(_numbers_of(values, key)) * factor


def _arm_of(values: dict[str, Any]) -> ArmPath:
    names, rows = tuple(map(str, values["joint_names"])), len(values["positions"])
    positions = _numbers_of(values, "positions", rows, len(names))
    first, second, third, fourth = (int(values["stages"][stage]) for stage in ARM_STAGES)
    if not 0 <= first <= second <= third <= fourth < rows:
        raise ValueError(f"arm.stages: {short_repr(values['stages'])}; expected ascending row indices below {rows}")
    return ArmPath(names, positions, (first, second, third, fourth))


def _contact_of(values: dict[str, Any]) -> Contact:
    position, normal = (_triple(_numbers_of(values, key, 3)) for key in ("position", "normal"))
    force = None if values.get("force") is None else _triple(_numbers_of(values, "force", 3))
    return Contact(str(values["link"]), position, normal, force)


def _numbers_of(values: dict[str, Any], key: str, *shape: int) -> Float[np.ndarray, "..."]:
    numbers = np.array(values[key], dtype=float)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"{key}: {short_repr(values[key])}; expected {math.prod(shape)} finite number(s)")
    return numbers


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")
