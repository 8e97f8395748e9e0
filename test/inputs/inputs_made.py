"""Inputs as people send them, made in a folder: clouds, depth images, meshes, recordings of messages."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from bag_writer import Record, camera_info_message, cloud_message, depth_message, write_bag

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import TabletopScene, depth_views, on_table, ring_poses, tabletop
from graspd_core import TriangleMesh, make_shape
from graspd_core.errors import CloudError
from graspd_core.mesh.mesh_files import mass_properties, save_mesh, surface_samples
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays
from graspd_core.perception.cloud.cloud_files import CLOUD_ENDINGS, is_cloud_file, load_views
from graspd_core.transforms import SECOND

CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)
MATRIX = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
POSE = ring_poses(1, elevation=0.6, azimuth=-1.2)[0]
GITHUB = "https://github.com/"
FRAME, OTHER_FRAME, STAMP = "camera_optical_frame", "other_optical_frame", 1_700_000_000 * SECOND


class Evil:
    """Pickles as a call of a function of one's choice."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


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
    """Return faces between neighbouring pixels, as camera viewers write them. `gaps` adds pixels without depth."""
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
        save_mesh(folder / name, mesh)
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
    """Write a binary cloud. `extra` names more properties, of floats."""
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


def cloud(points: np.ndarray, **changes: Any) -> Callable[[Path], Path]:
    """A recording of a PointCloud2 with other values in some of its fields."""
    return bag(lambda stamp: replace(cloud_message(points, FRAME, stamp), **changes))


def padded() -> Any:
    """The fields of a PointCloud2 of 32 bytes a point, as drivers align it: x, y, z, rgb and gaps."""
    grid = grid_of()
    data = np.zeros((*grid.shape[:2], 8), "<f4")
    data[..., :3], data[..., 4] = grid, 1e-38
    width = grid.shape[1]
    return {"point_step": 32, "row_step": 32 * width, "data": data.view(np.uint8).reshape(-1)}


def only_finite(points: np.ndarray) -> np.ndarray:
    return points[np.isfinite(points).all(1)]


def text(points: np.ndarray, *columns: float) -> bytes:
    more = " ".join(f"{value:g}" for value in columns)
    return "".join(f"{x:.5f} {y:.5f} {z:.5f} {more}\n" for x, y, z in points).encode()


def padded_pcd() -> bytes:
    """A binary pcd whose fields `_` are gaps, as PCL writes structures that are aligned."""
    points, head = rows_of(), pcd(np.zeros((0, 3))).decode().replace("WIDTH 0", "WIDTH 76800")
    head = head.replace("POINTS 0", "POINTS 76800").replace("FIELDS x y z", "FIELDS x y z _ rgb _")
    head = head.replace("SIZE 4 4 4", "SIZE 4 4 4 1 4 1").replace("TYPE F F F", "TYPE F F F U F U")
    data = np.zeros((len(points), 8), "<f4")
    data[:, :3] = points
    return head.replace("COUNT 1 1 1", "COUNT 1 1 1 4 1 12").encode() + data.tobytes()


def text_pcd() -> bytes:
    points = only_finite(rows_of())
    head = pcd(np.zeros((0, 3))).decode().replace("FIELDS x y z", "FIELDS x y z rgb").replace("binary", "ascii")
    for name, more in (("SIZE 4 4 4", "4"), ("TYPE F F F", "F"), ("COUNT 1 1 1", "1")):
        head = head.replace(name, f"{name} {more}")
    head = head.replace("WIDTH 0", f"WIDTH {len(points)}").replace("POINTS 0", f"POINTS {len(points)}")
    return head.encode() + text(points, 1.648931e-38)


def text_ply(kind: str = "double", colour: bool = True, gaps: bool = False) -> bytes:
    points = rows_of() if gaps else only_finite(rows_of())
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property {kind} {name}\n" for name in "xyz")
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) if colour else ""
    return (head + "end_header\n").encode() + text(points, *((9, 8, 7) if colour else ()))


def quads() -> bytes:
    """A box of quadrilaterals with a material that is not there."""
    x, y, z = 0.5 * np.ptp(make_shape("box").vertices, axis=0)
    corners = [(i * x, j * y, k * z) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
    faces = "1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"
    lines = ["mtllib gone.mtl", *("v {} {} {}".format(*corner) for corner in corners), "usemtl gone"]
    return "\n".join([*lines, *(f"f {face}" for face in faces)]).encode()


def solid_stl(folder: Path) -> Path:
    """A binary STL whose header begins as that of a text does."""
    path = mesh_file("a.stl", make_shape("box"))(folder)
    path.write_bytes(b"solid box".ljust(80) + path.read_bytes()[80:])
    return path


def sheared() -> np.ndarray:
    pose = POSE.copy()
    pose[:3, 0] *= 1.1
    return pose


def bag(
    make_message: Callable[[int], Any], topic: str = "points", matrix: np.ndarray = MATRIX
) -> Callable[[Path], Path]:
    """A recording of one message, and of its camera beside a depth image."""

    def make(folder: Path) -> Path:
        records = [Record(f"/{topic}", STAMP, make_message(STAMP))]
        if topic.startswith("depth"):
            (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
            camera = replace(CAMERA, fx=fx, fy=fy, cx=cx, cy=cy)
            # The last calibration of a frame counts: another one is of another frame.
            frame = FRAME if (matrix == MATRIX).all() else OTHER_FRAME
            records[0].message.header.frame_id = frame
            records.insert(0, Record("/depth/camera_info", STAMP, camera_info_message(camera, frame, STAMP)))
        write_bag(folder / "recording", records)
        return folder / "recording"

    return make


def recorded(path: Path) -> Path:
    """Return a row's input as a recording of what a driver would publish."""
    if path.is_dir():
        return path
    arrays = dict(np.load(path)) if path.suffix == ".npz" else {}
    if "depth" in arrays:
        whole = arrays["depth"].dtype.kind == "u"
        depth, encoding = (arrays["depth"] / 1000, "16UC1") if whole else (arrays["depth"], "32FC1")
        message = lambda stamp: depth_message(depth, FRAME, stamp, encoding=encoding)  # noqa: E731
        return bag(message, "depth/image_rect", arrays["K"])(path.parent)
    points = np.load(path) if path.suffix == ".npy" else load_views(path)[0].points
    return bag(lambda stamp: cloud_message(points, FRAME, stamp))(path.parent)


def camera_place(path: Path) -> tuple[float, ...]:
    """Return where a file says that its camera stood, or nothing."""
    if path.suffix.removeprefix(".") not in CLOUD_ENDINGS or not is_cloud_file(path):
        return ()
    try:
        return tuple(load_views(path)[0].viewpoint.tolist())
    except CloudError:
        return ()
