"""The file format `graspd/grasps`, version 2 (docs/format.md): write a result."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.errors import ConfigError
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.methods.plan_config import PlanConfig, to_mapping
from graspd_core.metrics.metric_registry import METRICS
from graspd_core.runtime.whole_files import save_bytes
from graspd_core.scene.scene import ObjectModel
from graspd_core.types import ARM_STAGES, ArmPath, Grasp, GraspResult, Posture

FORMAT, VERSION = "graspd/grasps", 2
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
            "next_view": result.next_view if result.next_view is None else result.next_view.tolist(),
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
        "audits": dataclasses.asdict(result.audits),
        "refused": dict(result.refused),
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
    path: str | Path,
    result: GraspResult,
    target: ObjectModel,
    hand: HandModel,
    config: PlanConfig,
    *,
    frame: str = "",
    stamp: float | None = None,
) -> None:
    """Write a result; the file appears whole or not at all. `frame` and `stamp` [s] name what its poses are in."""
    document = result_document(result, target, hand, config)
    document |= {"frame": frame} if frame else {}
    document |= {"stamp": stamp} if stamp is not None else {}
    # NaN is not JSON: a document that held one must never be written.
    save_text(Path(path), json.dumps(document, indent=1, allow_nan=False) + "\n")


def save_text(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all; makes missing directories."""
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
        "contacts": [{"link": c.link, "position": list(c.position), "normal": list(c.normal)} for c in grasp.contacts],
        "arm": grasp.arm and _arm(grasp.arm),
        **grasp_figures(grasp),
    }


def _arm(path: ArmPath) -> dict[str, Any]:
    """The arm's way, and the waypoint at which it is at each stage."""
    stages = dict(zip(ARM_STAGES, path.stages, strict=True))
    return {"joint_names": list(path.joint_names), "positions": path.positions.tolist(), "stages": stages}


def grasp_figures(grasp: Grasp) -> dict[str, Any]:
    """Metrics and trials of a grasp as JSON-ready values.

    Every metric of the registry has a key, which names its unit; trials are in [m] and [rad]. What was not measured and
    what is not finite is null.
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
