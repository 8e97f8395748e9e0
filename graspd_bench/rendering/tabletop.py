"""Synthetic tabletop scenes with known geometry: an object at rest on a table, neighbours, and cameras around it.

World frame: z is up, the table's top is the plane z = 0, and the object is above the origin. Clouds are in the world
frame too. So a grasp planned on a cloud can be tried on the true mesh (`truth`) without a transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from graspd_bench.rendering.depth_noise import NONE, DepthNoise, add_noise
from graspd_bench.rendering.render import look_at, render_scene
from graspd_core.mesh.mesh_files import mass_properties, surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.cloud.camera import PinholeCamera, cloud_from_depth
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.se3 import perpendicular, quaternion_between, rotation_from_quaternion
from graspd_core.types import Plane, TriangleMesh

# Half the table's side and its thickness [m].
TABLE_HALF, TABLE_THICK = 0.4, 0.02

# The depth camera of a RealSense D415: 640 x 480 pixels, horizontal field of view 55°.
CAMERA = PinholeCamera(640, 480, 616.0, 616.0, 319.5, 239.5)

# Built-in shapes that would topple in their own orientation.
LYING = ("capsule", "hammer")
# An object stands upright if the cosine between its own z axis and the vertical exceeds this value.
_UPRIGHT = 0.999


@dataclass(frozen=True)
class TabletopScene:
    """An object on a table with its neighbours. All meshes are in the world frame [m].

    Attributes:
        truth: mesh of the object to grasp.
        T_world_object: pose of the frame in which the object's mesh was given. Identity in scenes of `on_table`.
        obstacles: meshes of the neighbours.
        table: mesh of the table.
        support: the table's top as a half-space.
    """

    truth: TriangleMesh
    T_world_object: Float[np.ndarray, "4 4"]
    obstacles: tuple[TriangleMesh, ...]
    table: TriangleMesh
    support: Plane

    @property
    def meshes(self) -> tuple[TriangleMesh, ...]:
        """Return all meshes: the object, its neighbours, the table. The labels of `depth_views` index this list."""
        return (self.truth, *self.obstacles, self.table)


def tabletop(
    shape: str | TriangleMesh, *, yaw: float = 0.0, obstacles: Sequence[tuple[str | TriangleMesh, float, float]] = ()
) -> TabletopScene:
    """Put an object on the table. Return the scene.

    Args:
        shape: name of a built-in shape, or a mesh. A mesh gets the pose of `lowest_pose`. So do the shapes in `LYING`,
            which would topple. Other shapes keep their own orientation.
        yaw: rotation about the vertical [rad].
        obstacles: shape and position x, y [m] of each neighbour.

    Raises:
        MeshError: unknown shape.
    """
    mesh, pose = _at_rest(shape, yaw)
    others = []
    for other, x, y in obstacles:
        resting, T_world_other = _at_rest(other, 0.0)
        others.append(moved(resting, _pose(np.eye(3), (x, y, 0.0)) @ T_world_other))
    return replace(on_table(moved(mesh, pose), others), T_world_object=pose)


def on_table(target: TriangleMesh, others: Sequence[TriangleMesh] = ()) -> TabletopScene:
    """Return a scene with the table and the given meshes, which are already in the world frame [m]."""
    return TabletopScene(target, np.eye(4), tuple(others), _table(), Plane(np.array([0.0, 0.0, 1.0]), 0.0))


def lowest_pose(mesh: TriangleMesh) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a mesh on the plane z = 0 with the lowest centre of mass. This pose is always stable.

    The mesh rests on the facet of its convex hull that is nearest to the centre of mass.
    """
    from scipy.spatial import ConvexHull

    centre = mass_properties(mesh)[1]
    facets = ConvexHull(mesh.vertices).equations
    down = facets[np.argmax(facets[:, :3] @ centre + facets[:, 3]), :3]
    turn = quaternion_between(down, np.array([0.0, 0.0, -1.0]), around=perpendicular(down))
    return _set_down(mesh, rotation_from_quaternion(torch.as_tensor(turn)).numpy(), centre)


def resting_pose(mesh: TriangleMesh, rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """Draw a stable pose of a mesh on z = 0, with a random yaw.

    A mesh that can stand upright stands with a probability of 0.5. Otherwise, any stable pose is drawn. Each pose
    is as likely as after a fall from a random orientation.
    """
    import trimesh

    centre = mass_properties(mesh)[1]
    hull = trimesh.Trimesh(mesh.vertices, mesh.faces).convex_hull
    # For facets of nearly no area, trimesh takes the square root of a negative rounding error.
    with np.errstate(invalid="ignore"):
        given = {"center_mass": centre, "sigma": 0.0, "n_samples": 1, "threshold": 0.01}
        poses, shares = trimesh.poses.compute_stable_poses(hull, **given)
    poses, shares = np.asarray(poses), np.asarray(shares)
    if not len(poses):
        # A ball has no stable poses of its own, because it rests on any of its facets.
        return lowest_pose(mesh)
    standing = np.flatnonzero(poses[:, 2, 2] > _UPRIGHT)
    upright = len(standing) > 0 and rng.random() < 0.5
    pose = poses[standing[0] if upright else rng.choice(len(poses), p=shares / shares.sum())][:3, :3]
    return _set_down(mesh, _about_z(rng.uniform(0, 2 * np.pi)) @ pose, centre)


def crowded(target: TriangleMesh, others: Sequence[TriangleMesh], rng: np.random.Generator) -> tuple[TriangleMesh, ...]:
    """Return `others` at rest around the target. Each is 2 to 5 cm from the nearest mesh placed before it."""
    from scipy.spatial import KDTree

    placed, begun = [target], rng.uniform(0, 2 * np.pi)
    for number, other in enumerate(others):
        resting = moved(other, resting_pose(other, rng))
        angle = begun + 2 * np.pi * (number + rng.uniform(-0.2, 0.2)) / len(others)
        way, gap = np.array([np.cos(angle), np.sin(angle), 0.0]), rng.uniform(0.02, 0.05)
        about = KDTree(np.concatenate([surface_samples(mesh, 1500, 0)[0] for mesh in placed]))
        points = surface_samples(resting, 1500, 0)[0]
        reach = next(d for d in np.arange(0.0, 1.0, 0.005) if about.query(points + d * way)[0].min() > gap)
        placed.append(moved(resting, _pose(np.eye(3), (reach * way).tolist())))
    return tuple(placed[1:])


def ring_poses(
    count: int,
    *,
    elevation: float,
    distance: float = 0.55,
    azimuth: float = 0.0,
    target: tuple[float, float, float] = (0.0, 0.0, 0.04),
) -> tuple[Float[np.ndarray, "4 4"], ...]:
    """Return `T_world_camera` of cameras spaced evenly on a horizontal ring, all looking at `target`.

    Args:
        count: number of cameras.
        elevation: angle of the cameras above the horizontal plane, seen from the target [rad].
        distance: distance from the target [m].
        azimuth: angle of the first camera, from x towards y [rad].
        target: the point that the cameras look at [m].
    """
    turns = azimuth + 2 * np.pi * np.arange(count) / count
    flat, up = distance * np.cos(elevation), distance * np.sin(elevation)
    return tuple(look_at(np.add(target, (flat * np.cos(a), flat * np.sin(a), up)), target) for a in turns)


def depth_views(
    scene: TabletopScene,
    camera: PinholeCamera,
    poses: Sequence[Float[np.ndarray, "4 4"]],
    noise: DepthNoise = NONE,
    seed: int = 0,
) -> tuple[tuple[Float[np.ndarray, "height width"], Int[np.ndarray, "height width"]], ...]:
    """Return for each pose the noisy depth image [m], and for each pixel the index in `scene.meshes` (-1: no mesh)."""
    images = []
    for index, pose in enumerate(poses):
        depth, label = render_scene(scene.meshes, camera, pose)
        images.append((add_noise(depth, camera, noise, seed + index), label))
    return tuple(images)


def views_of(
    scene: TabletopScene,
    camera: PinholeCamera,
    poses: Sequence[Float[np.ndarray, "4 4"]],
    noise: DepthNoise = NONE,
    seed: int = 0,
) -> tuple[PointCloud, ...]:
    """Return the point cloud of each camera pose, in the world frame. The clouds include points of the table."""
    images = depth_views(scene, camera, poses, noise, seed)
    return tuple(cloud_from_depth(depth, camera, pose) for (depth, _), pose in zip(images, poses, strict=True))


def moved(mesh: TriangleMesh, transform: Float[np.ndarray, "4 4"]) -> TriangleMesh:
    """Return the mesh transformed by a 4 x 4 rigid transform."""
    return TriangleMesh(mesh.vertices @ transform[:3, :3].T + transform[:3, 3], mesh.faces)


def _at_rest(shape: str | TriangleMesh, yaw: float) -> tuple[TriangleMesh, Float[np.ndarray, "4 4"]]:
    mesh = make_shape(shape) if isinstance(shape, str) else shape
    if isinstance(shape, str) and shape not in LYING:
        pose = _set_down(mesh, np.eye(3), mesh.vertices.mean(0))
    else:
        pose = lowest_pose(mesh)
    return mesh, _pose(_about_z(yaw)) @ pose


def _set_down(mesh: TriangleMesh, turn: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]):
    x, y, _ = turn @ centre
    return _pose(turn, (-x, -y, -(mesh.vertices @ turn.T)[:, 2].min()))


def _about_z(angle: float) -> Float[np.ndarray, "3 3"]:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def _pose(turn: Float[np.ndarray, "3 3"], place: Sequence[float] = (0.0, 0.0, 0.0)) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, place
    return pose


def _table() -> TriangleMesh:
    import trimesh

    slab = trimesh.creation.box(extents=(2 * TABLE_HALF, 2 * TABLE_HALF, TABLE_THICK))
    return TriangleMesh(np.array(slab.vertices) - [0, 0, TABLE_THICK / 2], np.array(slab.faces, dtype=np.int64))
