"""What people send, as issue threads of comparable tools tell it: one row a situation.

A row makes its input in a folder and says what a person would expect: the object, by its volume, or a refusal, by its
words. To add a situation, add a row.
"""

import numpy as np
from bag_writer import cloud_message
from inputs_made import (
    FRAME,
    MATRIX,
    POSE,
    Situation,
    all_round,
    array_file,
    bag,
    bytes_file,
    cloud,
    depth_of,
    grid_of,
    in_camera,
    in_world,
    infinite,
    mesh_file,
    middle,
    millimetres,
    only_finite,
    only_object,
    padded,
    padded_pcd,
    pcd,
    ply,
    quads,
    rows_of,
    scaled,
    sheared,
    sheet,
    sheet_in_world,
    solid_stl,
    stage,
    text,
    text_pcd,
    text_ply,
    volume,
    zeroed,
)

from graspd_core import TriangleMesh, make_shape

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
        "no array called 'points', 'depth' or 'depths'; it has: xyz",
        "NVlabs/6dof-graspnet/issues/7",
    ),
    Situation(
        "a table with nothing on it",
        array_file("a.npy", lambda: rows_of("")),
        "no graspable object among .* nothing on it",
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
        "one side of an object, about its own middle",
        array_file("a.npy", lambda: only_object() - np.nanmean(only_object(), axis=0)),
        "did not stand at the origin of its frame",
        "NVlabs/6dof-graspnet/issues/7",
        {"alone": True},
    ),
    Situation(
        "a target where nothing is",
        array_file("a.npy", grid_of),
        "target: no object within 0.05 m",
        "atenpas/gpd/issues/57",
        {"target": in_camera(np.array([0.25, 0.25, 0.1]))},
    ),
    Situation(
        "a target in the middle of the thing",
        array_file("a.npy", lambda: grid_of(*PAIR)),
        BOX,
        "atenpas/gpd/issues/106",
        {"target": middle(stage(*PAIR).truth)},
        "the target touches another object",
    ),
    Situation(
        "a target in the thing that touches it",
        array_file("a.npy", lambda: grid_of(*PAIR)),
        CYLINDER,
        "atenpas/gpd/issues/30",
        {"target": middle(stage(*PAIR).obstacles[0])},
        "the target touches another object",
    ),
    Situation(
        "two things that touch",
        array_file("a.npy", lambda: grid_of(*PAIR)),
        BOX + CYLINDER,
        "atenpas/gpd/issues/59",
        {},
        "may be 2 objects that touch",
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
        "so its points are used as a cloud",
    ),
    Situation(
        "a camera viewer's mesh, y and z turned",
        mesh_file("a.obj", TriangleMesh(sheet().vertices * [1, -1, -1], sheet().faces)),
        BOTTLE,
        "realsenseai/librealsense/issues/10536",
        {},
        "used as a cloud",
    ),
    Situation(
        "a camera viewer's mesh with faces to what it did not see",
        mesh_file("a.ply", sheet(gaps=True)),
        BOTTLE,
        "giacomodabisias/libfreenect2pclgrabber/issues/11",
        {},
        "used as a cloud",
    ),
    Situation(
        "a camera viewer's mesh in another frame",
        mesh_file("a.ply", sheet_in_world()),
        "an open mesh of one camera's view, and not in the camera's frame",
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
    Situation("quadrilaterals, material lost", bytes_file("a.obj", quads), BOX, "graspnet/graspnetAPI/issues/34"),
    Situation("a binary stl that begins with solid", solid_stl, BOX, "ros-industrial/abb/issues/104", near=0.01),
    Situation(
        "an stl with nothing in it",
        bytes_file("a.stl", lambda: b"solid Empty\nendsolid Empty"),
        "empty mesh",
        "mikedh/trimesh/issues/95",
    ),
)
MESSAGES = (
    Situation(
        "a message without points",
        bag(lambda stamp: cloud_message(np.zeros((0, 3)), FRAME, stamp)),
        "empty",
        "QingyongHu/RandLA-Net/issues/197",
    ),
    Situation(
        "a message of 32 bytes a point",
        cloud(grid_of(), **padded()),
        BOTTLE,
        "ros2/common_interfaces/issues/197",
    ),
    Situation(
        "a message that says big endian and is not",
        cloud(grid_of(), is_bigendian=True),
        "is_bigendian=true, but",
        "Field-Robotics-Japan/UnitySensors/pull/212",
    ),
    Situation(
        "a message without a row's length",
        cloud(rows_of(), row_step=0),
        BOTTLE,
        "ros-drivers/velodyne/issues/279",
    ),
    Situation(
        "an organised message with the row's length of one row",
        cloud(grid_of(), row_step=12 * 320 * 240),
        BOTTLE,
        "realsenseai/realsense-ros/pull/1668",
    ),
    Situation(
        "a message cut short",
        cloud(grid_of(), data=np.zeros(999, np.uint8)),
        "999 bytes",
        "ros2/common_interfaces/issues/106",
    ),
)
DRIVERS = (
    Situation(
        "points with colours, n by 6",
        array_file("a.npy", lambda: np.hstack([rows_of(), np.full((76800, 3), 128.0)])),
        r"colours or normals beside x, y, z\? .*points\[:, :3\]",
        "YanjieZe/Improved-3D-Diffusion-Policy/issues/24",
    ),
    Situation(
        "text of points with colours",
        bytes_file("a.xyz", lambda: text(only_finite(rows_of()), 128, 64, 0)),
        BOTTLE,
        "felja633/DARE/issues/3",
    ),
    Situation("a pcd with gaps in its fields", bytes_file("a.pcd", padded_pcd), BOTTLE, "PDAL/PDAL/issues/3254"),
    Situation("a ply of text and doubles", bytes_file("a.ply", text_ply), BOTTLE, "keijiro/Pcx/issues/10"),
    Situation(
        "a ply that calls its types float64",
        bytes_file("a.ply", lambda: text_ply("float64", colour=False)),
        BOTTLE,
        "keijiro/Pcx/issues/10",
    ),
    Situation(
        "a cloud with y up and z back",
        array_file("a.npy", lambda: rows_of() * [1, -1, -1]),
        BOTTLE,
        "realsenseai/librealsense/issues/5833",
    ),
    Situation(
        "a ply of text with nan",
        bytes_file("a.ply", lambda: text_ply("float", colour=False, gaps=True)),
        BOTTLE,
        "ddiakopoulos/tinyply/issues/46",
    ),
    Situation(
        "a pcd of text with colours",
        bytes_file("a.pcd", text_pcd),
        BOTTLE,
        "Hitachi-Automotive-And-Industry-Lab/semantic-segmentation-editor/issues/90",
    ),
    Situation(
        "depth of 8 bits",
        array_file("a.npz", lambda: {"depth": np.minimum(millimetres(), 255).astype(np.uint8), "K": MATRIX}),
        "cut to 8 bits",
        "realsenseai/librealsense/issues/3938",
    ),
    Situation(
        "depth with 65535 where nothing was seen",
        array_file("a.npz", lambda: {"depth": np.where(millimetres() > 0, millimetres(), 65535), "K": MATRIX}),
        BOTTLE,
        "isl-org/Open3D/issues/6962",
    ),
    Situation(
        "a pose that is no rotation",
        array_file("a.npz", lambda: {"depth": millimetres(), "K": MATRIX, "T_world_camera": sheared()}),
        "rotation",
        "NVlabs/6dof-graspnet/issues/10",
    ),
    Situation(
        "the matrix of another resolution",
        array_file("a.npz", lambda: {"depth": millimetres(), "K": MATRIX * [[2], [2], [1]]}),
        "K is for another resolution",
        "stepjam/RLBench/issues/208",
    ),
)
SITUATIONS = CLOUDS + MESHES + DRIVERS + MESSAGES

# Only a file can be these: a driver's message has a matrix, metres, a length and x, y, z.
FILE_ONLY = {
    "a cloud in mm, said",
    "a cloud without points",
    "a cloud cut short",
    "a pose that is no rotation",
    "another array",
    "depth without a matrix",
    "points with colours, n by 6",
}
