"""What a trial refuses before the hand moves: links in each other, and a grasp deep in the object, by name."""
# pyright: reportAttributeAccessIssue=false

from dataclasses import replace

import numpy as np
import pytest

from graspd_core import load_hand, load_scene, plan_grasps, verify_grasps
from graspd_core.hands.self_collision import deepest_overlap
from graspd_core.perception.scene import object_parts
from graspd_core.types import Grasp, Plane, Posture, Verdict
from graspd_core.verify.hold_trial import hold_trial, out_of_place, self_fault, set_hand_pose
from graspd_core.verify.lift_trial import lift_trial
from graspd_core.verify.world import PROTOCOLS, build_world, trial_data

STANDARD = PROTOCOLS["standard"]
SOFT = replace(STANDARD, slide_stiffness=500.0, slide_damping=10.0)


@pytest.fixture(scope="module")
def allegro():
    return load_hand("allegro_right", candidates=64)


@pytest.fixture(scope="module")
def far(allegro, cube):
    """The Allegro hand with nothing in reach."""
    return build_world(allegro, cube, (cube.mesh,), STANDARD)


@pytest.fixture(scope="module")
def posture(allegro):
    """The hand 40 cm from the cube, its first two fingers crossed by an angle [rad]."""

    def posture(angle: float) -> Posture:
        joints = np.array(allegro.open_posture)
        joints[allegro.joint_names.index("joint_0.0")] = angle
        joints[allegro.joint_names.index("joint_4.0")] = -angle
        return Posture(np.array([0.4, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), joints)

    return posture


@pytest.mark.parametrize("where", ["pregrasp", "grasp"])
def test_crossed_fingers_are_refused_by_name(far, posture, where):
    clear = Grasp(posture(0.0), posture(0.0), posture(0.0), (), 0.0)
    crossed = replace(clear, **{where: posture(-0.47)})
    hold = hold_trial(far, crossed, STANDARD)
    assert not hold.passed
    assert hold.reason.startswith(f"the {where} puts link_")
    assert " mm into link_" in hold.reason
    # Out of place a hand is as deep in itself.
    assert hold_trial(far, crossed, out_of_place(STANDARD)).reason == hold.reason
    assert " puts " not in hold_trial(far, clear, STANDARD).reason


def test_all_ways_in_refuse_crossed_fingers(allegro, cube, posture):
    crossed = Grasp(posture(0.0), posture(-0.47), posture(0.0), (), 0.0)
    (tried,) = verify_grasps(load_scene("shape:box", resolution=16), allegro, [crossed], measure=False)
    assert tried.verdict is Verdict.FAILED
    assert tried.reason.startswith("the grasp puts link_")
    table = Plane(np.array([0.0, 0.0, 1.0]), -1.0)
    lift = lift_trial(build_world(allegro, cube, (cube.mesh,), STANDARD, table), allegro, crossed, STANDARD)
    assert lift.reason == tried.reason


@pytest.mark.parametrize("where", ["pregrasp", "grasp"])
def test_a_joint_beyond_its_limit_is_refused_by_name(allegro, posture, where):
    clear = Grasp(posture(0.0), posture(0.0), posture(0.0), (), 0.0)
    for angle, refused in ((allegro.upper[0] + 5e-4, False), (allegro.upper[0] + 0.05, True)):
        joints = np.array(clear.grasp.joint_positions)
        joints[0] = angle
        bent = replace(clear, **{where: replace(clear.grasp, joint_positions=joints)})
        (tried,) = verify_grasps(load_scene("shape:box", resolution=16), allegro, [bent], measure=False)
        told = f"the {where} puts joint {allegro.joint_names[0]!r} 0.05 rad or m beyond its limit"
        assert (tried.reason == told) == refused


def test_a_squeeze_that_ends_in_the_hand_is_refused(far, posture):
    clear = posture(0.0)
    grasp = Grasp(clear, clear, posture(-0.47), (), 0.0)
    # Contacts keep the fingers about where they meet: nothing to refuse, unless less is allowed than contacts give.
    assert " puts " not in hold_trial(far, grasp, STANDARD).reason
    strict = replace(STANDARD, max_self_penetration=1e-5)
    assert hold_trial(far, grasp, strict).reason.startswith("the squeeze puts link_")


def test_a_grasp_six_millimetres_deep_is_refused(gripper, cube, closing):
    world = build_world(gripper, cube, (cube.mesh,), SOFT)
    deep = closing(0.015, 0.031, (0.04, 0.04))
    assert hold_trial(world, deep, SOFT).reason == "the grasp penetrates the object by 6.0 mm"
    # Deep in a thing that is not where it was: fingers stop at its surface.
    assert hold_trial(world, deep, out_of_place(SOFT)).passed
    assert hold_trial(world, closing(0.015, 0.0295, (0.04, 0.04)), SOFT).passed


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["box", "bowl"])
@pytest.mark.parametrize("name", ["allegro_left", "allegro_right", "barrett_like", "leap_right", "parallel_gripper"])
def test_no_verified_grasp_is_in_itself(name, shape):
    hand, scene = load_hand(name), load_scene(f"shape:{shape}")
    result = plan_grasps(scene, hand, count=8, measure=False)
    verified = [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED]
    world = build_world(hand, scene.object, object_parts(scene.object), STANDARD)
    for grasp in verified:
        at = np.stack([grasp.pregrasp.joint_positions, grasp.grasp.joint_positions])
        assert (deepest_overlap(hand, at) <= STANDARD.max_self_penetration).all()
        with trial_data(world) as data:
            import mujoco

            for one in (grasp.pregrasp, grasp.grasp):
                set_hand_pose(world, data, one)
                mujoco.mj_forward(world.model, data)
                assert self_fault(world, data, STANDARD) == ""
