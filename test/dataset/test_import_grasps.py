"""Grasps of others: what was exported comes back to the digit, and a file that is wrong is named in one line."""

import json
import os
import pickle
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from expected import Evil, refused
from scipy.spatial.transform import Rotation

from graspd_core import Posture, Verdict, load_grasps, load_hand, load_scene, make_shape, plan_grasps, save_mesh
from graspd_core.errors import FormatError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import all_joint_names
from graspd_dataset.export_grasps import qpos
from graspd_dataset.foreign_grasps import STAGES, npy_dictionary, read_foreign

HAND = load_hand("allegro_right")


def links_at(posture: Posture) -> np.ndarray:
    """Where the links are in the object's frame [m]."""
    base = Rotation.from_quat(np.roll(posture.quaternion_wxyz, -1))
    return base.apply(link_poses(HAND, posture.joint_positions)[1]) + posture.position


def posture_of(row: dict[str, Any], stage: str) -> Posture:
    return Posture(*(np.array(row[f"{stage}_{part}"]) for part in ("position", "quaternion_wxyz", "joint_positions")))


@pytest.mark.parametrize(("kind", "stages"), [("isaac", ("grasp",)), ("dexgraspbench", STAGES)])
def test_what_was_exported_comes_back(exported, tmp_path: Path, graspd, kind: str, stages: tuple[str, ...]):
    folder, rows = exported
    assert graspd("import", folder / kind, "--hand", "allegro_right", "--out", tmp_path / "back.json") == 0
    back = load_grasps(tmp_path / "back.json")
    verified = [row for row in rows if row["verdict"] == "verified"]
    assert len(back) == len(verified) == 8
    for grasp, row in zip(back, verified, strict=True):
        assert grasp.verdict is Verdict.UNVERIFIED
        for stage in stages:
            ours, theirs = posture_of(row, stage), getattr(grasp, stage)
            assert np.abs(links_at(ours) - links_at(theirs)).max() < 1e-6
            assert np.abs(ours.joint_positions - theirs.joint_positions).max() < 1e-6
        assert np.abs(grasp.pregrasp.joint_positions - row["pregrasp_joint_positions"]).max() < 1e-6
        # The squeeze that isaac_grasp lacks presses: the joints go on where they went.
        assert np.abs(grasp.squeeze.joint_positions - grasp.grasp.joint_positions).max() > 0.01


def test_the_squeeze_that_is_found_is_that_of_a_planned_grasp(exported, tmp_path: Path, graspd):
    folder, rows = exported
    assert graspd("import", folder / "isaac", "--hand", "allegro_right", "--preset", "fast", "--out", tmp_path) == 0
    (path,) = tmp_path.glob("*.json")
    targets = np.array([row["squeeze_joint_positions"] for row in rows if row["verdict"] == "verified"])
    found = np.array([grasp.squeeze.joint_positions for grasp in load_grasps(path)])
    assert np.median(np.abs(found - targets)) < 0.01


def test_a_pose_alone_is_closed_and_pressed(exported, tmp_path: Path, graspd, capsys):
    folder, rows = exported
    out = tmp_path / "back.json"
    words = ("--hand", "allegro_right", "--verify", "standard", "--out", out)
    assert graspd("import", folder / "graspgen", *words) == 0
    document, back = json.loads(out.read_text()), load_grasps(out)
    failed = sum(row["verdict"] == "failed" for row in rows)
    assert document["refused"].get("its file says that the grasp did not hold", 0) == failed
    assert len(back) + sum(document["refused"].values()) == len(rows)
    ours = {tuple(np.round(row["grasp_position"], 7)): row for row in rows}
    for grasp in back:
        row = ours[tuple(np.round(grasp.grasp.position, 7))]
        turns = [np.array(q) / np.linalg.norm(q) for q in (grasp.grasp.quaternion_wxyz, row["grasp_quaternion_wxyz"])]
        assert min(np.abs(turns[0] - turns[1]).max(), np.abs(turns[0] + turns[1]).max()) < 1e-9
        assert len(grasp.contacts) >= 2
        assert grasp.metrics is not None
    assert sum(grasp.verdict is Verdict.VERIFIED for grasp in back) >= len(back) // 2
    assert "verified" in capsys.readouterr().out


def test_objects_of_equal_content_have_a_file_each(tmp_path: Path, graspd):
    for number, name in enumerate("ab", 1):
        (tmp_path / name).mkdir()
        save_mesh(tmp_path / name / "box.obj", make_shape("box"))
        poses = {"transforms": number * [np.eye(4).tolist()], "object_in_gripper": number * [False]}
        document = {"object": {"file": "box.obj", "scale": 1.0}, "grasps": poses}
        (tmp_path / name / "grasps.json").write_text(json.dumps(document))
    graspd("import", tmp_path, "--hand", "allegro_right", "--preset", "fast", "--out", tmp_path / "out")
    refused = [json.loads(path.read_text())["refused"] for path in (tmp_path / "out").iterdir()]
    assert sorted(sum(counts.values()) for counts in refused) == [1, 2]


def test_an_order_by_name_and_a_moved_object(exported, tmp_path: Path):
    """The same grasp with its joints turned round and everything moved in the world is the same grasp."""
    path, values = one_npy(exported)
    values["obj_scale"] = np.float32(2.0)
    names = list(all_joint_names(HAND))[::-1]
    turn, shift = Rotation.from_rotvec([0.3, -1.0, 0.5]), np.array([1.0, -2.0, 0.5])
    for key in ("pregrasp_qpos", "grasp_qpos", "squeeze_qpos"):
        row = values[key]
        turned = turn * Rotation.from_quat(np.roll(row[3:7], -1))
        values[key] = np.concatenate([turn.apply(row[:3]) + shift, np.roll(turned.as_quat(), 1), row[:6:-1]])
    values["obj_pose"] = np.concatenate([shift, np.roll(turn.as_quat(), 1)])
    (moved,) = read_foreign(written(tmp_path, values), HAND, mesh="shape:mug", order=names)
    (still,) = read_foreign(path, HAND)
    assert (moved.scale, still.scale) == (2.0, 1.0)
    assert np.abs(links_at(moved.grasp) - links_at(still.grasp)).max() < 1e-6


def test_another_link_may_carry_the_pose(exported, tmp_path: Path):
    folder, _ = exported
    (path,) = (folder / "isaac").rglob("*.yaml")
    document = yaml.safe_load(path.read_text())
    base = read_foreign(path, HAND)
    index = HAND.link_index["link_2.0"]
    for grasp, known in zip(document["grasps"].values(), base, strict=True):
        rotations, translations = link_poses(HAND, known.grasp.joint_positions)
        hand = Rotation.from_quat(np.roll(known.grasp.quaternion_wxyz, -1))
        quaternion = np.roll((hand * Rotation.from_matrix(rotations[index])).as_quat(), 1).tolist()
        grasp["orientation"] = {"w": quaternion[0], "xyz": quaternion[1:]}
        grasp["position"] = (hand.apply(translations[index]) + known.grasp.position).tolist()
    document["gripper_frame_link"] = "/World/hand/link_2.0"
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(document))
    for known, grasp in zip(base, read_foreign(other, HAND, mesh="shape:mug"), strict=True):
        assert np.abs(links_at(known.grasp) - links_at(grasp.grasp)).max() < 1e-6


def one_npy(exported) -> tuple[Path, dict[str, Any]]:
    path = sorted((exported[0] / "dexgraspbench").rglob("*.npy"))[0]
    return path, np.load(path, allow_pickle=True).item()


def written(folder: Path, values: Any) -> Path:
    np.save(folder / "grasp.npy", np.array(values, dtype=object), allow_pickle=True)
    return folder / "grasp.npy"


MOVED = """<mujoco model="moved"><worldbody><body name="palm" pos="0 0.02 0.034" quat="0 1 0 1">
<geom type="box" size=".04 .04 .01"/><body name="finger" pos="0.04 0 0.01">
<joint name="hinge" axis="0 1 0" range="0 90"/>
<geom type="capsule" fromto="0 0 0 0 0 .05" size=".01"/></body></body></worldbody></mujoco>"""


def test_a_qpos_is_that_of_the_frame_of_the_hands_file(tmp_path: Path):
    """That bench attaches the file's world, in which the base body stands somewhere."""
    (tmp_path / "moved.xml").write_text(MOVED)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    row = np.array([0.1, 0.2, 0.3, *np.roll(turn.as_quat(), 1), 0.5])
    values = {f"{stage}_qpos": row for stage in STAGES} | {"obj_path": "x", "obj_scale": 1.0}
    values["obj_pose"] = np.array([0.0, 0, 0, 1, 0, 0, 0])
    hand = load_hand(tmp_path / "moved.xml", candidates=20)
    (grasp,) = read_foreign(written(tmp_path, values), hand, mesh="shape:mug", order=("hinge",))
    assert np.allclose(grasp.grasp.position, row[:3] + turn.apply([0.0, 0.02, 0.034]))
    found = Rotation.from_quat(np.roll(grasp.grasp.quaternion_wxyz, -1))
    assert (found.inv() * turn * Rotation.from_quat([1, 0, 1, 0])).magnitude() < 1e-9


@pytest.fixture(scope="module")
def shifted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six grasps of a box whose hands are 34 mm farther along their approach than they were planned."""
    folder = tmp_path_factory.mktemp("shifted")
    found = plan_grasps(load_scene("shape:box"), HAND, count=6, preset="fast", verify="none", measure=False).grasps
    for number, grasp in enumerate(found):
        row: dict[str, Any] = {"hand_name": "allegro_right"}
        turn = Rotation.from_quat(np.roll(grasp.grasp.quaternion_wxyz, -1))
        for stage in STAGES:
            posture = getattr(grasp, stage)
            row[f"{stage}_position"] = posture.position + 0.034 * turn.apply(HAND.approach)
            row[f"{stage}_quaternion_wxyz"] = posture.quaternion_wxyz
            row[f"{stage}_joint_positions"] = posture.joint_positions
        values = {"obj_path": "x", "obj_scale": 1.0, "obj_pose": np.array([0.0, 0, 0, 1, 0, 0, 0])}
        values |= {f"{stage}_qpos": qpos(row, stage) for stage in STAGES}
        np.save(folder / f"{number}.npy", np.array(values, dtype=object), allow_pickle=True)
    return folder


def test_a_frame_in_doubt_is_named_and_no_share_is_printed_for_it(shifted: Path, tmp_path: Path, graspd, capsys):
    out = tmp_path / "out.json"
    assert graspd("import", shifted, "--object", "shape:box", "--hand", "allegro_right", "--out", out) == 0
    told = "grasps are more than 5 mm deep in the object: the poses do not seem to be those of base link 'base_link'"
    assert told in capsys.readouterr().err
    assert told in json.loads(out.read_text())["outcome"]["warnings"][0]
    words = ("--hand", "allegro_right", "--presets", "fast", "--trials", "standard", "--out", tmp_path / "out")
    assert graspd("bench", "--import", shifted, "--objects", "shape:box", *words) == 0
    printed = capsys.readouterr().out
    (line,) = [line for line in printed.splitlines() if "| imported, frame in doubt |" in line]
    assert "%" not in line
    assert told in printed


def test_a_file_that_runs_code_is_refused_and_runs_nothing(exported, tmp_path: Path):
    _, values = one_npy(exported)
    witness = tmp_path / "witness"
    for payload, culprit in (
        (Evil(os.system, f"touch {witness}"), "system"),
        (Evil(np.load, str(witness)), "load"),
        (Evil(eval, f"open({str(witness)!r}, 'w')"), "eval"),
    ):
        path = written(tmp_path, {**values, "more": payload})
        with refused(FormatError, match=rf"grasp.npy: asks for .*{culprit}.*refused, and nothing"):
            read_foreign(path, HAND, mesh="shape:mug")
    assert not witness.exists()


def test_plain_values_of_every_protocol_are_read_and_an_array_of_numbers_is_no_grasp(tmp_path: Path):
    values = {"obj_path": "x", "obj_scale": np.float32(0.5), "grasp_qpos": np.arange(23.0), "n": [1, (2, 3)]}
    for protocol in range(5):
        file = BytesIO()
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        pickle.dump(np.array(values, dtype=object), file, protocol=protocol)
        assert set(npy_dictionary(tmp_path, file.getvalue())) == set(values)
    np.save(tmp_path / "numbers.npy", np.zeros(23))
    with pytest.raises(FormatError, match="holds an array of float64 of shape"):
        read_foreign(tmp_path, HAND)


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "missing": (lambda v: v.pop("squeeze_qpos"), "the key 'squeeze_qpos' is missing"),
    "nan": (lambda v: v["grasp_qpos"].__setitem__(3, np.nan), "grasp_qpos.*expected 23 numbers"),
    "short": (lambda v: v.update(grasp_qpos=v["grasp_qpos"][:-1]), "grasp_qpos: 15 joints; the joint order has 16"),
    "matrix": (lambda v: v.update(grasp_qpos=np.zeros((2, 23))), "grasp_qpos.*expected 23 numbers"),
    "huge": (lambda v: v["grasp_qpos"].__setitem__(0, 1e200), "expected 23 numbers of at most 1e"),
    "length": (lambda v: v["grasp_qpos"].__setitem__(slice(3, 7), 0.1), "the quaternion has length 0.2"),
    "text": (lambda v: v.update(obj_scale="big"), "obj_scale: 'big'; expected a number of at most"),
    "objects": (lambda v: v.update(obj_pose=np.array([None] * 7)), "obj_pose: its array has type 'O8'"),
    "ragged": (lambda v: v.update(grasp_qpos=[[1.0], [1.0, 2.0]]), "grasp_qpos.*expected 23 numbers"),
    "mesh": (lambda v: v.update(obj_path="/nowhere"), "--object MESH"),
    "mesh of a long name": (lambda v: v.update(obj_path=300 * "x"), "--object MESH"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_wrong_entry_is_named(exported, tmp_path: Path, change: str):
    _, values = one_npy(exported)
    spoil, message = CHANGES[change]
    spoil(values)
    mesh = None if change.startswith("mesh") else "shape:mug"
    with refused(FormatError, match=message, start=f"{tmp_path / 'grasp.npy'}: "):
        read_foreign(written(tmp_path, values), HAND, mesh=mesh)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npy", b"", "not an npy file"),
        ("a.npy", b"no npy at all, but long enough for its magic", "not an npy file"),
        ("a.json", b"{", "not JSON"),
        ("a.json", b"[1]", "expected a mapping with the key 'object'"),
        ("a.json", b'{"object": {"file": "a.json", "scale": 1}, "grasps": {"transforms": [[1]]}}', "object_in_gripper"),
        ("a.yaml", b"format: isaac_grasp\nformat_version: 2.0", "valid: isaac_grasp 1.0"),
        ("a.yaml", b"a: [", "not YAML"),
        ("a.yaml", b"\xff\xfe\x00", "not YAML"),
        ("a.txt", b"", "unknown ending '.txt'; valid: .npy"),
    ],
)
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, name: str, content: bytes, message: str):
    path = tmp_path / name
    path.write_bytes(content)
    with refused(FormatError, match=message):
        read_foreign(path, HAND)


def test_a_truncated_npy_is_refused_wherever_it_ends(exported, tmp_path: Path):
    path, _ = one_npy(exported)
    content, cut = path.read_bytes(), tmp_path / "cut.npy"
    for size in range(0, len(content) - 1, 37):
        cut.write_bytes(content[:size])
        with pytest.raises(FormatError, match=r"cut\.npy: "):
            read_foreign(cut, HAND, mesh="shape:mug")


def test_isaac_joints_go_by_name(exported, tmp_path: Path):
    (path,) = (exported[0] / "isaac").rglob("*.yaml")
    document = yaml.safe_load(path.read_text())
    joints = next(iter(document["grasps"].values()))["cspace_position"]
    name, value = joints.popitem()
    other = tmp_path / "a.yaml"
    for more, message in ((None, f"joint '{name}' of allegro_right is missing"), ("LFJ5", "'LFJ5' is not a joint of")):
        joints.update({more: 0.0} if more else {})
        other.write_text(yaml.safe_dump(document))
        with pytest.raises(FormatError, match=message):
            read_foreign(other, HAND, mesh="shape:mug")
    joints.pop("LFJ5")
    joints[name] = value + 100
    other.write_text(yaml.safe_dump(document))
    assert len(read_foreign(other, HAND, mesh="shape:mug")) == 8


def test_a_joint_beyond_its_limit_is_refused_and_counted(exported, tmp_path: Path, graspd, capsys):
    _, values = one_npy(exported)
    values["grasp_qpos"][7] = 3.0
    written(tmp_path, values)
    words = ("import", tmp_path, "--object", "shape:mug", "--hand", "allegro_right", "--out", tmp_path / "x.json")
    assert graspd(*words) == 3
    assert f"1 refused: joint {HAND.joint_names[0]} is beyond its limits" in capsys.readouterr().err
    assert load_grasps(tmp_path / "x.json") == ()


def test_an_order_that_is_not_known_or_does_not_fit_is_refused(exported, tmp_path: Path, refusal_of):
    folder, _ = exported
    for words, message in (
        (("--hand", "leap_right"), "joint order: not known for leap_right; give all joints in the file's order, e.g. "),
        (("--hand", "allegro_right", "--joint-order", "a,b"), "joint order: 'a' is not a joint of allegro_right; "),
        (("--hand", "allegro_right", "--joint-order", HAND.joint_names[0]), "of allegro_right is missing"),
    ):
        assert message in refusal_of("import", folder / "dexgraspbench", *words, "--out", tmp_path)


def test_coupled_joints_may_be_named_and_must_follow():
    from graspd_core.hands.model import all_joint_positions
    from graspd_dataset.foreign_grasps import joints_by_name

    hand = load_hand("barrett_like")
    joints = 0.5 * (hand.lower + hand.upper)
    values = dict(zip(all_joint_names(hand), all_joint_positions(hand, joints).tolist(), strict=True))
    assert np.abs(joints_by_name(values, hand, "x") - joints).max() < 1e-12
    coupled = next(mimic.name for mimic in hand.mimics)
    with pytest.raises(FormatError, match=f"joint '{coupled}' is .*; valid: .*, because it is coupled"):
        joints_by_name({**values, coupled: values[coupled] + 0.1}, hand, "x")


def test_a_bench_tries_them_beside_ours(exported, tmp_path: Path, graspd, capsys):
    """Each of ours that was exported holds again, and a grasp from which the hand was taken away does not."""
    _, values = one_npy(exported)
    for stage in STAGES:
        values[f"{stage}_qpos"][:3] += 1.0
    good, away = one_npy(exported)[0], tmp_path / "two"
    away.mkdir()
    np.save(away / "0.npy", np.load(good, allow_pickle=True), allow_pickle=True)
    np.save(away / "1.npy", np.array(values, dtype=object), allow_pickle=True)
    meshes = (exported[0] / "dexgraspbench" / "objects").rglob("simplified.obj")
    words = ("bench", "--import", away, "--objects", *meshes)
    words += ("--hand", "allegro_right", "--presets", "fast", "--trials", "standard,gravity", "--out", tmp_path / "out")
    assert graspd(*words) == 0
    (record,) = json.loads((tmp_path / "out" / "results.json").read_text())["records"]
    assert [grasp["standard"]["passed"] for grasp in record["grasps"]["imported"]] == [True, False]
    assert [len(grasps) for grasps in record["grasps"].values()] == [2, 2, 2]
    assert all(grasp["standard"]["passed"] for grasp in record["grasps"]["planned"])
    assert record["grasps"]["imported"][0]["gravity"]["displacement_cm"] < 1.0
    assert record["grasps"]["imported"][1]["metrics"]["contact_links"] == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert "penetration mm" in lines[0]
    assert [line.split(" | ")[1:4] for line in lines[1:]] == [
        ["imported", "2 of 2", "50%"],
        ["graspd, as ranked", "2 of 2", lines[2].split(" | ")[3]],
        ["graspd, verified", "2 of 2", "100%"],
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("imported",), "imported: give both --import FOLDER and --hand"),
        (("--import", "x"), "imported: give both --import FOLDER and --hand"),
        (("--import", "nowhere", "--hand", "allegro_right"), "nowhere: no such file or folder"),
        (("--import", "x", "--hand", "allegro_right", "--trials", "luck"), "unknown trial 'luck'; valid: standard"),
        (("steered", "--import", "x"), "imported: not used by steered"),
    ],
)
def test_a_bench_without_what_it_needs_is_refused(tmp_path: Path, refusal_of, words: tuple[str, ...], message: str):
    assert message in refusal_of("bench", *words, "--out", tmp_path)
