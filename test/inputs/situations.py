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
    archive,
    array,
    bag,
    cloud,
    content,
    depth_of,
    grid_of,
    in_camera,
    in_world,
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
    written,
)

from graspd_core import TriangleMesh, make_shape

BOTTLE, BOX, CYLINDER = volume("bottle"), volume("box"), volume("cylinder")
ROWS, MILLIMETRES = rows_of(), millimetres()
PAIR, SOLID = ("box", "cylinder"), make_shape("box")
CLOUDS = (
    Situation(
        "depth in mm with its camera's matrix", archive(depth=MILLIMETRES, K=MATRIX), BOTTLE, "NVlabs/6dof-graspnet#11"
    ),
    Situation(
        "depth in metres",
        archive(depth=depth_of()[0].astype(np.float32), K=MATRIX),
        BOTTLE,
        "graspnet/graspnet-baseline#27",
    ),
    Situation(
        "depth of floats in mm",
        archive(depth=1000 * depth_of()[0], K=MATRIX),
        "millimetres",
        "graspnet/anygrasp_sdk#171",
    ),
    Situation("depth without a matrix", archive(depth=MILLIMETRES), "holds 'depth' but no 'K'", "ivalab/KGN#4"),
    Situation("an organised cloud with NaN", array(grid_of()), BOTTLE, "isl-org/Open3D#1016"),
    Situation(
        "gaps filled with zeros", array(np.nan_to_num(ROWS)), BOTTLE, "giacomodabisias/libfreenect2pclgrabber#11"
    ),
    Situation("gaps filled with infinity", ply(np.nan_to_num(ROWS, nan=-np.inf)), BOTTLE, "isl-org/Open3D#5985"),
    Situation(
        "a cloud with normals", ply(np.hstack([ROWS, np.ones((76800, 3))]), "nx ny nz"), BOTTLE, "isl-org/Open3D#2754"
    ),
    Situation("a pcd with NaN", pcd(ROWS), BOTTLE, "ch-sa/labelCloud#54"),
    Situation(
        "a pcd in the world's frame that says where its sensor stood",
        pcd(in_world(ROWS), VIEWPOINT="{:.6f} {:.6f} {:.6f} 1 0 0 0".format(*POSE[:3, 3])),
        BOTTLE,
        "atenpas/gpd#41",
    ),
    Situation(
        "points and the camera's place",
        archive(points=in_world(ROWS), viewpoint=POSE[:3, 3]),
        BOTTLE,
        "NVlabs/GraspGen#43",
    ),
    Situation(
        "a cloud in mm", array(1000 * ROWS), "in millimetres, divide them by 1000", "Lewis-Stuart-11/PlantDreamer#3"
    ),
    Situation("a cloud in mm, said", array(1000 * ROWS), BOTTLE, "Lewis-Stuart-11/PlantDreamer#3", {"scale": 0.001}),
    Situation("a cloud in cm", array(100 * ROWS), "in centimetres, divide them by 100", "graspnet/anygrasp_sdk#171"),
    Situation("nothing but NaN", array(np.full((90, 3), np.nan)), "NaN", "isl-org/Open3D#1188"),
    Situation("a cloud without points", ply(np.zeros((0, 3))), "empty", "QingyongHu/RandLA-Net#197"),
    Situation(
        "a cloud cut short", ply(ROWS, promised=10**6), "not a readable ply cloud", "realsenseai/librealsense#882"
    ),
    Situation("a handful of points", array(only_object()[:40]), "at least 50", "pearl-robot-lab/neugraspnet#4"),
    Situation(
        "another array",
        archive(xyz=ROWS),
        "no array called 'points', 'depth' or 'depths'; it has: xyz",
        "NVlabs/6dof-graspnet#7",
    ),
    Situation(
        "a table with nothing on it",
        array(rows_of("")),
        "no graspable object among .* nothing on it",
        "atenpas/gpd#119",
    ),
    Situation(
        "the object alone, cut out by others",
        array(only_object()),
        BOTTLE,
        "NVlabs/contact_graspnet#35",
        {"alone": True},
        near=0.6,
    ),
    Situation(
        "one side of an object, about its own middle",
        array(only_object() - np.nanmean(only_object(), axis=0)),
        "did not stand at the origin of its frame",
        "NVlabs/6dof-graspnet#7",
        {"alone": True},
    ),
    Situation(
        "a target where nothing is",
        array(grid_of()),
        "target: no object within 0.05 m",
        "atenpas/gpd#57",
        {"target": in_camera(np.array([0.25, 0.25, 0.1]))},
    ),
    Situation(
        "a target in the middle of the thing",
        array(grid_of(*PAIR)),
        BOX,
        "atenpas/gpd#106",
        {"target": middle(stage(*PAIR).truth)},
        "the target touches another object",
    ),
    Situation(
        "a target in the thing that touches it",
        array(grid_of(*PAIR)),
        CYLINDER,
        "atenpas/gpd#30",
        {"target": middle(stage(*PAIR).obstacles[0])},
        "the target touches another object",
    ),
    Situation(
        "two things that touch",
        array(grid_of(*PAIR)),
        BOX + CYLINDER,
        "atenpas/gpd#59",
        warns="may be 2 objects that touch",
        near=0.4,
    ),
    Situation("a box all round", array(all_round("box")), BOX, "atenpas/gpd#91", near=0.05),
    Situation("a bowl all round", array(all_round("bowl")), volume("bowl"), "atenpas/gpd#91"),
    Situation(
        "a mug all round, alone", array(all_round("mug")), volume("mug"), "atenpas/gpd#91", {"alone": True}, near=0.5
    ),
)
MESHES = (
    Situation(
        "a camera viewer's mesh",
        mesh_file("a.ply", sheet()),
        BOTTLE,
        "realsenseai/librealsense#2036",
        warns="so its points are used as a cloud",
    ),
    Situation(
        "a camera viewer's mesh, y and z turned",
        mesh_file("a.obj", TriangleMesh(sheet().vertices * [1, -1, -1], sheet().faces)),
        BOTTLE,
        "realsenseai/librealsense#10536",
        warns="used as a cloud",
    ),
    Situation(
        "a camera viewer's mesh with faces to what it did not see",
        mesh_file("a.ply", sheet(gaps=True)),
        BOTTLE,
        "giacomodabisias/libfreenect2pclgrabber#11",
        warns="used as a cloud",
    ),
    Situation(
        "a camera viewer's mesh in another frame",
        mesh_file("a.ply", sheet_in_world()),
        "an open mesh of one camera's view, and not in the camera's frame",
        "PointCloudLibrary/pcl#1474",
    ),
    Situation(
        "a mesh with a target",
        mesh_file("a.stl", SOLID),
        "target(_point)?: given with .*a.stl, a mesh",
        "",
        {"target": (0.0, 0.0, 0.0)},
    ),
    Situation(
        "a mesh in mm",
        mesh_file("a.stl", scaled("box", 1000)),
        r"scale 0.001 \(from mm\) makes it",
        "moveit/moveit#279",
    ),
    Situation(
        "a mesh in mm, said",
        mesh_file("a.stl", scaled("box", 1000)),
        BOX,
        "moveit/moveit#279",
        {"scale": 0.001},
        near=0.01,
    ),
    Situation(
        "a mesh in cm",
        mesh_file("a.stl", scaled("box", 100)),
        r"scale 0.01 \(from cm\) makes it",
        "tesseract-robotics/tesseract#1184",
    ),
    Situation(
        "a mesh with a hole",
        mesh_file("a.obj", TriangleMesh(SOLID.vertices, SOLID.faces[:-1])),
        BOX,
        "zdchan/GraspXL#7",
        warns="not closed",
        near=0.1,
    ),
    Situation(
        "a mesh turned inside out",
        mesh_file("a.obj", TriangleMesh(SOLID.vertices, SOLID.faces[:, ::-1])),
        BOX,
        "PointCloudLibrary/pcl#1474",
        near=0.01,
    ),
    Situation(
        "vertices without faces",
        content("a.obj", lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        "3 vertices and no face",
        "realsenseai/librealsense#2036",
    ),
    Situation(
        "a pointer of git-lfs",
        content("a.obj", lambda: b"version https://git-lfs.github.com/spec/v1\n"),
        "git-LFS pointer",
        "zdchan/GraspXL#7",
    ),
    Situation(
        "a page of a web site",
        content("a.stl", lambda: b"<!DOCTYPE html><html></html>"),
        "a page of HTML, not a mesh",
        "moveit/moveit#279",
    ),
    Situation(
        "an ending that is not known", content("a.las", lambda: b"LASF"), "unknown ending", "isl-org/Open3D#6623"
    ),
    Situation("a file that is not there", written("a.ply", lambda path: None), "no such", "graspnet/graspnetAPI#3"),
    Situation("quadrilaterals, material lost", content("a.obj", quads), BOX, "graspnet/graspnetAPI#34"),
    Situation("a binary stl that begins with solid", solid_stl, BOX, "ros-industrial/abb#104", near=0.01),
    Situation(
        "an stl with nothing in it",
        content("a.stl", lambda: b"solid Empty\nendsolid Empty"),
        "empty mesh",
        "mikedh/trimesh#95",
    ),
)
MESSAGES = (
    Situation(
        "a message without points",
        bag(lambda stamp: cloud_message(np.zeros((0, 3)), FRAME, stamp)),
        "empty",
        "QingyongHu/RandLA-Net#197",
    ),
    Situation("a message of 32 bytes a point", cloud(grid_of(), **padded()), BOTTLE, "ros2/common_interfaces#197"),
    Situation(
        "a message that says big endian and is not",
        cloud(grid_of(), is_bigendian=True),
        "is_bigendian=true, but",
        "Field-Robotics-Japan/UnitySensors#212",
    ),
    Situation("a message without a row's length", cloud(ROWS, row_step=0), BOTTLE, "ros-drivers/velodyne#279"),
    Situation(
        "an organised message with the row's length of one row",
        cloud(grid_of(), row_step=12 * 320 * 240),
        BOTTLE,
        "realsenseai/realsense-ros#1668",
    ),
    Situation(
        "a message cut short", cloud(grid_of(), data=np.zeros(999, np.uint8)), "999 bytes", "ros2/common_interfaces#106"
    ),
)
DRIVERS = (
    Situation(
        "points with colours, n by 6",
        array(np.hstack([ROWS, np.full((76800, 3), 128.0)])),
        r"colours or normals beside x, y, z\? .*points\[:, :3\]",
        "YanjieZe/Improved-3D-Diffusion-Policy#24",
    ),
    Situation(
        "text of points with colours",
        content("a.xyz", lambda: text(only_finite(ROWS), 128, 64, 0)),
        BOTTLE,
        "felja633/DARE#3",
    ),
    Situation("a pcd with gaps in its fields", padded_pcd(), BOTTLE, "PDAL/PDAL#3254"),
    Situation("a ply of text and doubles", text_ply(), BOTTLE, "keijiro/Pcx#10"),
    Situation("a ply that calls its types float64", text_ply("float64", colour=False), BOTTLE, "keijiro/Pcx#10"),
    Situation("a cloud with y up and z back", array(ROWS * [1, -1, -1]), BOTTLE, "realsenseai/librealsense#5833"),
    Situation("a ply of text with nan", text_ply("float", colour=False, gaps=True), BOTTLE, "ddiakopoulos/tinyply#46"),
    Situation(
        "a pcd of text with colours",
        text_pcd(),
        BOTTLE,
        "Hitachi-Automotive-And-Industry-Lab/semantic-segmentation-editor#90",
    ),
    Situation(
        "depth of 8 bits",
        archive(depth=np.minimum(MILLIMETRES, 255).astype(np.uint8), K=MATRIX),
        "cut to 8 bits",
        "realsenseai/librealsense#3938",
    ),
    Situation(
        "depth with 65535 where nothing was seen",
        archive(depth=np.where(MILLIMETRES > 0, MILLIMETRES, 65535), K=MATRIX),
        BOTTLE,
        "isl-org/Open3D#6962",
    ),
    Situation(
        "a pose that is no rotation",
        archive(depth=MILLIMETRES, K=MATRIX, T_world_camera=sheared()),
        "rotation",
        "NVlabs/6dof-graspnet#10",
    ),
    Situation(
        "the matrix of another resolution",
        archive(depth=MILLIMETRES, K=MATRIX * [[2], [2], [1]]),
        "K is for another resolution",
        "stepjam/RLBench#208",
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
    # As messages, these are others of the table: their points are the same.
    "a pcd of text with colours",
    "a pcd with NaN",
    "a pcd with gaps in its fields",
    "a ply of text and doubles",
    "a ply of text with nan",
    "a ply that calls its types float64",
    "points and the camera's place",
}
