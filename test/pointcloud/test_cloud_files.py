"""Clouds from files: every kind and every header comes back, and what is no cloud is named."""

import numpy as np
import pytest
from expected import refused, some

from graspd_bench.rendering.render import look_at, render_depth
from graspd_core.errors import CloudError
from graspd_core.mesh.mesh_files import save_mesh, surface_samples
from graspd_core.mesh.shapes import SPHERE_RADIUS, make_shape
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.perception.cloud.cloud_files import is_cloud_file, load_views
from graspd_core.perception.load_scene import scaled_views

MATRIX = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
LENS = (0.1, -0.2, 0.001, -0.001, 0.05)
EYES = [(0.4, 0.0, 0.2), (0.0, -0.4, 0.2), (-0.3, 0.3, 0.1)]
POSES = np.stack([look_at(eye, (0, 0, 0)) for eye in EYES])


@pytest.mark.parametrize("ending", ["npy", "npz", "ply", "pcd", "xyz"])
def test_cloud_files_come_back(tmp_path, ending):
    import open3d as o3d

    points = surface_samples(make_shape("box"), 200, 0)[0]
    path = tmp_path / f"cloud.{ending}"
    if ending == "npy":
        np.save(path, points)
    elif ending == "npz":
        np.savez(path, points=points, viewpoint=np.array([1.0, 2.0, 3.0]))
    else:
        o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    assert is_cloud_file(path)
    (cloud,) = load_views(path)
    assert cloud.points == pytest.approx(points, abs=1e-6)
    assert cloud.viewpoint == pytest.approx([1, 2, 3] if ending == "npz" else [0, 0, 0])


def test_a_ply_with_faces_is_a_mesh(tmp_path):
    save_mesh(tmp_path / "box.ply", make_shape("box"))
    assert not is_cloud_file(tmp_path / "box.ply")


@pytest.mark.parametrize(
    ("name", "write", "complaint"),
    [
        ("a.npy", lambda p: np.save(p, np.zeros((5, 2))), r"shape \(5, 2\)"),
        ("a.npy", lambda p: p.write_bytes(b"rubbish"), "not readable as numbers"),
        ("a.pcd", lambda p: p.write_bytes(b"rubbish"), "not a readable pcd"),
        (
            "a.npy",
            lambda p: np.save(p, np.array({"points": 1}, dtype=object)),
            r"a pickled Python object, .*np.savez\(path",
        ),
        (
            "a.npz",
            lambda p: np.savez(p, points=np.ones((4, 3)), points_rgb=np.ones((4, 3)), View_Point=np.ones(3)),
            "a.npz: unknown array 'View_Point'; did you mean 'viewpoint'",
        ),
        ("a.npz", lambda p: np.savez(p, depth=np.ones((4, 3)), K=MATRIX, t_world_camera=1), "mean 'T_world_camera'"),
        ("a.xyz", lambda p: p.write_text("0,0,1\n0,1,1\n"), "commas separate its numbers"),
        ("a.mcap", lambda p: p.write_bytes(b"x"), "is a recording of ROS 2; read it with graspd replay a.mcap"),
        ("a.las", lambda p: p.write_bytes(b"rubbish"), "unknown cloud ending '.las'; valid endings: npy"),
        ("a.npy", lambda p: p.mkdir(), "is a directory"),
        ("a.npy", lambda p: None, "no such cloud file"),
    ],
)
def test_bad_cloud_files_are_named(tmp_path, name, write, complaint):
    write(tmp_path / name)
    with pytest.raises(CloudError, match=complaint):
        load_views(tmp_path / name)


def spheres(lens=()) -> np.ndarray:
    camera = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5, lens)
    return np.stack([render_depth(make_shape("sphere"), camera, pose) for pose in POSES])


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_depth_images_with_poses_are_views_of_one_scene(tmp_path, unit):
    depths = spheres(LENS).astype("f4") if unit == "m" else np.rint(1000 * spheres(LENS)).astype(np.int32)
    np.savez(tmp_path / "views.npz", depths=depths, K=MATRIX, poses=POSES, distortion=np.array(LENS))
    views = load_views(tmp_path / "views.npz")
    assert len(views) == 3
    for view, eye in zip(views, EYES, strict=True):
        distance = np.linalg.norm(view.points, axis=1)
        assert distance == pytest.approx(np.full(len(distance), SPHERE_RADIUS), abs=7e-4 if unit == "mm" else 2e-4)
        assert len(distance) > 300
        assert view.viewpoint == pytest.approx(eye)
        assert view.forward == pytest.approx(-np.array(eye) / np.linalg.norm(eye))


@pytest.mark.parametrize(("pixels", "scale"), [(1000.0, 1e-3), (4000.0, 0.25e-3)])
@pytest.mark.parametrize("dtype", [float, np.uint16])
def test_a_scale_is_the_unit_of_depth_and_not_of_the_cameras_poses(tmp_path, pixels: float, scale: float, dtype: type):
    np.savez(tmp_path / "m.npz", depths=spheres(), K=MATRIX, poses=POSES)
    np.savez(tmp_path / "unit.npz", depths=np.rint(pixels * spheres()).astype(dtype), K=MATRIX, poses=POSES)
    others = scaled_views(tmp_path / "unit.npz", None, scale)
    for metres, other in zip(load_views(tmp_path / "m.npz"), others, strict=True):
        np.testing.assert_allclose(other.viewpoint, metres.viewpoint)
        np.testing.assert_allclose(other.points, metres.points, atol=1e-3)


def test_one_depth_image_needs_no_pose(tmp_path):
    depth = spheres()[0]
    np.savez(tmp_path / "own.npz", depth=depth, K=MATRIX)
    np.savez(tmp_path / "world.npz", depth=depth, K=MATRIX, T_world_camera=POSES[0])
    (own,), (world,) = load_views(tmp_path / "own.npz"), load_views(tmp_path / "world.npz")
    assert own.points[:, 2] == pytest.approx(depth[depth > 0])
    assert world.points == pytest.approx(own.points @ POSES[0, :3, :3].T + POSES[0, :3, 3])


def test_points_may_say_where_the_camera_stood_and_looked(tmp_path):
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.savez(tmp_path / "a.npz", points=points, viewpoint=[1, 2, 3], forward=[0, 0, -2])
    (cloud,) = load_views(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, points.reshape(-1, 3))
    assert cloud.viewpoint.tolist() == [1, 2, 3]
    assert some(cloud.forward).tolist() == [0, 0, -1]


PCD = """VERSION .7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT %s 1 0 0 0
POINTS 2
DATA ascii
1 2 3
4 5 6
"""


def test_a_pcd_says_where_its_sensor_stood(tmp_path):
    (tmp_path / "a.pcd").write_text(PCD % "0.5 -1 2e-1")
    (cloud,) = load_views(tmp_path / "a.pcd")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.viewpoint.tolist() == [0.5, -1, 0.2]
    (tmp_path / "a.pcd").write_text(PCD % "0.5 nan 2")
    with pytest.raises(CloudError, match=r"a\.pcd: its VIEWPOINT begins with"):
        load_views(tmp_path / "a.pcd")


GOOD = {"depths": np.ones((2, 6, 8)), "K": MATRIX, "poses": POSES[:2]}
FLIPPED = POSES[:2] * np.array([1, 1, -1, 1])


@pytest.mark.parametrize(
    ("arrays", "culprit"),
    [
        ({**GOOD, "K": np.eye(2)}, "'K' has shape (2, 2); 3 × 3 is needed"),
        ({**GOOD, "K": np.zeros((3, 3))}, "is not a calibration"),
        ({**GOOD, "K": MATRIX.T}, "K is 150, 0, 0, 0, 150, 0, 79.5, 59.5, 1; valid: fx, 0, cx, 0, fy, cy, 0, 0, 1"),
        ({**GOOD, "poses": POSES}, "'poses' has shape (3, 4, 4); 2 × 4 × 4 is needed"),
        ({**GOOD, "poses": FLIPPED}, "'poses' is not a rigid transform"),
        ({**GOOD, "distortion": np.ones(9)}, "9 distortion coefficients; rational_polynomial has at most 8"),
        ({**GOOD, "depths": np.ones((6, 8))}, "'depths' has shape (6, 8); views × height × width is needed"),
        ({**GOOD, "depths": np.ones((2, 6, 8), dtype=complex)}, "'depths' holds complex128; integers (mm) or floats"),
        ({**GOOD, "depths": np.full((2, 6, 8), 100, "u1")}, "'depths' holds uint8: cut to 8 bits; 16 bits (mm) or"),
        ({"depths": np.ones((2, 6, 8)), "K": MATRIX}, "holds 'depths' but no 'poses'; it has: depths, K"),
        ({"depth": np.ones((6, 8)), "K": MATRIX, "T_world_camera": np.eye(3)}, "shape (3, 3); 4 × 4 is needed"),
        ({"points": np.ones((5, 3)), "forward": np.zeros(3)}, "'forward' is not a direction"),
        ({"points": np.ones((5, 3)), "forward": np.array([0, 0, np.nan])}, "'forward' is not a direction"),
        ({"points": np.ones((5, 3)), "forward": np.array([0, 0, np.inf])}, "'forward' is not a direction"),
        ({"points": np.ones((5, 3)), "viewpoint": np.array([0, 0, np.nan])}, "'viewpoint' is NaN or infinite"),
        ({"points": np.ones((5, 3)), "viewpoint": np.array([np.inf, 0, 0])}, "'viewpoint' is NaN or infinite"),
        ({"points": np.array(["a", "b"])}, "'points' is not readable as numbers"),
    ],
)
def test_arrays_that_do_not_fit_are_named(tmp_path, arrays, culprit):
    np.savez(tmp_path / "a.npz", **arrays)
    with refused(CloudError, culprit, start=f"{tmp_path / 'a.npz'}: "):
        load_views(tmp_path / "a.npz")


def test_an_archive_that_was_cut_short_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.ones((500, 3)))
    whole = (tmp_path / "a.npz").read_bytes()
    for share in (0.0, 0.3, 0.9):
        (tmp_path / "a.npz").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(CloudError, match=r"a\.npz: not readable as numbers"):
            load_views(tmp_path / "a.npz")


POINTS = np.arange(6, dtype="<f4").reshape(2, 3)
_PLY = (
    "ply\nformat binary_little_endian 1.0\n{}element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
)
_PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 2\nDATA binary\n"


@pytest.mark.parametrize(
    ("name", "head", "body"),
    [
        ("a.ply", _PLY.format("comment up to end_header is text\n") + "end_header\n", POINTS.tobytes()),
        (
            "a.ply",
            _PLY.format("") + 2 * "property uchar quality\n" + "end_header\n",
            b"".join(row.tobytes() + b"\0\1" for row in POINTS),
        ),
        ("a.pcd", _PCD, POINTS.tobytes()),
    ],
    ids=["a comment names the end of the header", "two properties of one name", "width and height but no points"],
)
def test_headers_are_read(tmp_path, name: str, head: str, body: bytes):
    (tmp_path / name).write_bytes(head.encode() + body)
    (view,) = load_views(tmp_path / name)
    assert view.points.tolist() == POINTS.tolist()


def test_a_mesh_is_none_however_long_its_comments_are(tmp_path):
    comments = "comment up to end_header is text\n" * 200
    head = "ply\nformat ascii 1.0\n" + comments + "element vertex 3\nelement face 1\nend_header\n"
    (tmp_path / "a.ply").write_text(head)
    assert not is_cloud_file(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_text(head.replace("face 1", "face 0"))
    assert is_cloud_file(tmp_path / "a.ply")
