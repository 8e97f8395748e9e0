"""Study `dexgraspbench`, without a checkout: what is written for it, how it is run, what is told of its results."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from menagerie_like import menagerie_like

from graspd_bench.studies.dexgraspbench import (
    ARMATURE,
    AS_IS,
    bench_cases,
    bench_sections,
    run_bench,
    write_armature,
    write_grasps,
)
from graspd_bench.study import Request
from graspd_core import Grasp, Posture, load_hand, load_mesh, load_scene, make_shape
from graspd_core.cli import main
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import link_poses
from graspd_core.io.grasps_json import load_document
from graspd_core.mesh.topology import moved_mesh
from graspd_dataset.export_grasps import obj_text

# A stand-in for its program: grasps whose number is even hold, and it ends as `{ending}` says.
STAND_IN = """
import pathlib, sys
import numpy as np
if sys.argv[1:] == ["--help"]:
    sys.exit(0)
given = dict(word.split("=", 1) for word in sys.argv[1:])
own, out = (pathlib.Path(given[name].strip("'")) for name in ("grasp_dir", "eval_dir"))
assert pathlib.Path(given["hand.xml_path"].strip("'")).is_file() and given["hand"] == "allegro"
{ending}
for path in own.rglob("*.npy"):
    grasp = np.load(path, allow_pickle=True).item()
    assert list(pathlib.Path(grasp["obj_path"], "urdf/meshes").glob("convex_piece_*.obj"))
    held = int(path.stem) % 2 == 0
    moved = (0.01, 2.0) if held else (100, 100)
    to = out / path.relative_to(own)
    to.parent.mkdir(parents=True, exist_ok=True)
    np.save(to, {{"succ_flag": np.bool_(held), "delta_pos": np.float64(moved[0]), "delta_angle": moved[1]}})
"""


def checkout(folder: Path, ending: str = "") -> Path:
    for name, text in (
        ("src/main.py", STAND_IN.format(ending=ending)),
        ("assets/hand/allegro/right_hand.xml", menagerie_like()),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def bench_words(folder: Path, *words: Any, python: str = sys.executable) -> list[str]:
    asked = ("--objects", "shape:sphere", "--presets", "fast", "--count", 2, "--out", folder.parent / "out")
    return [str(word) for word in ("bench", "dexgraspbench", folder, "--python", python, *asked, *words)]


def test_fingers_and_object_stand_about_the_centre_of_mass_in_its_frame(tmp_path: Path):
    place = np.array([0.3, -0.2, 0.1])
    scene, hand = load_scene(moved_mesh(make_shape("mug"), place), mass=0.1), load_hand("allegro_right")
    joints = np.linspace(0.3, 1.0, 16).clip(hand.lower, hand.upper)
    pose = Posture(place + 0.05, np.array([0.5, -0.5, 0.1, 0.7]), joints)
    (path,) = write_grasps(scene, hand, [Grasp(pose, pose, pose)], tmp_path)
    grasp = np.load(tmp_path / path, allow_pickle=True).item()
    model = mujoco.MjModel.from_xml_string(menagerie_like())  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:] = grasp["squeeze_qpos"]
    mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    _, links = link_poses(hand, joints)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, pose.quaternion_wxyz)  # pyright: ignore[reportAttributeAccessIssue]
    for body, link in {"ff3": "link_3.0", "mf3": "link_7.0", "rf3": "link_11.0", "th3": "link_15.0"}.items():
        ours = turn.reshape(3, 3) @ links[hand.link_index[link]] + pose.position - scene.object.center_of_mass
        assert np.linalg.norm(data.body(body).xpos - ours) < 1e-5
    folder = Path(grasp["obj_path"])
    assert folder.is_absolute()
    assert (grasp["obj_scale"], grasp["obj_pose"].tolist()) == (1.0, [0, 0, 0, 1, 0, 0, 0])
    told = json.loads((folder / "info" / "simplified.json").read_text())
    assert told["mass"] / told["density"] == pytest.approx(scene.object.volume, rel=1e-6)
    assert np.abs(told["gravity_center"]).max() < 1e-4
    spec = mujoco.MjSpec()  # pyright: ignore[reportAttributeAccessIssue]
    body = spec.worldbody.add_body()
    for part in (folder / "urdf" / "meshes").glob("convex_piece_*.obj"):
        spec.add_mesh(name=part.stem, file=str(part))
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=part.stem)  # pyright: ignore[reportAttributeAccessIssue]
    # Parts fill a little more than the mug.
    assert np.abs(spec.compile().body_ipos[1]).max() < 0.005
    assert np.ptp(load_mesh(folder / "mesh" / "simplified.obj").vertices, axis=0) == pytest.approx(
        np.ptp(scene.object.mesh.vertices, axis=0)
    )


def test_every_joint_of_the_copy_has_the_armature_and_its_meshes_are_found(tmp_path: Path):
    folder = tmp_path / "hand"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "ball.obj").write_text(obj_text(make_shape("sphere")))
    text = menagerie_like().replace('angle="radian"', 'angle="radian" meshdir="meshes"')
    (folder / "hand.xml").write_text(text.replace("<worldbody>", '<asset><mesh file="ball.obj"/></asset><worldbody>'))
    copy = write_armature(folder / "hand.xml", tmp_path / "copy.xml", 1e-4)
    model = mujoco.MjModel.from_xml_path(str(copy))  # pyright: ignore[reportAttributeAccessIssue]
    assert model.nmesh == 1
    assert model.dof_armature.tolist() == [0.0] * 6 + [1e-4] * 16
    assert "armature" not in (folder / "hand.xml").read_text()


def test_both_verdicts_stand_side_by_side(tmp_path: Path, capsys):
    assert main(bench_words(checkout(tmp_path / "bench"), "--armature")) == 0
    told = capsys.readouterr().out
    for variant in (AS_IS, ARMATURE):
        assert re.search(rf"\| sphere \| {variant} \| \d+ \| 2 \| 1 \| 1 \| \d+ \| \d+ \| 50% \|", told)
        assert f"Failed only there, {variant}: 1: refused: the pregrasp overlaps" in told
    assert "Known differences" in told


def test_grasps_of_a_file_are_taken(tmp_path: Path):
    file = tmp_path / "grasps.json"
    assert main(["synthesize", "shape:box", "--preset", "fast", "--count", "3", "--out", str(file)]) == 0
    tried = len(load_document(file)["grasps"])
    (case,) = bench_cases(Request(checkout=str(checkout(tmp_path / "bench")), python=sys.executable, grasps=str(file)))
    record = run_bench(case)
    assert case.object == "shape:box"
    assert tried == len(record["ours"]) == len(record["theirs"][AS_IS]) > 2


def test_what_is_not_there_is_told_in_a_line(tmp_path: Path, refusal_of):
    def told(*words: Any, **other: Any) -> str:
        return refusal_of(*bench_words(*words, **other))

    assert "not a checkout of DexGraspBench: src/main.py is missing" in told(tmp_path / "none")
    folder = checkout(tmp_path / "bench")
    assert "python: '/no/python' is not a program" in told(folder, python="/no/python")
    assert "python: not given; give --python PATH" in told(folder, python="")
    assert "hand 'leap_right'; valid: allegro_right" in told(folder, "--hand", "leap_right")
    (folder / "src" / "main.py").write_text("import no_such_library\n")
    assert "ended with an error: ModuleNotFoundError: No module named 'no_such_library'" in told(folder)


@pytest.mark.parametrize(
    ("ending", "said"),
    [
        ("sys.exit('it went wrong')", "ended with an error: it went wrong .exit status 1"),
        ("print('one grasp raised')\nsys.exit(0)", "gave no result for grasp .*: one grasp raised"),
    ],
)
def test_an_evaluation_that_fails_is_told_in_a_line(tmp_path: Path, ending: str, said: str):
    asked = {"objects": ("shape:sphere",), "presets": ("fast",), "count": 1, "python": sys.executable}
    (case,) = bench_cases(Request(checkout=str(checkout(tmp_path / "bench", ending)), **asked))
    with pytest.raises(ConfigError, match=said):
        run_bench(case)


def test_reasons_are_counted_and_cells_add_up():
    def there(held: bool, travel: float = 0.0, turn: float = 0.0) -> dict[str, Any]:
        return {"held": held, "travel": travel, "turn": turn}

    ours = [{"verified": verified} for verified in (True, True, True, False, False)]
    theirs = [there(True), there(False, 0.06), there(False, 0.01, 20.0), there(True), there(False, 100.0, 100.0)]
    record = {"object": "shape:box", "ours": ours, "theirs": {AS_IS: theirs}}
    table, reasons, _ = bench_sections([record, record], None)["dexgraspbench"]
    assert f"| **all** | {AS_IS} | 10 | 6 | 2 | 4 | 2 | 2 | 33% |" in str(table)
    assert "2: the object moved more than 5 cm; 2: the object turned more than 15°." in str(reasons)
