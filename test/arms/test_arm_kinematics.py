"""An arm's tip and its Jacobian: against published tables, finite differences, and itself backwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.arms.arm import Arm, arm_links, capsules_about, load_arm
from graspd_core.arms.inverse_kinematics import (
    POSITION_TOLERANCE,
    ROTATION_TOLERANCE,
    nearest_postures,
    pose_error,
    random_postures,
    rotation_vector,
    solve,
    start_table,
    tip_and_jacobian,
    tip_chain,
)
from graspd_core.hands.readers.build_model import LinkSpec, assemble
from graspd_core.hands.readers.joint_limits import JointSpec
from graspd_core.se3 import SE3, axis_rotation, random_rotations

PI = np.pi


SEEDS = st.integers(0, 2**32 - 1)


def random_arm(count: int, seed: int) -> Arm:
    """So many joints at random places about random axes, one in four of them sliding, and a bent tool."""
    rng = np.random.default_rng(seed)
    turns = random_rotations(count + 1, torch.Generator().manual_seed(seed), torch.float64).numpy()
    joints = []
    for k in range(count + 1):
        axis = rng.normal(size=3)
        slides, last = rng.random() < 0.25, k == count
        kind = "fixed" if last else "prismatic" if slides else "revolute"
        middle, half = (rng.uniform(-1, 1), rng.uniform(0.3, 3)) if not slides else (0.2, 0.2)
        joints.append(
            JointSpec(
                f"j{k}",
                f"l{k}",
                f"l{k + 1}",
                kind,
                turns[k],
                rng.uniform(-0.4, 0.4, 3),
                np.zeros(3) if last else axis / np.linalg.norm(axis),
                middle - half,
                middle + half,
            )
        )
    chain = assemble(Path("random"), "random", [LinkSpec(f"l{k}") for k in range(count + 2)], joints, {})
    middle = 0.5 * (chain.lower + chain.upper)
    return Arm("random", chain, count + 1, chain.lower, chain.upper, middle, capsules_about(()))


def inside(arm: Arm, shares: torch.Tensor) -> torch.Tensor:
    """Joint values at shares of the limits."""
    return torch.as_tensor(arm.lower) + shares * torch.as_tensor(arm.upper - arm.lower)


def tip(arm: Arm, q: torch.Tensor) -> SE3:
    return arm_links(arm, q)[:, arm.tip]


# a, d and alpha as the makers publish them; the second table is in Craig's convention.
UR5E = [(0, 0.1625, PI / 2), (-0.425, 0, 0), (-0.3922, 0, 0), (0, 0.1333, PI / 2), (0, 0.0997, -PI / 2), (0, 0.0996, 0)]
PANDA = [
    (0, 0.333, 0),
    (0, 0, -PI / 2),
    (0, 0.316, PI / 2),
    (0.0825, 0, PI / 2),
    (-0.0825, 0.384, -PI / 2),
    (0, 0, PI / 2),
    (0.088, 0, PI / 2),
]


def about(axis: int, angle: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = axis_rotation(np.eye(3)[axis], angle)
    return matrix


def along(axis: int, length: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[axis, 3] = length
    return matrix


@pytest.mark.parametrize("name", ["ur5e_like", "panda_like"])
def test_the_tip_is_where_the_published_table_has_it(name: str):
    arm = load_arm(name)
    q = random_postures(arm, 20, torch.Generator().manual_seed(3))
    for values, rotation, translation in zip(q.tolist(), *vars(tip(arm, q)).values(), strict=True):
        wanted = np.eye(4)
        for angle, (a, d, alpha) in zip(values, UR5E if name == "ur5e_like" else PANDA, strict=True):
            turned, bent = about(2, angle) @ along(2, d), along(0, a) @ about(0, float(alpha))
            wanted = wanted @ (turned @ bent if name == "ur5e_like" else bent @ turned)
        wanted = wanted if name == "ur5e_like" else wanted @ along(2, 0.107)
        # The URDF's angles have ten digits.
        assert np.allclose(translation, wanted[:3, 3], atol=1e-8)
        assert np.allclose(rotation, wanted[:3, :3], atol=1e-8)


@given(st.integers(3, 8), SEEDS)
def test_the_jacobian_is_that_of_finite_differences(joints: int, seed: int):
    arm = random_arm(joints, seed)
    q = inside(arm, torch.rand(1, len(arm.lower), generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    at, jacobians = tip_and_jacobian(tip_chain(arm, torch.float64), q)
    assert torch.allclose(at.translation, tip(arm, q).translation, atol=1e-12)
    assert torch.allclose(at.rotation, tip(arm, q).rotation, atol=1e-12)
    jacobian, step = jacobians[0], 1e-5
    for joint in range(len(arm.lower)):
        change = torch.zeros_like(q)
        change[0, joint] = step
        measured = pose_error(tip(arm, q + change), tip(arm, q - change))[0] / (2 * step)
        # Of second order in the step, with third derivatives of a few.
        assert torch.allclose(jacobian[:, joint], measured, atol=1e-8)


@given(st.integers(3, 8), SEEDS)
def test_from_nearby_the_tip_comes_back_within_the_limits(joints: int, seed: int):
    """FK∘IK: some posture is found for the tip of every other near it, and its tip is there."""
    arm = random_arm(joints, seed)
    generator = torch.Generator().manual_seed(seed)
    shares = 0.2 + 0.6 * torch.rand(4, len(arm.lower), generator=generator, dtype=torch.float64)
    target = tip(arm, inside(arm, shares))
    start = inside(arm, shares + 0.02 * torch.rand(shares.shape, generator=generator, dtype=torch.float64))
    solved = solve(arm, target, start, 60)
    wrong = pose_error(target, tip(arm, solved.q))
    # Computed in float32, of lengths of metres.
    assert (wrong[solved.reached, :3].norm(dim=-1) < POSITION_TOLERANCE + 2e-6).all()
    assert (wrong[solved.reached, 3:].norm(dim=-1) < ROTATION_TOLERANCE + 2e-6).all()
    assert (solved.q >= torch.as_tensor(arm.lower)).all()
    assert (solved.q <= torch.as_tensor(arm.upper)).all()
    # Where an arm is singular, steps along what it cannot do are slow: it is near by then.
    assert (solved.error < 5e-3).all()


def test_nearly_every_pose_within_the_limits_is_found(arm: Arm):
    """Target of the issue: 99 %; the benchmark measures it on 1000 poses of each arm."""
    target = tip(arm, random_postures(arm, 300, torch.Generator().manual_seed(11)))
    found = torch.zeros(300, dtype=torch.bool)
    for starts in nearest_postures(start_table(arm), target, 12).unbind(1):
        rows = torch.nonzero(~found).flatten()
        found[rows] = solve(arm, target[rows], starts[rows], 24).reached
    assert found.double().mean() >= 0.99


def test_no_posture_is_found_beyond_a_limit(arm: Arm):
    """Poses with one joint beyond its limits: what is found for some of them lies within the limits all the same."""
    q = random_postures(arm, 100, torch.Generator().manual_seed(2))
    q[:, 3] = float(arm.upper[3]) + 0.2
    solved = solve(arm, tip(arm, q), q.clamp(torch.as_tensor(arm.lower), torch.as_tensor(arm.upper)), 20)
    assert (solved.q <= torch.as_tensor(arm.upper)).all()
    assert (solved.q >= torch.as_tensor(arm.lower)).all()
    free = solve(arm, tip(arm, q), q, 1, limited=False)
    assert free.reached.all()
    assert not solved.reached.all()


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1.0, PI - 1e-6, PI])
def test_the_rotation_vector_is_axis_times_angle(angle: float):
    axis = np.array([0.6, 0.0, 0.8])
    turn = torch.as_tensor(axis_rotation(axis, angle))[None]
    vector = rotation_vector(turn, torch.eye(3, dtype=torch.float64)[None])[0]
    assert float(vector.norm()) == pytest.approx(angle, abs=1e-9)
    if 0 < angle < PI:
        assert np.allclose(vector, angle * axis, atol=1e-8)
