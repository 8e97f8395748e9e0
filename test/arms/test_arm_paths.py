"""Ways of an arm through grasps: what they promise, measured anew, and why there is none.

The capsules that its links are: their distances against MuJoCo's, and that they hold what they stand for.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from expected import some
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from graspd_core import load_hand, load_scene, make_shape
from graspd_core.arms.arm import Arm, arm_links, capsules_about, placed, segment_distance, tip_hand
from graspd_core.arms.arm_collision import hits_of_hand, hits_of_scene, hits_of_self, hits_of_support
from graspd_core.arms.arm_paths import LARGEST_JUMP, LIFT, STAGE_ROWS, ArmTask, arm_paths, hand_paths, make_task
from graspd_core.arms.inverse_kinematics import random_postures
from graspd_core.hands.kinematics import RETREAT, forward, make_kinematics
from graspd_core.hands.model import HandModel, Primitive, PrimitiveKind
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import build_sdf
from graspd_core.perception.scene import Obstacle, Scene
from graspd_core.se3 import SE3, axis_rotation, quaternion_from_rotation
from graspd_core.types import ARM_STAGES, ArmPath, Grasp, Plane, Posture, TriangleMesh


@pytest.fixture(scope="session")
def hand() -> HandModel:
    return load_hand("barrett_like", candidates=100)


@pytest.fixture(scope="session")
def table() -> Scene:
    """A box on a table."""
    scene = load_scene("shape:box")
    return replace(scene, support=Plane(np.array([0.0, 0.0, 1.0]), float(scene.object.mesh.vertices[:, 2].min())))


def base_at(x: float, y: float, z: float) -> SE3:
    return SE3(torch.eye(3, dtype=torch.float64), torch.tensor([x, y, z], dtype=torch.float64))


def from_above(hand: HandModel, height: float, turn: float = 0.0) -> Grasp:
    """A hand that comes down along z to `height` over the origin, turned about z."""
    down = np.array([[np.cos(turn), np.sin(turn), 0], [np.sin(turn), -np.cos(turn), 0], [0, 0, -1.0]])
    quaternion = quaternion_from_rotation(torch.as_tensor(down)).numpy()
    before, there = (Posture(np.array([0.0, 0.0, z]), quaternion, hand.open_posture) for z in (height + 0.03, height))
    return Grasp(before, there, there)


def task_of(arm: Arm, hand: HandModel, scene: Scene, away: float) -> ArmTask:
    support = scene.support
    return make_task(arm, hand, scene, base_at(-away, 0.0, 0.0 if support is None else support.offset))


def test_the_way_of_a_hand_is_that_of_the_trial(hand: HandModel):
    """It retreats as far as the trials come from; rows of the stages are where the postures say."""
    grasp = from_above(hand, 0.2, 0.5)
    way = hand_paths([grasp], hand.approach, np.array([0.0, 0.0, 1.0]))
    heights = way.translation[0, list(STAGE_ROWS), 2].tolist()
    assert heights == pytest.approx([0.23 + RETREAT, 0.23, 0.2, 0.2 + LIFT])
    assert way.translation.diff(dim=1).norm(dim=-1).max() < 0.025
    again = replace(grasp.grasp, quaternion_wxyz=-grasp.grasp.quaternion_wxyz)
    other = hand_paths([replace(grasp, grasp=again)], hand.approach, np.array([0.0, 0.0, 1.0]))
    assert torch.allclose(other.rotation, way.rotation)


@pytest.mark.parametrize("away", [0.45, 0.6])
def test_a_way_goes_where_the_hand_goes_within_limits_without_jump_or_hit(arm, hand, table, away):
    grasps = [from_above(hand, 0.2, turn) for turn in np.linspace(-3, 3, 7)]
    task = task_of(arm, hand, table, away)
    found = arm_paths(task, grasps)
    assert sum(isinstance(path, ArmPath) for path in found) >= 6
    for grasp, path in zip(grasps, found, strict=True):
        if not isinstance(path, ArmPath):
            continue
        q = torch.as_tensor(path.positions)
        assert (path.joint_names, path.stages) == (arm.joint_names, STAGE_ROWS)
        assert path.velocity is arm.chain.velocity
        assert ((arm.lower <= path.positions) & (path.positions <= arm.upper)).all()
        assert np.abs(np.diff(path.positions, axis=0)).max() <= LARGEST_JUMP
        links = arm_links(arm, q)
        carried = task.base.compose(links[:, arm.tip].compose(tip_hand(arm, hand)))
        wanted = hand_paths([grasp], hand.approach, task.up)[0]
        assert torch.allclose(carried.translation, wanted.translation, atol=2e-4)
        assert torch.allclose(carried.rotation, wanted.rotation, atol=2e-3)
        assert np.array_equal(path.at("grasp"), path.positions[STAGE_ROWS[2]])
        joints = torch.as_tensor(hand.open_posture).expand(len(q), -1)
        assert (hits_of_scene(arm, table, task.base, links).depth <= 0).all()
        stages = links[list(STAGE_ROWS)]
        assert (hits_of_self(arm, stages).depth <= 0).all()
        assert (hits_of_hand(arm, hand, stages, joints[: len(STAGE_ROWS)]).depth <= 0).all()
    assert ARM_STAGES == ("retreat", "pregrasp", "grasp", "lift")


def test_answers_do_not_depend_on_who_else_is_asked(ur: Arm, hand: HandModel, table: Scene):
    grasps = [from_above(hand, 0.2, turn) for turn in (0.0, 1.0, 2.0)]
    task = task_of(ur, hand, table, 0.5)
    together, alone = arm_paths(task, grasps), [arm_paths(task, [grasp])[0] for grasp in grasps]
    for a, b in zip(together, alone, strict=True):
        assert isinstance(a, ArmPath)
        assert isinstance(b, ArmPath)
        assert np.allclose(a.positions, b.positions, atol=1e-6)
    assert arm_paths(task, []) == []


def reason(task: ArmTask, grasp: Grasp) -> str:
    told = arm_paths(task, [grasp])[0]
    assert isinstance(told, str)
    return told


def test_a_refusal_names_what_is_in_the_way(ur: Arm, hand: HandModel, table: Scene, tmp_path: Path):
    above = from_above(hand, 0.2)
    assert reason(task_of(ur, hand, table, 1.6), above) == "farther than the arm reaches"
    # From below, the wrist must be where the table is.
    below = replace(above, **{key: _upside_down(getattr(above, key)) for key in ("pregrasp", "grasp", "squeeze")})
    assert reason(task_of(ur, hand, table, 0.5), below).endswith("in the table")
    # A column that stands where the arm must pass; the hand has room.
    column = make_shape("cylinder")
    low, high = column.vertices.min(0), column.vertices.max(0)
    scaled = TriangleMesh((column.vertices - 0.5 * (low + high)) / (high - low) * [0.1, 0.4, 1.5], column.faces)
    placed_at = TriangleMesh(scaled.vertices + np.array([-0.25, 0.0, 0.0]), scaled.faces)
    scene = replace(table, obstacles=(Obstacle(placed_at, build_sdf(placed_at, resolution=32)),))
    assert reason(task_of(ur, hand, scene, 0.5), above).endswith("in an obstacle")


def test_a_limit_in_the_way_is_named(ur: Arm, hand: HandModel, table: Scene):
    """All joints but one as free as they are: where that one cannot turn, it is named."""
    task = task_of(ur, hand, table, 0.5)
    path = arm_paths(task, [from_above(hand, 0.2)])[0]
    assert isinstance(path, ArmPath)
    lower, upper = ur.lower.copy(), ur.upper.copy()
    lower[4], upper[4] = -0.3, 0.3
    narrow = replace(ur, lower=lower, upper=upper, seed=np.clip(ur.seed, lower, upper))
    assert reason(task_of(narrow, hand, table, 0.5), from_above(hand, 0.2)) == "beyond wrist_2_turn's limit"


def _upside_down(posture: Posture) -> Posture:
    w, x, y, z = posture.quaternion_wxyz
    # Times a half turn about x.
    quaternion = np.array([-x, w, z, -y])
    return replace(posture, position=posture.position * [1, 1, -1], quaternion_wxyz=quaternion)


def test_depths_are_those_of_dense_points(arm: Arm, table: Scene):
    """Depth in the support: that of the capsules' surfaces. Depth in a solid: never less than that of their points."""
    links = arm_links(arm, random_postures(arm, 20, torch.Generator().manual_seed(5)))
    base = base_at(-0.3, 0.1, 0.05)
    start, end, radius = placed(arm.capsules, links)
    ball = surface_samples(make_shape("sphere"), 400, seed=0)[0]
    ball = torch.as_tensor(ball / np.linalg.norm(ball, axis=1, keepdims=True))
    shares = torch.linspace(0, 1, 60, dtype=torch.float64)[:, None]
    along = start[:, :, None] + shares * (end - start)[:, :, None]
    surface = along[:, :, :, None] + radius[:, None, None, None] * ball
    world = surface + base.translation
    deepest = (some(table.support).offset - world[..., 2]).amax((2, 3))
    hits = hits_of_support(arm, table, base, (start, end))
    group = arm.chain.link_group[arm.capsules.link]
    held = np.flatnonzero((group != 0) & (group != arm.chain.link_group[arm.moved_link[0]]))
    assert torch.allclose(hits.depth, deepest[:, held], atol=2e-3)
    assert (hits.depth >= deepest[:, held] - 1e-9).all()
    # A tall box as an obstacle, whose distance is known in closed form.
    half, at = torch.tensor([0.1, 0.15, 0.5], dtype=torch.float64), torch.tensor([0.2, 0.0, 0.3])
    box = make_shape("box")
    low, high = box.vertices.min(0), box.vertices.max(0)
    corners = (box.vertices - 0.5 * (low + high)) / (high - low) * 2 * half.numpy() + at.numpy()
    mesh = TriangleMesh(corners, box.faces)
    scene = replace(table, support=None, obstacles=(Obstacle(mesh, build_sdf(mesh, resolution=48)),))
    off = (world - at).abs() - half
    distance = off.clamp_min(0).norm(dim=-1) + off.amax(-1).clamp_max(0)
    depth = (-distance).amax((2, 3))[:, np.flatnonzero(group != 0)]
    found = hits_of_scene(arm, scene, base, links)
    named = [k for k, what in enumerate(found.what) if what.endswith("an obstacle")]
    hit = depth > 0.005
    assert hit.any()
    assert (found.depth[:, named][hit] > 0).all()
    clear = depth < -0.03
    assert (found.depth[:, named][clear] < 0).all()


def test_what_it_keeps_of_a_hand_still_carries_gradients(ur: Arm, table: Scene):
    """Constants of a hand are kept for all who ask, those who want a gradient too."""
    hand = load_hand("barrett_like", candidates=50)
    assert isinstance(arm_paths(task_of(ur, hand, table, 0.5), [from_above(hand, 0.2)])[0], ArmPath)
    q = torch.as_tensor(hand.open_posture)[None].requires_grad_()
    forward(make_kinematics(hand, dtype=torch.float64), q).translation.sum().backward()
    assert q.grad is not None


# MuJoCo's types are not public to checkers.
mujoco: Any = pytest.importorskip("mujoco")
SEEDS = st.integers(0, 2**32 - 1)


def distance_in_mujoco(ends: np.ndarray, radii: np.ndarray) -> float:
    """Of two capsules."""
    geoms = "".join(
        f'<geom type="capsule" fromto="{" ".join(map(repr, pair.ravel().tolist()))}" size="{radius!r}"/>'
        for pair, radius in zip(ends, radii.tolist(), strict=True)
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)


@given(SEEDS)
def test_distances_are_those_of_mujoco(seed: int):
    rng = np.random.default_rng(seed)
    ends, radii = rng.uniform(-1, 1, (2, 2, 3)), rng.uniform(0.01, 0.2, 2)
    wanted = distance_in_mujoco(ends, radii)
    a, b, c, d = torch.as_tensor(ends.reshape(4, 3))
    # MuJoCo's capsules have ends of their own: to its tolerance.
    assert np.isclose(float(segment_distance(a, b, c, d)) - radii.sum(), wanted, atol=1e-6)


@given(SEEDS, st.sampled_from(["parallel", "point", "points", "crossing", "in line"]))
def test_degenerate_segments_have_their_distance(seed: int, kind: str):
    rng = np.random.default_rng(seed)
    a, way, up = rng.uniform(-1, 1, 3), rng.uniform(0.1, 1, 3), np.array([0.0, 0.0, 1.0])
    c, d = {
        "parallel": (a + np.cross(way, [1.0, 0.0, 0.0]), a + way + np.cross(way, [1.0, 0.0, 0.0])),
        "point": (a + 3 * up, a + 3 * up),
        "points": (a + way, a + way),
        "crossing": (a + 0.5 * way - up, a + 0.5 * way + up),
        "in line": (a + 2 * way, a + 3 * way),
    }[kind]
    b = a if kind == "points" else a + way
    # Dense samples of both are never nearer than the distance, and come within a step of it.
    shares = np.linspace(0, 1, 401)[:, None]
    pairs = (a + shares * (b - a))[:, None] - (c + shares * (d - c))[None]
    sampled = np.linalg.norm(pairs, axis=-1).min()
    distance = float(segment_distance(*map(torch.as_tensor, (a, b, c, d))))
    assert distance - 1e-9 <= sampled <= distance + 0.01


@given(SEEDS, st.sampled_from(get_args(PrimitiveKind)))
def test_a_capsule_holds_the_solid_that_it_is_about(seed: int, kind: PrimitiveKind):
    rng = np.random.default_rng(seed)
    size = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2, "hull": 0}[kind]
    corners = rng.normal(size=(20, 3)) * rng.uniform(0.01, 0.3, 3)
    faces = ConvexHull(corners).simplices.astype(np.int64) if kind == "hull" else np.zeros((0, 3), dtype=np.int64)
    rotation = axis_rotation(np.array([0.0, 0.6, 0.8]), rng.uniform(0, 3))
    half = tuple(rng.uniform(0.01, 0.3, size).tolist())
    at = rng.uniform(-1, 1, 3)
    vertices = corners if kind == "hull" else np.zeros((0, 3))
    capsule = capsules_about((Primitive(0, kind, rotation, at, half, vertices, faces),))
    surface = solid_points(kind, half, corners, rng) @ rotation.T + at
    point = torch.as_tensor(surface)
    start, end = (torch.as_tensor(x[0]).expand_as(point) for x in (capsule.start, capsule.end))
    assert float(segment_distance(point, point, start, end).max()) <= capsule.radius[0] + 1e-9


def solid_points(kind: str, size: tuple[float, ...], corners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points of a solid's surface or corners, in its frame."""
    if kind == "hull":
        return corners
    if kind == "box":
        return rng.choice([-1.0, 1.0], (50, 3)) * np.asarray(size)
    direction = rng.normal(size=(200, 3))
    if kind == "cylinder":
        flat = direction[:, :2] / np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
        return np.column_stack([size[0] * flat, rng.choice([-1.0, 1.0], 200) * size[1]])
    ball = size[0] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    shift = rng.choice([-1.0, 1.0], 200) * (size[1] if kind == "capsule" else 0.0)
    return ball + shift[:, None] * [0.0, 0.0, 1.0]
