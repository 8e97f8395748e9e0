"""Free things on a table: they come to rest the same way every time, and a lift takes out what the hand holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from graspd_bench.trials import Lifted, lift_out, placed, settle
from graspd_core.hands.model import HandModel
from graspd_core.types import Grasp, Posture
from graspd_core.verify.lift_trial import LiftSettings
from graspd_core.verify.world import PROTOCOLS, FreeBody

# As in test_lift_trial.py: a millimetre of squeeze is half a newton.
STANDARD = replace(PROTOCOLS["standard"], slide_stiffness=500.0, slide_damping=10.0)
LIFT = LiftSettings(lift_height=0.25, hold_time=0.5)
HALF = 0.02


@pytest.fixture(scope="module")
def hand(gripper) -> HandModel:
    """The gripper, coming along its fingers."""
    return replace(gripper, approach=np.array([0.0, 0.0, 1.0]))


@pytest.fixture(scope="module")
def block(cube):
    """The cube somewhere, turned about an axis (a scaled axis, [rad])."""
    from scipy.spatial.transform import Rotation

    def build(x: float, y: float, z: float, turn: Sequence[float] = (0.0, 0.0, 0.0)) -> FreeBody:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), (x, y, z)
        return FreeBody(cube, (cube.mesh,), pose)

    return build


def from_above(closing, z: float = 0.0, turned: bool = False) -> Grasp:
    """The gripper straight down about a cube that stands at height z; turned, it points up, away from the cube."""
    good = closing(0.015, 0.025, (0.04, 0.04))
    # The fingers reach 70 mm along +z of the base; half a turn about y lets them come from above, 2 mm off the table.
    quaternion = np.array([1.0, 0.0, 0.0, 0.0]) if turned else np.array([0.0, 0.0, 1.0, 0.0])

    def there(posture: Posture) -> Posture:
        place = np.array([0.0, 0.0, z + (0.13 if turned else 0.072)])
        return replace(posture, position=place, quaternion_wxyz=quaternion)

    return replace(good, pregrasp=there(good.pregrasp), grasp=there(good.grasp), squeeze=there(good.squeeze))


def lifted(hand: HandModel, bodies: Sequence[FreeBody], index: int, grasp: Grasp) -> Lifted:
    return lift_out(hand, bodies, index, grasp, STANDARD, LIFT)


def test_a_pile_settles_on_the_table_the_same_way_every_time(block):
    pile = [block(0.0, 0.005, 0.06, (0.4, 0.2, 0.0)), block(0.01, 0.0, 0.14, (0.1, 0.7, 0.3)), block(0, 0.012, 0.22)]
    poses = settle(pile, wall=0.06)
    assert np.array_equal(poses, settle(pile, wall=0.06))
    rest = settle([replace(body, pose=pose) for body, pose in zip(pile, poses, strict=True)])
    for body, pose in zip(pile, rest, strict=True):
        lowest = placed(replace(body, pose=pose))[0].mesh.vertices[:, 2].min()
        # On the table, on one other or on two.
        assert -0.002 < lowest < 4 * HALF + 0.002
    # What rests goes on resting.
    again = settle([replace(body, pose=pose) for body, pose in zip(pile, rest, strict=True)])
    assert np.allclose(again, rest, atol=1e-3)


def test_nothing_settles_to_nothing():
    assert settle([]) == ()


def test_the_thing_that_is_held_comes_up_and_the_others_stay(hand, block, closing):
    bodies = [block(0.15, 0.1, HALF), block(0.0, 0.0, HALF), block(-0.12, 0.0, HALF)]
    came = lifted(hand, bodies, 1, from_above(closing))
    assert came.result.passed, came.result
    assert came.poses[1][:3, 3] == pytest.approx([0, 0, HALF + LIFT.lift_height], abs=0.01)
    for k in (0, 2):
        assert came.poses[k] == pytest.approx(bodies[k].pose, abs=2e-3)
    assert came.hand is not None
    assert came.hand.position[2] == pytest.approx(0.072 + LIFT.lift_height, abs=1e-6)


def test_a_thing_that_lies_on_another_is_lifted_off_it(hand, block, closing):
    grasp = from_above(closing, z=2 * HALF)
    came = lifted(hand, [block(0, 0, HALF), block(0, 0, 3 * HALF)], 1, grasp)
    assert came.result.passed, came.result
    assert came.poses[0][2, 3] == pytest.approx(HALF, abs=2e-3)


def test_a_grasp_turned_away_fails_and_says_so(hand, block, closing):
    came = lifted(hand, [block(0.0, 0.0, HALF)], 0, from_above(closing, turned=True))
    assert not came.result.passed
    assert came.result.reason.endswith("while lifting")
    assert came.poses[0][2, 3] == pytest.approx(HALF, abs=2e-3)


def test_a_hand_that_would_reach_into_the_table_never_moves(hand, block, closing):
    grasp = from_above(closing)
    low = replace(grasp.grasp, position=grasp.grasp.position - [0, 0, 0.01])
    came = lifted(hand, [block(0.0, 0.0, HALF)], 0, replace(grasp, grasp=low))
    assert "into the support" in came.result.reason
    assert came.hand is None
    assert np.array_equal(came.poses[0], np.array(block(0.0, 0.0, HALF).pose))


def test_a_neighbour_in_the_way_is_pushed(hand, block, closing):
    """The open fingers end at y = ±40 mm: what lies there is hit as they come down, and is moved."""
    bodies = [block(0.0, 0.0, HALF), block(0.0, 0.055, HALF)]
    came = lifted(hand, bodies, 0, from_above(closing))
    assert np.linalg.norm(came.poses[1][:3, 3] - bodies[1].pose[:3, 3]) > 0.005
