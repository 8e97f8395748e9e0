"""Study `imported`: imported grasps compared with ours, on the same objects, with the same hand, trials and metrics.

    graspd bench --import FOLDER --hand NAME

Grasps that the import refuses, such as those marked as failed in the file, count as failed. So do requested grasps that
our planner does not find. Shares refer to all imported grasps of an object, or to the first `--count` of them.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.measurement import TRIALS, requested_trials
from graspd_bench.study import PROTOCOL_MASS, ObjectCase, Record, Request, Sections, raw_grasps
from graspd_core.errors import ConfigError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import Scene, object_parts
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Grasp, Verdict
from graspd_core.verify.metrics import METRICS, measure
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_dataset.complete_grasps import by_object, complete_grasps
from graspd_dataset.foreign_grasps import ImportedGrasp, foreign_files, read_foreign
from graspd_dataset.run_records import markdown_table, object_name

# Sources of grasps, in the order of the table.
SOURCES = {"imported": "imported", "ranked": "graspd, as ranked", "planned": "graspd, verified"}
# `_PASSED`: headings of trials with a verdict. `_FIGURES`: heading, key and digits of trials that measure a number.
_PASSED = {"standard": "holds", "hard": "holds hard", "bullet": "holds in PyBullet"}
_FIGURES = {
    "noisy": ("noisy", "share", 2),
    "gravity": ("gravity cm", "displacement_cm", 2),
    "sd": ("SD cm", "displacement_cm", 2),
}


@dataclass(frozen=True)
class ImportedCase(ObjectCase):
    """A case of `count` imported grasps of one object.

    Attributes:
        scale: factor by which the object's coordinates are multiplied.
        files: paths of the grasp files.
        mesh: mesh file to use instead of the mesh that the grasp files name. Empty if none.
        order: joint names in the order of npy files.
        trials: names of the trials.
        content: hash of the grasp files.
    """

    scale: float
    files: tuple[str, ...]
    mesh: str
    order: tuple[str, ...]
    trials: tuple[str, ...]
    content: str

    @property
    def label(self) -> str:
        return f"{_name(self.object)} scale {self.scale:g} {object_name(self.hand)} seed {self.seed}"

    def inputs(self) -> Record:
        """Return all inputs except the code. Files count by content, not by path."""
        return {name: value for name, value in super().inputs().items() if name not in ("files", "mesh")}

    def recorded(self) -> Record:
        return {name: value for name, value in super().recorded().items() if name != "files"}


def imported_cases(request: Request) -> tuple[ImportedCase, ...]:
    """Return a case for each object and seed. Raises GraspdError: folder or hand is missing, or a file is malformed."""
    if not request.imported or not request.hand:
        raise ConfigError("imported: give both --import FOLDER and --hand NAME")
    if len(request.objects) > 1:
        raise ConfigError(f"objects: {', '.join(request.objects)}; valid: one mesh, used for all imported files")
    trials = requested_trials(request, tuple(TRIALS))
    hand, mesh = load_hand(request.hand, candidates=1), "".join(request.objects)
    files: dict[tuple[str, float], dict[Path, int]] = {}
    for path in foreign_files(Path(request.imported)):
        imported = read_foreign(path, hand, mesh=mesh or None, order=request.joint_order)
        for target, grasps in by_object(imported).items():
            files.setdefault(target, {})[path] = len(grasps)
    most = request.count or (2 if request.quick else 1024)
    return tuple(
        ImportedCase(
            *(thing, request.preset(), request.hand, seed, min(most, sum(own.values())), scale),
            files=tuple(map(str, own)),
            mesh=mesh,
            order=request.joint_order,
            trials=trials,
            content=hashlib.sha256(b"".join(path.read_bytes() for path in own)).hexdigest(),
        )
        for seed in request.seeds or (0,)
        for (thing, scale), own in files.items()
    )


def run_imported(case: ImportedCase) -> Record:
    """Run the same trials and metrics on imported grasps, our raw grasps, and our verified grasps."""
    config, hand = case.config, load_hand(case.hand, candidates=case.config.problem.fine_candidates)
    scene = load_scene(case.object, mass=PROTOCOL_MASS, scale=case.scale, resolution=config.resolution)
    completed = complete_grasps(scene, hand, _theirs(case, hand), config)
    planned = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=config, measure=False).tried
    grasps = {
        "imported": completed.grasps,
        "ranked": raw_grasps(scene, hand, config, case.count, case.seed),
        "planned": tuple(grasp for grasp in planned if grasp.verdict is Verdict.VERIFIED)[: case.count],
    }
    figures = {name: tried(scene, hand, some, case.trials) for name, some in grasps.items()}
    held = {"held": sum(bool(r.get("standard", {}).get("passed")) for r in figures["imported"])}
    held = held if "standard" in case.trials else {}
    return {**held, "refused": completed.refused, "frame_doubt": completed.frame_doubt, "grasps": figures}


def _theirs(case: ImportedCase, hand: HandModel) -> tuple[ImportedGrasp, ...]:
    imported: list[ImportedGrasp] = []
    for path in case.files:
        imported += read_foreign(Path(path), hand, mesh=case.mesh or None, order=case.order)
    return by_object(imported)[case.object, case.scale][: case.count]


def tried(scene: Scene, hand: HandModel, grasps: Sequence[Grasp], trials: Sequence[str]) -> list[dict[str, Any]]:
    """Run the trials of every grasp. Return for each grasp its metrics, and the results of each trial by name."""
    context, parts = make_metrics_context(scene.object, hand), object_parts(scene.object)
    results: list[dict[str, Any]] = [{"metrics": dict(measure(context, grasp.grasp))} for grasp in grasps]
    for name in trials if grasps else ():
        trial = TRIALS[name](hand, scene.object, parts)
        for grasp, result in zip(grasps, results, strict=True):
            result[name] = trial(grasp)
    return results


def imported_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table with a row for every object and source of grasps, and rows for all objects together."""
    trials = [name for name in TRIALS if any(name in record["trials"] for record in records)]
    metrics = [row for row in METRICS.values() if row.measure is not None]
    headings = ["object", "grasps of", "tried", *(_PASSED[name] for name in trials if name in _PASSED)]
    headings += [_FIGURES[name][0] for name in trials if name in _FIGURES] + [row.title for row in metrics]
    groups = [(_name(record["object"]), [record]) for record in records]
    if len(records) > 1:
        groups.append(("**all**", list(records)))
    body = [_row(name, some, source, trials, len(headings)) for name, some in groups for source in SOURCES]
    whys = sum((Counter(record["refused"]) for record in records), Counter[str]())
    refused = "; ".join(f"{count} refused: {why}" for why, count in whys.items())
    note = "Shares are of all grasps of an object, also refused grasps and those not found. Other numbers are medians."
    doubted = [record for record in records if record.get("frame_doubt")]
    warnings = [f"{_name(record['object'])}: {record['frame_doubt']}." for record in doubted]
    return {"imported": [markdown_table(headings, body), " ".join(filter(None, (note, refused, *warnings)))]}


def _name(source: str) -> str:
    path = Path(source)
    return (path.parents[1].name if path.stem == "simplified" else object_name(source))[:16]


def _row(name: str, records: Sequence[Record], source: str, trials: Sequence[str], width: int) -> list[str]:
    count = sum(record["count"] for record in records)
    grasps = [grasp for record in records for grasp in record["grasps"][source]]

    def median(values: Sequence[float | None], digits: int) -> str:
        there = [value for value in values if value is not None]
        return f"{np.median(there):.{digits}f}" if there else "–"

    if source == "imported" and any(record.get("frame_doubt") for record in records):
        # Figures of poses in a wrong frame say nothing about the grasps.
        return [name, "imported, frame in doubt", f"{len(grasps)} of {count}", *["–"] * (width - 3)]
    cells = [name, SOURCES[source], f"{len(grasps)} of {count}"]
    for trial in trials:
        if trial in _PASSED:
            passed = [grasp[trial]["passed"] for grasp in grasps if grasp[trial]]
            cells.append(f"{sum(passed) / count:.0%}" if passed or not grasps else "–")
    for trial in trials:
        if trial in _FIGURES:
            _, key, digits = _FIGURES[trial]
            cells.append(median([grasp[trial].get(key) for grasp in grasps], digits))
    for row in METRICS.values():
        if row.measure is not None:
            values = [grasp["metrics"].get(row.name) for grasp in grasps]
            cells.append(median([None if value is None else value * row.scale for value in values], row.digits))
    return cells
