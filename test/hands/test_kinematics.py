"""Forward kinematics against finite differences; against MuJoCo in test_boxed_hands and readers/test_hands_in_use."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.hands.kinematics import (
    forward,
    make_kinematics,
    place_points,
    placement,
    point_jacobian,
    points_in_base,
)
from graspd_core.hands.library import load_hand
from graspd_core.hands.link_distance import make_collision_tensors
from graspd_core.hands.model import HandModel
from graspd_core.hands.readers.urdf import read_urdf

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
def allegro() -> HandModel:
    return load_hand("allegro_right")


@pytest.fixture(scope="module")
def slider(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    path = tmp_path_factory.mktemp("slider") / "slider.urdf"
    path.write_text(SLIDER)
    return read_urdf(path)


@pytest.fixture(scope="module", params=["allegro", "slider"])
def hand(request: pytest.FixtureRequest) -> HandModel:
    return request.getfixturevalue(request.param)


def _random_q(hand: HandModel, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(hand.lower, hand.upper, (count, hand.num_joints))


def test_gradients_by_finite_differences(hand: HandModel) -> None:
    kinematics = make_kinematics(hand, dtype=torch.float64)
    q = torch.as_tensor(_random_q(hand, 2, 2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: tuple(vars(forward(kinematics, x)).values()), q)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_link_poses_are_rigid_and_placing_agrees_with_them(allegro: HandModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = _random_q(allegro, 3, seed)
    points, links = rng.normal(size=(30, 3)), rng.integers(0, allegro.num_links, 30)
    kinematics = make_kinematics(allegro, dtype=torch.float64)
    poses = forward(kinematics, torch.as_tensor(q))
    rotations, translations = poses.rotation, poses.translation
    eye = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, eye, atol=1e-12, rtol=0)
    expected = (rotations[:, links] @ torch.as_tensor(points)[None, :, :, None]).squeeze(-1)
    turned = place_points(
        placement(allegro.num_links, torch.as_tensor(points), torch.as_tensor(links), directions=True),
        poses,
    )
    torch.testing.assert_close(turned, expected, atol=1e-12, rtol=0)
    moved = points_in_base(kinematics, torch.as_tensor(q), torch.as_tensor(points), torch.as_tensor(links))
    torch.testing.assert_close(moved, expected + translations[:, links], atol=1e-12, rtol=0)


def test_point_jacobian_is_the_derivative(hand: HandModel) -> None:
    rng = np.random.default_rng(3)
    q = _random_q(hand, 1, 3)[0]
    points, links = rng.normal(size=(25, 3)) * 0.05, rng.integers(0, hand.num_links, 25)
    kinematics = make_kinematics(hand, dtype=torch.float64)

    def positions(x: torch.Tensor) -> torch.Tensor:
        return points_in_base(kinematics, x[None], torch.as_tensor(points), torch.as_tensor(links))[0]

    expected = torch.autograd.functional.jacobian(positions, torch.as_tensor(q))
    np.testing.assert_allclose(point_jacobian(hand, q, points, links), np.asarray(expected), atol=1e-12)


def test_a_hand_is_laid_out_once_and_let_go_again(allegro: HandModel) -> None:
    assert make_kinematics(allegro) is make_kinematics(allegro, torch.device("cpu"), torch.float32)
    assert make_kinematics(allegro) is not make_kinematics(allegro, dtype=torch.float64)
    solids = [make_collision_tensors(allegro, device, torch.float32) for device in ("cpu", torch.device("cpu"))]
    assert solids[0] is solids[1]
    first = weakref.ref(copy := replace(allegro))
    assert make_kinematics(copy) is not make_kinematics(allegro)
    for copy in (replace(allegro) for _ in range(20)):
        make_kinematics(copy)
    gc.collect()
    assert first() is None
