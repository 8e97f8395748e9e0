"""What others read: the same fingertips by MuJoCo's kinematics of the URDF, the same poses, the same object."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import yaml
from menagerie_like import menagerie_like

from graspd_core import load_hand, load_mesh, make_shape
from graspd_core.hands.kinematics import link_poses
from graspd_dataset.dataset_store import DatasetStore, parquet_bytes
from graspd_dataset.export_grasps import write_dexgraspbench
from graspd_dataset.foreign_grasps import read_foreign
from graspd_dataset.inspect_dataset import tables_of


def mujoco_tips(urdf: str, position: list[float], orientation: dict, joints: dict[str, float]) -> dict[str, np.ndarray]:
    """Where MuJoCo has the links of the hand in the object's frame [m]; joints by name."""
    model = mujoco.MjModel.from_xml_path(urdf)  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    for name, value in joints.items():
        data.joint(name).qpos = value
    mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.array([orientation["w"], *orientation["xyz"]]))  # pyright: ignore[reportAttributeAccessIssue]
    bodies = {model.body(index).name: data.xpos[index] for index in range(1, model.nbody)}
    return {name: rotation.reshape(3, 3) @ there + position for name, there in bodies.items()}


def test_isaac_grasps_stand_where_they_did(exported):
    folder, rows = exported
    (path,) = (folder / "isaac" / "allegro_right").glob("*.yaml")
    document = yaml.safe_load(path.read_text())
    verified = [row for row in rows if row["verdict"] == "verified"]
    assert (document["format"], document["format_version"]) == ("isaac_grasp", 1.0)
    assert len(document["grasps"]) == len(verified) == 8
    hand = load_hand("allegro_right")
    for row, grasp in zip(verified, document["grasps"].values(), strict=True):
        assert list(grasp["pregrasp_cspace_position"].values()) == row["pregrasp_joint_positions"]
        tips = mujoco_tips(hand.urdf, grasp["position"], grasp["orientation"], grasp["cspace_position"])
        ours = link_positions(row)
        shared = set(tips) & set(ours)
        assert len(shared) >= 16
        assert max(np.linalg.norm(tips[name] - ours[name]) for name in shared) < 1e-6


def link_positions(row: dict) -> dict[str, np.ndarray]:
    """Where graspd has the links in the object's frame [m]."""
    hand = load_hand("allegro_right")
    _, translations = link_poses(hand, np.array(row["grasp_joint_positions"]))
    base = se3(row)
    return {name: base[:3, :3] @ there + base[:3, 3] for name, there in zip(hand.link_names, translations, strict=True)}


def se3(row: dict) -> np.ndarray:
    """`T_object_hand` of a row, by MuJoCo."""
    rotation, matrix = np.zeros(9), np.eye(4)
    mujoco.mju_quat2Mat(rotation, np.array(row["grasp_quaternion_wxyz"]))  # pyright: ignore[reportAttributeAccessIssue]
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), row["grasp_position"]
    return matrix


def test_graspgen_gets_poses_failures_and_the_mesh(allegro: DatasetStore, exported):
    folder, rows = exported
    (path,) = (folder / "graspgen" / "allegro_right").glob("*.json")
    document = json.loads(path.read_text())
    assert document["grasps"]["object_in_gripper"] == [row["verdict"] == "verified" for row in rows]
    for row, matrix in zip(rows, np.array(document["grasps"]["transforms"]), strict=True):
        assert np.allclose(matrix, se3(row), atol=1e-12)
    mesh = load_mesh(folder / "graspgen" / document["object"]["file"])
    assert path.stem == rows[0]["object_sha256"]
    assert len(mesh.vertices) == len(rows_of_objects(allegro)[0]["vertices"])


def rows_of_objects(store: DatasetStore) -> list[dict]:
    import pandas as pd

    return pd.read_parquet(f"{store.where}/objects").to_dict("records")


def test_an_unknown_format_and_a_hand_that_a_format_does_not_know_are_refused(tmp_path, refusal_of, made):
    line = refusal_of("dataset", "export", made.where, "--to", "usd", "--out", tmp_path)
    assert "to: 'usd'; valid: isaac, graspgen, dexgraspbench" in line
    line = refusal_of("dataset", "export", made.where, "--to", "dexgraspbench", "--out", tmp_path / "x")
    assert "hand 'parallel_gripper'; valid: allegro_right" in line


def test_dexgraspbench_has_every_finger_where_it_was(exported):
    own, rows = exported[0] / "dexgraspbench", exported[1]
    model = mujoco.MjModel.from_xml_string(menagerie_like())  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    verified = [row for row in rows if row["verdict"] == "verified"]
    files = sorted((own / "allegro_right").glob("*/*.npy"), key=lambda path: int(path.stem))
    assert len(files) == len(verified)
    for row, path in zip(verified, files, strict=True):
        grasp = np.load(path, allow_pickle=True).item()
        data.qpos[:] = grasp["grasp_qpos"]
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        (back,) = read_foreign(path, load_hand("allegro_right"))
        read = {f"grasp_{name}": value for name, value in vars(back.grasp).items()}
        # The last link of every finger; a fingertip sits on it, fixed.
        ends = {"ff3": "link_3.0", "mf3": "link_7.0", "rf3": "link_11.0", "th3": "link_15.0"}
        for ours in (link_positions(row), link_positions(read)):
            assert max(np.linalg.norm(data.body(end).xpos - ours[link]) for end, link in ends.items()) < 1e-5
        assert grasp["squeeze_qpos"].shape == grasp["pregrasp_qpos"].shape == (23,)
    folder = own / grasp["obj_path"]
    assert json.loads((folder / "info" / "simplified.json").read_text())["mass"] == row["mass"] > 0.1
    parts = [load_mesh(path) for path in (folder / "urdf" / "meshes").glob("convex_piece_*.obj")]
    assert len(parts) > 3
    whole = load_mesh(folder / "mesh" / "simplified.obj")
    assert np.allclose(
        np.ptp(np.concatenate([part.vertices for part in parts]), axis=0), np.ptp(whole.vertices, axis=0), atol=0.003
    )


def test_dexgraspbench_gets_the_least_mass_in_the_trials(exported, tmp_path: Path):
    light, heavy = ({**exported[1][0], "mass": mass} for mass in (0.2, 0.5))
    for name, rows in (("light first", [light, heavy]), ("heavy first", [heavy, light])):
        write_dexgraspbench(rows, make_shape("mug"), tmp_path / name)
        (about,) = (tmp_path / name).rglob("simplified.json")
        assert json.loads(about.read_text())["mass"] == 0.2


def test_grasps_of_two_hands_of_one_name_are_not_mixed(copied: DatasetStore, tmp_path: Path, refusal_of):
    path, _, table, told = next(iter(tables_of(copied)))
    at = table.schema.get_field_index("hand_sha256")
    other = table.set_column(at, table.schema.field(at), pa.array(["0" * 64] * table.num_rows))
    copied.write(path, parquet_bytes(other, {"block": told["block"], "asked": told["asked"]}))
    for kind in ("isaac", "graspgen"):
        line = refusal_of("dataset", "export", copied.where, "--to", kind, "--out", tmp_path / "out")
        assert "grasps of 2 different hands named 'parallel_gripper'; valid: one" in line
    assert not (tmp_path / "out").exists()
