"""What people send, as issue threads of comparable tools tell it: one row a situation.

A row makes its input in a folder and says what a person would expect: the object, by its volume, or a refusal, by its
words. To add a situation, add a row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from bag_writer import Record, camera_info_message, cloud_message, depth_message, write_bag

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import TabletopScene, depth_views, on_table, ring_poses, tabletop
from graspd_core.errors import CloudError
from graspd_core.mesh.mesh_files import mass_properties, save_mesh, surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays
from graspd_core.perception.cloud.cloud_files import CLOUD_ENDINGS, is_cloud_file, load_views
from graspd_core.transforms import SECOND
from graspd_core.types import TriangleMesh

CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)
MATRIX = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
POSE = ring_poses(1, elevation=0.6, azimuth=-1.2)[0]
GITHUB = "https://github.com/"
FRAME, STAMP = "camera_optical_frame", 1_700_000_000 * SECOND


@dataclass(frozen=True)
class Situation:
    """An input and what a person would expect of it.

    Attributes:
        name: of the situation.
        make: writes the input into a folder and returns its path.
        expect: the object's volume [m³], or the words of a refusal as a regular expression.
        thread: where somebody had it, below `GITHUB`; empty where it is of this project's own trials.
        options: of the command line; the library's arguments follow from them.
        warns: words of a warning.
        near: share of the volume that the answer may be off, for one view guesses the back.
    """

    name: str
    make: Callable[[Path], Path]
    expect: float | str
    thread: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    warns: str = ""
    near: float = 0.3


def volume(shape: str) -> float:
    return mass_properties(make_shape(shape))[0]


@cache
def stage(shape: str = "bottle", beside: str = "") -> TabletopScene:
    if not shape:
        return on_table(TriangleMesh(make_shape("box").vertices - np.array([0, 0, 0.3]), make_shape("box").faces))
    return tabletop(shape, obstacles=[(beside, 0.064, 0.0)] if beside else [])


@cache
def depth_of(shape: str = "bottle", beside: str = "") -> tuple[np.ndarray, np.ndarray]:
    """The depth image [m] and which mesh each pixel shows."""
    return depth_views(stage(shape, beside), CAMERA, [POSE], DEFAULT)[0]


def grid_of(shape: str = "bottle", beside: str = "") -> np.ndarray:
    """An organised cloud in the camera's frame [m], NaN where nothing was seen."""
    depth = depth_of(shape, beside)[0]
    return camera_rays(CAMERA) * np.where(depth > 0, depth, np.nan)[..., None]


def in_camera(point: np.ndarray) -> tuple[float, ...]:
    return tuple(float(x) for x in (point - POSE[:3, 3]) @ POSE[:3, :3])


def middle(mesh: TriangleMesh) -> tuple[float, ...]:
    return in_camera(0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0)))


def sheet(gaps: bool = False) -> TriangleMesh:
    """Faces between neighbouring pixels, as camera viewers write them; with `gaps`, to pixels without depth too."""
    grid = np.nan_to_num(grid_of())
    index = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, c, b), (b, c, d))])
    points = grid.reshape(-1, 3)
    depth = points[faces][..., 2]
    return TriangleMesh(points, faces[((np.ptp(depth, axis=1) < 0.02) & depth.all(1)) | (gaps & ~depth.all(1))])


def sheet_in_world() -> TriangleMesh:
    mesh, seen = sheet(), sheet().vertices.any(1)
    return TriangleMesh(in_world(mesh.vertices[seen]), (np.cumsum(seen) - 1)[mesh.faces])


def mesh_file(name: str, mesh: TriangleMesh) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        save_mesh(mesh, folder / name)
        return folder / name

    return make


def array_file(name: str, make_arrays: Callable[[], Any]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        arrays = make_arrays()
        if name.endswith(".npz"):
            np.savez(folder / name, **arrays)
        else:
            np.save(folder / name, arrays)
        return folder / name

    return make


def bytes_file(name: str, make_bytes: Callable[[], bytes]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(make_bytes())
        return folder / name

    return make


def ply(points: np.ndarray, extra: str = "", promised: int | None = None) -> bytes:
    """A binary cloud; `extra` names more properties, of floats."""
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", *extra.split()))
    count = len(points) if promised is None else promised
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    return head.encode() + points.astype("<f4").tobytes()


def pcd(points: np.ndarray, viewpoint: str = "0 0 0 1 0 0 0") -> bytes:
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {len(points)}\nDATA binary\n"
    return head.encode() + points.astype("<f4").tobytes()


def rows_of(shape: str = "bottle") -> np.ndarray:
    return grid_of(shape).reshape(-1, 3)


def zeroed() -> np.ndarray:
    return np.nan_to_num(rows_of())


def infinite() -> np.ndarray:
    return np.where(np.isfinite(rows_of()), rows_of(), -np.inf)


def only_object() -> np.ndarray:
    return grid_of()[depth_of()[1] == 0]


def all_round(shape: str, noise: float = 0.0005) -> np.ndarray:
    return surface_samples(make_shape(shape), 6000, 0)[0] + np.random.default_rng(0).normal(0, noise, (6000, 3))


def in_world(points: np.ndarray) -> np.ndarray:
    return points @ POSE[:3, :3].T + POSE[:3, 3]


def scaled(shape: str, factor: float) -> TriangleMesh:
    mesh = make_shape(shape)
    return TriangleMesh(mesh.vertices * factor, mesh.faces)


def millimetres() -> np.ndarray:
    return (1000 * depth_of()[0]).astype(np.uint16)


def bag(make_message: Callable[[int], Any], topic: str = "points") -> Callable[[Path], Path]:
    """A recording of one message, and of its camera beside a depth image."""

    def make(folder: Path) -> Path:
        records = [Record(f"/{topic}", STAMP, make_message(STAMP))]
        if topic.startswith("depth"):
            records.insert(0, Record("/depth/camera_info", STAMP, camera_info_message(CAMERA, FRAME, STAMP)))
        write_bag(folder / "recording", records)
        return folder / "recording"

    return make


def recorded(row: Situation, path: Path) -> Path | None:
    """Return the row's input as a recording of what a driver would publish; None where no message can be that."""
    if path.is_dir():
        return path
    if "scale" in row.options or not path.exists() or not is_cloud_file(path):
        return None
    arrays = dict(np.load(path)) if path.suffix == ".npz" else {}
    if "depth" in arrays:
        whole = arrays["depth"].dtype.kind == "u"
        depth, encoding = (arrays["depth"] / 1000, "16UC1") if whole else (arrays["depth"], "32FC1")
        message = lambda stamp: depth_message(depth, FRAME, stamp, encoding=encoding)  # noqa: E731
        return bag(message, "depth/image_rect")(path.parent) if "K" in arrays else None
    try:
        points = np.load(path) if path.suffix == ".npy" else load_views(path)[0].points
    except CloudError:
        return None
    return bag(lambda stamp: cloud_message(points, FRAME, stamp))(path.parent)


def camera_place(path: Path) -> tuple[float, ...]:
    """Where a file says that its camera stood; empty where it does not say."""
    if path.suffix.removeprefix(".") not in CLOUD_ENDINGS or not is_cloud_file(path):
        return ()
    try:
        return tuple(load_views(path)[0].viewpoint.tolist())
    except CloudError:
        return ()


BOTTLE, BOX, CYLINDER = volume("bottle"), volume("box"), volume("cylinder")
PAIR = ("box", "cylinder")
CLOUDS = (
    Situation(
        "depth in mm with its camera's matrix",
        array_file("a.npz", lambda: {"depth": millimetres(), "K": MATRIX}),
        BOTTLE,
        "NVlabs/6dof-graspnet/issues/11",
    ),
    Situation(
        "depth in metres",
        array_file("a.npz", lambda: {"depth": depth_of()[0].astype(np.float32), "K": MATRIX}),
        BOTTLE,
        "graspnet/graspnet-baseline/issues/27",
    ),
    Situation(
        "depth of floats in mm",
        array_file("a.npz", lambda: {"depth": 1000 * depth_of()[0], "K": MATRIX}),
        "millimetres",
        "graspnet/anygrasp_sdk/issues/171",
    ),
    Situation(
        "depth without a matrix",
        array_file("a.npz", lambda: {"depth": millimetres()}),
        "holds 'depth' but no 'K'",
        "ivalab/KGN/issues/4",
    ),
    Situation("an organised cloud with NaN", array_file("a.npy", grid_of), BOTTLE, "isl-org/Open3D/issues/1016"),
    Situation(
        "gaps filled with zeros",
        array_file("a.npy", zeroed),
        BOTTLE,
        "giacomodabisias/libfreenect2pclgrabber/issues/11",
    ),
    Situation(
        "gaps filled with infinity", bytes_file("a.ply", lambda: ply(infinite())), BOTTLE, "isl-org/Open3D/issues/5985"
    ),
    Situation(
        "a cloud with normals",
        bytes_file("a.ply", lambda: ply(np.hstack([rows_of(), np.ones((76800, 3))]), "nx ny nz")),
        BOTTLE,
        "isl-org/Open3D/issues/2754",
    ),
    Situation("a pcd with NaN", bytes_file("a.pcd", lambda: pcd(rows_of())), BOTTLE, "ch-sa/labelCloud/issues/54"),
    Situation(
        "a pcd in the world's frame that says where its sensor stood",
        bytes_file("a.pcd", lambda: pcd(in_world(rows_of()), " ".join(f"{x:.6f}" for x in POSE[:3, 3]) + " 1 0 0 0")),
        BOTTLE,
        "atenpas/gpd/issues/41",
    ),
    Situation(
        "points and the camera's place",
        array_file("a.npz", lambda: {"points": in_world(rows_of()), "viewpoint": POSE[:3, 3]}),
        BOTTLE,
        "NVlabs/GraspGen/issues/43",
    ),
    Situation(
        "a cloud in mm",
        array_file("a.npy", lambda: 1000 * rows_of()),
        "in millimetres, divide them by 1000",
        "Lewis-Stuart-11/PlantDreamer/issues/3",
    ),
    Situation(
        "a cloud in mm, said",
        array_file("a.npy", lambda: 1000 * rows_of()),
        BOTTLE,
        "Lewis-Stuart-11/PlantDreamer/issues/3",
        {"scale": 0.001},
    ),
    Situation(
        "a cloud in cm",
        array_file("a.npy", lambda: 100 * rows_of()),
        "in centimetres, divide them by 100",
        "graspnet/anygrasp_sdk/issues/171",
    ),
    Situation(
        "nothing but NaN", array_file("a.npy", lambda: np.full((90, 3), np.nan)), "NaN", "isl-org/Open3D/issues/1188"
    ),
    Situation(
        "a cloud without points",
        bytes_file("a.ply", lambda: ply(np.zeros((0, 3)))),
        "empty",
        "QingyongHu/RandLA-Net/issues/197",
    ),
    Situation(
        "a cloud cut short",
        bytes_file("a.ply", lambda: ply(rows_of(), promised=10**6)),
        "not a readable ply cloud",
        "realsenseai/librealsense/issues/882",
    ),
    Situation(
        "a handful of points",
        array_file("a.npy", lambda: only_object()[:40]),
        "at least 50",
        "pearl-robot-lab/neugraspnet/issues/4",
    ),
    Situation(
        "another array",
        array_file("a.npz", lambda: {"xyz": rows_of()}),
        "no array called 'points', 'depth' or 'depths'",
        "NVlabs/6dof-graspnet/issues/7",
    ),
    Situation(
        "a table with nothing on it",
        array_file("a.npy", lambda: rows_of("")),
        "no object among .* nothing on it",
        "atenpas/gpd/issues/119",
    ),
    Situation(
        "the object alone, cut out by others",
        array_file("a.npy", only_object),
        BOTTLE,
        "NVlabs/contact_graspnet/issues/35",
        {"alone": True},
        near=0.6,
    ),
    Situation(
        "a target where nothing is",
        array_file("a.npy", grid_of),
        "target: nothing within 0.05 m",
        "atenpas/gpd/issues/57",
        {"target": in_camera(np.array([0.25, 0.25, 0.1]))},
    ),
    Situation(
        "a target in the middle of the thing",
        array_file("a.npy", lambda: grid_of(*PAIR)),
        BOX,
        "atenpas/gpd/issues/106",
        {"target": middle(stage(*PAIR).truth)},
        "without what touches it",
    ),
    Situation(
        "a target in the thing that touches it",
        array_file("a.npy", lambda: grid_of(*PAIR)),
        CYLINDER,
        "atenpas/gpd/issues/30",
        {"target": middle(stage(*PAIR).obstacles[0])},
        "without what touches it",
    ),
    Situation(
        "two things that touch",
        array_file("a.npy", lambda: grid_of(*PAIR)),
        BOX + CYLINDER,
        "atenpas/gpd/issues/59",
        {},
        "may be 2 things that touch",
        near=0.4,
    ),
    Situation(
        "a box all round", array_file("a.npy", lambda: all_round("box")), BOX, "atenpas/gpd/issues/91", near=0.05
    ),
    Situation(
        "a bowl all round", array_file("a.npy", lambda: all_round("bowl")), volume("bowl"), "atenpas/gpd/issues/91"
    ),
    Situation(
        "a mug all round, alone",
        array_file("a.npy", lambda: all_round("mug")),
        volume("mug"),
        "atenpas/gpd/issues/91",
        {"alone": True},
        near=0.5,
    ),
)
MESHES = (
    Situation(
        "a camera viewer's mesh",
        mesh_file("a.ply", sheet()),
        BOTTLE,
        "realsenseai/librealsense/issues/2036",
        {},
        "open sheet: its points are taken as a cloud",
    ),
    Situation(
        "a camera viewer's mesh, y and z turned",
        mesh_file("a.obj", TriangleMesh(sheet().vertices * [1, -1, -1], sheet().faces)),
        BOTTLE,
        "realsenseai/librealsense/issues/10536",
        {},
        "taken as a cloud",
    ),
    Situation(
        "a camera viewer's mesh with faces to what it did not see",
        mesh_file("a.ply", sheet(gaps=True)),
        BOTTLE,
        "giacomodabisias/libfreenect2pclgrabber/issues/11",
        {},
        "taken as a cloud",
    ),
    Situation(
        "a camera viewer's mesh in another frame",
        mesh_file("a.ply", sheet_in_world()),
        "an open sheet as camera viewers export it",
        "PointCloudLibrary/pcl/issues/1474",
    ),
    Situation(
        "a mesh with a target",
        mesh_file("a.stl", make_shape("box")),
        "target(_point)?: given with .*a.stl, a mesh",
        "",
        {"target": (0.0, 0.0, 0.0)},
    ),
    Situation(
        "a mesh in mm",
        mesh_file("a.stl", scaled("box", 1000)),
        r"scale 0.001 \(from mm\) makes it",
        "moveit/moveit/issues/279",
    ),
    Situation(
        "a mesh in mm, said",
        mesh_file("a.stl", scaled("box", 1000)),
        BOX,
        "moveit/moveit/issues/279",
        {"scale": 0.001},
        near=0.01,
    ),
    Situation(
        "a mesh in cm",
        mesh_file("a.stl", scaled("box", 100)),
        r"scale 0.01 \(from cm\) makes it",
        "tesseract-robotics/tesseract/issues/1184",
    ),
    Situation(
        "a mesh with a hole",
        mesh_file("a.obj", TriangleMesh(make_shape("box").vertices, make_shape("box").faces[:-1])),
        BOX,
        "zdchan/GraspXL/issues/7",
        {},
        "not closed",
        near=0.1,
    ),
    Situation(
        "a mesh turned inside out",
        mesh_file("a.obj", TriangleMesh(make_shape("box").vertices, make_shape("box").faces[:, ::-1])),
        BOX,
        "PointCloudLibrary/pcl/issues/1474",
        near=0.01,
    ),
    Situation(
        "vertices without faces",
        bytes_file("a.obj", lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        "3 vertices and no face",
        "realsenseai/librealsense/issues/2036",
    ),
    Situation(
        "a pointer of git-lfs",
        bytes_file("a.obj", lambda: b"version https://git-lfs.github.com/spec/v1\n"),
        "git-LFS pointer",
        "zdchan/GraspXL/issues/7",
    ),
    Situation(
        "a page of a web site",
        bytes_file("a.stl", lambda: b"<!DOCTYPE html><html></html>"),
        "a page of HTML, not a mesh",
        "moveit/moveit/issues/279",
    ),
    Situation(
        "an ending that is not known",
        bytes_file("a.las", lambda: b"LASF"),
        "unknown ending",
        "isl-org/Open3D/issues/6623",
    ),
    Situation("a file that is not there", lambda folder: folder / "a.ply", "no such", "graspnet/graspnetAPI/issues/3"),
)
MESSAGES = (
    Situation(
        "a message without points",
        bag(lambda stamp: cloud_message(np.zeros((0, 3)), FRAME, stamp)),
        "empty",
        "QingyongHu/RandLA-Net/issues/197",
    ),
)
SITUATIONS = CLOUDS + MESHES + MESSAGES
