"""Make one block (one call of the planner and its file) in this process: prepare the object, plan, build the rows."""

from __future__ import annotations

import os
import pickle
import tempfile
import time
from collections import Counter, OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from graspd_core.errors import ConfigError
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.io.grasps_json import grasp_figures
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import ObjectModel, Scene, near_scene, object_parts, object_sharp_points
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.runtime import disk_cache
from graspd_core.types import Grasp, Verdict
from graspd_core.verify.metrics import measure
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_dataset.blocks import Block, DatasetObject
from graspd_dataset.dataset_store import parquet_bytes
from graspd_dataset.guarded_calls import Limits, MadeBlock, ReadyObject, Report, call_guarded, close_child
from graspd_dataset.ray_engine import pickled_hand
from graspd_dataset.record_schema import arrow_schema, object_schema
from graspd_dataset.run_records import code_version, forget_peak, peak_mb

# Number of unpickled scenes and hands that a process keeps. Consecutive blocks use them again, with their arrays.
_KEPT = 4
_loaded: OrderedDict[str, Any] = OrderedDict()


def make_ready(thing: DatasetObject, content: bytes | None, config: PlanConfig) -> ReadyObject:
    """Load an object, and compute the arrays that the optimiser and the trials need.

    `content` is the content of the object's file, if this machine may lack the file. Otherwise it is None.
    Raises GraspdError: the object cannot be read or used.
    """
    _one_thread()
    disk_cache.forget()
    options: dict[str, Any] = {"mass": thing.mass, "friction": thing.friction, "scale": thing.scale}
    with tempfile.TemporaryDirectory(prefix="graspd-object-") as folder:
        source = thing.source
        if content is not None:
            source = str(Path(folder) / Path(thing.source).name)
            Path(source).write_bytes(content)
        scene = load_scene(source, resolution=config.resolution, **options)
    scene = replace(scene, object=replace(scene.object, source=thing.source))
    near, _ = near_scene(scene)
    object_parts(near.object)
    object_sharp_points(near.object, 2 * config.problem.features)
    shared = pickle.dumps((scene, disk_cache.contents()), pickle.HIGHEST_PROTOCOL)
    return ReadyObject(scene.object.sha256, _object_file(scene.object), shared)


def make_block(block: Block, hand: bytes, shared: bytes) -> MadeBlock:
    """Plan the grasps of a block. `hand` is a pickled HandModel, `shared` is `ReadyObject.shared` of its object."""
    _one_thread()
    forget_peak()
    began = time.process_time()
    scene, arrays = _kept(block.object.key, shared)
    disk_cache.supply(arrays)
    model: HandModel = _kept(block.hand_content, hand)
    request: dict[str, Any] = {"preset": block.config, "verify": block.verify, "measure": block.measure != "none"}
    result = plan_grasps(scene, model, count=block.count, seed=block.seed, **request)
    grasps = result.tried if block.measure != "all" else all_measured(scene, model, result.tried)
    # If no grasp holds the assumed mass, the trials use a smaller mass. The rows hold the smaller mass.
    target = scene.object if result.mass is None else scene.object.at_mass(result.mass)
    row = {"block": block.key, "asked": block.inputs, "outcome": result.outcome.name, "message": result.message}
    file = parquet_bytes(_table(block, target, model, grasps), row)
    report = Report(
        block.key,
        rows=len(grasps),
        verified=sum(grasp.verdict is Verdict.VERIFIED for grasp in grasps),
        failures=dict(Counter(failure_kind(grasp) for grasp in grasps if grasp.verdict is Verdict.FAILED)),
        cpu=time.process_time() - began,
        peak_mb=peak_mb(),
    )
    return MadeBlock(file, scene.object.sha256, report)


def all_measured(scene: Scene, hand: HandModel, grasps: Sequence[Grasp]) -> tuple[Grasp, ...]:
    """Return all grasps with metrics. Measure those that have none, even failed grasps."""
    context = make_metrics_context(scene.object, hand)
    return tuple(grasp if grasp.metrics else replace(grasp, metrics=measure(context, grasp.grasp)) for grasp in grasps)


def failure_kind(grasp: Grasp) -> str:
    """Return why a grasp failed: `kind_of_reason` of its first failed trial."""
    return kind_of_reason(*next((trial.name, trial.reason) for trial in grasp.trials if not trial.passed))


def kind_of_reason(trial: str, reason: str) -> str:
    """Return "trial: reason" without the numbers and units of the reason. Equal texts can then be counted."""
    words = [word for word in reason.split() if not any(sign.isdigit() for sign in word)]
    return f"{trial}: {' '.join(word for word in words if word not in ('cm', 'mm', 'm', 'N'))}"


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _kept(key: str, pickled: bytes) -> Any:
    """Return the unpickled value of a key. Keep recent values, because MuJoCo models are cached per instance."""
    if key not in _loaded:
        _loaded[key] = pickle.loads(pickled)
    _loaded.move_to_end(key)
    while len(_loaded) > _KEPT:
        _loaded.popitem(last=False)
    return _loaded[key]


def _table(block: Block, target: ObjectModel, hand: HandModel, grasps: Sequence[Grasp]) -> Any:
    import pyarrow as pa

    same = {
        "block": block.key,
        "object_sha256": target.sha256,
        "object_source": block.object.source,
        "scale": block.object.scale,
        "mass": target.mass,
        "friction": block.object.friction,
        "hand_name": block.hand_name,
        "hand_sha256": block.hand_content,
        "joint_names": list(all_joint_names(hand)),
        "method": block.config.method,
        "preset": block.preset,
        "verify": block.verify,
        "seed": block.seed,
        "code": code_version(),
    }
    rows = [{**same, "row": number, **_row(grasp, hand)} for number, grasp in enumerate(grasps)]
    return pa.Table.from_pylist(rows, schema=arrow_schema())


def _row(grasp: Grasp, hand: HandModel) -> dict[str, Any]:
    """Return the columns of a grasp that differ between the grasps of a block."""
    row: dict[str, Any] = {
        "verdict": str(grasp.verdict),
        "reason": grasp.reason,
        "score": float(grasp.score),
        "probability": grasp.probability,
        "contacts": [{"link": c.link, "position": c.position, "normal": c.normal} for c in grasp.contacts],
    }
    for stage in ("pregrasp", "grasp", "squeeze"):
        posture = getattr(grasp, stage)
        row[f"{stage}_position"] = posture.position.tolist()
        row[f"{stage}_quaternion_wxyz"] = posture.quaternion_wxyz.tolist()
        row[f"{stage}_joint_positions"] = [float(q) for q in all_joint_positions(hand, posture.joint_positions)]
    figures = grasp_figures(grasp)
    return {**row, "trials": figures["trials"], **{f"metric_{key}": v for key, v in figures["metrics"].items()}}


def _object_file(target: ObjectModel) -> bytes:
    import pyarrow as pa

    row = {
        "object_sha256": target.sha256,
        "volume": float(target.volume),
        "radius": float(target.radius),
        "center_of_mass": target.center_of_mass.tolist(),
        "vertices": target.mesh.vertices.tolist(),
        "faces": target.mesh.faces.tolist(),
    }
    return parquet_bytes(pa.Table.from_pylist([row], schema=object_schema()), {"object": target.sha256})


def dry_run(blocks: Sequence[Block], limits: Limits, workers: int | None) -> str:
    """Make one block of each hand. Return as text the estimated grasps, CPU hours and megabytes of all blocks.

    Raises GraspdError: a block exceeds the limits, or its process died, or its object cannot be used.
    """
    if not blocks:
        return "nothing is missing"
    workers = workers or os.cpu_count() or 1
    measured: dict[str, tuple[Block, bytes, Report]] = {}
    for block in blocks:
        if block.hand_content not in measured:
            try:
                ready = call_guarded(limits, make_ready, block.object, None, block.config)
                made = call_guarded(limits, make_block, block, pickled_hand(block), ready.shared)
            except (MemoryError, TimeoutError, ChildProcessError) as error:
                raise ConfigError(f"{block.object.source}: {error}; change --memory or --patience") from None
            measured[block.hand_content] = block, made.file, made.report
    close_child()
    lines, wanted = [], Counter[str]()
    for block in blocks:
        wanted[block.hand_content] += block.count
    cpu = size = tried = 0.0
    for hand, (block, file, made) in measured.items():
        share = wanted[hand] / block.count
        cpu, size, tried = cpu + share * made.cpu, size + share * len(file), tried + share * made.rows
        counts = f"{made.verified} of {made.rows} verified, {made.cpu:.1f} CPU s, {len(file) / 1024:.0f} kB"
        lines.append(f"{block.hand}: one block of {block.object.source}: {counts}, {made.peak_mb:.0f} MB at the peak")
    hours = f"{cpu / 3600:.3g} CPU hours, {cpu / 3600 / workers:.3g} hours on {workers} cores"
    lines.append(f"{len(blocks)} blocks, {sum(wanted.values())} grasps wanted, about {tried:.0f} tried: {hours}")
    return "\n".join([*lines, f"about {size / 2**20:.1f} MB"])
