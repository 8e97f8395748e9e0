"""Simulated cells that tests share; each test has a robot of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np
import pytest
import torch

from graspd_bench.rendering.depth_noise import NONE
from graspd_cell.layout import layout_of
from graspd_cell.robot import JointMotion
from graspd_cell.simulated_robot import SimulatedRobot
from graspd_cell.things import find_sources, load_thing
from graspd_cell.world import CellWorld, build_cell
from graspd_core.arms.arm import load_arm
from graspd_core.arms.inverse_kinematics import solve
from graspd_core.hands.library import load_hand
from graspd_core.se3 import SE3

PAIRS = (("ur5e_like", "allegro_right"), ("panda_like", "leap_right"), ("ur5e_like", "parallel_gripper"))


@pytest.fixture(scope="session")
def domain(claim_domain: Callable[[], int]) -> int:
    """A domain of the cell's tests: transforms that tests of the node keep would be heard in theirs."""
    return claim_domain()


@pytest.fixture(scope="module")
def simulator(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cell with a pear in it, as a process of its own that ends without an error."""
    folder = tmp_path_factory.mktemp("cell")
    ros = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    words = ["--arm", "ur5e_like", "--hand", "parallel_gripper", "--things", "family:pear:0"]
    command = [sys.executable, "-m", "graspd_cell.simulator_node", *words, "--clock", "--speed", "3"]
    with (folder / "node.log").open("w") as log:
        process = subprocess.Popen(command, env={**os.environ, **ros}, stdout=log, stderr=log)
        yield
        process.terminate()
        status = process.wait(100.0)
    told = (folder / "node.log").read_text()
    assert (status, "Traceback" in told) == (0, False), told


@lru_cache(maxsize=8)
def _world(arm: str, hand: str, names: tuple[str, ...], height: float) -> CellWorld:
    model = load_arm(arm)
    layout = layout_of(model)
    things = [load_thing(source) for source in find_sources(names)]
    poses = []
    for index in range(len(things)):
        pose = np.eye(4)
        pose[:3, 3] = [*layout.pick.center, height]
        pose[1, 3] += 0.1 * (index - 0.5 * (len(things) - 1))
        poses.append(pose)
    return build_cell(model, load_hand(hand), layout, things, poses)


@pytest.fixture(params=PAIRS, ids="+".join)
def pair(request: pytest.FixtureRequest) -> tuple[str, str]:
    """Each pair of arm and hand that has to work."""
    return request.param


@pytest.fixture
def robot_of() -> Callable[..., SimulatedRobot]:
    """Make a robot in a cell with things in a row above the first bin, without noise in its images."""

    def make(arm: str, hand: str, *names: str, height: float = 0.1) -> SimulatedRobot:
        return SimulatedRobot(_world(arm, hand, names, height), noise=NONE)

    return make


def _smooth_motion(robot: SimulatedRobot, goal: np.ndarray, seconds: float) -> JointMotion:
    names = robot.world.arm.joint_names
    start = robot.joints().of(names).positions
    times = np.linspace(0.05, 1.0, 20)
    share, slope = 3 * times**2 - 2 * times**3, 6 * times - 6 * times**2
    positions, velocities = start + share[:, None] * (goal - start), slope[:, None] * (goal - start) / seconds
    return JointMotion(names, seconds * times, positions, velocities)


@pytest.fixture
def smooth_motion() -> Callable[[SimulatedRobot, np.ndarray, float], JointMotion]:
    """Make a motion of the arm from where it is to some joint values, from rest to rest."""
    return _smooth_motion


@pytest.fixture
def arm_at() -> Callable[[SimulatedRobot, np.ndarray, np.ndarray], np.ndarray]:
    """Return joint values that bring the tip to a place, pointing down."""

    def find(robot: SimulatedRobot, place: np.ndarray, start: np.ndarray) -> np.ndarray:
        down = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
        target = SE3(down[None], torch.as_tensor(place)[None])
        found, reached = solve(robot.world.arm, target, torch.as_tensor(start)[None], 200)
        assert bool(reached[0])
        return found[0].double().numpy()

    return find
