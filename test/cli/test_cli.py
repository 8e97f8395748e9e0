"""The command line: what comes out, the exit status, one line on stderr for what is wrong; recordings, libraries."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
from bag_writer import Record, camera_info_message, cloud_message, depth_message, transforms_message, write_bag
from expected import some

from graspd_bench.rendering.render import look_at, render_depth
from graspd_bench.rendering.tabletop import ring_poses, tabletop, views_of
from graspd_core.cli import main
from graspd_core.cli import options as clouds
from graspd_core.cli.options import summary
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_OK, EXIT_TOO_FEW, Interrupt
from graspd_core.io.grasps_json import load_document, load_grasps
from graspd_core.library.grasp_library import GraspLibrary
from graspd_core.mesh.mesh_files import load_mesh, save_mesh, surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.plan_config import preset_names
from graspd_core.paths import config_dir
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.perception.load_scene import load_scene
from graspd_core.planning import plan_grasps as pipeline
from graspd_core.transforms import SECOND
from graspd_core.types import Grasp, GraspResult, Outcome, Posture, Timing, TrialResult, TriangleMesh

GRASPD = [sys.executable, "-m", "graspd_core.cli"]

BAD_OPTIONS: list[tuple[list[str], str]] = [
    (["--hand", "claw"], "unknown hand 'claw'; valid: allegro_left, allegro_right"),
    (["--preset", "best"], f"unknown preset 'best'; valid: {', '.join(preset_names())}"),
    (["--preset", "mine/best.yaml"], "preset mine/best.yaml: no such file; valid: accurate"),
    (["-n", "many"], "invalid int value: 'many'"),
    (["--mass", "-0.1"], "mass -0.1 kg; valid: 0.001 to 100 kg"),
    (["--units", "furlong"], "argument --units: 'furlong'; valid: m, cm, mm, inch"),
    (["--scale", "2", "--units", "mm"], "not allowed with argument"),
    (["--any", "--alone"], "not allowed with argument"),
    (["--any"], "--any: given with shape:box; valid with clouds and depth images of several objects"),
    (["--any", "--view"], "--any: --view is given too; remove one of them"),
    (["--verify", "hardd"], "argument --verify: 'hardd'; did you mean 'hard'? (see graspd synthesize --help)"),
    (["--picture", "grasp.jpg"], "--picture grasp.jpg; valid: a file name that ends in .png"),
    (["--threads", "0"], "--threads: 0; valid: 1 or more"),
    (["--approach-angle", "20"], "--approach-angle needs --approach"),
    (["--roll-tolerance", "20"], "--roll-tolerance needs --roll"),
    (["--region", "cube", "0"], "--region: cube 0; valid: box X Y Z SX SY SZ"),
    (["--region", "box", "0", "0", "0"], "--region: box 0 0 0; valid: box X Y Z SX SY SZ, sphere X Y Z R, or FILE [R]"),
    (["--region", "sphere", "0", "0", "0", "wide"], "--region: sphere 0 0 0 wide; valid: box"),
    (["--arm", "ur5e_like"], "--arm: no base pose is given; give --arm-base X Y Z or X Y Z QW QX QY QZ, in metres"),
    (["--arm", "ur5e_like", "--arm-base", "1", "0", "0", "1"], "--arm-base: 4 numbers; valid"),
    (["--arm-base", "1", "0", "0"], "--arm-base: no arm is given; give --arm NAME"),
    (["--frobnicate"], "unrecognized arguments: --frobnicate"),
    (["--preste", "fast"], "unrecognized arguments: --preste fast; did you mean --preset?"),
    (["--hand", "alegro_right"], "unknown hand 'alegro_right'; did you mean 'allegro_right'?"),
    (["--preset", "balnced"], "unknown preset 'balnced'; did you mean 'balanced'?"),
    (["--method", "closedform"], "unknown method 'closedform'; did you mean 'closed_form'?"),
]


@pytest.mark.parametrize(("options", "culprit"), BAD_OPTIONS, ids=lambda value: str(value)[:40])
def test_a_bad_option_is_named_in_one_line(refusal_of, options: list[str], culprit: str):
    assert culprit in refusal_of("synthesize", "shape:box", *options)


@pytest.mark.parametrize("option", ["--out", "--html", "--picture"])
def test_an_unwritable_result_is_refused_before_the_run(tmp_path, refusal_of, monkeypatch, option: str):
    monkeypatch.setattr(pipeline, "plan_grasps", lambda *_, **__: pytest.fail("the run was started"))
    (tmp_path / "file").write_text("here")
    (tmp_path / "folder.png").mkdir()
    for path, culprit in (("folder.png", "is a directory"), ("file/a.png", "cannot be written")):
        line = refusal_of("synthesize", "shape:box", option, tmp_path / path)
        assert str(tmp_path / path) in line
        assert culprit in line


@pytest.mark.parametrize(
    ("words", "said"), [([], "reconstruct"), (["--help"], "doctor"), (["--version"], "graspd 0."),
                        (["synthesize", "--help"], "--friction"), (["hands", "inspect", "--version"], "graspd 0.")]
)  # fmt: skip
def test_help_and_version_are_no_errors(capsys: pytest.CaptureFixture[str], words: list[str], said: str):
    with pytest.raises(SystemExit) as left:
        main(words)
    assert left.value.code == 0
    assert said in capsys.readouterr().out


def test_an_unknown_command_is_named_with_the_one_that_was_meant(refusal_of):
    assert "(see graspd --help)" in refusal_of("--foo")
    told = "graspd: argument ACTION: 'biuld'; did you mean 'build'? (see graspd library --help)\n"
    assert refusal_of("library", "biuld") == told
    assert refusal_of("synthesise") == "graspd: unknown command 'synthesise'; did you mean 'synthesize'?\n"
    assert "valid: synthesize, replay, " in refusal_of("frobnicate")


def test_the_overview_names_every_command_and_no_help_imports_torch(capsys: pytest.CaptureFixture[str]):
    code = "import sys, graspd_core.cli as c; c._overview(); c.build_parser(); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"
    with pytest.raises(SystemExit):
        main(["--help"])
    out = capsys.readouterr().out
    for point in entry_points(group="graspd.commands"):
        assert f"    {point.name} " in out or f"    {point.name}\n" in out


def test_hands_lists_the_boxed_hands(capsys: pytest.CaptureFixture[str]):
    assert main(["hands"]) == EXIT_OK
    assert "allegro_right: 16 joints" in capsys.readouterr().out


@pytest.fixture
def ball(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A cloud of a sphere in the folder in which the command runs."""
    monkeypatch.chdir(tmp_path)
    np.save("ball.npy", surface_samples(make_shape("sphere"), 2000, 0)[0])
    return "ball.npy"


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (["--frame", "base"], "--frame base: given with ball.npy, a file; valid with recordings"),
        (["--camera-info", "/info"], "--camera-info /info: given with ball.npy, a file"),
        (["--sensor-frame", "eye"], "--sensor-frame eye: given with ball.npy, a file"),
        (["--every", "2"], "--every 2: given with ball.npy, a file"),
        (["--camera", "camera.json", "--limit", "1"], "--limit 1: given with ball.npy, a file"),
        (["--camera", "camera.json", "--view-point", "0", "0", "1"], "view_point: ball.npy is a depth image"),
        (["--out", "ball.doc"], "valid endings"),
    ],
)
def test_an_option_that_a_file_to_reconstruct_does_not_take_is_refused(ball: str, refusal_of, options, culprit):
    assert culprit in refusal_of("reconstruct", ball, "--out", "ball.ply", *options)
    assert os.listdir() == [ball]


def test_a_scene_file_sets_the_reconstruction(ball: str, refusal_of, capsys: pytest.CaptureFixture[str]):
    scene = Path("scene.yaml")
    scene.write_text("reconstruction: {max_faces: 300}")
    command = ["reconstruct", ball, "--out", "ball.ply", "--scene", "scene.yaml"]
    assert main(command) == EXIT_OK
    out = capsys.readouterr().out
    assert "ball.ply" in out
    assert int(out.split(": ")[1].split()[0]) <= 300
    assert Path("ball.ply").stat().st_size > 1000
    line = refusal_of("synthesize", "shape:sphere", "--scene", scene)
    assert "scene settings: given with shape:sphere, a mesh; valid with clouds" in line
    scene.write_text("reconstruction: {most_faces: 300}")
    told = "scene.yaml:1: reconstruction: unknown key 'most_faces'; did you mean 'max_faces'?"
    assert told in refusal_of(*command)
    assert told in refusal_of("synthesize", ball, "--scene", scene)
    assert "none.npy" in refusal_of("reconstruct", "none.npy", "--out", "x.ply")


def test_an_arm_that_reaches_is_written_and_one_that_does_not_is_told(tmp_path: Path, capsys):
    asked = ["synthesize", "shape:box", "-n", "1", "--preset", "fast", "--hand", "barrett_like", "--verify", "none"]
    asked += ["--arm", "panda_like"]
    assert main([*asked, "--arm-base", "-0.5", "0", "-0.1", "--out", str(tmp_path / "g.json")]) == EXIT_OK
    assert all(grasp.arm is not None for grasp in load_grasps(tmp_path / "g.json"))
    capsys.readouterr()
    assert main([*asked, "--arm-base", "-5", "0", "-0.1", "0", "0", "0", "1"]) == EXIT_TOO_FEW
    assert "m from the base of panda_like" in capsys.readouterr().out


def test_the_summary_lists_three_grasps_and_counts_the_others():
    posture = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(1))
    grasp = Grasp(posture, posture, posture, (), 0.0, trials=(TrialResult("hold", True, 0.0, 0.0),))
    lines = [
        summary(GraspResult(Outcome.SUCCEEDED, (grasp,) * count, Timing(), 0, "closed_form"), count, count).splitlines()
        for count in (3, 5)
    ]
    assert [line[-1] for line in lines] == ["  #2: 0 contacts", "  and 2 more"]
    told = summary(GraspResult(Outcome.SUCCEEDED, (grasp,) * 2, Timing(), 0, "closed_form"), 2, different=1)
    assert told.startswith("2 of 2 grasps (verified, 1 without near-duplicates, 2 tried): ")


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
def test_every_outcome_has_its_status(monkeypatch, capsys, outcome: Outcome, status: int):
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_interrupt_ends_the_run_and_the_second_the_process(number: signal.Signals):
    before = signal.getsignal(number)
    with Interrupt() as interrupt:
        assert not interrupt.is_interrupted()
        signal.raise_signal(number)
        assert interrupt.is_interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before


def test_the_main_job_in_a_process_of_its_own(tmp_path: Path):
    """A mesh in millimetres on disk in; grasps.json and a page out."""
    box = make_shape("box")
    save_mesh(tmp_path / "box.stl", TriangleMesh(box.vertices * 1000, box.faces))
    out = ["--out", "grasps.json", "--html", "view.html", "--picture", "grasp.png"]
    options = ["-n", "1", "--units", "mm", "--preset", "fast", "--seed", "1", *out]
    done = subprocess.run([*GRASPD, "synthesize", "box.stl", *options], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == EXIT_OK, done.stderr
    assert "<title>box.stl, allegro_right: verified grasp</title>" in (tmp_path / "view.html").read_text()
    document = load_document(tmp_path / "grasps.json")
    assert [grasp["verdict"] for grasp in document["grasps"]].count("verified") == 1
    assert document["object"]["scale"] == 0.001
    assert document["seed"] == 1
    assert len(document["grasps"][0]["joint_positions"]) == len(document["hand"]["joint_names"]) == 16
    assert (tmp_path / "view.html").stat().st_size > 100_000
    assert (tmp_path / "grasp.png").read_bytes().startswith(b"\x89PNG")
    assert "graspd: optimise" in done.stderr
    assert "total" in done.stdout


def test_an_interrupt_in_a_process_of_its_own(tmp_path: Path):
    out = tmp_path / "grasps.json"
    command = [*GRASPD, "synthesize", "shape:box", "-n", "32", "--preset", "accurate", "--out", str(out)]
    command += ["--mass", "0.1"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert "optimise" in some(process.stderr).readline()
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate()
    assert process.returncode == EXIT_INTERRUPTED, errors
    assert "Traceback" not in errors
    assert "cancelled" in output
    assert load_document(out)["outcome"]["name"] == "CANCELLED"
    # Amid its first round: nothing was tried.
    assert "verify" not in errors


CAMERA = PinholeCamera(160, 120, 190.0, 190.0, 79.5, 59.5, (0.05, -0.1))
OPTICAL = "camera_optical_frame"
START = 1_700_000_000 * SECOND
EYES = [(0.4, 0.1, 0.25), (-0.3, -0.3, 0.25)]
QUICK_PRESET = "closed_form: {explore_steps: 6, refine_steps: 6, polish_steps: 6}\n"


def records() -> list[Record]:
    """A box seen from two eyes, with an image of nothing between them."""
    box = make_shape("box")
    poses = [look_at(EYES[0], (0, 0, 0)), look_at(EYES[0], (0, 0, 0)), look_at(EYES[1], (0, 0, 0))]
    images = [render_depth(box, CAMERA, poses[0]), np.zeros((120, 160)), render_depth(box, CAMERA, poses[2])]
    found = []
    for index, (image, pose) in enumerate(zip(images, poses, strict=True)):
        stamp = START + index * SECOND
        found += [
            Record("/tf", stamp, transforms_message([("world", OPTICAL, pose)], stamp)),
            Record("/depth/camera_info", stamp, camera_info_message(CAMERA, OPTICAL, stamp)),
            Record("/depth/image_raw", stamp, depth_message(image, OPTICAL, stamp, encoding="32FC1")),
        ]
    return found


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    for storage in ("sqlite3", "mcap"):
        write_bag(folder / storage, records(), storage=storage)
    hopeless = [Record("/points", START + i, cloud_message(np.full((9, 3), np.nan), "lidar", START)) for i in range(2)]
    write_bag(folder / "hopeless", hopeless)
    return {path.name: path for path in folder.iterdir()}


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Options of a run that tries nothing and optimises hardly at all."""
    path = tmp_path_factory.mktemp("presets") / "quick.yaml"
    path.write_text(QUICK_PRESET)
    return ["-n", "1", "--preset", str(path), "--verify", "none"]


@pytest.fixture(scope="module")
def replayed(bags, quick, tmp_path_factory: pytest.TempPathFactory) -> tuple[int, list[str], Path, str]:
    """Exit status, lines, results and stderr of the whole mcap recording in the world's frame."""
    out, printed, said = tmp_path_factory.mktemp("replayed") / "grasps", io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
        status = main(["replay", str(bags["mcap"]), "--frame", "world", *quick, "--out", str(out)])
    return status, printed.getvalue().splitlines(), out, said.getvalue()


def test_every_cloud_of_a_recording_is_planned_on_in_the_frame_asked_for(replayed):
    status, lines, out, said = replayed
    # One of the three shows nothing: fewer than were asked for.
    assert status == EXIT_TOO_FEW
    assert len(lines) == 4
    assert lines[0].startswith("cloud 0 at 1700000000.000000000 s: ")
    assert "1 of 1 grasps" in lines[0]
    assert lines[1].startswith("cloud 1 at 1700000001.000000000 s: refused: depth image: none of its 160 x 120 pixels")
    assert lines[2].startswith("cloud 2 at 1700000002.000000000 s: ")
    assert lines[3].startswith("3 scenes: 2 with enough grasps, 0 with fewer, 1 refused; 2 grasps in ")
    for cloud in ("cloud 0 at 1700000000.000000000 s", "cloud 2 at 1700000002.000000000 s"):
        assert f"graspd: {cloud}: cloud: seen from one side only; the rest is guessed by " in said
    assert sorted(path.name for path in out.iterdir()) == ["cloud_000000.json", "cloud_000002.json"]
    for path in out.iterdir():
        # The box is at the world's origin, half a metre from the camera's; its unseen back is a guess.
        assert np.linalg.norm(load_document(path)["object"]["center_of_mass"]) < 0.05


def test_the_same_recording_gives_the_same_grasps_whatever_its_storage(replayed, bags, tmp_path, quick):
    out = tmp_path / "again.json"
    options = ["--frame", "world", "--limit", "1", *quick, "--out", str(out)]
    assert main(["replay", str(bags["sqlite3"]), *options]) == EXIT_OK
    first, again = load_document(replayed[2] / "cloud_000000.json"), load_document(out)
    assert first["grasps"] == again["grasps"]
    assert first["object"]["sha256"] == again["object"]["sha256"]


def test_a_cloud_that_is_not_made_whole_in_time_ends_by_the_deadline(bags, tmp_path, capsys, quick):
    options = ["--limit", "1", *quick, "--deadline", "1e-6", "--out", str(tmp_path / "out")]
    assert main(["replay", str(bags["mcap"]), *options]) == EXIT_TOO_FEW
    out, err = capsys.readouterr()
    assert "0 of 1 grasps (0 tried): the deadline passed before enough grasps were found" in out
    assert "1 scenes: 0 with enough grasps, 1 with fewer, 0 refused" in out
    assert err == ""
    assert not (tmp_path / "out" / "cloud_000000.json").exists()


def test_clouds_can_be_views_of_one_scene(bags, tmp_path, capsys, refusal_of, quick):
    out = tmp_path / "grasps.json"
    fused = ["--fuse", "--frame", "world"]
    assert main(["replay", str(bags["sqlite3"]), *fused, *quick, "--out", str(out)]) == EXIT_OK
    printed, said = capsys.readouterr()
    assert printed.startswith("2 clouds fused: ")
    assert np.abs(load_document(out)["object"]["center_of_mass"]).max() < 0.01
    # The empty image between the two is no view of anything.
    assert "graspd: 1 of 3 clouds are left out, the first: cloud 1: depth image: none of its" in said
    assert "cloud 0: the cloud has no finite point" in refusal_of("replay", bags["hopeless"], "--fuse", *quick)


def test_where_the_camera_of_a_cloud_stood_can_be_said_and_is_checked(tmp_path, capsys, refusal_of, quick):
    """The same cloud in the frame of a robot's base, as a file and as a recording."""
    pose = ring_poses(1, elevation=0.7, azimuth=0.4)[0]
    (view,) = views_of(tabletop("cylinder"), PinholeCamera(160, 120, 154.0, 154.0, 79.5, 59.5), [pose])
    points, file = view.points[np.random.default_rng(0).permutation(len(view.points))], tmp_path / "base.npy"
    np.save(file, points)
    place, turned = [str(x) for x in pose[:3, 3]], [str(-x) for x in pose[:3, 3]]
    to = [*quick, "--target", "0", "0", "0.05", "--out", str(tmp_path / "out.json")]
    assert main(["synthesize", str(file), "--view-point", *place, *to]) == EXIT_OK
    assert np.linalg.norm(load_document(tmp_path / "out.json")["object"]["center_of_mass"][:2]) < 0.01
    assert main(["synthesize", str(file), "--view-point", *place, *quick, "--any"]) == EXIT_OK
    assert f"{file}: the object at about (" in capsys.readouterr().err
    for wrong in ([], ["--view-point", *turned]):
        for command, rest in (("synthesize", to), ("reconstruct", ["--out", tmp_path / "x.ply"])):
            assert "its camera did not stand at" in refusal_of(command, file, *wrong, *rest)
    line = refusal_of("synthesize", "shape:mug", "--view-point", "0", "0", "1", *quick)
    assert "view_point: given with shape:mug, a mesh" in line
    stamped = [
        Record("/tf", START, transforms_message([("base", OPTICAL, pose)], START)),
        Record("/points", START, cloud_message(points, "base", START)),
    ]
    write_bag(tmp_path / "bag", stamped)
    said, to = ["--sensor-frame", OPTICAL, "--frame", "base"], ["--limit", "1", *to]
    assert main(["replay", str(tmp_path / "bag"), *said, *to]) == EXIT_OK
    assert main(["replay", str(tmp_path / "bag"), *to]) == EXIT_BAD_INPUT
    assert "refused: cloud: its camera did not stand at the origin of its frame" in capsys.readouterr().out
    line = refusal_of("replay", tmp_path / "bag", "--sensor-frame", "elbow", *to)
    assert "no frame 'elbow'; frames of its transforms: " in line
    line = refusal_of("replay", tmp_path / "bag", "--camera-info", "/info", *to)
    assert "--camera-info: /points has clouds; valid with depth images" in line


def test_any_object_of_a_recording_is_told_with_all_seen(bags, capsys, quick):
    assert main(["replay", str(bags["mcap"]), "--json", "--limit", "1", "--any", *quick]) == EXIT_OK
    out, err = capsys.readouterr()
    (scene,) = json.loads(out)["scenes"]
    (seen,) = scene["objects"]
    assert scene["outcome"]["name"] == "SUCCEEDED"
    assert f"the object at about {tuple(seen['center'])} m, one of 1 seen" in err


def test_a_long_recording_is_not_fused_whole(bags, refusal_of, monkeypatch, quick):
    monkeypatch.setattr(clouds, "MOST_VIEWS", 1)
    line = refusal_of("replay", bags["mcap"], "--fuse", "--frame", "world", *quick)
    assert "more than 1 clouds to fuse; choose some with --every or --limit" in line


def test_ctrl_c_ends_a_recording_of_which_every_cloud_is_refused(bags, capsys, monkeypatch, quick):
    monkeypatch.setattr(Interrupt, "is_interrupted", lambda self: True)
    assert main(["replay", str(bags["hopeless"]), *quick]) == EXIT_INTERRUPTED
    assert capsys.readouterr().out.startswith("0 scenes: ")


def test_a_recording_without_any_usable_cloud_is_bad_input(bags, capsys, quick):
    assert main(["replay", str(bags["hopeless"]), *quick]) == EXIT_BAD_INPUT
    lines = capsys.readouterr().out.splitlines()
    assert ["no finite point" in line for line in lines] == [True, True, False]
    assert lines[-1].startswith("2 scenes: 0 with enough grasps, 0 with fewer, 2 refused; 0 grasps")


def test_a_target_that_is_not_there_is_an_answer_and_no_bad_input(bags, capsys, quick):
    far = ["--target", "0", "0", "3"]
    assert main(["replay", str(bags["mcap"]), "--limit", "1", *far, *quick]) == EXIT_TOO_FEW
    assert "refused: " in capsys.readouterr().out.splitlines()[0]


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (["--every", "0"], "--every: 0 clouds; valid: 1 or more"),
        (["--limit", "0"], "--limit: 0 clouds; valid: 1 or more"),
        (["--out", "one.json"], "one.json: one file for several clouds; give a directory, --limit 1, or --fuse"),
        (["--target", "0", "0", "0", "--alone"], "not allowed with argument"),
        (["--view-point", "0", "0", "1"], "--view-point: /depth/image_raw has depth images; valid with clouds"),
        (["--sensor-frame", "world"], "--sensor-frame: /depth/image_raw has depth images; valid with clouds"),
    ],
)
def test_a_bad_option_of_replay_is_named_in_one_line(bags, refusal_of, options, culprit):
    assert culprit in refusal_of("replay", bags["mcap"], *options)


def test_a_mesh_comes_out_of_a_recording_in_either_frame(bags, tmp_path, capsys):
    out = tmp_path / "box.ply"
    extent = np.ptp(make_shape("box").vertices, axis=0)
    both = ["--every", "2", "--limit", "2", "--frame", "world"]
    assert main(["reconstruct", str(bags["mcap"]), *both, "--out", str(out)]) == EXIT_OK
    assert "box.ply" in capsys.readouterr().out
    in_world = load_mesh(out).vertices
    assert np.ptp(in_world, axis=0) == pytest.approx(extent, abs=0.02)
    # The first cloud alone, in its camera's frame: straight ahead.
    assert main(["reconstruct", str(bags["sqlite3"]), "--out", str(out)]) == EXIT_OK
    in_camera = load_mesh(out).vertices
    assert in_camera.mean(0) == pytest.approx([0, 0, np.linalg.norm(EYES[0])], abs=0.05)


FEW = ["-n", "2", "--preset", "fast"]


def build(out: Path, *words: str) -> int:
    return main(["library", "build", *words, "--out", str(out), *FEW])


def test_a_library_is_built_gone_on_with_and_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "known.grasps"
    assert build(out, "shape:sphere") == 0
    assert "sphere: 2 of 2 grasps" in capsys.readouterr().out
    assert build(out, "shape:sphere", "--scales", "1", "0.9") == 0
    told = capsys.readouterr().out
    assert "sphere: the library has 2 grasps already" in told
    assert "sphere@0.9: 2 of 2 grasps" in told
    assert main(["library", "list", str(out)]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert [row.split()[:4] for row in rows[:2]] == [
        ["sphere", "allegro_right", "2", "grasps"],
        ["sphere@0.9", "allegro_right", "2", "grasps"],
    ]
    assert rows[2] == f"{out}: 2 records, 4 grasps"
    # A mesh that cannot be used keeps no other from being added.
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "bad.obj").write_text("v 0 0 0\n")
    save_mesh(tmp_path / "meshes" / "capsule.obj", make_shape("capsule"))
    assert build(out, str(tmp_path / "meshes")) == 3
    told = capsys.readouterr()
    assert "capsule: 2 of 2 grasps" in told.out
    assert "bad.obj" in told.err


def test_a_library_of_a_hand_that_cannot_lift_the_assumed_mass_is_gone_on_with(tmp_path: Path, capsys):
    """The grasps are stored at the mass that the hand lifts. A second build plans none of them again."""
    for name in ("parallel_gripper.yaml", "parallel_gripper.urdf"):
        (tmp_path / name).write_text((config_dir() / "hands" / name).read_text())
    with (tmp_path / "parallel_gripper.yaml").open("a") as description:
        description.write("\neffort: 11.0\n")
    words, out = ("shape:box", "--hand", str(tmp_path / "parallel_gripper.yaml")), tmp_path / "known.grasps"
    assert build(out, *words) == 0
    told, heavy = capsys.readouterr(), load_scene("shape:box").object.mass
    assert "box: 2 of 2 grasps" in told.out
    assert f"kg, because the hand cannot hold the {heavy:.2g} kg that were assumed" in told.err
    ((entry, count),) = GraspLibrary(out).entries()
    assert entry.mass < heavy
    assert entry.mass_assumed
    assert build(out, *words) == 0
    assert "box: the library has 2 grasps already" in capsys.readouterr().out
    assert GraspLibrary(out).entries() == [(entry, count)]


def test_an_object_that_would_go_by_the_name_of_another_is_refused(tmp_path: Path, capsys):
    out, mesh = tmp_path / "known.grasps", make_shape("sphere")
    for folder, size in (("a", 1.0), ("b", 0.9)):
        (tmp_path / folder).mkdir()
        save_mesh(tmp_path / folder / "ball.obj", TriangleMesh(mesh.vertices * size, mesh.faces))
    assert build(out, str(tmp_path / "a" / "ball.obj")) == 0
    assert build(out, str(tmp_path / "b" / "ball.obj")) == 2
    told = capsys.readouterr().err
    assert "has another 'ball', from" in told
    assert "give one of the files another name" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["build", "shape:sphere"], "--out"),
        (["build", "shape:nothing", "--out", "new.grasps"], "shape"),
        (["build", "shape:sphere", "--out", "new.grasps", "--verify", "none"], "--verify: 'none'; valid for a library"),
        (["build", "shape:sphere", "--out", "other.grasps"], "other.grasps: damaged or not a library"),
        (["list", "none.grasps"], "none.grasps: no such file"),
        (["list", "other.grasps"], "other.grasps: damaged or not a library"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(tmp_path, monkeypatch, refusal_of, words: list[str], told: str):
    monkeypatch.chdir(tmp_path)
    Path("other.grasps").write_text("some other file\n" * 100)
    assert told in refusal_of("library", *words)
    assert not Path("new.grasps").exists()
