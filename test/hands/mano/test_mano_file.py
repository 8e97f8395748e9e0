"""MANO: what is read of a file, what a file can not make this program do, and the hand made of it."""

import os
import pickle
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from expected import Evil, refused
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from graspd_bench.studies.human_hand import measure_skin
from graspd_core import Posture, Verdict, load_hand, load_scene, plan_grasps
from graspd_core.errors import HandError
from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.mano.mano_file import ADMITTED, BODIES, PARENTS, ManoData, numbers, read_mano, read_pickle
from graspd_core.hands.mano.mano_hand import ManoHand, load_mano
from graspd_core.hands.mano.mano_skin import closed_faces, wrist_loop
from graspd_core.hands.self_collision import deepest_overlap
from graspd_core.hands.surface_points import with_candidates
from graspd_core.mesh.surface_queries import make_distance_query, signed_distance
from graspd_core.runtime.inert_pickle import Maker

# Shape coefficients of the fixture `mano`.
BETAS = np.array([0.7, -1.0, 0.5, *[0.0] * 7])
SYNTHETIC = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks" / "mano_synthetic.py"))


@pytest.fixture(scope="module")
def model() -> dict[str, Any]:
    return SYNTHETIC["synthetic_model"](seed=3)


def write(path: Path, content: dict[str, Any]) -> Path:
    path.write_bytes(SYNTHETIC["mano_pickle"](content))
    return path


def test_everything_is_read_back(model: dict[str, Any], tmp_path: Path) -> None:
    path = write(tmp_path / "MANO_RIGHT.pkl", model)
    # The file names what a licensed one names, chumpy's expression included.
    assert b"chumpy.reordering\nSelect" in path.read_bytes()
    data = read_mano(path)
    np.testing.assert_array_equal(data.template, model["v_template"])
    np.testing.assert_array_equal(data.shape_directions, model["shapedirs"])
    np.testing.assert_array_equal(data.pose_directions, model["posedirs"])
    np.testing.assert_array_equal(data.joint_regressor, model["J_regressor"].toarray())
    np.testing.assert_array_equal(data.weights, model["weights"])
    np.testing.assert_array_equal(data.faces, model["f"])
    np.testing.assert_array_equal(data.mean, model["hands_mean"])


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4])
def test_every_protocol_and_both_sparse_kinds(model: dict[str, Any], tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "hand.pkl"
    rows = csr_matrix(model["J_regressor"])
    fortran = np.asfortranarray(model["weights"].astype(">f4"))
    path.write_bytes(pickle.dumps({**model, "J_regressor": rows, "weights": fortran}, protocol=protocol))
    data = read_mano(path)
    np.testing.assert_array_equal(data.joint_regressor, model["J_regressor"].toarray())
    np.testing.assert_array_equal(data.weights, model["weights"].astype(np.float32))


def test_an_array_as_python_2_wrote_it(tmp_path: Path) -> None:
    """Protocol 2 of Python 2 has raw bytes as text: written here by hand."""
    values = np.array([[1.5, -2.0, 0.25], [200.0, 0.0, 7e-300]])
    raw = values.tobytes()
    path = tmp_path / "two.pkl"
    path.write_bytes(
        b"\x80\x02}U\x01xcnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x02K\x03\x86cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xff"
        b"K\x00tb\x89U" + bytes([len(raw)]) + raw + b"tbs."
    )
    np.testing.assert_array_equal(numbers(read_pickle(path)["x"]), values)


def test_a_malicious_file_is_refused_and_runs_nothing(model: dict[str, Any], tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    command = f"touch {witness}"
    shell = f"{os.system.__module__}.system"
    cases: dict[str, tuple[Any, str]] = {
        "system": (Evil(os.system, command), shell),
        "eval": (Evil(eval, f"open({str(witness)!r}, 'w')"), "builtin.*eval"),
        "nested": ({"a": [(Evil(os.system, command),)]}, shell),
        "open": (Evil(open, str(witness), "w"), "io.open"),
        "getattr": (Evil(getattr, Evil(__import__, "os"), "system"), "__import__|getattr"),
        "numpy": (Evil(np.load, str(witness)), "load"),
        "fromfunction": (Evil(np.fromfunction, "x", (3,)), "fromfunction"),
        "unpickler": (Evil(pickle.loads, pickle.dumps(Evil(os.system, command))), "pickle.*loads"),
        "code": (Evil(compile, "1", "x", "eval"), "compile"),
    }
    for name, (payload, culprit) in cases.items():
        for protocol in (0, 2, 4):
            path = tmp_path / f"{name}.pkl"
            path.write_bytes(pickle.dumps({**model, "bs_style": payload}, protocol=protocol))
            with refused(HandError, match=rf"{name}.pkl: asks for .*({culprit}).*refused"):
                load_hand(path)
    assert not witness.exists()


@pytest.mark.parametrize(
    "content",
    [
        b"cchumpy.ch\nCh\n}S'x'\nI1\nsb.",  # a state for a class, not for an object
        b"ccopy_reg\n_reconstructor\n}S'__class__'\nI1\nsb.",  # attributes of an admitted function
        b"ccopy_reg\n_reconstructor\n(N}S'call'\nI1\nstb.",  # the same by slots
        b"ccopy_reg\n_reconstructor\n(S'x'\ntR.",  # an object of no class
        b"c_codecs\nencode\n(S'x'\nS'rot13'\ntR.",  # another encoding
        b"Pother\n.",  # something outside the file
        b"\x80\x02\x82\x01.",  # a name by its number in a registry
        b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\x00\x00.",  # 280 TB of memory, please
        b"N\x72\xff\xff\xff\x7f.",  # a memo of two thousand million slots: its C reader allocates them
        b"",
        b"PK\x03\x04 a zip file",
        b"\x80\x63.",
        b"I1\n" * 3,
        b"\x80\x02})" + b"2\x86" * 200 + b"Ns.",  # a key whose hash takes 2^200 steps
        b"\x80\x02})" + b"\x85" * 500_000 + b"Ns.",  # one whose hash takes more stack than there is
        b"\x80\x02(" + b")" + b"2\x86" * 200 + b"Nd.",  # the same in the three other ways to write a key
        b"\x80\x02}()" + b"2\x86" * 200 + b"Nu.",
        b"\x80\x04\x8f()" + b"2\x86" * 200 + b"\x90.",
        b"\x80\x04()" + b"2\x86" * 200 + b"\x91.",
        b"Np" + str(2**61 - 1).encode() + b"\n.",  # places in the memo that have one hash
        b"\x80\x02\x8a\x09" + (2**61 - 1).to_bytes(9, "little") + b"p0\n}(g0\nNu.",
        b"\x80\x02cnumpy\ndtype\nq\x00(" + b"N" * 1000 + b"tR.",  # arguments that every call copies
        b"cmodule\x1b[2J\nname\n.",  # a name that clears the screen
    ],
)
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.pkl"
    path.write_bytes(content)
    with refused(HandError, match=r"broken.pkl: "):
        read_mano(path)


def test_nothing_admitted_is_a_real_class_or_function() -> None:
    assert all(type(made) is Maker for made in ADMITTED.values())


def test_a_missing_or_huge_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HandError, match=r"MANO_RIGHT.pkl: cannot be read: No such file"):
        load_hand(tmp_path / "MANO_RIGHT.pkl")
    path = tmp_path / "huge.pkl"
    with path.open("wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(HandError, match=r"huge.pkl: larger than 64 MB"):
        load_hand(path)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("v_template", None, "v_template: holds NoneType where numbers are expected"),
        ("v_template", np.zeros((5, 2)), r"v_template has shape 5 x 2; valid: any x 3"),
        ("posedirs", np.zeros((5, 3, 135)), r"posedirs has shape 5 x 3 x 135; valid: \d+ x 3 x 135"),
        ("weights", "half", "weights: holds str"),
        ("hands_mean", np.full(45, np.nan), "hands_mean has entries that are not finite"),
        ("hands_mean", np.array([None] * 45), "hands_mean: its array has type 'O8'"),
        ("f", np.array([[0, 1, 10**6]]), "f: no faces, or vertex indices outside"),
        ("kintree_table", np.zeros((2, 16)), "kintree_table is not MANO's tree"),
    ],
)
def test_a_wrong_entry_is_named(model: dict[str, Any], tmp_path: Path, key: str, value: Any, message: str) -> None:
    with pytest.raises(HandError, match=message):
        read_mano(write(tmp_path / "hand.pkl", {**model, key: value}))


def test_a_missing_entry_and_bad_sums_are_named(model: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(HandError, match=r"hands_mean is missing; the file has .*v_template"):
        read_mano(write(tmp_path / "hand.pkl", {k: v for k, v in model.items() if k != "hands_mean"}))
    for key in ("weights", "J_regressor"):
        with pytest.raises(HandError, match=f"{key}: rows do not sum to one"):
            read_mano(write(tmp_path / "hand.pkl", {**model, key: 2 * model[key]}))
    lost = model["weights"].copy()
    lost[:, [3, 2]] = np.column_stack([np.zeros(len(lost)), lost[:, 2] + lost[:, 3]])
    with pytest.raises(HandError, match="no vertex belongs to index3"):
        read_mano(write(tmp_path / "hand.pkl", {**model, "weights": lost}))


def test_expressions_and_matrices_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    cyclic = b"(dS'x'\nccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nobject\nNtRp1\n(dS'x'\ng1\nsbs."
    path = tmp_path / "x.pkl"
    path.write_bytes(cyclic)
    with pytest.raises(ValueError, match="nested more than 8 deep"):
        numbers(read_pickle(path)["x"])
    sparse = csr_matrix(np.eye(3))
    for change, message in (
        ({"indices": np.array([0, 1, 7])}, "indices do not fit its shape"),
        ({"_shape": (3, 10**12)}, "at most 4194304 entries"),
        ({"_shape": (3.5, 3)}, "not two positive numbers"),
    ):
        broken = csr_matrix(sparse)
        vars(broken).update(change)
        path.write_bytes(pickle.dumps(broken, protocol=2))
        with pytest.raises(ValueError, match=message):
            numbers(read_pickle(path))


def array(code: bytes, raw: bytes, shape: bytes = b"K\x01\x85") -> bytes:
    """An array in protocol 2, of a type by its code."""
    text = b"X" + len(code).to_bytes(4, "little") + code
    content = b"T" + len(raw).to_bytes(4, "little") + raw
    head = b"cnumpy.core.multiarray\n_reconstruct\n)R(K\x01"
    return head + shape + b"cnumpy\ndtype\n" + text + b"\x85R\x89" + content + b"tb"


def sparse(starts: bytes, indices: bytes = b"i4") -> bytes:
    """A matrix of two columns and three entries."""
    parts = {"data": array(b"f8", bytes(24), b"K\x03\x85"), "indices": array(indices, bytes(12), b"K\x03\x85"),
             "indptr": starts, "_shape": b"K\x02K\x02\x86"}  # fmt: skip
    state = b"".join(b"X" + len(k).to_bytes(4, "little") + k.encode() + v for k, v in parts.items())
    return b"cscipy.sparse.csc\ncsc_matrix\n)R}(" + state + b"ub"


# Lists in lists: two hundred bytes that take 2^60 characters to write out.
LISTS = b"]" + b"".join(b"q" + bytes([i]) + b"0](h" + bytes([i]) + b"h" + bytes([i]) + b"e" for i in range(60))


@pytest.mark.parametrize(
    "content",
    [
        array(b"f3", bytes(8)),
        array("f\u00b2".encode(), bytes(8)),
        array(b"O8", bytes(8)),
        array(b"f8", bytes(8), b"(" + b"K\x01" * 40 + b"t"),
        array(b"f8", bytes(8)).replace(b"X\x02\x00\x00\x00f8", LISTS),
        b"\x8b\xc8\x00\x00\x00" + b"\x7f" * 200,
        b"(K\x01\x8b\xc8\x00\x00\x00" + b"\x7f" * 200 + b"l",
        sparse(array(b"u4", np.array([0, 5, 3], np.uint32).tobytes(), b"K\x03\x85")),
        sparse(array(b"i4", np.array([0, 3, 3], np.int32).tobytes(), b"K\x03\x85"), indices=b"f4"),
        sparse(array(b"f4", np.array([0, 3, 3], np.float32).tobytes(), b"K\x03\x85")),
        sparse(array(b"i4", np.array([0, 3, 3], np.int32).tobytes(), b"K\x03\x85")).replace(b"K\x02K\x02\x86", LISTS),
    ],
)
def test_numbers_that_are_none_are_refused_in_one_short_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "odd.pkl"
    path.write_bytes(b"\x80\x02}X\x0a\x00\x00\x00v_template" + content + b"s.")
    with pytest.raises(HandError, match=r"odd.pkl: v_template: ") as caught:
        read_mano(path)
    assert len(str(caught.value)) < 400


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl"
    SYNTHETIC["write_synthetic"](path, 3)
    return path


@pytest.fixture(scope="module")
def mano(path: Path) -> ManoHand:
    return load_mano(path, BETAS[:3].tolist(), candidates=200)


def by_the_paper(data: ManoData, betas: np.ndarray, pose: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the vertices [m] by the paper's equations, in numpy. `pose` has 16 axis-angle vectors."""
    shaped = data.template + data.shape_directions @ betas
    joints = data.joint_regressor @ shaped
    turns = Rotation.from_rotvec(pose).as_matrix()
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
    homogeneous = np.column_stack([posed, np.ones(len(posed))])
    return np.einsum("vb,bij,vj->vi", data.weights, chain, homogeneous)[:, :3] + shift


@pytest.mark.parametrize("seed", range(3))
def test_the_skin_is_that_of_the_paper(mano: ManoHand, seed: int) -> None:
    """The hinges turn every body by B Rx Ry Rz Bᵀ in its parent. The paper's equations give the vertices."""
    hand, rng = mano.model, np.random.default_rng(seed)
    q, at, turn = rng.uniform(hand.lower, hand.upper), rng.normal(scale=0.2, size=3), Rotation.random(rng=rng)
    frames = link_poses(hand, np.zeros(45))[0][[hand.link_index[name] for name in BODIES[1:]]]
    local = frames @ Rotation.from_euler("XYZ", q.reshape(15, 3)).as_matrix() @ frames.transpose(0, 2, 1)
    pose = np.vstack([turn.as_rotvec(), Rotation.from_matrix(local).as_rotvec()])
    wrist = mano.data.joint_regressor[0] @ (mano.data.template + mano.data.shape_directions @ BETAS)
    mesh = mano.skinned_mesh(Posture(at, turn.as_quat(scalar_first=True), q))
    np.testing.assert_allclose(mesh.vertices[:-1], by_the_paper(mano.data, BETAS, pose, at - wrist), atol=1e-12)


def test_the_wrist_is_closed(mano: ManoHand) -> None:
    faces, loop = closed_faces(mano.data), wrist_loop(mano.data)
    assert len(loop) >= 8
    assert len(faces) == len(mano.data.faces) + len(loop)
    for q in (np.zeros(45), mano.model.open_posture, mano.model.closed_posture):
        skin = mano.skinned_mesh(Posture(np.full(3, 0.2), np.array([0.6, 0.8, 0, 0]), q))
        np.testing.assert_array_equal(skin.faces, faces)
        mesh = trimesh.Trimesh(skin.vertices, faces, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert 1e-4 < mesh.volume < 1e-3  # a hand has some 0.4 l


def test_a_mesh_that_is_not_open_at_one_place_is_refused(model: dict[str, Any], path: Path, tmp_path: Path) -> None:
    apart = int(np.flatnonzero((model["f"] == model["v_template"][:, 0].argmin()).any(1))[0])
    for faces, message in (
        (np.delete(model["f"], apart, axis=0), "the boundary is not one loop"),
        (np.concatenate([model["f"], model["f"][:1]]), "faces of opposite winding"),
    ):
        with pytest.raises(HandError, match=message):
            load_mano(write(tmp_path / "hand.pkl", {**model, "f": faces}))
    data = read_mano(path)
    hub = np.vstack([model["v_template"], data.template[wrist_loop(data)].mean(0)])
    grown = {"shapedirs": 0, "posedirs": 0, "weights": 0}
    more = {key: np.concatenate([model[key], model[key][-1:] * (key == "weights")]) for key in grown}
    regressor = np.column_stack([model["J_regressor"].toarray(), np.zeros(16)])
    content = {**model, **more, "v_template": hub, "f": closed_faces(data), "J_regressor": regressor}
    closed = write(tmp_path / "closed.pkl", content)
    assert len(wrist_loop(read_mano(closed))) == 0
    np.testing.assert_array_equal(closed_faces(read_mano(closed)), closed_faces(data))


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


def test_a_left_hand_is_told_by_its_mean_pose(model: dict[str, Any], path: Path, tmp_path: Path) -> None:
    """The mirror image of a right hand, z to −z: rotation vectors keep z and lose the sign of x and y."""
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
    left_path = write(tmp_path / "MANO_LEFT.pkl", flipped)
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
        with pytest.raises(HandError, match="valid: at most 10 finite numbers"):
            load_mano(path, betas)
