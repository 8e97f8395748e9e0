"""The file format `graspd/grasps`, version 1 (docs/format.md): write a result, read it back."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.errors import ConfigError, FormatError, shown
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.methods.plan_config import PlanConfig, to_mapping
from graspd_core.scene.scene import ObjectModel
from graspd_core.types import Contact, Grasp, GraspMetrics, GraspResult, HoldResult, LiftResult, Posture, Verdict

FORMAT, VERSION = "graspd/grasps", 1
_METRIC_KEYS = (
    "contact_area_cm2",
    "intersection_volume_cm3",
    "penetration_mm",
    "self_penetration_mm",
    "epsilon",
    "volume",
    "sd_cm",
    "robustness",
)
_LIBRARIES = ("graspd", "torch", "mujoco", "open3d", "numpy")


def result_document(result: GraspResult, target: ObjectModel, hand: HandModel, config: PlanConfig) -> dict[str, Any]:
    """A result as JSON-ready values; lengths in metres, angles in radians, forces in newtons unless a key says so."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "units": "m, rad, N",
        "outcome": {
            "name": result.outcome.name,
            "message": result.message or result.outcome.value,
            "warnings": list(result.warnings),
        },
        "hand": _hand(hand),
        "object": {
            "source": target.source,
            "sha256": target.sha256,
            "center_of_mass": target.center_of_mass.tolist(),
            "mass": target.mass,
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
        "grasps": [_grasp(rank, grasp, hand) for rank, grasp in enumerate(result.grasps)],
    }


def _hand(hand: HandModel) -> dict[str, Any]:
    """Whose joints these are, which of them follow others, and where the hand sits on an arm."""
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
    """Refuse a path that no file can be written to, before the work that would be lost; makes missing directories.

    Raises:
        ConfigError: the path is a directory, or its directory cannot be made or written to.
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
    path: str | Path, result: GraspResult, target: ObjectModel, hand: HandModel, config: PlanConfig
) -> None:
    """Write a result; the file appears whole or not at all."""
    # NaN is not JSON: a document that held one must never be written.
    save_text(Path(path), json.dumps(result_document(result, target, hand, config), indent=1, allow_nan=False) + "\n")


def save_text(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all; makes missing directories."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


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
    if document.get("version") != VERSION:
        raise FormatError(f"{path}: version {shown(document.get('version'))} is unknown; this reader knows {VERSION}")
    return document


def grasps_of(document: dict[str, Any]) -> tuple[Grasp, ...]:
    """The grasps of a document that `load_document` read, in rank order; the squeeze has the grasp's base pose.

    Joint positions are those of the actuated joints, as everywhere in graspd: coupled ones follow from them. Metrics
    stay in the document: who wants to judge a grasp measures it anew.

    Raises:
        FormatError: a grasp lacks a key, or holds something there that is of the wrong kind or not finite.
    """
    try:
        hand = document["hand"]
        # Files written before joints could be coupled have no such key.
        coupled = {mimic["joint"] for mimic in hand.get("mimic", ())}
        actuated = np.array([name not in coupled for name in hand["joint_names"]], dtype=bool)
        return tuple(_grasp_of(values, actuated) for values in document["grasps"])
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

    # Files written before there was a lift trial have no such key.
    hold, lift = values["metrics"]["hold"], values["metrics"].get("lift")
    verdict, reason = Verdict(values["verdict"]), str(values["reason"])
    # A lift is tried only with grasps that held, so the reason is that of the last trial.
    verified = verdict is Verdict.VERIFIED
    held = verified or lift is not None
    return Grasp(
        pregrasp=posture("pregrasp_position", "pregrasp_quaternion_wxyz", "pregrasp_joint_positions"),
        grasp=posture("position", "quaternion_wxyz", "joint_positions"),
        squeeze=posture("position", "quaternion_wxyz", "squeeze_joint_positions"),
        contacts=tuple(_contact_of(contact) for contact in values["contacts"]),
        score=float(_numbers_of(values, "score")),
        hold=None if hold is None else HoldResult(held, *_moved_of(hold), "" if lift else reason),
        verdict=verdict,
        reason=reason,
        lift=None if lift is None else _lift_of(lift, verified, reason),
    )


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


def _lift_of(trial: dict[str, Any], passed: bool, reason: str) -> LiftResult:
    return LiftResult(passed, *_moved_of(trial), float(_numbers_of(trial, "reach_through_mm")) / 1e3, reason)


def _moved_of(trial: dict[str, Any]) -> tuple[float, float]:
    """Displacement [m] and rotation [rad] of a trial, infinite where they were not finite."""
    displacement, rotation = (
        float("inf") if trial[key] is None else float(_numbers_of(trial, key))
        for key in ("max_displacement_cm", "max_rotation_deg")
    )
    return displacement / 100, math.radians(rotation)


def _grasp(rank: int, grasp: Grasp, hand: HandModel) -> dict[str, Any]:
    def joints(posture: Posture) -> list[float]:
        return _list(all_joint_positions(hand, posture.joint_positions))

    return {
        "rank": rank,
        "verdict": str(grasp.verdict),
        "reason": grasp.reason,
        "score": grasp.score,
        "position": _list(grasp.grasp.position),
        "quaternion_wxyz": _list(grasp.grasp.quaternion_wxyz),
        "joint_positions": joints(grasp.grasp),
        "pregrasp_joint_positions": joints(grasp.pregrasp),
        "squeeze_joint_positions": joints(grasp.squeeze),
        "pregrasp_position": _list(grasp.pregrasp.position),
        "pregrasp_quaternion_wxyz": _list(grasp.pregrasp.quaternion_wxyz),
        "contacts": [{"link": c.link, "position": list(c.position), "normal": list(c.normal)} for c in grasp.contacts],
        "metrics": _metrics(grasp.metrics, grasp.hold, grasp.lift),
    }


def _metrics(metrics: GraspMetrics | None, hold: HoldResult | None, lift: LiftResult | None) -> dict[str, Any]:
    """Every key in every grasp; null where nothing was measured or a figure is not finite."""
    values: dict[str, float | None] = dict.fromkeys(_METRIC_KEYS)
    if metrics is not None:
        figures = (
            metrics.contact_area * 1e4,
            metrics.intersection_volume * 1e6,
            metrics.penetration * 1e3,
            metrics.self_penetration * 1e3,
            metrics.epsilon,
            metrics.volume,
            None if metrics.displacement is None else metrics.displacement * 100,
            metrics.robustness,
        )
        values = dict(zip(_METRIC_KEYS, map(_finite, figures), strict=True))
    return {
        **values,
        "hold": hold and _moved(hold),
        "lift": lift and {**_moved(lift), "reach_through_mm": lift.reach_through * 1e3},
    }


def _moved(trial: HoldResult | LiftResult) -> dict[str, float | None]:
    return {
        "max_displacement_cm": _finite(trial.max_displacement * 100),
        "max_rotation_deg": _finite(float(np.rad2deg(trial.max_rotation))),
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


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
