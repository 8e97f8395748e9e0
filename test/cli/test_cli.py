"""The command line: what comes out, the exit status, and one line on stderr for whatever is wrong with the input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspd_core.cli import main
from graspd_core.cli.options import summary
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_OK, EXIT_TOO_FEW, Interrupt
from graspd_core.io.grasps_json import load_document, load_grasps
from graspd_core.mesh.mesh_files import save_mesh, surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.plan_config import preset_names
from graspd_core.planning import plan_grasps as pipeline
from graspd_core.types import Grasp, GraspResult, Outcome, Posture, Timing, TrialResult, TriangleMesh

GRASPD = [sys.executable, "-m", "graspd_core.cli"]
NO_FACES = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
NAN_VERTEX = "v 0 0 0\nv nan 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def save_large(path: Path) -> None:
    box = make_shape("box")
    save_mesh(TriangleMesh(box.vertices / np.ptp(box.vertices, axis=0).max() * 40.0, box.faces), path)


# name of the file: how to make it, and what the message must say
BAD_OBJECTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing.obj": (lambda path: None, "no such"),
    "missing.npy": (lambda path: None, "no such"),
    "folder.stl": (lambda path: path.mkdir(), "is a directory"),
    "notes.txt": (lambda path: path.write_text("hello"), "unknown ending"),
    "noise.stl": (lambda path: path.write_bytes(b"not a mesh at all"), "noise.stl"),
    "empty.obj": (lambda path: path.write_text(""), "empty.obj"),
    "points.obj": (lambda path: path.write_text(NO_FACES), "3 vertices and no face"),
    "nan.obj": (lambda path: path.write_text(NAN_VERTEX), "NaN"),
    "large.ply": (save_large, "40 m across"),
    "empty.npy": (lambda path: np.save(path, np.zeros((0, 3))), "empty"),
    "nan.npy": (lambda path: np.save(path, np.full((100, 3), np.nan)), "NaN"),
    "flat.npy": (lambda path: np.save(path, np.zeros(7)), "points × 3"),
    "words.npz": (lambda path: path.write_bytes(b"PK nothing"), "words.npz"),
}
BAD_OPTIONS: list[tuple[list[str], str]] = [
    (["--hand", "claw"], "unknown hand 'claw'; known: allegro_left, allegro_right"),
    (["--hand", "missing.yaml"], "missing.yaml: no such file"),
    (["--preset", "best"], f"unknown preset 'best'; valid presets: {', '.join(preset_names())}"),
    (["-n", "0"], "count: 0 grasps; valid: 1 to 1024"),
    (["-n", "many"], "invalid int value: 'many'"),
    (["--seed", "-1"], "seed: -1; valid: 0 to"),
    (["--mass", "-0.1"], "mass -0.1 kg must be a positive number"),
    (["--mass", "nan"], "mass nan kg"),
    (["--friction", "-1"], "friction -1.0 must be a positive number"),
    (["--scale", "0"], "scale 0.0 must be a positive number"),
    (["--scale", "1e6"], "m across"),
    (["--units", "furlong"], "invalid choice: 'furlong' (choose from"),
    (["--scale", "2", "--units", "mm"], "not allowed with argument"),
    (["--deadline", "0"], "deadline: 0.0 s; it must be positive"),
    (["--verify", "gently"], "invalid choice: 'gently' (choose from"),
    (["--method", "magic"], "invalid choice: 'magic' (choose from"),
    (["--device", "abacus"], "device: 'abacus'; valid on this machine: cpu"),
    (["--threads", "0"], "threads: 0; at least 1"),
    (["--approach", "0", "0", "0"], "approach_direction: (0, 0, 0) is no direction"),
    (["--approach", "0", "nan", "0"], "approach_direction: [0.0, nan, 0.0]; valid: 3 finite numbers"),
    (["--approach", "0", "0", "-1", "--approach-angle", "200"], "approach_angle: 3.491 rad; valid: above 0"),
    (["--approach-angle", "20"], "--approach-angle: it needs --approach"),
    (["--roll-tolerance", "20"], "--roll-tolerance: it needs --roll"),
    (["--roll", "20"], "roll: needs approach_direction"),
    (["--region", "cube", "0"], "--region: cube 0; valid: box X Y Z SX SY SZ"),
    (["--region", "box", "0", "0", "0"], "--region: box 0 0 0; valid: box X Y Z SX SY SZ, sphere X Y Z R, or FILE [R]"),
    (["--region", "sphere", "0", "0", "0", "wide"], "--region: sphere 0 0 0 wide; valid: box"),
    (["--region", "sphere", "1", "0", "0", "0.1"], "region: no part of the object lies in it; the object goes from"),
    (["--avoid", "0", "0", "0", "1", "1", "0"], "box size: (1.0, 1.0, 0.0); valid: three lengths above 0"),
    (["--arm", "ur99", "--arm-base", "1", "0", "0"], "unknown arm 'ur99'; known: panda_like, ur5e_like"),
    (["--arm", "ur5e_like"], "--arm: say where it stands, --arm-base X Y Z or X Y Z QW QX QY QZ"),
    (["--arm", "ur5e_like", "--arm-base", "1", "0", "0", "1"], "--arm-base: 4 numbers; valid"),
    (["--arm-base", "1", "0", "0"], "--arm-base: there is no arm"),
    (["--arm", "ur5e_like", "--arm-base", "0", "0", "0", "1", "1", "0", "0"], "valid: w x y z of length 1"),
    (["--frobnicate"], "unrecognized arguments: --frobnicate"),
]


def the_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of stderr; nothing on stdout."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("graspd: ")
    assert err.count("\n") == 1, err
    return err


@pytest.mark.parametrize("name", BAD_OBJECTS)
def test_a_bad_object_is_named_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str):
    make, culprit = BAD_OBJECTS[name]
    make(tmp_path / name)
    assert main(["synthesize", str(tmp_path / name)]) == EXIT_BAD_INPUT
    line = the_line(capsys)
    assert culprit in line
    assert name in line or name.endswith("npy"), "clouds are cleaned after they were read, under the name of cloud"


def test_an_unknown_shape_lists_the_known(capsys: pytest.CaptureFixture[str]):
    assert main(["synthesize", "shape:teapot"]) == EXIT_BAD_INPUT
    line = the_line(capsys)
    assert "teapot" in line
    assert "cylinder" in line


@pytest.mark.parametrize(("options", "culprit"), BAD_OPTIONS, ids=lambda value: str(value)[:40])
def test_a_bad_option_is_named_in_one_line(capsys: pytest.CaptureFixture[str], options: list[str], culprit: str):
    assert main(["synthesize", "shape:box", *options]) == EXIT_BAD_INPUT
    assert culprit in the_line(capsys)


@pytest.mark.parametrize("option", ["--hand", "--preset"])
def test_malformed_yaml_is_named_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str):
    (tmp_path / "broken.yaml").write_text("a: [1\nb: {")
    assert main(["synthesize", "shape:box", option, str(tmp_path / "broken.yaml")]) == EXIT_BAD_INPUT
    assert "broken.yaml" in the_line(capsys)


@pytest.mark.parametrize("option", ["--out", "--html"])
def test_an_unwritable_result_is_refused_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pipeline, "plan_grasps", lambda *_, **__: pytest.fail("the run was started"))
    (tmp_path / "file").write_text("here")
    for path, culprit in ((tmp_path, "is a directory"), (tmp_path / "file" / "out", "cannot be written")):
        assert main(["synthesize", "shape:box", option, str(path)]) == EXIT_BAD_INPUT
        line = the_line(capsys)
        assert str(path) in line
        assert culprit in line


def test_no_command_is_bad_input_and_help_is_not(capsys: pytest.CaptureFixture[str]):
    assert main([]) == EXIT_BAD_INPUT
    assert "COMMAND" in the_line(capsys)
    with pytest.raises(SystemExit) as left:
        main(["synthesize", "--help"])
    assert left.value.code == 0
    assert "--friction" in capsys.readouterr().out


def test_hands_lists_the_boxed_hands(capsys: pytest.CaptureFixture[str]):
    assert main(["hands"]) == EXIT_OK
    assert "allegro_right: 16 joints" in capsys.readouterr().out


def test_a_cloud_is_reconstructed_to_a_mesh_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    np.save(tmp_path / "ball.npy", surface_samples(make_shape("sphere"), 2000, 0)[0])
    assert main(["reconstruct", str(tmp_path / "ball.npy"), "--out", str(tmp_path / "ball.ply")]) == EXIT_OK
    assert "ball.ply" in capsys.readouterr().out
    assert (tmp_path / "ball.ply").stat().st_size > 1000
    assert main(["reconstruct", str(tmp_path / "ball.npy"), "--out", str(tmp_path / "ball.doc")]) == EXIT_BAD_INPUT
    assert "valid endings" in the_line(capsys)
    assert main(["reconstruct", str(tmp_path / "none.npy"), "--out", str(tmp_path / "x.ply")]) == EXIT_BAD_INPUT
    assert "none.npy" in the_line(capsys)


def test_a_scene_file_sets_the_reconstruction(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    np.save(tmp_path / "ball.npy", surface_samples(make_shape("sphere"), 2000, 0)[0])
    scene = tmp_path / "scene.yaml"
    scene.write_text("reconstruction: {max_faces: 300}")
    command = ["reconstruct", str(tmp_path / "ball.npy"), "--out", str(tmp_path / "ball.ply"), "--scene", str(scene)]
    assert main(command) == EXIT_OK
    assert int(capsys.readouterr().out.split(": ")[1].split()[0]) <= 300
    scene.write_text("reconstruction: {most_faces: 300}")
    for bad in (command, ["synthesize", str(tmp_path / "ball.npy"), "--scene", str(scene)]):
        assert main(bad) == EXIT_BAD_INPUT
        assert "scene.yaml.reconstruction: unknown key 'most_faces'; valid keys: fit_distance" in the_line(capsys)


def test_an_arm_that_reaches_is_written_and_one_that_does_not_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    asked = ["synthesize", "shape:box", "-n", "1", "--hand", "barrett_like", "--verify", "none", "--arm", "panda_like"]
    assert main([*asked, "--arm-base", "-0.5", "0", "-0.1", "--out", str(tmp_path / "g.json")]) == EXIT_OK
    assert all(grasp.arm is not None for grasp in load_grasps(tmp_path / "g.json"))
    capsys.readouterr()
    assert main([*asked, "--arm-base", "-5", "0", "-0.1", "0", "0", "0", "1"]) == EXIT_TOO_FEW
    assert "m from the base of panda_like" in capsys.readouterr().out


def test_a_run_that_ends_with_too_few_says_so(capsys: pytest.CaptureFixture[str]):
    assert main(["synthesize", "shape:box", "-n", "2", "--preset", "fast", "--deadline", "0.01"]) == EXIT_TOO_FEW
    assert "0 of 2 grasps (verified, 0 tried): the deadline passed" in capsys.readouterr().out


def test_the_summary_lists_three_grasps_and_counts_the_others():
    posture = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(1))
    grasp = Grasp(posture, posture, posture, (), 0.0, trials=(TrialResult("hold", True, 0.0, 0.0),))
    lines = [
        summary(GraspResult(Outcome.SUCCEEDED, (grasp,) * count, Timing(), 0, "closed_form"), count, count).splitlines()
        for count in (3, 5)
    ]
    assert [line[-1] for line in lines] == ["  #2: 0 contacts", "  and 2 more"]


@pytest.mark.parametrize(
    ("outcome", "status"),
    [
        (Outcome.SUCCEEDED, EXIT_OK),
        (Outcome.TOO_FEW, EXIT_TOO_FEW),
        (Outcome.NO_CANDIDATES, EXIT_TOO_FEW),
        (Outcome.DEADLINE, EXIT_TOO_FEW),
        (Outcome.CANCELLED, EXIT_INTERRUPTED),
    ],
)
def test_every_outcome_has_its_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], outcome: Outcome, status: int
):
    ended = GraspResult(outcome, (), Timing(), 0, "closed_form")
    monkeypatch.setattr(pipeline, "plan_grasps", lambda *_, **__: ended)
    assert main(["synthesize", "shape:box"]) == status
    assert outcome.value in capsys.readouterr().out


def test_grasps_come_from_where_they_are_asked_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    np.save(tmp_path / "top.npy", make_shape("bottle").vertices)
    out = tmp_path / "grasps.json"
    asked = ["--approach", "0", "0", "-1", "--approach-angle", "40", "--roll", "90", "--roll-tolerance", "60"]
    asked += ["--region", str(tmp_path / "top.npy"), "0.05", "--avoid", "0", "0", "-0.2", "1", "1", "0.1"]
    status = main(["synthesize", "shape:bottle", "-n", "2", "--preset", "fast", *asked, "--out", str(out)])
    assert status in (EXIT_OK, EXIT_TOO_FEW)
    grasps = json.loads(out.read_text())["grasps"]
    assert grasps
    for grasp in grasps:
        w, x, y, z = grasp["quaternion_wxyz"]
        # The third row of the rotation: where allegro's approach, x, goes.
        assert 2 * (x * z - w * y) < -np.cos(np.radians(40)) + 1e-6
    assert "candidates held" in capsys.readouterr().out or json.loads(out.read_text())["refused"] == {}


def test_the_first_interrupt_ends_the_run_and_the_second_the_process():
    before = signal.getsignal(signal.SIGINT)
    with Interrupt() as interrupt:
        assert not interrupt.came()
        signal.raise_signal(signal.SIGINT)
        assert interrupt.came()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_the_main_job_in_a_process_of_its_own(tmp_path: Path):
    """A mesh in millimetres on disk in; grasps.json and a page out."""
    box = make_shape("box")
    save_mesh(TriangleMesh(box.vertices * 1000, box.faces), tmp_path / "box.stl")
    options = [
        "-n",
        "1",
        "--units",
        "mm",
        "--preset",
        "fast",
        "--seed",
        "1",
        "--out",
        "grasps.json",
        "--html",
        "view.html",
    ]
    done = subprocess.run([*GRASPD, "synthesize", "box.stl", *options], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == EXIT_OK, done.stderr
    assert "<title>box.stl, allegro_right: verified grasp</title>" in (tmp_path / "view.html").read_text()
    document = load_document(tmp_path / "grasps.json")
    assert [grasp["verdict"] for grasp in document["grasps"]].count("verified") == 1
    assert document["object"]["scale"] == 0.001
    assert document["seed"] == 1
    assert len(document["grasps"][0]["joint_positions"]) == len(document["hand"]["joint_names"]) == 16
    assert (tmp_path / "view.html").stat().st_size > 100_000
    assert "graspd: optimise" in done.stderr
    assert "total" in done.stdout


def test_ctrl_c_in_a_process_of_its_own(tmp_path: Path):
    out = tmp_path / "grasps.json"
    command = [*GRASPD, "synthesize", "shape:box", "-n", "32", "--preset", "accurate", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert "optimise" in process.stderr.readline()
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate()
    assert process.returncode == EXIT_INTERRUPTED, errors
    assert "Traceback" not in errors
    assert "cancelled" in output
    assert load_document(out)["outcome"]["name"] == "CANCELLED"
    # Amid its first round: nothing was tried.
    assert "verify" not in errors
