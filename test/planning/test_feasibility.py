"""What a hand cannot hold anywhere is told at once; what it might hold is never refused."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from made_meshes import box_of

from graspd_core import Scene, hand_names, load_hand, load_preset, load_scene, override, plan_grasps
from graspd_core.mesh.shapes import SHAPES, make_shape
from graspd_core.planning.feasibility import out_of_reach, reach_of, why_trials_failed
from graspd_core.types import Contact, Outcome, Plane, Stage, TrialResult, TriangleMesh, Verdict, joined


def scene_of(*meshes: TriangleMesh, friction: float = 0.6) -> Scene:
    return load_scene(joined(*meshes), resolution=8, friction=friction)


def crate(wall: float) -> tuple[TriangleMesh, ...]:
    """A cube of 1.2 m, open above."""
    half = 0.6
    sides = [((wall, half, half), (x, 0.0, 0.0)) for x in (-half, half)]
    sides += [((half, wall, half), (0.0, y, 0.0)) for y in (-half, half)]
    return tuple(box_of(*side) for side in (*sides, ((half, half, wall), (0.0, 0.0, -half))))


HOLDABLE = {
    "rod": (box_of((0.6, 0.012, 0.012)),),
    "board": (box_of((0.6, 0.6, 0.008)),),
    "open crate": crate(0.005),
    "cube with a handle": (box_of((0.5, 0.5, 0.5)), box_of((0.01, 0.06, 0.03), (0.53, 0.0, 0.0))),
}


@pytest.fixture(scope="module")
def holdable() -> dict[str, Scene]:
    """Shapes, what has an edge, and objects as large and as small as scans are."""
    shapes = {shape: load_scene(f"shape:{shape}", resolution=8) for shape in SHAPES}
    scans = {f"ball x{scale}": load_scene("shape:sphere", scale=scale, resolution=8) for scale in (0.1, 0.5, 2.0, 3.0)}
    return {**shapes, **scans, **{about: scene_of(*meshes) for about, meshes in HOLDABLE.items()}}


@pytest.mark.parametrize("name", hand_names())
def test_no_hand_refuses_what_it_might_hold(name: str, holdable):
    hand = load_hand(name, candidates=120)
    for about, scene in holdable.items():
        assert out_of_reach(scene, hand) == "", about


def test_a_small_knob_on_a_cabinet_of_many_faces_is_found(holdable):
    """Ten of 16394 faces, and a four thousandth of the surface; the knob is open where it sits."""
    whole, knob = box_of((0.99, 0.99, 0.99)), trimesh.creation.box((0.02, 0.02, 0.02))
    fine = trimesh.Trimesh(whole.vertices, whole.faces, process=False).subdivide().subdivide()
    outer = knob.faces[(knob.vertices[knob.faces, 0] > -0.009).any(1)] + len(fine.vertices)
    corners = np.add(knob.vertices, (1.0, 0.3, 0.2))
    mesh = TriangleMesh(np.vstack([fine.vertices, corners]), np.vstack([fine.faces, outer]))
    scene = replace(holdable["rod"], object=replace(holdable["rod"].object, mesh=mesh))
    assert len(outer) == 10
    assert out_of_reach(scene, load_hand("parallel_gripper", candidates=120)) == ""


@pytest.mark.parametrize("friction", [0.1, 0.6, 1.5])
def test_a_crate_beyond_the_hand_is_refused_with_both_sizes(hand, friction: float):
    said = out_of_reach(scene_of(box_of((0.6, 0.6, 0.6)), friction=friction), hand)
    assert "120 cm across" in said
    assert "fingertips of allegro_right open to" in said


def test_the_corner_of_a_crate_is_refused_up_to_the_friction_that_would_hold_it(hand, monkeypatch: pytest.MonkeyPatch):
    """The normals of a corner lie arccos(1/√3) = 54.7° about its diagonal: friction of tan(35.3°) = 0.707 closes it."""
    monkeypatch.setattr("graspd_core.planning.feasibility._MOST_FRICTION", 10.0)
    assert out_of_reach(scene_of(box_of((0.6, 0.6, 0.6)), friction=0.65), hand)
    assert not out_of_reach(scene_of(box_of((0.6, 0.6, 0.6)), friction=0.75), hand)


def test_a_jaw_opens_as_wide_as_its_description_says():
    span, opening = reach_of(load_hand("parallel_gripper", candidates=120))
    # Two jaws of 70 mm stroke; their pads stand 5 mm into the gap.
    assert opening == pytest.approx(0.13, abs=0.002)
    assert opening < span < 0.25


def test_a_ball_of_70_cm_ends_the_run_before_its_first_step(hand):
    scene = load_scene("shape:sphere", scale=10.0, resolution=16)
    told: list[Stage] = []
    result = plan_grasps(scene, hand, count=2, progress=lambda report: told.append(report.stage))
    assert told == [Stage.DONE]
    assert (result.outcome, result.tried) == (Outcome.NO_CANDIDATES, ())
    assert "70 cm across" in result.message


@pytest.fixture(scope="module")
def card_on_table() -> Scene:
    return replace(scene_of(box_of((0.043, 0.027, 0.001))), support=Plane(np.array([0.0, 0.0, 1.0]), -0.001))


def test_what_is_too_low_for_the_fingers_is_told_with_what_became_of_the_trials(hand, card_on_table):
    one_round = override(load_preset("fast"), {"rounds.most": 1})
    result = plan_grasps(card_on_table, hand, count=2, preset=one_round, measure=False)
    assert result.outcome is Outcome.TOO_FEW
    assert not any(grasp.verdict is Verdict.VERIFIED for grasp in result.tried)
    assert result.message.startswith(f"{len(result.tried)} grasps failed their trials: the object ")
    assert "; the object is 2 mm high on its support" in result.message


def test_reasons_are_told_without_numbers_the_most_frequent_first(hand, card_on_table):
    [held] = plan_grasps(scene_of(make_shape("sphere")), hand, count=1, preset="fast", measure=False).tried[:1]
    reasons = (
        "the object turned 15° under a pull along +x",
        "the object turned 132° under a pull along -y",
        "the object moved 3.0 cm while closing",
        "the pregrasp penetrates the object by 11.4 mm",
        "the pregrasp penetrates the object by 2.0 mm",
        "the pregrasp penetrates the object by 7.1 mm",
    )
    failed = [replace(held, trials=(TrialResult("hold", False, 0.0, 0.0, why),)) for why in reasons]
    told = "6 grasps failed their trials: the pregrasp penetrates the object (3), the object turned under a pull (2), "
    free = scene_of(make_shape("sphere"))
    assert why_trials_failed(free, [held, *failed]) == told + "the object moved while closing (1)"
    assert why_trials_failed(free, [held]) == ""
    own = TrialResult("hold", False, 0.0, 0.0, "the pregrasp puts finger3_link2 2.4 mm into palm_1")
    assert "puts finger3_link2 into palm_1 (1)" in why_trials_failed(free, [replace(held, trials=(own,))])
    # Only what is low and pressed from above is called so.
    aside = [replace(one, contacts=(Contact("tip", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),)) for one in failed]
    assert "support" not in why_trials_failed(card_on_table, aside)
    above = [replace(one, contacts=(Contact("tip", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),)) for one in failed]
    assert "2 mm high on its support" in why_trials_failed(card_on_table, above)
    tall = replace(card_on_table, support=Plane(np.array([0.0, 0.0, 1.0]), -0.2))
    assert "support" not in why_trials_failed(tall, above)
