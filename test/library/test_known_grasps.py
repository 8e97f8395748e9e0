"""What a library has of an object, in the scene that it is in now."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd_core import GraspResult, HandModel, Outcome, Scene, Steering, TriangleMesh, Verdict, load_hand, load_scene
from graspd_core.errors import ConfigError, FormatError, MeshError
from graspd_core.library import known_grasps as module
from graspd_core.library.grasp_library import GraspLibrary
from graspd_core.library.known_grasps import (
    NEAR,
    Physics,
    add_planned,
    clearance,
    entry_by_file,
    entry_by_name,
    known_grasps,
    known_or_planned,
)
from graspd_core.mesh.mesh_files import save_mesh
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.plan_config import load_preset
from graspd_core.planning.steering import angle_of_approach
from graspd_core.types import Plane
from graspd_core.verify.trial_registry import grasp_trials

PHYSICS = Physics(mass=0.1, friction=0.6)


def test_a_known_object_alone_is_answered_without_a_trial(library, scene, hand, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "grasp_trials", None)
    monkeypatch.setattr(module, "plan_grasps", None)
    result = known_or_planned(library, scene, hand, count=4)
    assert result.outcome is Outcome.SUCCEEDED
    assert [grasp.verdict for grasp in result.grasps] == [Verdict.VERIFIED] * 4
    assert "4 grasps of the library known.grasps" in result.message


def test_an_object_that_is_not_there_has_none(library: GraspLibrary, hand: HandModel):
    for other in (load_scene("shape:box"), load_scene("shape:sphere", scale=1.1), load_scene("shape:sphere", mass=0.3)):
        result = known_grasps(library, other, hand)
        assert (result.outcome, result.grasps) == (Outcome.NO_CANDIDATES, ())


def test_what_is_missing_is_planned_and_added(library: GraspLibrary, scene: Scene, hand: HandModel):
    result = known_or_planned(library, scene, hand, count=6, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
    assert "4 grasps of the library known.grasps, 2 planned" in result.message
    ((_, count),) = library.entries()
    assert count == 6
    assert len(known_grasps(library, scene, hand, count=6).grasps) == 6


def test_a_library_that_cannot_be_written_costs_no_grasp(library, scene, hand, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> int:
        raise FormatError("known.grasps: the library cannot be used: disk is full")

    monkeypatch.setattr(GraspLibrary, "add", refuse)
    result = known_or_planned(library, scene, hand, count=5, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
    assert result.warnings[-1] == "known.grasps: the library cannot be used: disk is full; what was planned is not kept"


def test_restrictions_are_kept(library: GraspLibrary, scene: Scene, hand: HandModel, planned: GraspResult):
    first = planned.grasps[0]
    direction = np.array([0.0, 0.0, 1.0])
    angles = [angle_of_approach(hand, grasp, direction) for grasp in planned.grasps[:4]]
    # A cone that some of the four lie in and others do not.
    cone = Steering(approach_direction=(0, 0, 1), approach_angle=(min(angles) + max(angles)) / 2)
    result = known_grasps(library, scene, hand, count=4, restrictions=[cone])
    assert 0 < len(result.grasps) < 4
    assert sum(result.refused.values()) == 4 - len(result.grasps)
    assert "outside the approach cone" in result.message
    more = known_or_planned(library, scene, hand, count=4, restrictions=[cone], preset="fast")
    assert more.outcome is Outcome.SUCCEEDED
    assert all(angle_of_approach(hand, grasp, direction) <= cone.approach_angle + 1e-6 for grasp in more.grasps)
    assert known_grasps(library, scene, hand, count=1, wanted=lambda found: found[1:]).grasps[0] is not first


def at_height(scene: Scene, hand: HandModel, grasps: GraspResult, gap: float) -> Scene:
    """The scene with a support so far [m] below the lowest point of the first grasp's way."""
    low = float(scene.object.mesh.vertices[:, 2].min()) - 1.0
    floor = replace(scene, support=Plane(np.array([0.0, 0.0, 1.0]), low))
    lift = float(clearance(floor, hand, grasps.grasps[:1])[0]) - gap
    return replace(scene, support=Plane(np.array([0.0, 0.0, 1.0]), low + lift))


def test_only_what_comes_near_something_is_tried_again(
    library: GraspLibrary, scene: Scene, hand: HandModel, planned: GraspResult, monkeypatch: pytest.MonkeyPatch
):
    tried = []
    real = grasp_trials
    monkeypatch.setattr(module, "grasp_trials", lambda *given: tried.append(1) or real(*given))
    for gap in (0.25, 0.01, -0.03):
        tried.clear()
        about = at_height(scene, hand, planned, gap)
        gaps = clearance(about, hand, planned.grasps[:4])
        assert gaps[0] == pytest.approx(gap, abs=1e-6)
        result = known_grasps(library, about, hand, count=4)
        assert len(tried) == int(((gaps < NEAR) & (gaps >= -0.005)).sum())
        inside = int((gaps < -0.005).sum())
        assert result.refused.get("with a link in what stands about the object", 0) == inside
        assert len(result.grasps) + sum(result.refused.values()) == 4
        # What was tried again has the trial of the scene too.
        assert {len(grasp.trials) for grasp in result.grasps} <= {1, 2}
        assert sum(len(grasp.trials) == 2 for grasp in result.grasps) <= len(tried)


def test_what_was_planned_on_a_table_is_kept_as_a_grasp_of_the_object_alone(library, scene, hand, planned):
    about = at_height(scene, hand, planned, 0.1)
    lifted = replace(planned.grasps[0].trials[0], name="lift")
    both = replace(planned.grasps[0], trials=(*planned.grasps[0].trials, lifted))
    assert add_planned(library, about, hand, load_preset("fast"), [both], "standard") == 5
    ((entry, _),) = library.entries()
    assert [trial.name for trial in library.grasps(entry, hand)[-1].trials] == ["hold"]


@pytest.fixture
def ball(library: GraspLibrary, hand: HandModel, planned: GraspResult, tmp_path: Path) -> Path:
    """A mesh file that the library knows."""
    path = tmp_path / "ball.obj"
    save_mesh(make_shape("sphere"), path)
    add_planned(library, load_scene(path), hand, load_preset("fast"), planned.grasps, "standard")
    return path


def test_an_object_is_found_by_name_and_by_file(library: GraspLibrary, hand: HandModel, ball: Path, tmp_path: Path):
    by_name = entry_by_name(library, hand, "ball", PHYSICS)
    assert entry_by_file(library, hand, ball, 1.0, PHYSICS) == by_name
    # Whatever the file is called, and with the only mass that there is.
    copy = tmp_path / "copy.obj"
    copy.write_bytes(ball.read_bytes())
    assert entry_by_file(library, hand, copy, 1.0, PHYSICS) == by_name
    assert entry_by_name(library, hand, "ball", Physics(0.5, 0.6)) == by_name
    assert entry_by_file(library, hand, ball, 1.1, PHYSICS, required=False) is None


@pytest.mark.parametrize(
    ("look", "error", "told"),
    [
        (lambda library, hand, ball: entry_by_name(library, hand, "bal", PHYSICS), ConfigError, "it has ball"),
        (
            lambda library, hand, ball: entry_by_name(library, load_hand("leap_right"), "ball", PHYSICS),
            ConfigError,
            "for allegro_right, not for leap_right",
        ),
        (
            lambda library, hand, ball: entry_by_name(library, hand, "ball", Physics(0.1, 0.6, "hard")),
            ConfigError,
            "it has 0.1 kg, friction 0.6, standard trials",
        ),
        (
            lambda library, hand, ball: entry_by_file(library, hand, ball, 0.5, PHYSICS),
            ConfigError,
            "ball.obj: not at scale 0.5 in the library",
        ),
        (
            lambda library, hand, ball: entry_by_file(library, hand, "shape:mug", 1.0, PHYSICS),
            ConfigError,
            "shape:mug: its mesh is not in the library",
        ),
    ],
)
def test_what_the_library_lacks_is_named_with_what_it_has(library, hand, ball, look, error, told):
    with pytest.raises(error, match=re.escape(told)):
        look(library, hand, ball)


def test_a_mesh_that_changed_is_told(library: GraspLibrary, hand: HandModel, ball: Path):
    mesh = make_shape("sphere")
    save_mesh(TriangleMesh(mesh.vertices * 1.2, mesh.faces), ball)
    for look in (
        lambda: entry_by_name(library, hand, "ball", PHYSICS),
        lambda: entry_by_file(library, hand, ball, 1.0, PHYSICS),
    ):
        with pytest.raises(MeshError, match=r"ball\.obj: the mesh has changed since ball came into the library"):
            look()


def test_two_objects_of_one_name_are_told(library, hand, ball, planned, tmp_path: Path):
    other = tmp_path / "other" / "ball.obj"
    other.parent.mkdir()
    save_mesh(make_shape("box"), other)
    add_planned(library, load_scene(other), hand, load_preset("fast"), planned.grasps, "standard")
    with pytest.raises(ConfigError, match=r"ball: the library .* has several: .*ball\.obj, .*ball\.obj; name the mesh"):
        entry_by_name(library, hand, "ball", PHYSICS)
