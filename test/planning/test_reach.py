"""Grasps that an arm reaches: what it refuses, what its grasps carry, and that who asks for none loads none of it."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from expected import some

from graspd_core import HandModel, Reach, Scene, load_arm, load_grasps, load_hand, load_preset, plan_grasps, save_result
from graspd_core.arms.arm import arm_links, tip_hand
from graspd_core.errors import ConfigError
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.restrictions import BoundRestrictions
from graspd_core.perception.scene import build_scene
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Grasp, GraspResult, Outcome, Plane, TriangleMesh


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return load_hand("barrett_like")


@pytest.fixture(scope="module")
def table() -> Scene:
    return on_table(np.zeros(3))


def on_table(at: np.ndarray) -> Scene:
    """A box on a table, its middle at a place."""
    mesh = make_shape("box")
    support = Plane(np.array([0.0, 0.0, 1.0]), float(mesh.vertices[:, 2].min() + at[2]))
    return build_scene(TriangleMesh(mesh.vertices + at, mesh.faces), support=support)


def reach_of(scene: Scene, away: float, at: np.ndarray | None = None) -> Reach:
    x, y, _ = np.zeros(3) if at is None else at
    quarter = (float(np.cos(np.pi / 4)), 0.0, 0.0, float(np.sin(np.pi / 4)))
    return Reach(load_arm("panda_like"), (x - away, y + 0.1, some(scene.support).offset), quarter)


def planned(scene: Scene, hand: HandModel, reach: Reach, count: int = 2) -> GraspResult:
    return plan_grasps(scene, hand, count=count, verify="none", measure=False, restrictions=[reach])


def check_arms(result: GraspResult, hand: HandModel, reach: Reach) -> None:
    """The arm of each grasp has the hand where the grasp has it."""
    base = SE3(
        rotation_from_quaternion(torch.tensor(reach.quaternion_wxyz, dtype=torch.float64)),
        torch.tensor(reach.position, dtype=torch.float64),
    )
    assert result.tried
    for grasp in result.tried:
        for stage in ("pregrasp", "grasp"):
            links = arm_links(reach.arm, torch.as_tensor(some(grasp.arm).at(stage))[None])
            carried = base.compose(links[0, reach.arm.tip].compose(tip_hand(reach.arm, hand)))
            posture = getattr(grasp, stage)
            turned = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz))
            assert np.allclose(carried.translation, posture.position, atol=2e-4)
            assert torch.allclose(carried.rotation, turned, atol=2e-3)


@pytest.fixture(scope="module")
def reached(hand: HandModel, table: Scene) -> GraspResult:
    return planned(table, hand, reach_of(table, 0.5))


def test_every_grasp_comes_with_the_arm_that_brings_the_hand_there(hand: HandModel, table: Scene, reached):
    assert reached.outcome is Outcome.SUCCEEDED
    check_arms(reached, hand, reach_of(table, 0.5))


def test_what_the_arm_cannot_do_is_counted_by_reason(hand: HandModel, table: Scene):
    result = planned(table, hand, reach_of(table, 0.72), count=8)
    assert sum(result.refused.values()) > 0
    assert f"{sum(result.refused.values())} refused: " in result.message
    known = ("beyond joint_", "in the table", "in the object", "no posture of the arm", "farther than", "against")
    known = (*known, "on the path", "without a", "jump")
    assert [reason for reason in result.refused if not any(word in reason for word in known)] == []


def test_starts_are_drawn_where_the_arm_can_come_from(hand: HandModel, table: Scene):
    """Near the end of its reach most drawn hands are out of it; of those that are kept, more are reached."""
    bound = reach_of(table, 0.85).bind(table, hand)
    plain = draw_starts(table, hand, 64, 0, "cpu", torch.float64)
    drawn = draw_starts(table, hand, 64, 0, "cpu", torch.float64, restrictions=BoundRestrictions((bound,)))

    def share(poses: object) -> float:
        values = [value.numpy() for value in vars(poses).values()]
        return float(bound.starts(*values).mean())

    # Hands are lifted off the support after they are drawn, so that a few end beside what was allowed.
    assert share(drawn) > 0.95
    assert share(plain) < 0.6


def test_an_object_far_away_is_told_at_once(hand: HandModel, table: Scene):
    result = planned(table, hand, reach_of(table, 5.0))
    assert result.outcome is Outcome.NO_CANDIDATES
    assert not result.tried
    assert "m from the base of panda_like, whose reach with barrett_like" in result.message


@pytest.mark.parametrize(("name", "below", "link"), [("ur5e_like", 0.12, "upper_arm"), ("panda_like", 0.3, "link_2")])
def test_an_arm_whose_every_posture_is_in_the_table_is_told_at_once(hand: HandModel, table: Scene, name, below, link):
    reach = Reach(load_arm(name), (-0.5, 0.1, some(table.support).offset - below))
    result = planned(table, hand, reach)
    assert result.outcome is Outcome.NO_CANDIDATES
    told = f"every posture of {name} has {link} in the table; the table is {below:.2f} m above the arm's base"
    assert result.message.startswith(told)


def test_an_object_out_of_reach_is_told_by_reasons_not_by_a_class(hand: HandModel):
    """Near enough that a search begins, too far for any hand: the reasons of docs/arms.md, counted."""
    scene = build_scene(make_shape("box"))
    result = planned(scene, hand, Reach(load_arm("panda_like"), (-1.3, 0.1, 0.0)))
    assert result.outcome is Outcome.NO_CANDIDATES
    assert result.message.startswith("no candidate was found under the reach of panda_like; of 64 hand poses around")
    assert re.search(r": [1-9]\d* farther than the arm reaches", result.message)


def test_poses_far_from_the_origin_are_reached_alike(hand: HandModel):
    """The run works on an object near its own origin; the arm stands where the caller said."""
    at = np.array([40.0, -30.0, 2.0])
    scene = on_table(at)
    reach = reach_of(scene, 0.5, at)
    check_arms(planned(scene, hand, reach), hand, reach)


def test_the_arm_is_written_and_read(hand: HandModel, table: Scene, reached: GraspResult, tmp_path: Path):
    result = reached
    save_result(tmp_path / "grasps.json", result, table.object, hand, load_preset("balanced"))
    for written, read in zip(result.tried, load_grasps(tmp_path / "grasps.json"), strict=True):
        assert written.arm is not None
        assert read.arm is not None
        assert (read.arm.joint_names, read.arm.stages) == (written.arm.joint_names, written.arm.stages)
        assert np.array_equal(read.arm.positions, written.arm.positions)
    bare: tuple[Grasp, ...] = tuple(replace(grasp, arm=None) for grasp in result.tried)
    save_result(tmp_path / "bare.json", replace(result, tried=bare), table.object, hand, load_preset("balanced"))
    assert all(grasp.arm is None for grasp in load_grasps(tmp_path / "bare.json"))


@pytest.mark.parametrize(
    ("position", "quaternion", "told"),
    [
        ((0.0, float("nan"), 0.0), (1.0, 0.0, 0.0, 0.0), "arm base: position .*; valid: three numbers up to 100 m"),
        ((0.0, 4000.0, 0.0), (1.0, 0.0, 0.0, 0.0), "arm base: position"),
        ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), "arm base: quaternion .*; valid: w x y z of length 1"),
    ],
)
def test_a_base_that_is_nowhere_is_refused(hand, table, position, quaternion, told):
    with pytest.raises(ConfigError, match=told):
        planned(table, hand, Reach(load_arm("panda_like"), position, quaternion))
