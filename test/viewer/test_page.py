"""The page in a real browser: grasps are chosen, the hand moves, trials play, and what visitors do breaks nothing."""

from __future__ import annotations

import re
import threading
from pathlib import Path

import numpy as np
import pytest

from graspd_core.hands.library import load_hand
from graspd_core.mesh.shapes import make_shape
from graspd_core.planning.steering import angle_of_approach
from graspd_core.types import TriangleMesh
from graspd_viewer.drawing import OBJECT, Part
from graspd_viewer.scene_nodes import PER_METRE
from graspd_viewer.session import open_grasps


def places(viewer) -> np.ndarray:
    """Where the links of the hand are [m]."""
    return np.array([node.position for node in viewer._nodes._links.values()]) / PER_METRE


def unlike(one: np.ndarray, other: np.ndarray) -> float:
    """Share of pixels that differ by more than a shade."""
    return float((np.abs(one - other).max(-1) > 16).mean())


@pytest.fixture
def page(viewer, visit, grasps_file):
    viewer.show(open_grasps(grasps_file))
    page = visit(viewer.url)
    page.text("grasps.json")
    page.text("#0 verified")
    return page


def test_the_tab_names_what_is_shown_and_the_legend_every_arrow(page):
    page.until(lambda: page.tab.title() == "shape:box, parallel_gripper - graspd")
    for arrow in ("normal at a contact", "force, 4 mm for a newton", "weakest push", "axis of its turn"):
        page.text(arrow)


def test_a_grasp_is_chosen_and_said(page, viewer):
    before = places(viewer)
    page.choose("Grasp", "✗ #3 failed, 3 contacts")
    page.text("the object moved")
    page.until(lambda: np.abs(places(viewer) - before).max() > 0.05)


def test_the_scrubber_moves_the_hand(page, viewer):
    page.tab.wait_for_timeout(1500)
    at_grasp, seen = places(viewer), page.picture()
    assert unlike(page.picture(), seen) < 0.01
    page.set("Way", 0)
    page.until(lambda: np.abs(places(viewer) - at_grasp).max() > 0.09)
    page.until(lambda: unlike(page.picture(), seen) > 0.05)
    page.set("Way", 2)
    page.until(lambda: places(viewer) == pytest.approx(at_grasp))
    page.until(lambda: unlike(page.picture(), seen) < 0.01)
    # A flood of changes ends where the last one is.
    for value in np.linspace(0, 3, 25):
        page.widget("Way").fill(f"{value:.2f}")
    page.set("Way", 2)
    page.until(lambda: places(viewer) == pytest.approx(at_grasp))


def test_a_dragged_hand_goes_half_way_first(page, viewer):
    ways: list[float] = []
    tab, draw = viewer._grasps, viewer._grasps.draw_pose

    def drawn(at: float | None = None) -> None:
        draw(at)
        ways.append(tab._at)

    tab.draw_pose = drawn
    page.set("Way", 0)
    page.until(lambda: 0.0 in ways)
    assert ways[:2] == [1.0, 0.0]


def test_closed_bodies_are_drawn_from_outside_and_open_ones_from_both_sides(page, viewer):
    box, nodes = make_shape("box"), viewer._nodes
    nodes.draw("object", [Part("closed", box, OBJECT), Part("open", TriangleMesh(box.vertices, box.faces[1:]), OBJECT)])
    assert [node.side for node in nodes._groups["object"]] == ["front", "double"]
    # Shades by facet, and fewer of them, for the hand.
    assert all(node.material == "toon5" and len(node.vertices) == node.faces.size for node in nodes._links.values())
    # The panel stands beside the scene.
    page.until(lambda: page.tab.locator("canvas").first.bounding_box()["width"] < 600)


def test_the_empty_background_of_the_page_is_not_drawn(page):
    """It is the one opaque mesh of the page that has a shader of its own, and costs a software browser every pixel."""
    near, away = page.tab.evaluate("""() => {
      const {scene, camera} = window.__viserMutable, found = [];
      scene.traverse(o => o.material?.type === "ShaderMaterial" && !o.material.transparent && found.push(o));
      return [camera.near, found.map(o => camera.position.distanceTo(o.position))];
    }""")
    assert len(away) == 1
    assert away[0] < near < 0.015 * PER_METRE


def test_keys_go_to_the_next_grasp_and_back_and_the_list_is_filtered_and_sorted(page):
    page.key("n")
    page.text("#1 verified")
    page.key("p")
    page.text("#0 verified")
    page.key("p")
    page.text("#3 failed")
    page.choose("Show", "failed")
    page.text("1 of 1 shown (3 verified, 1 failed)")
    page.choose("Show", "unverified")
    page.text("no grasp passes this filter")
    page.choose("Show", "all")
    page.choose("Sort by", "epsilon")
    page.text("1 of 4 shown")


def test_a_failed_trial_is_replayed_to_its_reason(page, viewer):
    page.choose("Show", "failed")
    page.text("1 of 1 shown")
    page.press("Run and play")
    page.text(re.compile(r"failed at \d+\.\d\d s: the object moved .* under a pull along"))
    page.until(lambda: np.linalg.norm(viewer._nodes._object.position) > 0.04 * PER_METRE)
    page.set("Way", 1)
    page.until(lambda: np.linalg.norm(viewer._nodes._object.position) == 0)


def test_a_second_visitor_sees_the_same_and_one_that_leaves_stops_nothing(page, viewer, visit):
    second = visit(viewer.url)
    second.text("#0 verified")
    page.key("n")
    second.text("#1 verified")
    page.tab.reload()
    page.text("#1 verified")
    second.tab.close()
    page.key("n")
    page.text("#2 verified")


def angles_from_y(viewer, folder: Path) -> list[float]:
    """Of the grasps that can be saved, to a hand that comes from +y [degrees]; -1 where there is none."""
    if viewer._planner._saved is None:
        return [-1.0]
    (folder / "grasps.json").write_bytes(viewer._planner._saved)
    hand, grasps = load_hand("parallel_gripper"), open_grasps(folder / "grasps.json").grasps
    return [np.degrees(angle_of_approach(hand, grasp, np.array([0.0, -1.0, 0.0]))) for grasp in grasps] or [-1.0]


def test_plans_are_made_stopped_and_saved(viewer, visit, tmp_path):
    page = visit(viewer.url)
    page.tab.get_by_role("tab", name="Plan").click()
    page.choose("Hand", "parallel_gripper")
    page.choose("Object", "box")
    page.set("Grasps", 2)
    page.press("Plan")
    page.text("2 of 2 grasps")
    with page.tab.expect_download() as saved:
        page.press("Save grasps.json")
    assert '"graspd/grasps"' in saved.value.path().read_text()
    page.choose("The hand comes from", "+y")
    page.set("Within [°]", 20)
    page.press("Plan")
    page.until(lambda: 0 < max(angles_from_y(viewer, tmp_path)) < 20.01)
    page.choose("The hand comes from", "any side")
    page.choose("Preset", "accurate")
    page.set("Grasps", 64)
    page.press("Plan")
    page.text(re.compile(r"searching \d+ of \d+"))
    page.press("Stop")
    page.text("the caller cancelled the run")


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("notes.txt", b"hello", "notes.txt: unknown ending; valid endings"),
        ("cut.stl", b"solid x\nfacet", "refused: cut.stl"),
        ("<b>x.obj", b"nothing", "refused: <b>x.obj"),
    ],
)
def test_a_bad_file_is_refused_with_its_reason(viewer, visit, name: str, content: bytes, reason: str):
    page = visit(viewer.url)
    page.tab.get_by_role("tab", name="Plan").click()
    with page.tab.expect_file_chooser() as chooser:
        page.press("Send a mesh or a cloud")
    chooser.value.set_files([{"name": name, "mimeType": "application/octet-stream", "buffer": content}])
    if not name.endswith("txt"):
        page.text("press Plan")
        page.press("Plan")
    page.text(reason)


def test_a_page_that_is_closed_leaves_no_thread_behind(visit):
    from graspd_viewer.viewer import Viewer

    before = set(threading.enumerate())
    viewer = Viewer(port=0)
    page = visit(viewer.url)
    page.tab.get_by_role("tab", name="Plan").click()
    page.press("Plan")
    page.text(re.compile(r"loading|searching|trying"))
    viewer.close()
    page.errors.clear()  # of the connection that is gone
    page.until(lambda: not [t for t in set(threading.enumerate()) - before if not t.name.startswith("graspd-parts")])
