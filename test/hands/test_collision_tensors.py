"""Distances to primitives and of all solids at once; forward kinematics against finite differences."""

import gc
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from expected import some
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck

from graspd_core.hands.kinematics import Kinematics, forward, make_kinematics, place_points, placement, point_jacobian
from graspd_core.hands.link_distance import (
    CollisionTensors,
    make_collision_tensors,
    pair_distance,
    primitive_sdf,
    solid_distance,
)
from graspd_core.hands.model import HandModel, Primitive, PrimitiveKind
from graspd_core.hands.readers.urdf import read_urdf
from graspd_core.mesh.convex_parts import hull_surface
from graspd_core.se3 import SE3


@pytest.fixture(scope="module")
def solids(hand: HandModel) -> CollisionTensors:
    return make_collision_tensors(hand, "cpu", torch.float64)


@pytest.fixture(scope="module")
def kinematics(hand: HandModel) -> Kinematics:
    return make_kinematics(hand, dtype=torch.float64)


def drawn(hand: HandModel, seed: int, postures: int = 2, points: int = 12) -> tuple[Tensor, Tensor]:
    """Joint values within limits, and points in the space that the hand takes up."""
    generator = torch.Generator().manual_seed(seed)
    lower, upper = torch.as_tensor(hand.lower), torch.as_tensor(hand.upper)
    q = lower + (upper - lower) * torch.rand(postures, len(lower), generator=generator, dtype=torch.float64)
    low, high = torch.tensor([-0.05, -0.1, -0.1]), torch.tensor([0.1, 0.1, 0.2])
    return q, low + (high - low) * torch.rand(postures, points, 3, generator=generator, dtype=torch.float64)


@given(seed=st.integers(0, 2**31))
@settings(max_examples=8)
def test_distances_are_those_of_the_primitives_and_pairs_are_entries_of_the_whole(hand, solids, kinematics, seed):
    q, points = drawn(hand, seed)
    links = forward(kinematics, q)
    together = solid_distance(solids, links, points)
    assert solids.link.tolist() == [primitive.link for primitive in hand.primitives]
    alone = [primitive_sdf(primitive, links[:, primitive.link].apply_inverse(points)) for primitive in hand.primitives]
    # The same formulas in another order: rounding of 0.1 m.
    assert together.numpy() == pytest.approx(torch.stack(alone, -1).numpy(), abs=1e-12)
    which = torch.randint(len(solids.link), points.shape[:2], generator=torch.Generator().manual_seed(seed))
    pairs = pair_distance(solids, links, points, which)
    whole = together.gather(-1, which[..., None]).squeeze(-1)
    assert pairs.numpy() == pytest.approx(whole.numpy(), abs=1e-12)


def test_capsules_are_swept_segments(hand):
    capsule = Primitive(1, "capsule", np.eye(3)[:, [1, 2, 0]], np.array([0.02, 0.0, 0.01]), (0.01, 0.03))
    found = make_collision_tensors(replace(hand, primitives=(capsule,)), "cpu", torch.float64)
    assert found.link.tolist() == [1]
    q, points = drawn(hand, 0)
    links = forward(make_kinematics(hand, dtype=torch.float64), q)
    local = links[:, 1].apply_inverse(points)
    together = solid_distance(found, links, points)[..., 0]
    assert together.numpy() == pytest.approx(primitive_sdf(capsule, local).numpy(), abs=1e-12)


def test_a_filled_hull_of_a_box_is_that_box(hand):
    # The corners are those of a box of 4 by 2 by 1 cm, turned and off the origin.
    corners = np.stack(np.meshgrid([-0.02, 0.02], [-0.01, 0.01], [-0.005, 0.005]), -1).reshape(-1, 3)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    shape = hull_surface(corners @ turn.T + [0.01, 0.02, 0.03])
    hull = Primitive(1, "hull", turn, np.array([0.0, 0.01, 0.0]), (), shape.vertices, shape.faces)
    found = make_collision_tensors(replace(hand, primitives=(hull,)), "cpu", torch.float64)
    _, points = drawn(hand, 0, postures=1, points=40)
    links = SE3(torch.eye(3, dtype=torch.float64).repeat(1, 2, 1, 1), torch.zeros(1, 2, 3, dtype=torch.float64))
    inside = solid_distance(found, links, points)[..., 0] < 0
    box = Primitive(1, "box", turn @ turn, turn @ [0.01, 0.02, 0.03] + [0.0, 0.01, 0.0], (0.02, 0.01, 0.005))
    middle = torch.as_tensor(box.translation)[None, None]
    # All corners of the filled box are inside the true box, and its middle is as deep.
    assert solid_distance(found, links, middle).item() == pytest.approx(-0.005, abs=1e-7)
    assert (primitive_sdf(box, points)[inside] < 1e-7).all()


def test_gradients_against_finite_differences(hand, solids, kinematics):
    q, points = drawn(hand, 5, points=3)
    which = torch.tensor([[0, 7, 13], [4, 19, 26]])

    def every(q: Tensor, points: Tensor) -> Tensor:
        return solid_distance(solids, forward(kinematics, q), points)

    def pairs(q: Tensor, points: Tensor) -> Tensor:
        return pair_distance(solids, forward(kinematics, q), points, which)

    # Points are drawn anywhere, so none is within the step of 1e-6 of a kink (an edge's or a middle plane's extension).
    inputs = (q.requires_grad_(True), points.requires_grad_(True))
    assert gradcheck(every, inputs)
    assert gradcheck(pairs, inputs)


def test_gradients_are_finite_on_an_axis(solids):
    at = solids.translation[None].clone().requires_grad_(True)
    links = int(solids.link.max()) + 1
    rotations = torch.eye(3, dtype=torch.float64).expand(1, links, 3, 3)
    distance = solid_distance(solids, SE3(rotations, torch.zeros(1, links, 3, dtype=torch.float64)), at)
    # Each point is the middle of its own solid, and of no other necessarily.
    assert (distance[0].diagonal() < 0).all()
    (gradient,) = torch.autograd.grad(distance.sum(), at)
    assert gradient.isfinite().all()


SIZES: dict[PrimitiveKind, tuple[float, ...]] = {
    "sphere": (0.2,),
    "box": (0.1, 0.2, 0.3),
    "capsule": (0.1, 0.2),
    "cylinder": (0.1, 0.2),
}
KERNELS = {
    kind: partial(primitive_sdf, Primitive(0, kind, np.eye(3), np.zeros(3), size)) for kind, size in SIZES.items()
}
GOLDEN = [
    ("sphere", (0.0, 0.0, 0.0), -0.2),
    ("sphere", (0.3, 0.0, 0.4), 0.3),
    ("box", (0.0, 0.0, 0.0), -0.1),
    ("box", (0.4, 0.6, 0.0), 0.5),  # 0.3 past x and 0.4 past y
    ("capsule", (0.0, 0.0, 0.35), 0.05),
    ("capsule", (0.3, 0.0, 0.1), 0.2),
    ("cylinder", (0.0, 0.0, 0.0), -0.1),
    ("cylinder", (0.0, 0.4, 0.6), 0.5),  # 0.3 past the side and 0.4 past the end
]


@pytest.mark.parametrize(("name", "point", "expected"), GOLDEN)
def test_golden_distance(name, point, expected):
    distance = KERNELS[name](torch.tensor(point, dtype=torch.float64))
    assert float(distance) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", KERNELS)
@given(seed=st.integers(0, 10_000))
def test_distance_changes_no_faster_than_one_moves(name, seed):
    generator = torch.Generator().manual_seed(seed)
    a, b = (torch.rand(16, 3, generator=generator, dtype=torch.float64) - 0.5 for _ in range(2))
    change = (KERNELS[name](a) - KERNELS[name](b)).abs()
    assert (change <= (a - b).norm(dim=-1) + 1e-12).all()


@pytest.mark.parametrize("name", KERNELS)
def test_gradient_has_no_nan_on_centre_and_axis(name):
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.9]], requires_grad=True)
    KERNELS[name](points).sum().backward()
    assert torch.isfinite(some(points.grad)).all()


@pytest.mark.parametrize("name", KERNELS)
@given(seed=st.integers(0, 10_000))
def test_gradient_is_the_finite_difference(name, seed):
    generator = torch.Generator().manual_seed(seed)
    # Irregular offsets keep clear of the creases, where no derivative exists.
    points = torch.rand(4, 3, generator=generator, dtype=torch.float64) - 0.5
    points.requires_grad_()
    (gradient,) = torch.autograd.grad(KERNELS[name](points).sum(), points)
    step = 1e-6
    shifts = step * torch.eye(3, dtype=torch.float64)
    ahead, behind = (torch.stack([KERNELS[name](points.detach() + s * d) for d in shifts], -1) for s in (1, -1))
    smooth = (ahead + behind - 2 * KERNELS[name](points.detach())[:, None]).abs() < 1e-9
    assert torch.allclose(gradient[smooth], ((ahead - behind) / (2 * step))[smooth], atol=1e-5)


SLIDER = """<robot name="slider">
  <link name="rail"/><link name="cart"/><link name="plate"/><link name="arm"/><link name="second"/>
  <link name="third"/>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/>
    <origin xyz="0.1 0 0" rpy="0.3 -0.2 0.5"/><axis xyz="0 1 1"/>
    <limit lower="-0.1" upper="0.2" effort="5" velocity="1"/></joint>
  <joint name="weld" type="fixed"><parent link="cart"/><child link="plate"/><origin xyz="0 0 0.05" rpy="0 0 1"/></joint>
  <joint name="turn" type="continuous"><parent link="plate"/><child link="arm"/><axis xyz="1 2 2"/></joint>
  <joint name="other" type="revolute"><parent link="rail"/><child link="second"/><origin xyz="0 0.2 0"/>
    <axis xyz="0 0 -1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="follows" type="revolute"><parent link="arm"/><child link="third"/><origin xyz="0.03 0 0" rpy="1 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-9" upper="9"/><mimic joint="other" multiplier="-0.7" offset="0.2"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def slider(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    path = tmp_path_factory.mktemp("slider") / "slider.urdf"
    path.write_text(SLIDER)
    return read_urdf(path)


@pytest.fixture(scope="module", params=["hand", "slider"])
def moving(request: pytest.FixtureRequest) -> HandModel:
    return request.getfixturevalue(request.param)


def _random_q(moving: HandModel, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(moving.lower, moving.upper, (count, moving.num_joints))


def test_gradients_by_finite_differences(moving: HandModel) -> None:
    kinematics = make_kinematics(moving, dtype=torch.float64)
    q = torch.as_tensor(_random_q(moving, 2, 2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: tuple(vars(forward(kinematics, x)).values()), q)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_link_poses_are_rigid_and_placing_agrees_with_them(hand: HandModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = _random_q(hand, 3, seed)
    points, links = rng.normal(size=(30, 3)), rng.integers(0, hand.num_links, 30)
    kinematics = make_kinematics(hand, dtype=torch.float64)
    poses = forward(kinematics, torch.as_tensor(q))
    rotations, translations = poses.rotation, poses.translation
    eye = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, eye, atol=1e-12, rtol=0)
    expected = (rotations[:, links] @ torch.as_tensor(points)[None, :, :, None]).squeeze(-1)
    given = hand.num_links, torch.as_tensor(points), torch.as_tensor(links)
    turned = place_points(placement(*given, directions=True), poses)
    torch.testing.assert_close(turned, expected, atol=1e-12, rtol=0)
    moved = place_points(placement(*given), poses)
    torch.testing.assert_close(moved, expected + translations[:, links], atol=1e-12, rtol=0)


def test_point_jacobian_is_the_derivative(moving: HandModel) -> None:
    rng = np.random.default_rng(3)
    q = _random_q(moving, 1, 3)[0]
    points, links = rng.normal(size=(25, 3)) * 0.05, rng.integers(0, moving.num_links, 25)
    kinematics = make_kinematics(moving, dtype=torch.float64)
    matrix = placement(moving.num_links, torch.as_tensor(points), torch.as_tensor(links))

    def positions(x: torch.Tensor) -> torch.Tensor:
        return place_points(matrix, forward(kinematics, x[None]))[0]

    expected = torch.autograd.functional.jacobian(positions, torch.as_tensor(q))
    np.testing.assert_allclose(point_jacobian(moving, q, points, links), np.asarray(expected), atol=1e-12)


def test_a_hand_is_laid_out_once_and_let_go_again(hand: HandModel) -> None:
    assert make_kinematics(hand) is make_kinematics(hand)
    assert make_kinematics(hand) is not make_kinematics(hand, dtype=torch.float64)
    solids = [make_collision_tensors(hand, "cpu", torch.float32) for _ in range(2)]
    assert solids[0] is solids[1]
    first = weakref.ref(copy := replace(hand))
    assert make_kinematics(copy) is not make_kinematics(hand)
    for copy in (replace(hand) for _ in range(20)):
        make_kinematics(copy)
    gc.collect()
    assert first() is None
