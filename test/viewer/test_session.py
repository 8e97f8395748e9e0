"""What a grasps file comes to: its grasps in any case, its hand and its object where they can be had."""

from __future__ import annotations

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from expected import some

from graspd_core.errors import FormatError, HandError, MeshError
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.types import ROBUSTNESS, Snapshot, TrialResult, Verdict
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_viewer.drawing import (
    placed_links,
    posture_at,
    sdf_slice,
    skeletons,
    slice_axes,
    squeeze_parts,
    weakest_push,
)
from graspd_viewer.grasp_list import figures_html, label, listed, table_html
from graspd_viewer.live_view import LiveView
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import LatestJobs
from graspd_viewer.session import make_session, open_grasps


def changed(grasps_file, tmp_path, **changes):
    """The file with other values, by section and key."""
    document = json.loads(grasps_file.read_text())
    for section, values in changes.items():
        document[section].update(values)
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(document))
    return path


def test_a_file_gives_what_was_saved(grasps_file, result):
    session = open_grasps(grasps_file)
    assert session.hand.name == "parallel_gripper"
    assert [g.verdict for g in session.grasps] == [g.verdict for g in result.tried]
    assert session.scene is not None
    assert session.notes == result.warnings
    assert "no mass was given" in session.notes[0]


def test_what_was_tried_at_less_mass_is_shown_at_that_mass(grasps_file):
    heavy = open_grasps(grasps_file)
    lighter = make_session("", heavy.hand, (), some(heavy.scene), PlanConfig(), heavy.seen, (), mass=0.1)
    assert some(lighter.scene).object.mass == 0.1 < some(heavy.scene).object.mass


def test_an_object_that_is_gone_or_another_is_said(grasps_file, tmp_path):
    gone = open_grasps(changed(grasps_file, tmp_path, object={"source": "gone.obj"}))
    assert gone.scene is None
    assert "gone.obj" in gone.notes[0]
    assert len(gone.grasps) == 4
    other = open_grasps(grasps_file, object_source="shape:mug")
    assert "planned on another object than 'shape:mug'" in other.notes[0]
    with pytest.raises(MeshError, match="cube"):
        open_grasps(grasps_file, object_source="shape:cube")


def test_a_hand_that_does_not_fit_is_refused(grasps_file, tmp_path):
    with pytest.raises(FormatError, match="its joints are not those of allegro_right"):
        open_grasps(grasps_file, hand="allegro_right")
    # A hand description with `root` begins the hand at a later link than its URDF.
    with pytest.raises(FormatError, match="of link 'palm', but the base link of parallel_gripper is 'base_link'"):
        open_grasps(changed(grasps_file, tmp_path, hand={"base_link": "palm"}))
    strange = {"name": "mine", "urdf": "gone.urdf"}
    with pytest.raises(HandError, match=r"gone\.urdf"):
        open_grasps(changed(grasps_file, tmp_path, hand=strange))


def test_the_list_is_filtered_and_sorted_and_escaped(result):
    grasps = result.tried
    assert listed(grasps, "all", "rank") == [0, 1, 2, 3]
    assert listed(grasps, "failed", "rank") == [3]
    by_epsilon = listed(grasps, "all", "epsilon")
    values = [grasps[rank].metrics["epsilon"] for rank in by_epsilon[:-1]]
    assert values == sorted(values, reverse=True)
    assert by_epsilon[-1] == 3  # it was not measured
    assert listed(grasps, "<forged>", "<forged>") == [0, 1, 2, 3]
    assert "3 verified, 1 failed" in table_html(grasps, [0, 1, 2, 3], 1)
    bad = grasps[3]
    trial = type(bad.trials[0])("<script>", False, 0.1, 0.1, "<img src=x>")
    shown = figures_html(type(bad)(**{**vars(bad), "trials": (trial,)}), 3)
    assert "<img" not in shown
    assert "<script" not in shown


def test_a_grasp_that_is_less_sure_is_said_with_its_probability(result):
    held = result.tried[0]
    under = TrialResult(ROBUSTNESS, False, 0.1, 0.1, "fails with 2 of the 5 hypotheses tried")
    less = replace(held, trials=(*held.trials, under), probability=0.75)
    sure, untried = replace(held, probability=0.97), replace(held, trials=())
    grasps = (less, sure, untried, result.tried[3])
    assert label(less, 0).startswith("~ #0 less sure, 75 %, ")
    assert label(sure, 1).startswith("✓ #1 verified, 97 %, ")
    assert "%" not in label(untried, 2)
    assert "unverified" in label(untried, 2)
    assert [listed(grasps, which, "rank") for which in ("less sure", "unverified", "verified")] == [[0], [2], [1]]
    assert listed(grasps, "all", "probability") == [1, 0, 2, 3]
    table = table_html(grasps, [0, 1, 2, 3], 0)
    assert "1 verified, 1 less sure, 1 unverified, 1 failed" in table
    assert table.count(" %</td>") == 2
    figures = figures_html(less, 0)
    assert "probability <b>75 %</b>" in figures
    assert "fails with 2 of the 5" in figures
    assert "probability" not in figures_html(untried, 2)


def test_the_way_goes_through_its_stages(grasps_file):
    session = open_grasps(grasps_file)
    hand, grasp = session.hand, session.grasps[0]
    for at, stage in ((1.0, grasp.pregrasp), (2.0, grasp.grasp), (3.0, grasp.squeeze), (9.0, grasp.squeeze)):
        posture = posture_at(hand, grasp, at)
        assert posture.position == pytest.approx(stage.position)
        assert posture.joint_positions == pytest.approx(stage.joint_positions)
    assert np.linalg.norm(posture_at(hand, grasp, 0.0).position - grasp.pregrasp.position) == pytest.approx(0.1)
    # Bones end where links are.
    position, quaternion, joints = vars(grasp.grasp).values()
    bones = skeletons(hand, Snapshot(position[None], quaternion[None], joints[None]))
    positions, _ = placed_links(hand, grasp.grasp)
    assert bones[0, :, 1] == pytest.approx(positions[hand.link_parent >= 0], abs=1e-5)


def test_the_arrows_of_a_squeeze_end_at_its_contacts_and_the_weakest_push_is_a_unit(grasps_file):
    session = open_grasps(grasps_file)
    grasp = session.grasps[0]
    forces = np.array([contact.force for contact in grasp.contacts])
    strength = np.linalg.norm(forces, axis=1).sum()
    assert strength > max(1.0, 10 * np.linalg.norm(forces.sum(0)))
    assert ((forces * [contact.normal for contact in grasp.contacts]).sum(1) < 0).all()
    (arrows,) = squeeze_parts(grasp.contacts)
    gaps = [np.linalg.norm(arrows.mesh.vertices - contact.position, axis=1).min() for contact in grasp.contacts]
    assert max(gaps) < 1e-6
    assert not squeeze_parts([replace(contact, force=None) for contact in grasp.contacts])
    assert session.scene is not None
    context = make_metrics_context(session.scene.object, session.hand)
    push = weakest_push(context, grasp)
    assert push is not None
    assert np.linalg.norm(push) == pytest.approx(1.0)
    assert weakest_push(context, session.grasps[3]) is None  # that hand touches nothing


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slice_is_blue_inside_and_red_outside(grasps_file, axis):
    scene = open_grasps(grasps_file).scene
    assert scene is not None
    image, middle = sdf_slice(scene, axis, 0.5)
    assert middle == pytest.approx(np.zeros(3), abs=1e-3)
    rows, columns, _ = image.shape
    red, _, blue = image[rows // 2, columns // 2].astype(int)
    assert blue > red + 30
    red, _, blue = image[0, 0].astype(int)
    assert red > blue + 30
    assert {axis, *slice_axes(axis)} == {0, 1, 2}


def test_of_each_kind_the_newest_job_is_done_and_a_fault_ends_nothing():
    done, failed, gate = [], [], threading.Event()
    jobs = LatestJobs(failed.append)
    jobs.submit("gate", lambda: gate.wait(20))
    jobs.submit("fault", lambda: 1 / 0)
    for number in range(100):
        jobs.submit("draw", lambda number=number: done.append(number))
    jobs.submit("dropped", lambda: done.append(-1), after=0.01)
    jobs.drop("dropped")
    ended = threading.Event()
    jobs.submit("last", ended.set, after=0.05)
    gate.set()
    assert ended.wait(20)
    jobs.close()
    assert done == [99]
    assert [type(error) for error in failed] == [ZeroDivisionError]


def test_a_live_view_draws_five_times_a_second_at_most_and_the_last_state(grasps_file):
    session = open_grasps(grasps_file)
    drawn: list[tuple[int, np.ndarray]] = []

    class Nodes(SceneNodes):
        def __init__(self):
            pass

        def draw_lines(self, lines, colours):
            drawn.append((len(lines), colours))

        def show_hand(self, visible):
            pass

    jobs = LatestJobs(lambda error: pytest.fail(str(error)))
    live = LiveView(jobs, Nodes(), lambda line, share: None)
    live.begin(session)
    grasp = session.grasps[0].grasp
    rows = [np.repeat(row[None], 3, 0) for row in (grasp.position, grasp.quaternion_wxyz, grasp.joint_positions)]
    for count in range(50):
        live.watch(
            Snapshot(*rows, verdicts=(Verdict.VERIFIED, Verdict.FAILED, Verdict.UNVERIFIED) if count == 49 else ())
        )
    ended = threading.Event()
    jobs.submit("last", ended.set, after=0.3)
    assert ended.wait(20)
    jobs.close()
    assert 1 <= len(drawn) <= 3
    bones = session.hand.num_links - 1
    assert drawn[-1][0] == 3 * bones
    green, red, grey = drawn[-1][1][::bones]
    assert green[1] > green[0]
    assert red[0] > red[1]
    assert np.ptp(grey) < 0.1
