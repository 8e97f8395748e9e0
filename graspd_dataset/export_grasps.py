"""Export of a data set to isaac_grasp 1.0 (Isaac Sim, Isaac ROS), GraspGen's training JSON, and DexGraspBench.

Poses are those of the hand's base link in the object frame, the frame of the exported mesh. Lengths are in metres.
DexGraspBench reads one pickled dictionary per grasp and one folder per object. Its Allegro is MuJoCo Menagerie's right
hand, with graspd's joint order. graspd's palm has the orientation (0, 1, 0, 1)/√2, wxyz, in the hand's root frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from graspd_core.errors import ConfigError
from graspd_core.io.grasps_json import save_text
from graspd_core.mesh.topology import far_centre, moved_mesh
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import moved_object, object_parts
from graspd_core.runtime.disk_cache import save_bytes
from graspd_core.types import TriangleMesh
from graspd_dataset.dataset_store import DatasetStore, read_parquet
from graspd_dataset.foreign_grasps import PALMS, STAGES
from graspd_dataset.inspect_dataset import tables_of

Row = dict[str, Any]


def export(store: DatasetStore, kind: str, out: Path) -> tuple[int, int]:
    """Write the grasps of each pair of hand and object, and the meshes. Return the counts of pairs and of grasps.

    Raises:
        ConfigError: the format `kind` is unknown or does not support a hand, or different hands have the same name.
        FormatError: there is no data set, or a file is damaged.
    """
    if kind not in (*KINDS, DEXGRASPBENCH):
        raise ConfigError(f"to: {kind!r}; valid: {', '.join((*KINDS, DEXGRASPBENCH))}")
    ending, keep, written = KINDS.get(kind, ("", ("verified",), None))
    rows: dict[tuple[str, str], list[Row]] = {}
    for _, _, table, _ in tables_of(store, _COLUMNS):
        for row in table.to_pylist():
            if row["verdict"] in keep:
                rows.setdefault((row["hand_name"], row["object_sha256"]), []).append(row)
    for hand in {hand for hand, _ in rows}:
        files = {row["hand_sha256"] for (name, _), own in rows.items() if name == hand for row in own}
        if len(files) > 1:
            raise ConfigError(f"{store.label}: grasps of {len(files)} different hands named {hand!r}; valid: one")
        if written is None:
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
    """Return the isaac_grasp 1.0 YAML of grasps, without squeezes. `mesh` is the mesh's path in the YAML."""

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
    """Return the GraspGen JSON of grasps: each pose, and whether the grasp was verified. `mesh` is the mesh's path."""
    transforms = [_matrix(row["grasp_position"], row["grasp_quaternion_wxyz"]).tolist() for row in rows]
    held = [row["verdict"] == "verified" for row in rows]
    grasps = {"transforms": transforms, "object_in_gripper": held}
    return json.dumps({"object": {"file": mesh, "scale": 1.0}, "grasps": grasps}) + "\n"


# For each format: the file ending, the verdicts of exported grasps, and the function that makes a file's text.
KINDS: dict[str, tuple[str, tuple[str, ...], Callable[[Sequence[Row], str], str]]] = {
    "isaac": (".yaml", ("verified",), isaac_grasp),
    "graspgen": (".json", ("verified", "failed"), graspgen),
}
DEXGRASPBENCH = "dexgraspbench"
_PARTS = ("position", "quaternion_wxyz", "joint_positions")
_COLUMNS = ("hand_name", "hand_sha256", "object_sha256", "mass", "verdict", "code", "joint_names")
_COLUMNS += tuple(f"{stage}_{part}" for stage in ("pregrasp", "grasp", "squeeze") for part in _PARTS)


def _matrix(position: Sequence[float], quaternion_wxyz: Sequence[float]) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(np.roll(quaternion_wxyz, -1)).as_matrix()
    matrix[:3, 3] = position
    return matrix


def _mesh(store: DatasetStore, target: str) -> TriangleMesh:
    path = f"objects/{target}.parquet"
    row = read_parquet(store.read(path), path)[0].to_pylist()[0]
    return TriangleMesh(np.array(row["vertices"]), np.array(row["faces"]))


def refuse_hand(name: str) -> None:
    """Raise ConfigError if `PALMS` lacks the hand. Then we do not know the root frame of DexGraspBench's model."""
    if name not in PALMS:
        raise ConfigError(f"to dexgraspbench: hand {name!r}; valid: {', '.join(PALMS)}")


def write_dexgraspbench(
    rows: Sequence[dict[str, Any]], mesh: TriangleMesh, out: Path, *, objects: str = "objects"
) -> None:
    """Write the grasps of one hand on one object. Also write the object: mesh, convex parts, mass and centre of mass.

    The written mass is the least in the trials of the grasps, because blocks may differ in the object's mass. Grasp
    files name the object folder by the path `objects`. DexGraspBench looks for this path in its code folder.
    """
    name = rows[0]["object_sha256"]
    for number, row in enumerate(rows):
        grasp = {"obj_path": f"{objects}/{name}", "obj_scale": 1.0, "obj_pose": np.array([0, 0, 0, 1, 0, 0, 0.0])}
        grasp |= {f"{stage}_qpos": qpos(row, stage) for stage in STAGES}
        buffer = BytesIO()
        np.save(buffer, np.array(grasp, dtype=object), allow_pickle=True)
        save_bytes(out / row["hand_name"] / name / f"{number}.npy", buffer.getvalue())
    folder = out / "objects" / name
    model = load_scene(mesh, mass=min(row["mass"] for row in rows)).object
    values = {"mass": model.mass, "density": model.mass / model.volume, "scale": 1.0}
    values["gravity_center"] = model.center_of_mass.tolist()
    save_text(folder / "info" / "simplified.json", json.dumps(values, indent=1) + "\n")
    save_text(folder / "mesh" / "simplified.obj", obj_text(mesh))
    far = far_centre(model.mesh.vertices)
    for number, part in enumerate(object_parts(moved_object(model, -far))):
        save_text(folder / "urdf" / "meshes" / f"convex_piece_{number:03d}.obj", obj_text(moved_mesh(part, far)))


def qpos(row: dict[str, Any], stage: str) -> np.ndarray:
    """Return a posture as DexGraspBench's qpos: position [m], quaternion wxyz, joint values [rad] or [m]."""
    from scipy.spatial.transform import Rotation

    palm = Rotation.from_quat(np.roll(PALMS[row["hand_name"]], -1))
    turned = Rotation.from_quat(np.roll(row[f"{stage}_quaternion_wxyz"], -1)) * palm.inv()
    return np.concatenate([row[f"{stage}_position"], np.roll(turned.as_quat(), 1), row[f"{stage}_joint_positions"]])


def obj_text(mesh: TriangleMesh) -> str:
    """Return a mesh as the text of a Wavefront OBJ file, with coordinates at full precision."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist())]) + "\n"
