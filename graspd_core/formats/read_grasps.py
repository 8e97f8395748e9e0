"""Read files of the format `graspd/grasps`, versions 1 and 2 (docs/format.md)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.errors import FormatError, shown
from graspd_core.formats.grasps_json import FORMAT, VERSION
from graspd_core.metrics.metric_registry import METRICS
from graspd_core.types import ARM_STAGES, ArmPath, Contact, Grasp, GraspMetrics, Posture, TrialResult


def load_grasps(path: str | Path) -> tuple[Grasp, ...]:
    """Read the grasps of a file that `save_result` wrote, in rank order.

    Raises:
        FormatError: missing, not of this format or version, or a grasp in it is malformed.
    """
    return grasps_of(load_document(path))


def load_document(path: str | Path) -> dict[str, Any]:
    """Read a grasps file.

    Raises:
        FormatError: missing, not JSON, of another format or of an unknown version.
    """
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
        version = shown(document.get("version"))
        raise FormatError(f"{path}: version {version} is unknown; this reader knows 1 and {VERSION}")
    return document


def grasps_of(document: dict[str, Any]) -> tuple[Grasp, ...]:
    """The grasps of a document that `load_document` read, in rank order; the squeeze has the grasp's base pose.

    Joint positions are those of the actuated joints, as everywhere in graspd: coupled ones follow from them. Metrics
    that this version does not know are left out.

    Raises:
        FormatError: a grasp lacks a key, or holds something there that is of the wrong kind or not finite.
    """
    try:
        hand = document["hand"]
        # Files written before joints could be coupled have no such key.
        coupled = {mimic["joint"] for mimic in hand.get("mimic", ())}
        actuated = np.array([name not in coupled for name in hand["joint_names"]], dtype=bool)
        upgrade = _from_version_1 if document.get("version") == 1 else dict
        return tuple(_grasp_of(upgrade(values), actuated) for values in document["grasps"])
    except KeyError as error:
        raise FormatError(f"grasps: a grasp lacks the key {shown(error.args[0])}") from None
    # A number of JSON may be larger than any float.
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"grasps: {' '.join(str(error).split())[:300]}") from None


def _grasp_of(values: dict[str, Any], actuated: Bool[np.ndarray, "movable"]) -> Grasp:
    def posture(*keys: str) -> Posture:
        if len(values[keys[2]]) != actuated.size:
            raise ValueError(f"{keys[2]} has {len(values[keys[2]])} values for {actuated.size} joints")
        sizes = (3, 4, actuated.size)
        position, quaternion, joints = (_numbers_of(values, key, n) for key, n in zip(keys, sizes, strict=True))
        if abs(np.linalg.norm(quaternion.clip(-2, 2)) - 1) > 0.01:
            raise ValueError(f"{keys[1]} is no unit quaternion: {quaternion.tolist()}")
        return Posture(position, quaternion, joints[actuated])

    grasp = Grasp(
        pregrasp=posture("pregrasp_position", "pregrasp_quaternion_wxyz", "pregrasp_joint_positions"),
        grasp=posture("position", "quaternion_wxyz", "joint_positions"),
        squeeze=posture("position", "quaternion_wxyz", "squeeze_joint_positions"),
        contacts=tuple(_contact_of(contact) for contact in values["contacts"]),
        score=float(_numbers_of(values, "score")),
        metrics=_metrics_of(values["metrics"]),
        trials=tuple(_trial_of(trial) for trial in values["trials"]),
        # Files written before clouds were doubted have no such key.
        probability=_scaled({"probability": None, **values}, "probability", 1.0),
        # Nor those written before an arm could be given.
        arm=_arm_of(values["arm"]) if values.get("arm") is not None else None,
    )
    if values["verdict"] != grasp.verdict:
        raise ValueError(f"verdict: {shown(values['verdict'])}; by its trials the grasp is {grasp.verdict}")
    return grasp


def _from_version_1(values: dict[str, Any]) -> dict[str, Any]:
    """A grasp of version 1 with its trials as version 2 writes them; the reason was that of the last trial."""
    # Files written before there was a lift trial have no such key.
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
    """The metrics of the registry; None where none was measured."""
    read = {name: _scaled(values, row.key, 1 / row.scale) for name, row in METRICS.items()}
    return None if set(read.values()) <= {None} else GraspMetrics(read)


def _trial_of(values: dict[str, Any]) -> TrialResult:
    if not isinstance(values["passed"], bool):
        raise ValueError(f"passed: {shown(values['passed'])}; expected true or false")
    # What was not finite was written as null.
    moved = [_scaled(values, key, 1.0) for key in ("displacement", "rotation")]
    displacement, rotation = (math.inf if value is None else value for value in moved)
    return TrialResult(str(values["name"]), values["passed"], displacement, rotation, str(values["reason"]))


def _scaled(values: dict[str, Any], key: str, factor: float) -> float | None:
    """A number times `factor`; None where there is none."""
    return None if values.get(key) is None else float(_numbers_of(values, key)) * factor


def _arm_of(values: dict[str, Any]) -> ArmPath:
    names, rows = tuple(map(str, values["joint_names"])), len(values["positions"])
    positions = _numbers_of(values, "positions", rows, len(names))
    first, second, third, fourth = (int(values["stages"][stage]) for stage in ARM_STAGES)
    if not 0 <= first <= second <= third <= fourth < rows:
        raise ValueError(f"arm.stages: {shown(values['stages'])}; expected rows of its {rows} waypoints in order")
    return ArmPath(names, positions, (first, second, third, fourth))


def _contact_of(values: dict[str, Any]) -> Contact:
    position, normal = (_numbers_of(values, key, 3) for key in ("position", "normal"))
    return Contact(str(values["link"]), _triple(position), _triple(normal))


def _numbers_of(values: dict[str, Any], key: str, *shape: int) -> Float[np.ndarray, "..."]:
    """What a key holds, as finite numbers of a shape. Raises ValueError: it holds something else."""
    numbers = np.array(values[key], dtype=float)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"{key}: {shown(values[key])}; expected {math.prod(shape)} finite number(s)")
    return numbers


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")
