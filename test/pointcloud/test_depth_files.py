"""Depth images of every kind of file become the same points, or are refused by one line that names the file."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from expected import refused, some
from PIL import Image

from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core import PinholeCamera, cloud_from_depth, load_depth_view, load_scene
from graspd_core.cli import main
from graspd_core.errors import CloudError
from graspd_core.perception.cloud.depth_files import load_depth_camera

CAMERA = PinholeCamera(320, 240, 300.0, 300.0, 159.5, 119.5)
TOLD: dict[str, Any] = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5}
(POSE,) = ring_poses(1, elevation=0.6)


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    """A cylinder on a table, to the millimetre."""
    ((depth, _),) = depth_views(tabletop("cylinder"), CAMERA, [POSE])
    return np.round(depth, 3)


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    return written(tmp_path, T_world_camera=POSE.tolist())


def written(folder: Path, **keys: Any) -> Path:
    """The camera's file; a key that is None is left out."""
    told = {key: value for key, value in {**TOLD, **keys}.items() if value is not None}
    (folder / "camera.json").write_text(json.dumps(told))
    return folder / "camera.json"


def saved(path: Path, pixels: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, pixels)
    elif path.suffix == ".npz":
        np.savez(path, depth=pixels)
    else:
        Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize(
    ("name", "kind", "factor", "unit"),
    [
        ("depth.png", "u2", 1000, None),
        ("depth.tiff", "f4", 1, None),
        ("depth.tif", "u2", 1000, None),
        ("depth.npy", "f8", 1, None),
        ("depth.npz", "u2", 1000, None),
        ("depth.npz", "i4", 1000, None),
        ("depth.png", "u2", 4000, 0.00025),
        ("depth.npy", "f4", 1000, 0.001),
    ],
)
def test_every_kind_of_file_shows_the_same(depth, camera: Path, tmp_path: Path, name, kind, factor, unit):
    image = saved(tmp_path / name, np.round(depth * factor, 3).astype(kind))
    view, wanted = load_depth_view(image, camera, unit), cloud_from_depth(depth, CAMERA, POSE)
    assert np.allclose(view.points, wanted.points, atol=1e-6)
    assert np.allclose(view.viewpoint, POSE[:3, 3])
    assert np.allclose(some(view.forward), POSE[:3, 2])


@pytest.mark.parametrize("unit", [0.00025, "mm, 0 invalid", "um"])
def test_the_camera_may_say_the_unit(tmp_path: Path, unit: Any):
    pixels = np.full((240, 320), 2000, dtype=np.uint16)
    metres = {0.00025: 0.5, "mm, 0 invalid": 2.0, "um": 0.002}[unit]
    view = load_depth_view(saved(tmp_path / "d.png", pixels), written(tmp_path, depth_unit=unit))
    assert np.allclose(view.points[:, 2], metres)


@pytest.mark.parametrize(
    "matrix",
    [
        {"K": [[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]]},
        {"K": [300, 0, 159.5, 0, 300, 119.5, 0, 0, 1]},
        {"intrinsic_matrix": [300, 0, 0, 0, 300, 0, 159.5, 119.5, 1]},
    ],
)
def test_a_matrix_is_read_in_every_usual_form(tmp_path: Path, matrix: dict[str, Any]):
    path = written(tmp_path, **dict.fromkeys(("fx", "fy", "cx", "cy")), **matrix)
    assert load_depth_camera(path)[0] == CAMERA
    bent = written(tmp_path, distortion=[0.1, -0.2, 0.001, 0, 0])
    assert load_depth_camera(bent)[0].distortion == (0.1, -0.2, 0.001, 0.0, 0.0)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"width": None}, "width is missing; give the image's width and height; the file has height, fx"),
        ({"fx": None}, "fx is missing; give K, or fx, fy, cx and cy; the file has width"),
        ({"fx": "300"}, None),
        ({"fx": float("nan")}, "fx: nan; expected a number"),
        ({"K": [1, 2]}, "its matrix K has 2 numbers; 9 are needed"),
        ({"depth_scale": 0.1}, "depth_scale: 0.1 is ambiguous, because programs disagree on its unit"),
        ({"depth_units": "mm"}, "unknown key 'depth_units'; did you mean 'depth_unit'"),
        ({"depth_unit": 1000}, r"depth_unit: 1000; valid: metres per unit in \(0, 1\], or m, cm, mm, um"),
        ({"depth_unit": "miles"}, "depth_unit: 'miles'; valid"),
        ({"T_world_camera": np.full((4, 4), 2).tolist()}, "'T_world_camera' is not a rigid transform"),
        ({"T_world_camera": [1, 2, 3]}, "T_world_camera: .*; expected 4 × 4 numbers"),
        ({"distortion_model": "fisheye", "distortion": [0.1]}, "unknown distortion model 'fisheye'"),
    ],
)
def test_a_camera_that_says_something_else_is_named(tmp_path: Path, keys: dict[str, Any], told: str | None):
    path = written(tmp_path, **keys)
    if told is None:
        assert load_depth_camera(path)[0] == CAMERA
        return
    with refused(CloudError, match=rf"camera.json: .*{told}"):
        load_depth_camera(path)


@pytest.mark.parametrize(
    ("name", "pixels", "told"),
    [
        ("color.png", np.zeros((240, 320, 3), "u1"), r"240 × 320 × 3 of uint8 is not a depth image; valid: one"),
        ("gray.png", np.zeros((240, 320), "u1"), "is not a depth image"),
        ("small.png", np.full((120, 160), 500, "u2"), "160 x 120 pixels, but its camera has 320 x 240"),
        ("far.npy", np.full((240, 320), 850.0), "beyond 850 m at 1 m a unit; give the unit: --units mm, or depth_unit"),
        ("mug.ply", None, "valid endings: png, tif, tiff, npy, npz"),
        ("spoilt.png", None, "not a readable image"),
        ("nowhere.png", None, "no such depth image"),
    ],
)
def test_what_is_no_depth_image_is_named(tmp_path: Path, camera: Path, name: str, pixels, told: str):
    if pixels is not None:
        saved(tmp_path / name, pixels)
    elif name != "nowhere.png":
        (tmp_path / name).write_bytes(b"ply")
    with pytest.raises(CloudError, match=f"{name}: .*{told}"):
        load_depth_view(tmp_path / name, camera)


def test_it_is_an_object_by_library_and_command_line(depth, camera: Path, tmp_path: Path, capsys):
    image = saved(tmp_path / "depth.png", np.round(depth * 1000).astype(np.uint16))
    scene = load_scene(image, camera=camera)
    assert scene.support is not None
    # The table of the scene is the world's plane z = 0.
    assert np.allclose([*scene.support.normal, scene.support.offset], [0, 0, 1, 0], atol=0.02)
    quarter = saved(tmp_path / "quarter.png", np.round(depth * 4000).astype(np.uint16))
    again = load_scene(quarter, camera=camera, scale=0.00025)
    assert np.allclose(np.ptp(again.object.mesh.vertices, 0), np.ptp(scene.object.mesh.vertices, 0), atol=1e-3)
    out = tmp_path / "grasps.json"
    words = ["-n", "1", "--preset", "fast", "--verify", "none", "--out", str(out)]
    assert main(["synthesize", str(image), "--camera", str(camera), *words]) == 0
    assert json.loads(out.read_text())["grasps"]
    assert main(["reconstruct", str(image), "--camera", str(camera), "--out", str(tmp_path / "m.ply")]) == 0
    capsys.readouterr()
    for command in (["synthesize"], ["reconstruct", "--out", str(tmp_path / "m.ply")]):
        assert main([command[0], str(image), *command[1:]]) == 2
        told = "depth.png: a depth image needs the camera that took it: --camera camera.json"
        assert told in capsys.readouterr().err


@pytest.mark.parametrize("given", [["--units", "m"], ["--scale", "1"]])
@pytest.mark.parametrize("any_object", [[], ["--any"]])
def test_metres_beside_another_unit_of_the_camera_are_refused(depth, tmp_path: Path, capsys, given, any_object):
    image, camera = (
        saved(tmp_path / "depth.png", np.round(depth * 1000).astype("u2")),
        written(tmp_path, depth_unit="mm"),
    )
    assert main(["synthesize", str(image), "--camera", str(camera), *given, *any_object]) == 2
    told = f"{' '.join(given)}: {camera} has depth_unit 0.001 m; remove one of them"
    assert told in capsys.readouterr().err
