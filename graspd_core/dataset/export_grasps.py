"""A data set in the files of others: isaac_grasp 1.0 (Isaac Sim, Isaac ROS), the JSON that GraspGen trains on, and
DexGraspBench's.

Poses are those of the hand's base link in the object's frame, which is that of the mesh written beside: metres.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from graspd_core.dataset.dataset_stats import tables_of
from graspd_core.dataset.dataset_store import DatasetStore
from graspd_core.dataset.dexgraspbench import obj_text, refuse_hand, write_dexgraspbench
from graspd_core.dataset.parquet_files import read_parquet
from graspd_core.errors import ConfigError
from graspd_core.formats.grasps_json import save_text
from graspd_core.types import TriangleMesh

Row = dict[str, Any]


def export(store: DatasetStore, kind: str, out: Path) -> tuple[int, int]:
    """Write files for every hand and object, and the meshes; numbers of such pairs and of grasps.

    Raises:
        ConfigError: no such kind, or a hand that it does not know.
        FormatError: there is no data set, or a file is spoilt.
    """
    if kind not in (*KINDS, DEXGRASPBENCH):
        raise ConfigError(f"to: {kind!r}; valid: {', '.join((*KINDS, DEXGRASPBENCH))}")
    ending, keep, written = KINDS.get(kind, ("", ("verified",), None))
    rows: dict[tuple[str, str], list[Row]] = {}
    for _, _, table, _ in tables_of(store, _COLUMNS):
        for row in table.to_pylist():
            if row["verdict"] in keep:
                rows.setdefault((row["hand_name"], row["object_sha256"]), []).append(row)
    for hand in {hand for hand, _ in rows} if written is None else ():
        refuse_hand(hand)
    for (hand, target), own in rows.items():
        if written is None:
            write_dexgraspbench(own, _mesh(store, target), out)
            continue
        mesh = out / "objects" / f"{target}.obj"
        if not mesh.exists():
            save_text(mesh, obj_text(_mesh(store, target)))
        save_text(out / hand / f"{target}{ending}", written(own, f"objects/{target}.obj"))
    return len(rows), sum(map(len, rows.values()))


def isaac_grasp(rows: Sequence[Row], mesh: str) -> str:
    """Verified grasps as isaac_grasp 1.0 has them; of a hand that presses it knows the touching posture only."""

    def joints(row: Row, stage: str) -> dict[str, float]:
        return dict(zip(row["joint_names"], row[f"{stage}_joint_positions"], strict=True))

    grasps = {
        f"grasp_{number}": {
            "confidence": 1.0,
            "position": row["grasp_position"],
            "orientation": {"w": row["grasp_quaternion_wxyz"][0], "xyz": row["grasp_quaternion_wxyz"][1:]},
            "cspace_position": joints(row, "grasp"),
            "pregrasp_cspace_position": joints(row, "pregrasp"),
        }
        for number, row in enumerate(rows)
    }
    head = {"format": "isaac_grasp", "format_version": 1.0, "created_with": f"graspd {rows[0]['code']}"}
    frames = {"object_frame_link": mesh, "gripper_frame_link": f"base link of {rows[0]['hand_name']}"}
    return yaml.safe_dump({**head, **frames, "grasps": grasps}, sort_keys=False, default_flow_style=None, width=120)


def graspgen(rows: Sequence[Row], mesh: str) -> str:
    """Poses of tried grasps and whether each held, those that failed among them."""
    transforms = [_matrix(row["grasp_position"], row["grasp_quaternion_wxyz"]).tolist() for row in rows]
    held = [row["verdict"] == "verified" for row in rows]
    grasps = {"transforms": transforms, "object_in_gripper": held}
    return json.dumps({"object": {"file": mesh, "scale": 1.0}, "grasps": grasps}) + "\n"


# Ending of the files, the verdicts that are written, and what writes them.
KINDS: dict[str, tuple[str, tuple[str, ...], Callable[[Sequence[Row], str], str]]] = {
    "isaac": (".yaml", ("verified",), isaac_grasp),
    "graspgen": (".json", ("verified", "failed"), graspgen),
}
DEXGRASPBENCH = "dexgraspbench"
_PARTS = ("position", "quaternion_wxyz", "joint_positions")
_COLUMNS = ("hand_name", "object_sha256", "mass", "verdict", "code", "joint_names")
_COLUMNS += tuple(f"{stage}_{part}" for stage in ("pregrasp", "grasp", "squeeze") for part in _PARTS)


def _matrix(position: Sequence[float], quaternion_wxyz: Sequence[float]) -> np.ndarray:
    """`T_object_hand`."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(np.roll(quaternion_wxyz, -1)).as_matrix()
    matrix[:3, 3] = position
    return matrix


def _mesh(store: DatasetStore, target: str) -> TriangleMesh:
    path = f"objects/{target}.parquet"
    row = read_parquet(store.read(path), path)[0].to_pylist()[0]
    return TriangleMesh(np.array(row["vertices"]), np.array(row["faces"]))
