"""A data set as DexGraspBench reads it: a pickled dictionary a grasp, a folder an object.

Its Allegro is Menagerie's right hand: joints in the order of ours, fingers placed in the palm as in our base link; but
the pose of its qpos is that of a frame in which the palm is turned by the quaternion (0, 1, 0, 1).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.errors import ConfigError
from graspd_core.formats.foreign.dexgraspbench_npy import PALMS, STAGES
from graspd_core.formats.grasps_json import save_text
from graspd_core.runtime.whole_files import save_bytes
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import object_parts
from graspd_core.types import TriangleMesh


def refuse_hand(name: str) -> None:
    """Raises ConfigError: that bench's model of the hand is not known here."""
    if name not in PALMS:
        raise ConfigError(f"to dexgraspbench: hand {name!r}; valid: {', '.join(PALMS)}")


def write_dexgraspbench(rows: Sequence[dict[str, Any]], mesh: TriangleMesh, out: Path) -> None:
    """Write the grasps of one hand on one object, and the object: mesh, convex parts, mass and centre of mass."""
    name = rows[0]["object_sha256"]
    for number, row in enumerate(rows):
        grasp = {"obj_path": f"objects/{name}", "obj_scale": 1.0, "obj_pose": np.array([0, 0, 0, 1, 0, 0, 0.0])}
        grasp |= {f"{stage}_qpos": qpos(row, stage) for stage in STAGES}
        buffer = BytesIO()
        np.save(buffer, np.array(grasp, dtype=object), allow_pickle=True)
        save_bytes(out / row["hand_name"] / name / f"{number}.npy", buffer.getvalue())
    folder = out / "objects" / name
    model = load_scene(mesh, mass=rows[0]["mass"]).object
    told = {"mass": model.mass, "density": model.mass / model.volume, "scale": 1.0}
    told["gravity_center"] = model.center_of_mass.tolist()
    save_text(folder / "info" / "simplified.json", json.dumps(told, indent=1) + "\n")
    save_text(folder / "mesh" / "simplified.obj", obj_text(mesh))
    for number, part in enumerate(object_parts(model)):
        save_text(folder / "urdf" / "meshes" / f"convex_piece_{number:03d}.obj", obj_text(part))


def qpos(row: dict[str, Any], stage: str) -> np.ndarray:
    """A posture as that bench has it: position, quaternion wxyz, joints."""
    from scipy.spatial.transform import Rotation

    palm = Rotation.from_quat(np.roll(PALMS[row["hand_name"]], -1))
    turned = Rotation.from_quat(np.roll(row[f"{stage}_quaternion_wxyz"], -1)) * palm.inv()
    return np.concatenate([row[f"{stage}_position"], np.roll(turned.as_quat(), 1), row[f"{stage}_joint_positions"]])


def obj_text(mesh: TriangleMesh) -> str:
    """A mesh as a Wavefront file, to the last digit."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist())]) + "\n"
