"""Stress cases: clouds of a tabletop scene, with faults that depth cameras, drivers and clutter cause."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.rendering.depth_noise import DEFAULT, HIGH
from graspd_bench.rendering.tabletop import (
    CAMERA,
    TABLE_HALF,
    TabletopScene,
    depth_views,
    moved,
    ring_poses,
    tabletop,
    views_of,
)
from graspd_bench.stress.broken_meshes import box
from graspd_bench.stress.run_stress_case import GRASP, Case
from graspd_core.perception.cloud.camera import cloud_from_depth
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.scene import Scene
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.segment import Target
from graspd_core.se3 import axis_rotation
from graspd_core.types import TriangleMesh

_SEED, _YAW = 11, 0.3
_FEW = ("TOO_FEW", "NO_CANDIDATES")
_POSES = ring_poses(3, elevation=0.7, azimuth=0.5)
_EYE = np.array([0.4, 0.2, 0.4])

Views = Sequence[PointCloud]

_PAIR = tabletop("box", obstacles=[("cylinder", 0.063, 0.0)])
_SIDE = ring_poses(1, elevation=0.9, azimuth=-1.57)


def cloud_cases() -> tuple[Case, ...]:
    """Return all cases of faulty clouds. `scene_from_views` makes the scenes."""
    return (*_measured(), *_refused(), *_special())


def _measured() -> Iterator[Case]:
    """Yield cases with faults of sensor or scene that should nevertheless give a verified grasp."""
    cuboid, mug, cylinder, block = (_true(shape) for shape in ("box", "mug", "cylinder", "l_block"))
    seen = (
        ("single-view", "one view of a box on a table", lambda: _views("box", 1), cuboid),
        ("single-view-mug", "one view of a mug, its inside unseen", lambda: _views("mug", 1), mug),
        ("single-view-bottle", "one view of a bottle", lambda: _views("bottle", 1), _true("bottle")),
        ("noisy-sensor", "three views with three times the usual noise",
         lambda: _views("l_block", 3, noise=HIGH), block),
        ("flying-pixels", "every edge smeared along its rays",
         lambda: _views("box", 3, noise=replace(HIGH, flying=1.0, edge_loss=0.0)), cuboid),
        ("table-bleed", "a ring of table about the foot of a mug taken for mug", bled, mug),
        ("dropouts", "nine of ten points lost",
         lambda: _each("box", lambda points, rng: points[rng.random(len(points)) >= 0.9]), cuboid),
        ("half-nan", "every other point is NaN",
         lambda: _each("cylinder", lambda p, rng: np.where(rng.random((len(p), 1)) < 0.5, np.nan, p)), cylinder),
        ("outliers", "two hundred points anywhere in the room",
         lambda: _each("box", lambda points, rng: np.vstack([points, rng.uniform(-0.7, 0.7, (200, 3))])), cuboid),
        ("repeated-points", "every point five times",
         lambda: _each("cylinder", lambda points, _: np.repeat(points, 5, axis=0), 1), cylinder),
        ("coarse-depth", "depth in steps of 4 mm", _stepped, cuboid),
        ("moved-view", "three views of which one stands 4 mm and 1° off", _misplaced, cuboid),
        ("mirror-shine", "a hole of 3 cm burnt into the middle of the object", _shiny, cuboid),
        ("far-camera", "a box seen from 1.6 m", lambda: _views("box", 3, distance=1.6), cuboid),
        ("black-neighbour", "beside a box something black leaves a hole", lambda: black_neighbour("box"), cuboid),
        ("table-edge", "a mug at the edge of the table", lambda: at_the_edge("mug"), mug),
        ("stepped-table", "a table with a step of 3 cm beside a box", lambda: beside_a_step("box"), cuboid),
        ("arm-in-view", "a forearm beside a cylinder",
         lambda: _seen(_with("cylinder", box((0.09, 0.5, 0.09), (-0.05, -0.38, 0.17)))), cylinder),
        ("same-view-thrice", "one message of a mug three times", lambda: [*_seen(tabletop("mug", yaw=_YAW))] * 3, mug),
        ("zero-filled", "two points of three are the camera's own place", lambda: zero_filled("box"), cuboid),
        ("tilted-table", "camera coordinates: the table tilts by 40°", _in_camera,
         lambda: moved(cuboid(), np.linalg.inv(_POSES[0]))),
    )  # fmt: skip
    return (_case(name, about, make, truth=truth) for name, about, make, truth in seen)


def _refused() -> Iterator[Case]:
    """Yield cases of clouds without a usable object. No grasp is expected."""
    refused = (
        ("empty", "no point at all", lambda: [_cloud(np.zeros((0, 3)))], ("CloudError",)),
        ("no-view", "a list of no views", lambda: [], ("CloudError",)),
        ("all-nan", "every point is NaN", lambda: [_cloud(np.full((5000, 3), np.nan))], ("CloudError",)),
        ("ten-points", "ten points", lambda: [_cloud(np.random.default_rng(_SEED).normal(0, 0.02, (10, 3)))], None),
        ("infinite", "points at infinity", lambda: [_cloud(np.full((5000, 3), np.inf))], ("CloudError",)),
        ("no-object", "a table and nothing on it", _bare, ("NoObjectError",)),
        ("all-at-origin", "a driver that fills with zeros", lambda: [_cloud(np.zeros((307_200, 3)))], None),
        ("white-noise", "points anywhere in a cube of 2 m",
         lambda: [_cloud(np.random.default_rng(_SEED).uniform(-1.0, 1.0, (100_000, 3)))],
         ("CloudError", "NoObjectError", *_FEW)),
        ("wrong-units", "a cloud in millimetres", _in_millimetres, None),
    )  # fmt: skip
    return (
        _case(name, about, make, expect or ("CloudError", "NoObjectError"), whole=False)
        for name, about, make, expect in refused
    )


def _special() -> tuple[Case, ...]:
    """Return cases with special arguments of `scene_from_views`, special limits, or more than one valid ending."""
    return (
        _case("lone-object", "the object alone, nothing under it", lambda: _alone("cylinder"),
              alone=True, truth=_true("cylinder")),
        _case("touching-masked", "two things that touch, one of them masked", _touching,
              target=_mask, truth=_true("box", 0.0)),
        _case("half-out-of-view", "the image ends in the middle of a box", lambda: half_out_of_view("box"), _FEW,
              whole=False, truth=_true("box")),
        _case("touching", "two things that touch, and no word which", _touching, (GRASP, *_FEW), whole=False),
        _case("touching-unequal", "a slab against a box, and no word which", unequal_pair, (GRASP, *_FEW), whole=False),
        _case("ten-million-points", "ten million points", _many, memory=3000.0, loading=30.0, truth=_true("box")),
    )  # fmt: skip


def _case(
    name: str,
    about: str,
    make: Callable[[], Views],
    expect: tuple[str, ...] = (GRASP,),
    *,
    target: Callable[[], Target] | None = None,
    whole: bool = True,
    alone: bool = False,
    memory: float = 2000.0,
    loading: float = 15.0,
    truth: Callable[[], TriangleMesh] | None = None,
) -> Case:
    def scene(folder: Path) -> Scene:
        return scene_from_views(make(), source=name, alone=alone, target=target() if target else None)

    return Case(name, "cloud", about, scene, expect, whole, memory=memory, loading=loading, truth=truth)


def _views(shape: str, count: int, *, noise: Any = DEFAULT, distance: float = 0.55) -> Views:
    poses = ring_poses(count, elevation=0.7, azimuth=0.5, distance=distance)
    return views_of(tabletop(shape, yaw=_YAW), CAMERA, poses, noise, _SEED)


def _true(shape: str, yaw: float = _YAW) -> Callable[[], TriangleMesh]:
    return lambda: tabletop(shape, yaw=yaw).truth


def _cloud(points: np.ndarray) -> PointCloud:
    return PointCloud(points, _EYE, -_EYE / np.linalg.norm(_EYE))


def _each(shape: str, change: Callable[[np.ndarray, np.random.Generator], np.ndarray], count: int = 3) -> Views:
    rng = np.random.default_rng(_SEED)
    return [replace(view, points=change(view.points, rng)) for view in _views(shape, count)]


def _in_millimetres() -> Views:
    return [replace(v, points=1e3 * v.points, viewpoint=1e3 * v.viewpoint) for v in _views("box", 1)]


def bled() -> Views:
    """Return a view of a mug, segmented a little too low. A patch of the table remains around the mug's foot."""
    stage = tabletop("mug", yaw=_YAW)
    ((depth, label),) = depth_views(stage, CAMERA, _POSES[:1], DEFAULT)
    (view,) = views_of(stage, CAMERA, _POSES[:1], DEFAULT)
    seen = label[depth > 0]
    x, y, z = view.points.T
    patch = (seen == 1) & (np.hypot(x, y) < 0.06) & (z > 0.0015)
    return [replace(view, points=view.points[(seen == 0) | patch])]


def _stepped() -> Views:
    images = depth_views(tabletop("box", yaw=_YAW), CAMERA, _POSES, DEFAULT, _SEED)
    steps = (np.round(depth / 0.004) * 0.004 for depth, _ in images)
    return [cloud_from_depth(depth, CAMERA, pose) for depth, pose in zip(steps, _POSES, strict=True)]


def _misplaced() -> Views:
    first, second, third = _views("box", 3)
    turn = axis_rotation(np.array([0.0, 0.0, 1.0]), np.deg2rad(1.0))
    return [first, second, replace(third, points=third.points @ turn.T + np.array([0.004, 0.0, 0.0]))]


def _shiny() -> Views:
    """Return views with a hole of 15 mm radius in the middle of the visible object, as a reflection causes."""

    def burn(view: PointCloud) -> PointCloud:
        above = view.points[:, 2] > 0.01
        middle = np.nanmean(view.points[above], axis=0)
        near = np.linalg.norm(view.points - middle, axis=1)
        nearest = view.points[np.argmin(near)]
        return replace(view, points=view.points[np.linalg.norm(view.points - nearest, axis=1) > 0.015])

    return [burn(view) for view in _views("box", 3)]


def _in_camera() -> Views:
    (view,) = _views("box", 1)
    R, t = _POSES[0][:3, :3], _POSES[0][:3, 3]
    return [PointCloud((view.points - t) @ R, np.zeros(3), np.array([0.0, 0.0, 1.0]))]


def _alone(shape: str) -> Views:
    images = depth_views(tabletop(shape, yaw=_YAW), CAMERA, _POSES, DEFAULT, _SEED)
    alone = (np.where(label == 0, depth, 0.0) for depth, label in images)
    return [cloud_from_depth(depth, CAMERA, pose) for depth, pose in zip(alone, _POSES, strict=True)]


def _bare() -> Views:
    stage = tabletop("box", yaw=_YAW)
    bare = replace(stage, truth=replace(stage.truth, vertices=stage.truth.vertices - np.array([0.0, 0.0, 1.0])))
    return views_of(bare, CAMERA, _POSES[:1], DEFAULT, _SEED)


def _many() -> Views:
    rng = np.random.default_rng(_SEED)
    (view,) = _views("box", 1)
    many = view.points[rng.integers(0, len(view.points), 10_000_000)]
    return [replace(view, points=many + rng.normal(0, 3e-4, many.shape))]


def _touching() -> Views:
    return views_of(_PAIR, CAMERA, _SIDE, DEFAULT, _SEED)


def _mask() -> Target:
    ((depth, label),) = depth_views(_PAIR, CAMERA, _SIDE, DEFAULT, _SEED)
    return Target(mask=label[depth > 0] == 0)


def half_out_of_view(shape: str) -> Views:
    """Return a view whose image ends in the middle of the object."""
    ((depth, label),) = depth_views(tabletop(shape, yaw=_YAW), CAMERA, _POSES[:1], DEFAULT, _SEED)
    middle = int(np.nonzero(label == 0)[1].mean())
    return [cloud_from_depth(np.where(np.arange(CAMERA.width) < middle, depth, 0.0), CAMERA, _POSES[0])]


def black_neighbour(shape: str) -> Views:
    """Return a view with a black neighbour beside the object. All pixels of the neighbour lack depth."""
    stage = tabletop(shape, yaw=_YAW, obstacles=[("cylinder", 0.13, 0.03)])
    ((depth, label),) = depth_views(stage, CAMERA, _POSES[:1], DEFAULT, _SEED)
    return [cloud_from_depth(np.where(label == 1, 0.0, depth), CAMERA, _POSES[0])]


def at_the_edge(shape: str) -> Views:
    """Return a view in which the table ends beside the object, on the camera's side."""
    stage = tabletop(shape, yaw=_YAW)
    table = stage.table.vertices - np.array([TABLE_HALF - 0.05, 0.0, 0.0])
    return _seen(replace(stage, table=TriangleMesh(table, stage.table.faces)))


def beside_a_step(shape: str) -> Views:
    """Return a view in which half of the table is 3 cm higher."""
    return _seen(_with(shape, box((0.3, 0.8, 0.03), (0.23, 0.0, 0.015))))


def zero_filled(shape: str) -> Views:
    """Return a view with two thirds of its points at the camera. Some drivers write such points for missing depth."""
    (view,) = _seen(tabletop(shape, yaw=_YAW))
    lost = np.random.default_rng(_SEED).random(len(view.points)) < 2 / 3
    return [replace(view, points=np.where(lost[:, None], view.viewpoint, view.points))]


def unequal_pair() -> Views:
    """Return a view of a box that touches a slab. The slab is a third as high as the box."""
    stage = tabletop("box", obstacles=[(box((0.08, 0.05, 0.03), (0.0, 0.0, 0.0)), 0.0702, 0.0)])
    return views_of(stage, CAMERA, _SIDE, DEFAULT, _SEED)


def _seen(stage: TabletopScene) -> Views:
    return views_of(stage, CAMERA, _POSES[:1], DEFAULT, _SEED)


def _with(shape: str, other: TriangleMesh) -> TabletopScene:
    return replace(tabletop(shape, yaw=_YAW), obstacles=(other,))
