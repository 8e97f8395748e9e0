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

Maker = Callable[[Path], Path]
CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)
MATRIX = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
POSE = ring_poses(1, elevation=0.6, azimuth=-1.2)[0]
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
        thread: where somebody had it on GitHub; empty where it is of this project's own trials.
        options: of the command line; the library's arguments follow from them.
        warns: words of a warning.
        near: share of the volume that the answer may be off, for one view guesses the back.
    """

    name: str
    make: Maker
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


def written(name: str, write: Callable[[Path], Any]) -> Maker:
    """What makes an input: it calls `write` with the path of a file in the folder that it is given."""

    def make(folder: Path) -> Path:
        write(folder / name)
        return folder / name

    return make


def mesh_file(name: str, mesh: TriangleMesh) -> Maker:
    return written(name, lambda path: save_mesh(path, mesh))


def content(name: str, make_bytes: Callable[[], bytes]) -> Maker:
    return written(name, lambda path: path.write_bytes(make_bytes()))


def array(points: np.ndarray) -> Maker:
    return written("a.npy", lambda path: np.save(path, points))


def archive(**arrays: np.ndarray) -> Maker:
    return written("a.npz", lambda path: np.savez(path, allow_pickle=False, **arrays))


def ply(points: np.ndarray, extra: str = "", promised: int | None = None) -> Maker:
    """A binary cloud. `extra` names more properties, of floats."""
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", *extra.split()))
    count = len(points) if promised is None else promised
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    return content("a.ply", lambda: head.encode() + points.astype("<f4").tobytes())


def pcd_head(count: int, **entries: str) -> bytes:
    """The header of a cloud of x, y and z in float32, with other entries as given."""
    head = {"VERSION": ".7", "FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1", "WIDTH": str(count)}
    head |= {"HEIGHT": "1", "VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": str(count), "DATA": "binary"} | entries
    return "".join(f"{key} {value}\n" for key, value in head.items()).encode()


def pcd(points: np.ndarray, **entries: str) -> Maker:
    return content("a.pcd", lambda: pcd_head(len(points), **entries) + points.astype("<f4").tobytes())


def rows_of(shape: str = "bottle") -> np.ndarray:
    return grid_of(shape).reshape(-1, 3)


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


def cloud(points: np.ndarray, **changes: Any) -> Maker:
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


def padded_pcd() -> Maker:
    """A binary pcd whose fields `_` are gaps, as PCL writes structures that are aligned."""
    rows = np.zeros((76800, 8), "<f4")
    rows[:, :3] = rows_of()
    return pcd(rows, FIELDS="x y z _ rgb _", SIZE="4 4 4 1 4 1", TYPE="F F F U F U", COUNT="1 1 1 4 1 12")


def text_pcd() -> Maker:
    points = only_finite(rows_of())
    head = pcd_head(len(points), FIELDS="x y z rgb", SIZE="4 4 4 4", TYPE="F F F F", COUNT="1 1 1 1", DATA="ascii")
    return content("a.pcd", lambda: head + text(points, 1.648931e-38))


def text_ply(kind: str = "double", colour: bool = True, gaps: bool = False) -> Maker:
    points = rows_of() if gaps else only_finite(rows_of())
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property {kind} {name}\n" for name in "xyz")
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) if colour else ""
    head += "end_header\n"
    return content("a.ply", lambda: head.encode() + text(points, *((9, 8, 7) if colour else ())))


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


def bag(make_message: Callable[[int], Any], topic: str = "points", matrix: np.ndarray = MATRIX) -> Maker:
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
