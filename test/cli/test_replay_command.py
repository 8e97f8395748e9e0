"""`graspd replay` and `graspd reconstruct` of recordings: what comes out, in which frame, and what is refused."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
from bag_writer import (
    Record,
    camera_info_message,
    cloud_message,
    depth_message,
    transforms_message,
    write_bag,
)

from graspd_bench.rendering.render import look_at, render_depth
from graspd_core.cli import main
from graspd_core.cli import options as clouds
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_OK, EXIT_TOO_FEW, Interrupt
from graspd_core.io.grasps_json import load_document
from graspd_core.mesh.mesh_files import load_mesh
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.transforms import SECOND

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


def the_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of stderr; nothing on stdout."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("graspd: ")
    assert err.count("\n") == 1, err
    return err


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


def test_clouds_can_be_views_of_one_scene(bags, tmp_path, capsys, quick):
    out = tmp_path / "grasps.json"
    fused = ["--fuse", "--frame", "world"]
    assert main(["replay", str(bags["sqlite3"]), *fused, *quick, "--out", str(out)]) == EXIT_OK
    printed, said = capsys.readouterr()
    assert printed.startswith("2 clouds fused: ")
    assert np.abs(load_document(out)["object"]["center_of_mass"]).max() < 0.01
    # The empty image between the two is no view of anything.
    assert "graspd: 1 of 3 clouds left out, the first cloud 1: depth image: none of its" in said
    assert main(["replay", str(bags["hopeless"]), "--fuse", *quick]) == EXIT_BAD_INPUT
    assert "cloud 0: the cloud has no finite point" in the_line(capsys)


def test_a_long_recording_is_not_fused_whole(bags, capsys, monkeypatch, quick):
    monkeypatch.setattr(clouds, "MOST_VIEWS", 1)
    assert main(["replay", str(bags["mcap"]), "--fuse", "--frame", "world", *quick]) == EXIT_BAD_INPUT
    assert "more than 1 clouds to fuse; choose some with --every or --limit" in the_line(capsys)


def test_ctrl_c_ends_a_recording_of_which_every_cloud_is_refused(bags, capsys, monkeypatch, quick):
    monkeypatch.setattr(Interrupt, "came", lambda self: True)
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
        (["--every", "0"], "every: 0 clouds; at least 1"),
        (["--limit", "0"], "limit: 0 clouds; at least 1"),
        (["--frame", "nowhere"], "no frame 'nowhere'; its transforms know: camera_optical_frame, world"),
        (["--topic", "/points"], "no clouds or depth images on '/points'; topics with some: /depth/image_raw"),
        (["--camera-info", "/info"], "no camera info on '/info'"),
        (["--out", "one.json"], "one.json: one file for many clouds; give a directory, or --limit 1, or --fuse"),
        (["--target", "0", "0", "0", "--alone"], "not allowed with argument"),
        (["--hand", "claw"], "unknown hand 'claw'"),
        (["-n", "0"], "count: 0 grasps"),
    ],
)
def test_a_bad_option_is_named_in_one_line(bags, capsys, monkeypatch, tmp_path, options, culprit):
    monkeypatch.chdir(tmp_path)
    assert main(["replay", str(bags["mcap"]), *options]) == EXIT_BAD_INPUT
    assert culprit in the_line(capsys)


def test_a_frame_in_a_recording_without_transforms_is_named(bags, capsys):
    assert main(["replay", str(bags["hopeless"]), "--frame", "world"]) == EXIT_BAD_INPUT
    assert "holds no transforms" in the_line(capsys)


@pytest.mark.parametrize("name", ["missing", "notes.txt"])
def test_what_is_no_bag_is_named(tmp_path, capsys, name):
    (tmp_path / "notes.txt").write_text("hello")
    assert main(["replay", str(tmp_path / name)]) == EXIT_BAD_INPUT
    assert name in the_line(capsys)


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
