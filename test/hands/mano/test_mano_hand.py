"""MANO's forward function and the hand that is made of it."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given

from graspd_bench.studies.human_hand import measure_skin
from graspd_core.errors import HandError
from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.library import load_hand
from graspd_core.hands.mano import mano_hand as mano_joints
from graspd_core.hands.mano.mano_file import BODIES, PARENTS, ManoData, read_mano
from graspd_core.hands.mano.mano_hand import ManoHand, load_mano
from graspd_core.hands.mano.mano_skin import (
    close_wrist,
    closed_faces,
    make_skin,
    pose_from_components,
    rest,
    rotation_from_vector,
    skin_vertices,
    wrist_loop,
)
from graspd_core.hands.self_collision import deepest_overlap
from graspd_core.hands.surface_points import with_candidates
from graspd_core.mesh.surface_queries import make_distance_query, signed_distance
from graspd_core.perception.load_scene import load_scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Posture, Verdict

SYNTHETIC = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks" / "mano_synthetic.py"))
DOUBLE = torch.float64


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl"
    SYNTHETIC["write_synthetic"](path, 3)
    return path


@pytest.fixture(scope="module")
def data(path: Path) -> ManoData:
    return read_mano(path)


@pytest.fixture(scope="module")
def mano(path: Path) -> ManoHand:
    return load_mano(path, [0.7, -1.0, 0.5], candidates=200)


def rodrigues(vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def by_the_paper(data: ManoData, betas: np.ndarray, pose: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Vertices [m], vertex by vertex in numpy after the paper's equations; `pose` is 16 axis-angle vectors."""
    shaped = data.template + data.shape_directions @ betas
    joints = data.joint_regressor @ shaped
    turns = [rodrigues(vector) for vector in pose]
    posed = shaped + data.pose_directions @ np.concatenate([(r - np.eye(3)).ravel() for r in turns[1:]])
    chain: list[np.ndarray] = []
    for body, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turns[body], joints[body] - (joints[parent] if body else 0.0)
        chain.append(chain[parent] @ local if body else local)
    for body in range(16):
        back = np.eye(4)
        back[:3, 3] = -joints[body]
        chain[body] = chain[body] @ back
    out = np.zeros_like(posed)
    for number, vertex in enumerate(posed):
        mixed = sum(data.weights[number, body] * chain[body] for body in range(16))
        out[number] = (mixed @ np.append(vertex, 1.0))[:3] + shift
    return out


def draw(seed: int, shapes: int, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    sizes = ((batch, shapes), (batch, 16, 3), (batch, 3))
    betas, pose, shift = (
        torch.as_tensor(rng.normal(scale=s, size=n)) for s, n in zip((1, 0.6, 0.2), sizes, strict=True)
    )
    return betas, pose, shift


def test_forward_agrees_with_the_paper(data: ManoData) -> None:
    betas, pose, shift = draw(0, 10)
    vertices, _ = skin_vertices(make_skin(data, dtype=DOUBLE), betas, rotation_from_vector(pose), shift)
    for row in range(2):
        expected = by_the_paper(data, betas[row].numpy(), pose[row].numpy(), shift[row].numpy())
        np.testing.assert_allclose(vertices[row], expected, atol=1e-12)
    single, _ = skin_vertices(make_skin(data), betas.float(), rotation_from_vector(pose.float()), shift.float())
    np.testing.assert_allclose(single, vertices, atol=2e-6)  # float32 over four joints in a row


def test_gradients_are_those_of_finite_differences(data: ManoData) -> None:
    skin = make_skin(data, dtype=DOUBLE)
    weights = torch.as_tensor(np.random.default_rng(1).normal(size=data.template.shape))
    betas, pose, shift = (x[:1].requires_grad_(True) for x in draw(2, 10))

    def value(betas: torch.Tensor, pose: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        return (skin_vertices(skin, betas, rotation_from_vector(pose), shift)[0] * weights).sum()

    assert torch.autograd.gradcheck(value, (betas, pose, shift), eps=1e-6, atol=1e-6)
    # At the zero rotation, where Rodrigues' formula divides nothing by nothing.
    assert torch.autograd.gradcheck(value, (betas, torch.zeros_like(pose).requires_grad_(True), shift), atol=1e-6)


@given(seed=st.integers(0, 10_000), length=st.sampled_from([0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.1]))
def test_rotation_vectors_are_those_of_rodrigues(seed: int, length: float) -> None:
    direction = np.random.default_rng(seed).normal(size=3)
    vector = torch.as_tensor(length * direction / np.linalg.norm(direction))
    rotation = rotation_from_vector(vector)
    np.testing.assert_allclose(rotation, rodrigues(vector.numpy()), atol=1e-12)


def test_principal_components(data: ManoData) -> None:
    coefficients = torch.as_tensor(np.random.default_rng(4).normal(size=(2, 6)))
    flat = pose_from_components(data, coefficients, about_mean=False)
    np.testing.assert_allclose(flat.flatten(1), coefficients.numpy() @ data.components[:6], atol=1e-14)
    about = pose_from_components(data, coefficients)
    np.testing.assert_allclose((about - flat).flatten(1), np.tile(data.mean, (2, 1)), atol=1e-14)
    # All components reach every pose: they are a basis.
    pose = np.random.default_rng(5).normal(size=45)
    found = torch.as_tensor(np.linalg.solve(data.components.T, pose))[None]
    np.testing.assert_allclose(pose_from_components(data, found, about_mean=False).flatten(), pose, atol=1e-12)
    with pytest.raises(HandError, match="46 pose coefficients, but 45 components"):
        pose_from_components(data, torch.zeros(1, 46))


def test_the_wrist_is_closed(data: ManoData) -> None:
    faces, loop = closed_faces(data), wrist_loop(data)
    assert len(loop) >= 8
    assert len(faces) == len(data.faces) + len(loop)
    betas, pose, shift = draw(6, 10, batch=1)
    for scale in (0.0, 0.3):
        rotations = rotation_from_vector(scale * pose)
        vertices, _ = skin_vertices(make_skin(data, dtype=DOUBLE), betas, rotations, shift)
        mesh = trimesh.Trimesh(close_wrist(data, vertices)[0].numpy(), faces, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert 1e-4 < mesh.volume < 1e-3  # a hand has some 0.4 l


def test_a_mesh_that_is_not_open_at_one_place_is_refused(path: Path, tmp_path: Path) -> None:
    model: dict[str, Any] = SYNTHETIC["synthetic_model"](3)
    apart = int(np.flatnonzero((model["f"] == model["v_template"][:, 0].argmin()).any(1))[0])
    for faces, message in (
        (np.delete(model["f"], apart, axis=0), "the boundary is not one loop"),
        (np.concatenate([model["f"], model["f"][:1]]), "wound against each other"),
    ):
        broken = tmp_path / "hand.pkl"
        broken.write_bytes(SYNTHETIC["mano_pickle"]({**model, "f": faces}))
        with pytest.raises(HandError, match=message):
            load_mano(broken)
    closed = tmp_path / "closed.pkl"
    data = read_mano(path)
    hub = np.vstack([model["v_template"], data.template[wrist_loop(data)].mean(0)])
    grown = {"shapedirs": 0, "posedirs": 0, "weights": 0}
    more = {key: np.concatenate([model[key], model[key][-1:] * (key == "weights")]) for key in grown}
    regressor = np.column_stack([model["J_regressor"].toarray(), np.zeros(16)])
    content = {**model, **more, "v_template": hub, "f": closed_faces(data), "J_regressor": regressor}
    closed.write_bytes(SYNTHETIC["mano_pickle"](content))
    assert len(wrist_loop(read_mano(closed))) == 0
    np.testing.assert_array_equal(closed_faces(read_mano(closed)), closed_faces(data))


@given(seed=st.integers(0, 10_000))
def test_the_hands_links_are_the_skins_bodies(mano: ManoHand, seed: int) -> None:
    """The tree of hinges puts every body where MANO's own chain puts it."""
    hand = mano.model
    q = np.random.default_rng(seed).uniform(hand.lower, hand.upper)
    rotations, translations = link_poses(hand, q)
    skin, betas = make_skin(mano.data, dtype=DOUBLE), torch.as_tensor(mano.betas)[None]
    turned = mano_joints.rotations_from_joints(torch.as_tensor(mano.frames), torch.as_tensor(q)[None])
    origin = rest(skin, betas)[1][:, 0]
    _, joints = skin_vertices(skin, betas, turned, -origin)
    links = [hand.link_index[name] for name in BODIES]
    np.testing.assert_allclose(translations[links], joints[0], atol=1e-12)
    whole = np.eye(3)
    for body in (1, 2, 3):
        whole = whole @ turned[0, body].numpy()
        np.testing.assert_allclose(rotations[links[body]], whole @ mano.frames[body], atol=1e-12)


def test_hulls_hold_the_skin_at_rest(mano: ManoHand) -> None:
    hand = mano.model
    mesh = mano.skinned_mesh(Posture(np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(45)))
    rotations, translations = link_poses(hand, np.zeros(45))
    owner = mano.data.weights.argmax(1)
    for body, name in enumerate(BODIES):
        link = hand.link_index[name]
        (hull,) = hand.primitives_of[link]
        own = (mesh.vertices[:-1][owner == body] - translations[link]) @ rotations[link]
        gaps = [np.linalg.norm(own - corner, axis=1).min() for corner in hull.vertices]
        assert max(gaps) < 1e-12
    assert 0.2 < hand.link_mass.sum() < 0.8  # a hand has some 0.4 kg


@pytest.mark.parametrize("count", [200, 300])
def test_candidates_lie_on_the_skin_at_rest_and_look_out_of_it(mano: ManoHand, count: int) -> None:
    hand = with_candidates(mano.model, count)
    assert len(hand.candidate_link) == count
    skin = make_distance_query(mano.skinned_mesh(Posture(np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(45))))
    poses = link_poses(hand, np.zeros(45))
    placed = in_base(poses, hand.candidate_points, hand.candidate_link)
    raised = in_base(poses, hand.candidate_points + 1e-4 * hand.candidate_normals, hand.candidate_link)
    assert np.abs(signed_distance(skin, placed)).max() < 1e-9
    assert (signed_distance(skin, raised) > 0).mean() > 0.95


def test_the_hand_is_anatomical(mano: ManoHand) -> None:
    hand = mano.model
    assert hand.num_joints == 45
    # Bodies are neighbours of the bodies that they hang from, whatever massless links lie between.
    for body in range(1, 16):
        assert hand.adjacent[hand.link_index[BODIES[body]], hand.link_index[BODIES[PARENTS[body]]]]
    assert not hand.adjacent[hand.link_index["index3"], hand.link_index["thumb3"]]
    assert (hand.lower < hand.upper).all()
    tips = [hand.link_index[f"{finger}3"] for finger in ("index", "middle", "pinky", "ring")]
    base = link_poses(hand, np.zeros(45))[1]
    flexed = np.zeros(45)
    flexed[[3 * body for body in range(12)]] = 0.5
    # Flexion takes the fingertips out of the palm's plane, along the palm's normal, and nearer to the palm.
    moved = link_poses(hand, flexed)[1] - base
    assert (moved[tips] @ hand.palm_normal > 0.02).all()
    thumb = np.zeros(45)
    thumb[[36, 39, 42]] = 0.4
    target = hand.palm_center + 0.05 * hand.palm_normal
    end = hand.link_index["thumb3"]
    after = link_poses(hand, thumb)[1][end]
    assert np.linalg.norm(after - target) < np.linalg.norm(base[end] - target)
    for posture in (hand.open_posture, hand.closed_posture):
        assert ((hand.lower <= posture) & (posture <= hand.upper)).all()
        assert deepest_overlap(hand, posture[None])[0] < 2e-3  # hulls graze where flesh would give


def test_a_left_hand_is_told_by_its_mean_pose(path: Path, tmp_path: Path) -> None:
    """The mirror image of a right hand, z to −z: rotation vectors keep z and lose the sign of x and y."""
    model: dict[str, Any] = SYNTHETIC["synthetic_model"](3)
    mirror = np.array([1.0, 1.0, -1.0])
    vectors = np.array([-1.0, -1.0, 1.0])
    flipped = {
        **model,
        "v_template": model["v_template"] * mirror,
        "shapedirs": model["shapedirs"] * mirror[:, None],
        "posedirs": np.zeros_like(model["posedirs"]),
        "hands_mean": (model["hands_mean"].reshape(15, 3) * vectors).ravel(),
        "f": model["f"][:, ::-1],
    }
    left_path = tmp_path / "MANO_LEFT.pkl"
    left_path.write_bytes(SYNTHETIC["mano_pickle"](flipped))
    right, left = load_hand(path, candidates=20), load_hand(left_path, candidates=20)
    assert left.name == "MANO_LEFT"
    np.testing.assert_allclose(left.palm_normal, mirror * right.palm_normal, atol=1e-9)
    np.testing.assert_allclose(left.palm_center, mirror * right.palm_center, atol=1e-9)
    q = right.closed_posture
    np.testing.assert_allclose(link_poses(left, q)[1], mirror * link_poses(right, q)[1], atol=1e-9)


@pytest.mark.slow
def test_a_human_grasp_of_a_sphere_from_end_to_end(mano: ManoHand) -> None:
    scene = load_scene("shape:sphere")
    result = plan_grasps(scene, mano.model, count=2, seed=0, preset="fast")
    assert [grasp.verdict for grasp in result.grasps[:1]] == [Verdict.VERIFIED]
    grasp = result.grasps[0].grasp
    found = measure_skin(make_distance_query(scene.object.mesh), mano.skinned_mesh(grasp))
    assert found.contact_area[0] > 1e-4
    assert found.intersection_volume < 2e-5
    assert found.penetration < 0.01


def test_bad_betas_are_refused(path: Path) -> None:
    for betas in ([0.0] * 11, [np.nan]):
        with pytest.raises(HandError, match="expected at most 10 finite numbers"):
            load_mano(path, betas)
