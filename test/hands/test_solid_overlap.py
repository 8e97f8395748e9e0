"""How deep solids are in each other, against MuJoCo, and its gradients against finite differences."""
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np
import pytest
import torch

from graspd_core import Posture, hand_names, load_hand, load_scene
from graspd_core.hands.kinematics import forward, make_kinematics
from graspd_core.hands.link_distance import CollisionTensors, make_collision_tensors
from graspd_core.hands.self_collision import solid_overlaps, solid_pairs
from graspd_core.se3 import SE3
from graspd_core.verify.hold_trial import set_hand_pose
from graspd_core.verify.world import PROTOCOLS, build_world, trial_data


def postures_of(hand, count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(hand.lower, hand.upper, (count, hand.num_joints))


def two(core: list[list[float]], radius: list[float], around: list[float], at: list[list[float]]) -> torch.Tensor:
    """Depths of two solids, unturned, at two places."""
    same = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    tensor = lambda x: torch.tensor(x, dtype=torch.float64)  # noqa: E731
    rest = torch.zeros(2, 3, dtype=torch.float64)
    solids = CollisionTensors(same, rest, tensor(core), tensor(radius), tensor(around), torch.tensor([0, 1]))
    return solid_overlaps(solids, torch.tensor([[0, 1]]), SE3(same[None], tensor([at])))[1]


def test_known_depths():
    boxes = [[0.02, 0.02, 0.02], [0.01, 0.01, 0.01]]
    assert two(boxes, [0, 0], [0, 0], [[0, 0, 0], [0.027, 0, 0.005]]).tolist() == pytest.approx([0.003])
    assert len(two(boxes, [0, 0], [0, 0], [[0, 0, 0], [0.031, 0, 0]])) == 0
    points = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.03]]
    assert two(points, [0.01, 0.02], [0, 0], [[0, 0, 0], [0.015, 0.02, 0.01]]).tolist() == pytest.approx([0.005])
    cylinders = [[0.01, 0.01, 0.05], [0.02, 0.02, 0.05]]
    assert two(cylinders, [0, 0], [1, 1], [[0, 0, 0], [0.0, 0.024, 0.0]]).tolist() == pytest.approx([0.006])


@pytest.mark.parametrize("name", hand_names())
def test_it_is_what_mujoco_finds(name):
    hand, scene = load_hand(name, candidates=8), load_scene("shape:box", resolution=16)
    world = build_world(hand, scene.object, (scene.object.mesh,), PROTOCOLS["standard"])
    postures, found = postures_of(hand, 60), []
    with trial_data(world) as data:
        for joints in postures:
            set_hand_pose(world, data, Posture(np.array([1.0, 0, 0]), np.array([1.0, 0, 0, 0]), joints))
            mujoco.mj_kinematics(world.model, data)
            mujoco.mj_collision(world.model, data)
            found.append(max(0.0, -min(data.contact.dist, default=0.0)))
    links = forward(make_kinematics(hand, "cpu", torch.float64), torch.as_tensor(postures))
    solids = make_collision_tensors(hand, "cpu", torch.float64)
    row, depth = solid_overlaps(solids, torch.as_tensor(solid_pairs(hand)), links)
    mine = torch.zeros(60, dtype=torch.float64).scatter_reduce(0, row, depth, "amax").numpy()
    error = mine - np.array(found)
    # MuJoCo's own depth of boxes errs by up to a tenth of a millimetre. Rims are taken for deeper than they are.
    assert error.min() > -2e-4
    assert np.quantile(np.abs(error), 0.8) < 1e-4
    assert ((mine > 0.002) == (np.array(found) > 0.002)).mean() > 0.9


@pytest.mark.parametrize("name", hand_names()[:4])
def test_gradients_are_finite_differences(name):
    hand = load_hand(name, candidates=8)
    kinematics = make_kinematics(hand, "cpu", torch.float64)
    solids = make_collision_tensors(hand, "cpu", torch.float64)
    pairs = torch.as_tensor(solid_pairs(hand))
    joints = torch.as_tensor(postures_of(hand, 60))

    def squares(joints: torch.Tensor) -> torch.Tensor:
        row, depth = solid_overlaps(solids, pairs, forward(kinematics, joints))
        return torch.zeros(len(joints), dtype=torch.float64).index_add(0, row, (1e3 * depth) ** 2)

    joints.requires_grad_(True)
    value = squares(joints)
    (gradient,) = torch.autograd.grad(value.sum(), joints)
    way = torch.randn(joints.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.no_grad():
        slope = (squares(joints + 1e-6 * way) - squares(joints - 1e-6 * way)) / 2e-6
    assert (value > 0).sum() >= 5
    # In millimetres: two directions that are equally deep make a kink, which a posture at random is not at.
    assert (gradient * way).sum(-1).tolist() == pytest.approx(slope.tolist(), rel=1e-4, abs=1e-3)
