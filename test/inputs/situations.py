"""What people send, as issue threads of comparable tools tell it: one row a situation.

A row makes its input in a folder and says what a person would expect: the object, by its volume, or a refusal, by its
words. To add a situation, add a row.
"""

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


@dataclass(frozen=True)
class Situation:
    """An input and what a person would expect of it.

    Attributes:
        make: writes the input into a folder and returns its path.
        expect: the object's volume [m³], or the words of a refusal as a regular expression.
        thread: where somebody had it on GitHub; empty where it is of this project's own trials.
        options: of the command line; the library's arguments follow from them.
        warns: words of a warning.
        near: share of the volume that the answer may be off, for one view guesses the back.
    """

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


BOTTLE, BOX, CYLINDER = volume("bottle"), volume("box"), volume("cylinder")
ROWS, MILLIMETRES = rows_of(), millimetres()
PAIR, SOLID = ("box", "cylinder"), make_shape("box")
CLOUDS = {
    "depth in mm with its camera's matrix": Situation(
        archive(depth=MILLIMETRES, K=MATRIX), BOTTLE, "NVlabs/6dof-graspnet#11"
    ),
    "depth in metres": Situation(
        archive(depth=depth_of()[0].astype(np.float32), K=MATRIX), BOTTLE, "graspnet/graspnet-baseline#27"
    ),
    "depth of floats in mm": Situation(
        archive(depth=1000 * depth_of()[0], K=MATRIX), "millimetres", "graspnet/anygrasp_sdk#171"
    ),
    "depth without a matrix": Situation(archive(depth=MILLIMETRES), "holds 'depth' but no 'K'", "ivalab/KGN#4"),
    "an organised cloud with NaN": Situation(array(grid_of()), BOTTLE, "isl-org/Open3D#1016"),
    "gaps filled with zeros": Situation(
        array(np.nan_to_num(ROWS)), BOTTLE, "giacomodabisias/libfreenect2pclgrabber#11"
    ),
    "gaps filled with infinity": Situation(ply(np.nan_to_num(ROWS, nan=-np.inf)), BOTTLE, "isl-org/Open3D#5985"),
    "a cloud with normals": Situation(
        ply(np.hstack([ROWS, np.ones((76800, 3))]), "nx ny nz"), BOTTLE, "isl-org/Open3D#2754"
    ),
    "a pcd with NaN": Situation(pcd(ROWS), BOTTLE, "ch-sa/labelCloud#54"),
    "a pcd in the world's frame that says where its sensor stood": Situation(
        pcd(in_world(ROWS), VIEWPOINT="{:.6f} {:.6f} {:.6f} 1 0 0 0".format(*POSE[:3, 3])), BOTTLE, "atenpas/gpd#41"
    ),
    "points and the camera's place": Situation(
        archive(points=in_world(ROWS), viewpoint=POSE[:3, 3]), BOTTLE, "NVlabs/GraspGen#43"
    ),
    "a cloud in mm": Situation(
        array(1000 * ROWS), r"in millimetres, divide them by 1000 \(--units mm", "Lewis-Stuart-11/PlantDreamer#3"
    ),
    "a cloud in mm, said": Situation(array(1000 * ROWS), BOTTLE, "Lewis-Stuart-11/PlantDreamer#3", {"scale": 0.001}),
    "points in m, the camera's place in mm": Situation(
        archive(points=in_world(ROWS), viewpoint=1000 * POSE[:3, 3]),
        r"if the camera's position \(.*\) is in millimetres, give it in metres",
    ),
    "a cloud in cm": Situation(array(100 * ROWS), "in centimetres, divide them by 100", "graspnet/anygrasp_sdk#171"),
    "nothing but NaN": Situation(array(np.full((90, 3), np.nan)), "NaN", "isl-org/Open3D#1188"),
    "a cloud without points": Situation(ply(np.zeros((0, 3))), "empty", "QingyongHu/RandLA-Net#197"),
    "a cloud cut short": Situation(
        ply(ROWS, promised=10**6), "not a readable ply cloud", "realsenseai/librealsense#882"
    ),
    "a handful of points": Situation(array(only_object()[:40]), "at least 50", "pearl-robot-lab/neugraspnet#4"),
    "another array": Situation(
        archive(xyz=ROWS), "no array called 'points', 'depth' or 'depths'; it has: xyz", "NVlabs/6dof-graspnet#7"
    ),
    "a table with nothing on it": Situation(
        array(rows_of("")), "no graspable object among .* nothing on it", "atenpas/gpd#119"
    ),
    "the object alone, cut out by others": Situation(
        array(only_object()), BOTTLE, "NVlabs/contact_graspnet#35", {"alone": True}, near=0.6
    ),
    "one side of an object, about its own middle": Situation(
        array(only_object() - np.nanmean(only_object(), axis=0)),
        "did not stand at the origin of its frame",
        "NVlabs/6dof-graspnet#7",
        {"alone": True},
    ),
    "a target where nothing is": Situation(
        array(grid_of()),
        "target: no object within 0.05 m",
        "atenpas/gpd#57",
        {"target": in_camera(np.array([0.25, 0.25, 0.1]))},
    ),
    "a target in the middle of the thing": Situation(
        array(grid_of(*PAIR)),
        BOX,
        "atenpas/gpd#106",
        {"target": middle(stage(*PAIR).truth)},
        "the target touches another object",
    ),
    "a target in the thing that touches it": Situation(
        array(grid_of(*PAIR)),
        CYLINDER,
        "atenpas/gpd#30",
        {"target": middle(stage(*PAIR).obstacles[0])},
        "the target touches another object",
    ),
    "two things that touch": Situation(
        array(grid_of(*PAIR)), BOX + CYLINDER, "atenpas/gpd#59", warns="may be 2 objects that touch", near=0.4
    ),
    "a box all round": Situation(array(all_round("box")), BOX, "atenpas/gpd#91", near=0.05),
    "a bowl all round": Situation(array(all_round("bowl")), volume("bowl"), "atenpas/gpd#91"),
    "a mug all round, alone": Situation(
        array(all_round("mug")), volume("mug"), "atenpas/gpd#91", {"alone": True}, near=0.5
    ),
}
MESHES = {
    "a camera viewer's mesh": Situation(
        mesh_file("a.ply", sheet()), BOTTLE, "realsenseai/librealsense#2036", warns="so its points are used as a cloud"
    ),
    "a camera viewer's mesh, y and z turned": Situation(
        mesh_file("a.obj", TriangleMesh(sheet().vertices * [1, -1, -1], sheet().faces)),
        BOTTLE,
        "realsenseai/librealsense#10536",
        warns="used as a cloud",
    ),
    "a camera viewer's mesh with faces to what it did not see": Situation(
        mesh_file("a.ply", sheet(gaps=True)),
        BOTTLE,
        "giacomodabisias/libfreenect2pclgrabber#11",
        warns="used as a cloud",
    ),
    "a camera viewer's mesh in another frame": Situation(
        mesh_file("a.ply", sheet_in_world()),
        "an open mesh of one camera's view, and not in the camera's frame",
        "PointCloudLibrary/pcl#1474",
    ),
    "a mesh with a target": Situation(
        mesh_file("a.stl", SOLID), "target(_point)?: given with .*a.stl, a mesh", "", {"target": (0.0, 0.0, 0.0)}
    ),
    "a mesh in mm": Situation(
        mesh_file("a.stl", scaled("box", 1000)), r"scale 0.001 \(from mm\) makes it", "moveit/moveit#279"
    ),
    "a mesh in mm, said": Situation(
        mesh_file("a.stl", scaled("box", 1000)), BOX, "moveit/moveit#279", {"scale": 0.001}, near=0.01
    ),
    "a mesh in cm": Situation(
        mesh_file("a.stl", scaled("box", 100)), r"scale 0.01 \(from cm\) makes it", "tesseract-robotics/tesseract#1184"
    ),
    "a mesh with a hole": Situation(
        mesh_file("a.obj", TriangleMesh(SOLID.vertices, SOLID.faces[:-1])),
        BOX,
        "zdchan/GraspXL#7",
        warns="not closed",
        near=0.1,
    ),
    "a mesh turned inside out": Situation(
        mesh_file("a.obj", TriangleMesh(SOLID.vertices, SOLID.faces[:, ::-1])),
        BOX,
        "PointCloudLibrary/pcl#1474",
        near=0.01,
    ),
    "vertices without faces": Situation(
        content("a.obj", lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        "3 vertices and no face",
        "realsenseai/librealsense#2036",
    ),
    "a pointer of git-lfs": Situation(
        content("a.obj", lambda: b"version https://git-lfs.github.com/spec/v1\n"), "git-LFS pointer", "zdchan/GraspXL#7"
    ),
    "a page of a web site": Situation(
        content("a.stl", lambda: b"<!DOCTYPE html><html></html>"), "a page of HTML, not a mesh", "moveit/moveit#279"
    ),
    "an ending that is not known": Situation(
        content("a.las", lambda: b"LASF"), "unknown ending", "isl-org/Open3D#6623"
    ),
    "a file that is not there": Situation(written("a.ply", lambda path: None), "no such", "graspnet/graspnetAPI#3"),
    "quadrilaterals, material lost": Situation(content("a.obj", quads), BOX, "graspnet/graspnetAPI#34"),
    "a binary stl that begins with solid": Situation(solid_stl, BOX, "ros-industrial/abb#104", near=0.01),
    "an stl with nothing in it": Situation(
        content("a.stl", lambda: b"solid Empty\nendsolid Empty"), "empty mesh", "mikedh/trimesh#95"
    ),
}
MESSAGES = {
    "a message without points": Situation(
        bag(lambda stamp: cloud_message(np.zeros((0, 3)), FRAME, stamp)), "empty", "QingyongHu/RandLA-Net#197"
    ),
    "a message of 32 bytes a point": Situation(cloud(grid_of(), **padded()), BOTTLE, "ros2/common_interfaces#197"),
    "a message that says big endian and is not": Situation(
        cloud(grid_of(), is_bigendian=True), "is_bigendian=true, but", "Field-Robotics-Japan/UnitySensors#212"
    ),
    "a message without a row's length": Situation(cloud(ROWS, row_step=0), BOTTLE, "ros-drivers/velodyne#279"),
    "an organised message with the row's length of one row": Situation(
        cloud(grid_of(), row_step=12 * 320 * 240), BOTTLE, "realsenseai/realsense-ros#1668"
    ),
    "a message cut short": Situation(
        cloud(grid_of(), data=np.zeros(999, np.uint8)), "999 bytes", "ros2/common_interfaces#106"
    ),
}
DRIVERS = {
    "points with colours, n by 6": Situation(
        array(np.hstack([ROWS, np.full((76800, 3), 128.0)])),
        r"colours or normals after x, y, z\? .*points\[:, :3\]",
        "YanjieZe/Improved-3D-Diffusion-Policy#24",
    ),
    "text of points with colours": Situation(
        content("a.xyz", lambda: text(only_finite(ROWS), 128, 64, 0)), BOTTLE, "felja633/DARE#3"
    ),
    "a pcd with gaps in its fields": Situation(padded_pcd(), BOTTLE, "PDAL/PDAL#3254"),
    "a ply of text and doubles": Situation(text_ply(), BOTTLE, "keijiro/Pcx#10"),
    "a ply that calls its types float64": Situation(text_ply("float64", colour=False), BOTTLE, "keijiro/Pcx#10"),
    "a cloud with y up and z back": Situation(array(ROWS * [1, -1, -1]), BOTTLE, "realsenseai/librealsense#5833"),
    "a ply of text with nan": Situation(text_ply("float", colour=False, gaps=True), BOTTLE, "ddiakopoulos/tinyply#46"),
    "a pcd of text with colours": Situation(
        text_pcd(), BOTTLE, "Hitachi-Automotive-And-Industry-Lab/semantic-segmentation-editor#90"
    ),
    "depth of 8 bits": Situation(
        archive(depth=np.minimum(MILLIMETRES, 255).astype(np.uint8), K=MATRIX),
        "cut to 8 bits",
        "realsenseai/librealsense#3938",
    ),
    "depth with 65535 where nothing was seen": Situation(
        archive(depth=np.where(MILLIMETRES > 0, MILLIMETRES, 65535), K=MATRIX), BOTTLE, "isl-org/Open3D#6962"
    ),
    "a pose that is no rotation": Situation(
        archive(depth=MILLIMETRES, K=MATRIX, T_world_camera=sheared()), "rotation", "NVlabs/6dof-graspnet#10"
    ),
    "the matrix of another resolution": Situation(
        archive(depth=MILLIMETRES, K=MATRIX * [[2], [2], [1]]), "K is for another resolution", "stepjam/RLBench#208"
    ),
}
SITUATIONS = CLOUDS | MESHES | DRIVERS | MESSAGES

# Only a file can be these: a driver's message has a matrix, metres, a length and x, y, z.
FILE_ONLY = {
    "a cloud in mm, said",
    "a cloud without points",
    "a cloud cut short",
    "a pose that is no rotation",
    "another array",
    "depth without a matrix",
    "points with colours, n by 6",
    # As messages, these are others of the table: their points are the same.
    "a pcd of text with colours",
    "a pcd with NaN",
    "a pcd with gaps in its fields",
    "a ply of text and doubles",
    "a ply of text with nan",
    "a ply that calls its types float64",
    "points and the camera's place",
}
