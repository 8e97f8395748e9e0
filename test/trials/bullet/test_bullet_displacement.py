"""The displacement trial against falls worked out on paper, in PyBullet and in MuJoCo."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch

from graspd_bench.bullet import bullet_world as bullet
from graspd_bench.bullet.bullet_world import (
    OBMAN,
    BulletWorld,
    build_bullet_world,
    bullet_displacement,
    displacements,
)
from graspd_bench.trials import FrozenWorld, build_frozen_world, displacement_trial
from graspd_core.errors import SimulatorError
from graspd_core.mesh.mesh_files import content_hash, mass_properties
from graspd_core.perception.scene import ObjectModel
from graspd_core.se3 import quaternion_from_rotation, random_rotations
from graspd_core.types import Posture, TriangleMesh
from graspd_core.verify.hold_trial import DIRECTIONS

pytest.importorskip("pybullet")

STEP, STEPS, GRAVITY = 1 / 240, 35, 9.8
UP = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def world(gripper, cube) -> BulletWorld:
    return build_bullet_world(gripper, cube, (cube.mesh,))


@pytest.fixture(scope="module")
def frozen(gripper, cube) -> FrozenWorld:
    return build_frozen_world(gripper, cube, (cube.mesh,))


def hand_at(height: float, finger: float) -> Posture:
    return Posture(np.array([0.0, 0.0, height]), UP, np.array([finger, finger]))


def fall(drag: float = 0.0) -> float:
    """Semi-implicit Euler from rest against a drag of `drag (1 + v) v`; 10.42 cm without it, in small steps."""
    height = speed = 0.0
    for _ in range(STEPS):
        speed += (GRAVITY - drag * (1 + speed) * speed) * STEP
        height += speed * STEP
    return height


def test_free_fall(world, frozen):
    far = hand_at(-1.0, 0.0)
    # Bullet's damping of 0.04, linear and quadratic in the velocity; it computes in float32.
    assert displacements(world, far, DIRECTIONS) == pytest.approx(np.full(6, fall(0.04)), abs=2e-6)
    assert bullet_displacement(world, far) == pytest.approx(0.1068, abs=1e-4)
    assert displacement_trial(frozen, far) == pytest.approx(fall(), rel=1e-6)


def test_a_frozen_grip_holds_in_every_direction(world, frozen):
    # Either finger 0.2 mm deep: else nothing presses, and MuJoCo's cube slides out. Bullet has a margin of 1 mm.
    grip = hand_at(-0.045, 0.0252)
    assert displacements(world, grip, DIRECTIONS).max() < 0.0005
    assert displacement_trial(frozen, grip) < 0.0005


def test_an_object_falls_onto_the_palm_and_no_farther(world, frozen):
    # Fingers wide open, the palm 10 mm below the cube's face: it is there after 45 ms. Bullet's margin takes 1 mm.
    down, up = np.array([[0.0, 0, -1]]), np.array([[0.0, 0, 1]])
    open_hand = hand_at(-0.03, 0.0)
    assert bullet_displacement(world, open_hand, directions=down) == pytest.approx(0.0095, abs=0.0015)
    assert displacement_trial(frozen, open_hand, directions=down) == pytest.approx(0.01, abs=0.001)
    assert bullet_displacement(world, open_hand, directions=up) > 0.1


def test_the_figure_is_the_mean_of_six_directions_and_obmans_one_of_them(world):
    open_hand = hand_at(-0.03, 0.0)
    six = displacements(world, open_hand, DIRECTIONS)
    assert bullet_displacement(world, open_hand) == pytest.approx(six.mean())
    assert bullet_displacement(world, open_hand, directions=OBMAN) == pytest.approx(six[1], abs=1e-6)
    assert len({round(d, 3) for d in six}) > 1


def test_the_same_figure_whatever_ran_before_and_in_another_process(world):
    grip = hand_at(-0.045, 0.0252)
    first = bullet_displacement(world, grip)
    bullet_displacement(world, hand_at(-0.03, 0.0))
    assert bullet_displacement(pickle.loads(pickle.dumps(world)), grip) == first


@pytest.mark.parametrize("seed", range(3))
def test_turning_and_moving_everything_changes_nothing(seed, world, gripper, cube):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
    mesh = TriangleMesh(cube.mesh.vertices @ rotation.T + shift, cube.mesh.faces)
    volume, center, inertia = mass_properties(mesh)
    sha256 = content_hash(mesh)
    turned = ObjectModel("cube", sha256, mesh, volume, 0.1, center, inertia * 0.1 / volume, 0.6, 1.0, cube.radius, ())
    here = hand_at(-0.03, 0.0)
    there = Posture(
        rotation @ here.position + shift, quaternion_from_rotation(torch.as_tensor(rotation)).numpy(), np.zeros(2)
    )
    moved = displacements(build_bullet_world(gripper, turned, (mesh,)), there, DIRECTIONS @ rotation.T)
    # Half a millimetre of how a cube in contact settles in float32 far from the origin.
    assert moved == pytest.approx(displacements(world, here, DIRECTIONS), abs=0.0005)


def test_without_the_simulator_one_clear_error(gripper, cube, monkeypatch):
    monkeypatch.setattr(bullet.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulatorError, match=r"pybullet is not installed.*bench"):
        build_bullet_world(gripper, cube, (cube.mesh,))
