"""A library of grasps: what goes in comes out, after a kill or a write; what it has of an object in its scene."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from expected import refused

from graspd_core import (
    GraspResult,
    HandModel,
    Outcome,
    Scene,
    Steering,
    TriangleMesh,
    load_hand,
    load_scene,
    plan_grasps,
)
from graspd_core.config.planning_config import light_end
from graspd_core.errors import ConfigError, FormatError, MeshError
from graspd_core.hands.kinematics import hand_mesh
from graspd_core.io.grasps_json import result_document
from graspd_core.library import known_grasps as module
from graspd_core.library.grasp_library import GraspLibrary, LibraryEntry, entry_of, hand_hash
from graspd_core.library.known_grasps import (
    NEAR,
    Physics,
    add_planned,
    clearance,
    entry_by_file,
    entry_by_name,
    known_grasps,
    known_or_planned,
    lift_clearance,
)
from graspd_core.mesh.mesh_files import save_mesh
from graspd_core.mesh.sdf import build_sdf
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.plan_config import load_preset
from graspd_core.perception.scene import Obstacle
from graspd_core.planning.steering import angle_of_approach
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, Plane, Verdict
from graspd_core.verify.trial_registry import TrialContext, grasp_trials
from graspd_core.verify.verification import trial_context


@pytest.fixture(scope="session")
def scene() -> Scene:
    return load_scene("shape:sphere", mass=0.1)


@pytest.fixture(scope="session")
def planned(scene: Scene, hand: HandModel) -> GraspResult:
    return plan_grasps(scene, hand, count=4, preset="fast", seed=3)


@pytest.fixture
def library(tmp_path: Path, scene: Scene, hand: HandModel, planned: GraspResult) -> GraspLibrary:
    library = GraspLibrary(tmp_path / "known.grasps")
    library.create()
    assert add_planned(library, scene, hand, load_preset("fast"), planned, "standard") == 4
    return library


# Adds records without end, and says the number of each once it is in.
WRITER = """
import sys
from dataclasses import replace
from pathlib import Path
from graspd_core import load_hand, load_preset, load_scene
from graspd_core.library.grasp_library import GraspLibrary

library = GraspLibrary(Path(sys.argv[1]))
((entry, _),) = library.entries()
hand, target, config = load_hand("allegro_right"), load_scene("shape:sphere", mass=0.1).object, load_preset("fast")
grasps = library.grasps(entry, hand)
for number in range(10**9):
    other = replace(entry, name=f"record{number}", mesh_sha256=f"{number:064}")
    library.add(other, target, hand, config, grasps)
    print(number, flush=True)
"""


def stored(library: GraspLibrary, hand: HandModel) -> tuple[LibraryEntry, tuple[Grasp, ...]]:
    ((entry, count),) = library.entries()
    grasps = library.grasps(entry, hand)
    assert len(grasps) == count
    return entry, grasps


def same(a: Grasp, b: Grasp) -> bool:
    postures = [(getattr(a, stage), getattr(b, stage)) for stage in ("pregrasp", "grasp", "squeeze")]
    near = all(
        np.allclose(getattr(p, part), getattr(q, part))
        for p, q in postures
        for part in ("position", "quaternion_wxyz", "joint_positions")
    )
    return near and a.contacts == b.contacts and a.trials == b.trials


def test_grasps_come_back_as_they_were_put_in(library: GraspLibrary, planned: GraspResult, hand: HandModel):
    entry, grasps = stored(library, hand)
    assert (entry.name, entry.source, entry.hand, entry.verify) == ("sphere", "shape:sphere", hand.name, "standard")
    good = [grasp for grasp in planned.tried if grasp.verdict is Verdict.VERIFIED]
    assert len(grasps) == len(good) == 4
    assert all(map(same, grasps, good))


def test_another_process_may_create_the_library_at_the_same_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    library, opened = GraspLibrary(tmp_path / "known.grasps"), GraspLibrary._opened

    def opened_second(self: GraspLibrary, mode: str):
        monkeypatch.setattr(GraspLibrary, "_opened", opened)
        library.create()
        return opened(self, mode)

    monkeypatch.setattr(GraspLibrary, "_opened", opened_second)
    library.create()
    assert library.checked().names() == []


def test_grasps_of_a_file_that_changed_after_loading_are_not_stored_under_its_new_content(
    tmp_path: Path, library: GraspLibrary, planned: GraspResult, hand: HandModel
):
    path = tmp_path / "thing.obj"
    save_mesh(path, make_shape("sphere"))
    scene = load_scene(path, mass=0.2)
    other = tmp_path / "other.obj"
    save_mesh(other, make_shape("box"))
    other.replace(path)
    assert add_planned(library, scene, hand, load_preset("fast"), planned, "standard") == 4
    with pytest.raises(ConfigError, match="is not in the library"):
        entry_by_file(library, hand, path, 1.0, Physics(0.2, scene.object.friction))
    assert len(known_grasps(library, scene, hand, count=4).grasps) == 4


def test_what_is_added_stands_behind_what_was_there(library: GraspLibrary, planned: GraspResult, scene, hand):
    entry, before = stored(library, hand)
    bad = replace(planned.tried[0], trials=())
    assert library.add(entry, scene.object, hand, load_preset("fast"), [planned.tried[1], bad]) == 5
    _, after = stored(library, hand)
    assert all(map(same, after, (*before, before[1])))


def test_a_key_is_the_content_of_object_hand_and_physics(scene: Scene, hand: HandModel):
    entry = entry_of(scene.object, hand, "standard")
    others = [
        entry_of(load_scene("shape:sphere", mass=0.1, scale=1.1).object, hand, "standard"),
        entry_of(load_scene("shape:sphere", mass=0.2).object, hand, "standard"),
        entry_of(load_scene("shape:sphere", mass=0.1, friction=0.5).object, hand, "standard"),
        entry_of(scene.object, hand, "hard"),
        entry_of(scene.object, replace(hand, effort=hand.effort * 2), "standard"),
        entry_of(load_scene("shape:box", mass=0.1).object, hand, "standard"),
    ]
    assert len({entry.key, *(other.key for other in others)}) == 7
    assert replace(entry, name="ball", source="", hand="other").key == entry.key


def test_a_prefix_of_names_is_no_other_hand(library: GraspLibrary, hand: HandModel):
    prefixed = load_hand("allegro_right", prefix="left_", candidates=10)
    assert hand_hash(prefixed) == hand_hash(hand)
    _, grasps = stored(library, prefixed)
    assert {contact.link for grasp in grasps for contact in grasp.contacts} <= set(prefixed.link_names)


def test_a_changed_file_takes_the_place_of_what_it_was(library: GraspLibrary, scene, hand, planned, tmp_path: Path):
    entry = replace(entry_of(scene.object, hand, "standard"), source=str(tmp_path / "ball.obj"), file_sha256="old")
    config = load_preset("fast")
    for content in ("old", "new"):
        changed = replace(entry, file_sha256=content, mesh_sha256=content)
        library.add(changed, scene.object, hand, config, planned.tried)
    assert [found.mesh_sha256 for found, _ in library.entries(source=entry.source)] == ["new"]


@pytest.mark.timeout(300)
def test_a_kill_during_writes_loses_no_record_that_was_in(library: GraspLibrary, hand: HandModel):
    entry, grasps = stored(library, hand)
    for _ in range(2):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(library.path)], stdout=subprocess.PIPE, text=True)
        assert writer.stdout is not None
        said = [int(writer.stdout.readline()) for _ in range(5)]
        # While it writes, whoever reads sees whole records.
        whole = [other for other, _ in library.entries() if other.name != "sphere"]
        assert len(whole) >= 5
        assert same(library.grasps(whole[-1], hand)[0], grasps[0])
        writer.send_signal(signal.SIGKILL)
        said += [int(line) for line in writer.stdout.read().split()]
        writer.wait()
        writer.stdout.close()
        found = {other.name for other, _ in library.checked().entries()}
        assert {f"record{number}" for number in said} <= found
        # The next writer adds under other names; the first entry is the only one that it looks for.
        with sqlite3.connect(library.path) as base:
            base.execute("DELETE FROM records WHERE name != 'sphere'")
        base.close()
    assert same(library.grasps(entry, hand)[0], grasps[0])


def test_a_reader_does_not_wait_for_a_writer(library: GraspLibrary, hand: HandModel):
    base = sqlite3.connect(library.path, isolation_level=None)
    base.execute("BEGIN IMMEDIATE")
    base.execute("UPDATE records SET name = 'other'")
    began = time.thread_time()
    entry, grasps = stored(library, hand)
    assert entry.name == "sphere"
    assert len(grasps) == 4
    assert time.thread_time() - began < 5
    base.execute("COMMIT")
    base.close()
    assert library.names() == ["other"]


def test_a_library_that_nobody_may_write_is_read(library: GraspLibrary, hand, tmp_path: Path, monkeypatch):
    copy = tmp_path / "still" / "known.grasps"
    copy.parent.mkdir()
    copy.write_bytes(library.path.read_bytes())
    # As it is on a medium that cannot be written; the tests may run as one who may write anywhere.
    monkeypatch.setattr(os, "access", lambda *_: False)
    connected = []
    real = sqlite3.connect

    def connect(address: str, **named):
        connected.append(address)
        return real(address, **named)

    monkeypatch.setattr(sqlite3, "connect", connect)
    assert len(stored(GraspLibrary(copy), hand)[1]) == 4
    assert all(address.endswith("mode=ro&immutable=1") for address in connected)
    assert list(copy.parent.iterdir()) == [copy]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda path: path.unlink(), "no such file; `graspd library build --out"),
        (lambda path: path.write_bytes(b""), "not a library of grasps"),
        (lambda path: path.write_text("grasps: none\n" * 500), "damaged or not a library"),
        (lambda path: os.truncate(path, path.stat().st_size // 2), "damaged or not a library"),
        (lambda path: _scribble(path), "damaged or not a library"),
        (lambda path: _sql(path, "PRAGMA user_version = 7"), "library version 7 is unknown; valid: 2;"),
        (lambda path: _sql(path, "PRAGMA application_id = 7"), "not a library of grasps"),
    ],
)
def test_what_is_no_whole_library_of_this_version_is_told_in_one_line(library: GraspLibrary, spoil, told: str):
    spoil(library.path)
    with refused(FormatError, str(library.path), "graspd library build", told):
        library.checked()


def test_a_record_that_was_spoilt_is_named(library: GraspLibrary, hand: HandModel):
    entry, _ = stored(library, hand)
    _sql(library.path, "UPDATE records SET document = substr(document, 1, 100)")
    with pytest.raises(FormatError, match=r"known\.grasps: damaged .*record sphere for allegro"):
        library.grasps(entry, hand)


def _sql(path: Path, command: str) -> None:
    with sqlite3.connect(path) as base:
        base.execute(command)
    base.close()


def _scribble(path: Path) -> None:
    """Other bytes where the tree of the records begins."""
    content = bytearray(path.read_bytes())
    content[4096 : 4096 + 200] = b"\xa5" * 200
    path.write_bytes(bytes(content))


PHYSICS = Physics(mass=0.1, friction=0.6)


def test_a_known_object_alone_is_answered_without_a_trial(library, scene, hand, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "grasp_trials", None)
    monkeypatch.setattr(module, "plan_grasps", None)
    result = known_or_planned(library, scene, hand, count=4)
    assert result.outcome is Outcome.SUCCEEDED
    assert [grasp.verdict for grasp in result.grasps] == [Verdict.VERIFIED] * 4
    assert "4 grasps from the library known.grasps" in result.message


def test_an_object_that_is_not_there_has_none(library: GraspLibrary, hand: HandModel):
    grown = load_scene("shape:sphere", mass=0.1, scale=1.1)
    for other in (load_scene("shape:box", mass=0.1), grown, load_scene("shape:sphere", mass=0.3)):
        result = known_grasps(library, other, hand)
        assert (result.outcome, result.grasps) == (Outcome.NO_CANDIDATES, ())


def test_what_is_missing_is_planned_and_added(library: GraspLibrary, scene: Scene, hand: HandModel):
    result = known_or_planned(library, scene, hand, count=6, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
    assert "4 grasps from the library known.grasps, and 2 newly planned" in result.message
    ((_, count),) = library.entries()
    assert count == 6
    assert len(known_grasps(library, scene, hand, count=6).grasps) == 6


def test_a_library_that_cannot_be_written_costs_no_grasp(library, scene, hand, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> int:
        raise FormatError("known.grasps: the library cannot be used: disk is full")

    monkeypatch.setattr(GraspLibrary, "add", refuse)
    result = known_or_planned(library, scene, hand, count=5, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
    assert result.warnings[-1] == "known.grasps: the library cannot be used: disk is full; the grasps are not stored"


def test_restrictions_are_kept(library: GraspLibrary, scene: Scene, hand: HandModel, planned: GraspResult):
    first = planned.tried[0]
    direction = np.array([0.0, 0.0, 1.0])
    angles = [angle_of_approach(hand, grasp, direction) for grasp in planned.tried[:4]]
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


def test_only_what_comes_near_something_is_tried_again(library, scene, hand, planned, monkeypatch):
    tried = []
    real = grasp_trials
    monkeypatch.setattr(module, "grasp_trials", lambda *given: tried.append(1) or real(*given))
    for gap in (0.25, 0.01, -0.03):
        tried.clear()
        about = at_height(scene, hand, planned, gap)
        gaps = clearance(about, hand, planned.tried[:4])
        assert gaps[0] == pytest.approx(gap, abs=1e-6)
        result = known_grasps(library, about, hand, count=4)
        assert len(tried) == int(((gaps < NEAR) & (gaps >= -0.005)).sum())
        inside = int((gaps < -0.005).sum())
        assert result.refused.get("with a link inside the support or an obstacle", 0) == inside
        assert len(result.grasps) + sum(result.refused.values()) == 4
        # What was tried again has the trial of the scene too.
        assert {len(grasp.trials) for grasp in result.grasps} <= {1, 2}
        assert sum(len(grasp.trials) == 2 for grasp in result.grasps) <= len(tried)


def test_an_answer_on_a_table_tells_the_table(library, scene, hand, planned):
    """Like the planner's answer. Without it, a file of the answer is shown and planned again without its table."""
    about = at_height(scene, hand, planned, 0.25)
    answers = (known_grasps(library, about, hand, count=4), known_or_planned(library, about, hand, count=4))
    for result in answers:
        assert len(result.grasps) == 4
        assert result.support is about.support
        document = result_document(result, about.object, hand, load_preset("fast"))
        assert document["object"]["support"]["normal"] == [0.0, 0.0, 1.0]


def test_what_would_rise_into_an_obstacle_is_tried_again(library, scene, hand, planned):
    """A ceiling clear of the hand at the grasp, and within the lift."""
    grasps = planned.tried[:4]
    placed = [
        hand_mesh(hand, at.joint_positions).vertices
        @ rotation_from_quaternion(torch.as_tensor(at.quaternion_wxyz)).numpy().T
        + at.position
        for at in (grasp.grasp for grasp in grasps)
    ]
    highest = max(float(points[:, 2].max()) for points in placed)
    ceiling = make_shape("box").vertices / np.ptp(make_shape("box").vertices, axis=0) * [0.5, 0.5, 0.02]
    mesh = TriangleMesh(ceiling + np.array([0.0, 0.0, highest + 0.16]), make_shape("box").faces)
    low = float(scene.object.mesh.vertices[:, 2].min()) - 0.3
    about = replace(
        scene, support=Plane(np.array([0.0, 0.0, 1.0]), low), obstacles=(Obstacle(mesh, build_sdf(mesh, padding=0.02)),)
    )
    assert lift_clearance(about, hand, grasps).min() < 0.0
    assert np.isinf(lift_clearance(replace(about, obstacles=()), hand, grasps)).all()
    held = known_grasps(library, about, hand, count=4)
    assert held.refused["that failed near the support or an obstacle"] > 0
    worlds = trial_context(about, hand, "standard")
    assert all(trial.passed for grasp in held.grasps for trial in grasp_trials(worlds, grasp))


def test_a_trial_that_was_stopped_refuses_no_grasp(library, scene, hand, planned):
    about, calls = at_height(scene, hand, planned, 0.01), []
    ended = known_grasps(library, about, hand, count=4, stop=lambda: calls.append(1) or len(calls) > 2)
    assert "that failed near the support or an obstacle" not in ended.refused


def add_at(library: GraspLibrary, hand: HandModel, planned: GraspResult, mass: float, count: int) -> None:
    target = load_scene("shape:sphere", mass=mass).object
    library.add(entry_of(target, hand, "standard"), target, hand, load_preset("fast"), planned.tried[:count])


def test_of_an_unknown_mass_the_heaviest_are_given_first_and_the_light_ones_never(library, hand, planned):
    for mass in (0.05, 0.4, 0.8, 0.2):
        add_at(library, hand, planned, mass, 1)
    unknown = load_scene("shape:sphere")
    assert 0.2 < light_end(unknown.object.mass) < 0.4
    assert [entry.mass for entry in library.of_mesh(entry_of(unknown.object, hand, "standard"))] == [0.8, 0.4]


def test_what_was_stored_with_a_mass_is_not_verified_for_one_that_nobody_knows(library, hand, ball):
    unknown = load_scene(ball)
    assert known_grasps(library, unknown, hand).grasps == ()
    assert entry_by_file(library, hand, ball, 1.0, Physics(None, 0.6), required=False) is None
    # Who names the object takes the library's mass.
    assert entry_by_name(library, hand, "ball", Physics(None, 0.6)).mass == 0.1
    with refused(ConfigError, "does not have it with 0.5 kg", "valid: 0.1 kg"):
        entry_by_name(library, hand, "ball", Physics(0.5, 0.6))
    (entry,) = {entry for entry, _ in library.entries(name="ball")}
    assert not entry.mass_assumed
    assert entry_of(unknown.object, hand, "standard").mass_assumed


def test_of_an_unknown_mass_the_least_mass_in_the_trials_is_told(library, scene, hand, planned):
    unknown = load_scene("shape:sphere")
    add_at(library, hand, planned, 0.8, 2)
    add_at(library, hand, planned, 0.4, 2)
    found = known_grasps(library, unknown, hand, count=2)
    assert (found.mass, found.tried_mass) == (None, 0.8)
    for found in (known_grasps(library, unknown, hand, count=3), known_or_planned(library, unknown, hand, count=3)):
        assert (found.mass, found.tried_mass, len(found.grasps)) == (0.4, 0.4, 3)
        assert "tried at 0.4 kg" in found.message
    assert known_grasps(library, scene, hand).tried_mass == scene.object.mass


def test_of_an_unknown_mass_trials_near_the_support_have_the_mass_of_the_entry(
    library, hand, planned, monkeypatch: pytest.MonkeyPatch
):
    """Else a hand that lifts less than the assumed mass never gets its stored grasps back on a table."""
    tried, real = list[float](), grasp_trials

    def weighed(worlds: TrialContext, grasp: Grasp, stop):
        tried.extend(float(w.model.body_mass[w.object_body]) for w in (worlds.alone, worlds.around) if w)
        return real(worlds, grasp, stop)

    monkeypatch.setattr(module, "grasp_trials", weighed)
    about = at_height(load_scene("shape:sphere"), hand, planned, 0.01)
    add_at(library, hand, planned, 0.4, 4)
    result = known_grasps(library, about, hand, count=4)
    assert about.object.mass > 0.5
    assert result.tried_mass == 0.4
    assert set(tried) == {0.4}


@pytest.mark.parametrize(
    ("asked", "told"),
    [({"deadline": -1.0}, "deadline: -1.0 s"), ({"seed": -1}, "seed: -1"), ({"device": "tpu"}, "device: 'tpu'")],
)
def test_a_request_is_checked_though_the_library_answers_it(library, scene, hand, asked: dict, told: str):
    with refused(ConfigError, told):
        known_or_planned(library, scene, hand, count=2, **asked)


def test_the_greatest_seed_is_valid_though_some_are_known(library, scene, hand):
    result = known_or_planned(library, scene, hand, count=5, seed=2**63 - 1, preset="fast", deadline=1e-3)
    assert len(result.grasps) == 4


def test_what_was_planned_on_a_table_is_kept_as_a_grasp_of_the_object_alone(library, scene, hand, planned):
    about = at_height(scene, hand, planned, 0.1)
    lifted = replace(planned.tried[0].trials[0], name="lift")
    both = replace(planned.tried[0], trials=(*planned.tried[0].trials, lifted))
    assert add_planned(library, about, hand, load_preset("fast"), replace(planned, tried=(both,)), "standard") == 5
    ((entry, _),) = library.entries()
    assert [trial.name for trial in library.grasps(entry, hand)[-1].trials] == ["hold"]


@pytest.fixture
def ball(library: GraspLibrary, hand: HandModel, planned: GraspResult, tmp_path: Path) -> Path:
    """A mesh file that the library knows."""
    path = tmp_path / "ball.obj"
    save_mesh(path, make_shape("sphere"))
    add_planned(library, load_scene(path, mass=0.1), hand, load_preset("fast"), planned, "standard")
    return path


def test_an_object_is_found_by_name_and_by_file(library: GraspLibrary, hand: HandModel, ball: Path, tmp_path: Path):
    by_name = entry_by_name(library, hand, "ball", PHYSICS)
    assert entry_by_file(library, hand, ball, 1.0, PHYSICS) == by_name
    # Whatever the file is called, and for a lighter one.
    copy = tmp_path / "copy.obj"
    copy.write_bytes(ball.read_bytes())
    assert entry_by_file(library, hand, copy, 1.0, PHYSICS) == by_name
    assert entry_by_name(library, hand, "ball", Physics(0.05, 0.6)) == by_name
    assert entry_by_file(library, hand, ball, 1.1, PHYSICS, required=False) is None


@pytest.mark.parametrize(
    ("name", "asked_of", "physics", "told"),
    [
        ("bal", "allegro_right", PHYSICS, "it has ball"),
        ("ball", "leap_right", PHYSICS, "for allegro_right, not for leap_right"),
        ("ball", "allegro_right", Physics(0.1, 0.6, "hard"), "valid: 0.1 kg, friction 0.6, standard trials"),
    ],
)
def test_a_name_that_the_library_lacks_is_told_with_what_it_has(library, ball, name, asked_of, physics, told: str):
    with refused(ConfigError, told):
        entry_by_name(library, load_hand(asked_of), name, physics)


def test_a_file_that_the_library_lacks_is_told(library, hand, ball: Path):
    with refused(ConfigError, "ball.obj: scale 0.5 is not in the library"):
        entry_by_file(library, hand, ball, 0.5, PHYSICS)
    with refused(ConfigError, "shape:mug: its mesh is not in the library"):
        entry_by_file(library, hand, "shape:mug", 1.0, PHYSICS)


def test_a_mesh_that_changed_is_told(library: GraspLibrary, hand: HandModel, ball: Path):
    mesh = make_shape("sphere")
    save_mesh(ball, TriangleMesh(mesh.vertices * 1.2, mesh.faces))
    told = r"ball\.obj: the mesh has changed since ball was added to the library"
    with pytest.raises(MeshError, match=told):
        entry_by_name(library, hand, "ball", PHYSICS)
    with pytest.raises(MeshError, match=told):
        entry_by_file(library, hand, ball, 1.0, PHYSICS)


def test_two_objects_of_one_name_are_told(library, hand, ball, planned, tmp_path: Path):
    other = tmp_path / "other" / "ball.obj"
    other.parent.mkdir()
    save_mesh(other, make_shape("box"))
    add_planned(library, load_scene(other, mass=0.1), hand, load_preset("fast"), planned, "standard")
    with pytest.raises(ConfigError, match=r"ball: the library .* has several such objects: .*; name a mesh"):
        entry_by_name(library, hand, "ball", PHYSICS)
