"""The file format: what is written comes back, other files are refused by name; and the page of a grasp."""

import base64
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from expected import refused, some
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graspd_core import METRICS, PlanConfig, load_grasps, load_hand, load_scene, make_shape
from graspd_core.errors import ConfigError, FormatError
from graspd_core.hands.model import Mount
from graspd_core.io.grasps_json import check_writable, grasps_of, load_document, result_document, save_result
from graspd_core.types import (
    ArmPath,
    Contact,
    Grasp,
    GraspMetrics,
    GraspResult,
    Outcome,
    Plane,
    Posture,
    Timing,
    TrialResult,
    Verdict,
)
from graspd_viewer.grasp_page import placed_hand, save_view
from graspd_viewer.session import open_grasps

VERSION_1 = Path(__file__).parent / "data" / "grasps_v1.json"


@pytest.fixture(scope="module")
def target():
    return load_scene("shape:box", mass=0.25, friction=0.8, resolution=16).object


def posture(seed: int) -> Posture:
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)
    return Posture(rng.normal(size=3), quaternion / np.linalg.norm(quaternion), rng.normal(size=16))


@pytest.fixture
def result() -> GraspResult:
    grip = posture(1)
    held = Grasp(
        pregrasp=posture(0),
        grasp=grip,
        squeeze=replace(posture(2), position=grip.position, quaternion_wxyz=grip.quaternion_wxyz),
        contacts=(Contact("link_3.0_tip", (0.1, 0.2, 0.3), (0.0, 0.6, 0.8), (0.0, -1.0, -2.5)),),
        score=-1.5,
        metrics=GraspMetrics({"contact_area": 2e-4, "intersection_volume": 1e-6, "penetration": 0.0015}),
        trials=(TrialResult("hold", True, 0.01, 0.1),),
    )
    lost = replace(
        held, metrics=None, trials=(TrialResult("hold", False, float("inf"), float("inf"), "the simulation diverged"),)
    )
    timing = Timing(load=0.5, first_verified=2.5, total=3.0)
    return GraspResult(Outcome.TOO_FEW, (held, lost), timing, 7, "closed_form", warnings=("open mesh",))


@pytest.fixture
def document(result, target, hand) -> dict[str, Any]:
    return result_document(result, target, hand, PlanConfig())


def test_units_are_converted_where_a_key_names_one(document):
    metrics = document["grasps"][0]["metrics"]
    assert metrics["contact_area_cm2"] == pytest.approx(2.0)
    assert metrics["intersection_volume_cm3"] == pytest.approx(1.0)
    assert metrics["penetration_mm"] == pytest.approx(1.5)


def test_a_saved_result_is_read_back_bit_by_bit(tmp_path: Path, result, target, hand, document):
    path = tmp_path / "deep" / "down" / "grasps.json"
    save_result(path, result, target, hand, PlanConfig())
    read = load_document(path)
    assert read == document
    assert [p.name for p in path.parent.iterdir()] == ["grasps.json"]
    for before, after in zip(result.tried, grasps_of(read), strict=True):
        for name in ("pregrasp", "grasp", "squeeze"):
            for field in ("position", "quaternion_wxyz", "joint_positions"):
                assert np.array_equal(getattr(getattr(before, name), field), getattr(getattr(after, name), field))
        assert after.contacts == before.contacts
        assert (after.score, after.verdict, after.reason) == (before.score, before.verdict, before.reason)
        assert after.trials == before.trials


figures = st.floats(0.0, 1e3)
measured = st.fixed_dictionaries({name: st.none() | figures for name in METRICS})
moved = figures | st.just(float("inf"))
tried = st.lists(st.tuples(st.text(), st.booleans(), moved, moved, st.text()), max_size=3)


@pytest.fixture
def read_back(result, target, hand) -> Callable[..., tuple[Grasp, Grasp]]:
    """Gives a grasp with changes, and what is read of it when it has been written."""

    def write_and_read(**changes: Any) -> tuple[Grasp, Grasp]:
        before = replace(result.tried[0], **changes)
        written = result_document(replace(result, tried=(before,)), target, hand, PlanConfig())
        return before, grasps_of(json.loads(json.dumps(written, allow_nan=False)))[0]

    return write_and_read


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=measured, trials=tried)
def test_all_metrics_and_trials_are_read_back(read_back, values, trials):
    run = tuple(TrialResult(*trial) for trial in trials)
    before, after = read_back(metrics=GraspMetrics(values), trials=run)
    assert (after.trials, after.verdict, after.reason) == (run, before.verdict, before.reason)
    # A scale is multiplied and divided: the last bits may differ.
    read, expected = ({n: v for n, v in m.items() if v is not None} for m in (after.metrics or {}, values))
    assert read == pytest.approx(expected, rel=1e-14, abs=1e-300)
    assert after.metrics is None or set(after.metrics) == set(METRICS)


def test_what_is_not_finite_is_written_as_null(document):
    lost = json.loads(json.dumps(document, allow_nan=False))["grasps"][1]
    (hold,) = lost["trials"]
    assert (hold["displacement"], hold["rotation"]) == (None, None)
    assert set(lost["metrics"].values()) == {None}


def test_the_support_is_written(result, target, hand):
    table = Plane(np.array([0.0, 0.0, 1.0]), -0.05)
    written = result_document(replace(result, support=table), target, hand, PlanConfig())
    assert json.loads(json.dumps(written, allow_nan=False)) == written
    assert written["object"]["support"] == {"normal": [0.0, 0.0, 1.0], "offset": -0.05}


def test_files_of_version_1_are_read():
    held, lifted, untried, lost, wild = grasps_of(load_document(VERSION_1))
    fell, wrong = "the object moved 6.0 cm while lifting", "the simulation diverged while closing"
    hold = ["hold", True, pytest.approx(0.01), pytest.approx(0.25), ""]
    expected = [
        (held, Verdict.VERIFIED, "", [hold]),
        (lifted, Verdict.VERIFIED, "", [hold, ["lift", True, pytest.approx(0.02), pytest.approx(0.125), ""]]),
        (untried, Verdict.UNVERIFIED, "", []),
        (lost, Verdict.FAILED, fell, [hold, ["lift", False, pytest.approx(0.06), pytest.approx(0.125), fell]]),
        (wild, Verdict.FAILED, wrong, [["hold", False, float("inf"), float("inf"), wrong]]),
    ]
    for grasp, *found in expected:
        trials = [[t.name, t.passed, t.displacement, t.rotation, t.reason] for t in grasp.trials]
        assert [grasp.verdict, grasp.reason, trials] == found
    assert wild.metrics is None
    assert {name: value for name, value in some(held.metrics).items() if value is not None} == pytest.approx({
        "contact_area": 2e-4, "intersection_volume": 1e-6, "penetration": 0.0015, "self_penetration": 0.0005,
        "epsilon": 0.25, "volume": 1.5, "robustness": 0.75,
    })  # fmt: skip
    assert held.grasp.joint_positions.tolist() == [0.03]


def test_a_file_of_version_1_from_before_there_was_a_lift_trial_is_read():
    document = load_document(VERSION_1)
    document["grasps"] = document["grasps"][:1]
    del document["grasps"][0]["metrics"]["lift"]
    assert grasps_of(document)[0].verdict is Verdict.VERIFIED


@pytest.mark.parametrize(
    ("spoil", "culprit"),
    [
        (lambda d: d["grasps"][1].update(probability=1.2), r"probability: 1\.2; expected 0 to 1"),
        (lambda d: d["grasps"][1].update(verdict="verified"), "verdict: 'verified'; expected failed, by the trials"),
        (lambda d: d["grasps"][1]["trials"][0].update(passed="yes"), "passed: 'yes'; expected true or false"),
        (lambda d: d["grasps"][0]["squeeze_joint_positions"].pop(), "squeeze_joint_positions: 15 values; expected 16"),
        (lambda d: d.update(units="mm, deg, N"), "units 'mm, deg, N'; valid: 'm, rad, N'"),
    ],
)
@pytest.mark.parametrize("read", [load_grasps, open_grasps])
def test_values_that_cannot_be_are_refused_with_the_files_name(document, tmp_path: Path, read, spoil, culprit: str):
    spoil(document)
    (tmp_path / "odd.json").write_text(json.dumps(document))
    with pytest.raises(FormatError, match=rf"odd\.json: .*{culprit}"):
        read(tmp_path / "odd.json")


@pytest.mark.parametrize(
    ("text", "culprit"),
    [
        ('{"format": "graspd/grasps", "version": 3}', "version 3 is unknown; this reader knows 1 and 2"),
        ('{"format": "graspd/grasps"}', "version None"),
        ('{"format": "other", "version": 1}', "not a graspd/grasps file"),
        ("[]", "not a graspd/grasps file"),
        ('{"format": ', "not JSON"),
        ('{"format": "graspd/grasps", "version": 1, "seed": NaN}', "NaN is not a JSON number"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, culprit: str):
    path = tmp_path / "odd.json"
    path.write_text(text)
    with refused(FormatError, culprit, "odd.json"):
        load_document(path)


@pytest.mark.parametrize("key", ["position", "verdict", "squeeze_joint_positions", "metrics", "trials"])
def test_a_grasp_without_a_key_is_refused(document, key: str):
    del document["grasps"][0][key]
    with pytest.raises(FormatError, match=key):
        grasps_of(document)


def test_a_failed_write_leaves_nothing_behind(tmp_path: Path, result, target, hand):
    spoilt = replace(result, tried=(replace(result.tried[0], score=float("nan")),))
    with pytest.raises(ValueError, match="JSON"):
        save_result(tmp_path / "grasps.json", spoilt, target, hand, PlanConfig())
    assert list(tmp_path.iterdir()) == []


def test_unwritable_paths_are_refused_and_writable_ones_left_alone(tmp_path: Path):
    (tmp_path / "file").write_text("here")
    with pytest.raises(ConfigError, match="is a directory"):
        check_writable(tmp_path)
    with pytest.raises(ConfigError, match="cannot be written"):
        check_writable(tmp_path / "file" / "grasps.json")
    check_writable(tmp_path / "new" / "grasps.json")
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(FormatError, match=r"nowhere\.json"):
        load_document(tmp_path / "nowhere.json")


def test_coupled_joints_are_written_with_their_own_values_and_read_back_as_they_were(result, target):
    hand = replace(load_hand("barrett_like", candidates=8), mount=Mount("tool0", (0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)))
    rng = np.random.default_rng(0)

    def at(posture: Posture) -> Posture:
        return replace(posture, joint_positions=rng.uniform(hand.lower, hand.upper))

    grasp = result.tried[0]
    grasp = replace(grasp, pregrasp=at(grasp.pregrasp), grasp=at(grasp.grasp), squeeze=at(grasp.squeeze))
    document = json.loads(json.dumps(result_document(replace(result, tried=(grasp,)), target, hand, PlanConfig())))
    names, values = document["hand"]["joint_names"], document["grasps"][0]["joint_positions"]
    assert len(names) == len(values) == 8
    value = dict(zip(names, values, strict=True))
    for mimic in document["hand"]["mimic"]:
        assert value[mimic["joint"]] == pytest.approx(mimic["multiplier"] * value[mimic["of"]] + mimic["offset"])
    assert document["hand"]["mount"] == {
        "parent": "tool0", "position": [0.0, 0.0, 0.1], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]
    }  # fmt: skip
    (after,) = grasps_of(document)
    for name in ("pregrasp", "grasp", "squeeze"):
        assert np.array_equal(getattr(after, name).joint_positions, getattr(grasp, name).joint_positions)


def test_a_file_from_before_joints_could_be_coupled_is_read(document, result):
    del document["hand"]["mimic"]
    del document["hand"]["mount"]
    assert np.array_equal(grasps_of(document)[0].grasp.joint_positions, result.tried[0].grasp.joint_positions)


# Half a turn about z: x and y change sign.
HALF_TURN = np.array([0.0, 0.0, 0.0, 1.0])


def grasp_at(hand, verdict: Verdict) -> Grasp:
    posture = Posture(np.array([0.1, 0.2, 0.3]), HALF_TURN, hand.open_posture)
    trials = () if verdict is Verdict.UNVERIFIED else (TrialResult("hold", verdict is Verdict.VERIFIED, 0.0, 0.0),)
    return Grasp(posture, posture, posture, (), 0.0, trials=trials)


def shown(path: Path) -> dict[str, np.ndarray]:
    """Bounds of every mesh in a page, read back from its embedded GLB."""
    (encoded,) = re.findall(r'base64_data\s*=\s*"([A-Za-z0-9+/=]+)"', path.read_text())
    scene = trimesh.load_scene(io.BytesIO(base64.b64decode(encoded)), file_type="glb")
    return {name: mesh.bounds for name, mesh in scene.geometry.items()}


def test_the_page_shows_object_and_hand_and_needs_no_network(tmp_path: Path, hand):
    cup = make_shape("mug")
    save_view(tmp_path / "deep" / "view.html", cup, hand, [grasp_at(hand, Verdict.VERIFIED)], name="<mug>")
    page = (tmp_path / "deep" / "view.html").read_text()
    assert not re.findall(
        r"""(?:src|href)\s*=\s*["']?https?:|@import|fetch\(\s*["']http|import[^;]{0,80}["']http""", page
    )
    assert not re.findall(r"<(?:link|iframe|img)\b", page)
    assert f"<title>&lt;mug&gt;, {hand.name}: verified grasp</title>" in page
    meshes = shown(tmp_path / "deep" / "view.html")
    assert {name.split("_")[0] for name in meshes} == {"object", "hand", "pregrasp"}
    # float32 in the file
    assert meshes["object"] == pytest.approx(np.stack([cup.vertices.min(0), cup.vertices.max(0)]), abs=1e-6)


def test_the_hand_is_where_the_posture_puts_it(hand):
    posture = grasp_at(hand, Verdict.VERIFIED).grasp
    centre = placed_hand(hand, posture).vertices.mean(0)
    at_origin = placed_hand(hand, Posture(np.zeros(3), np.array([1.0, 0, 0, 0]), hand.open_posture)).vertices.mean(0)
    assert centre == pytest.approx(at_origin * [-1, -1, 1] + posture.position, abs=1e-9)


def test_a_grasp_that_failed_is_not_shown(tmp_path: Path, hand):
    save_view(tmp_path / "view.html", make_shape("box"), hand, [grasp_at(hand, Verdict.FAILED)])
    assert set(shown(tmp_path / "view.html")) == {"object"}
    assert f"<title>object, {hand.name}: no grasp</title>" in (tmp_path / "view.html").read_text()


# What stands there goes by names of its own: settings, libraries, reasons.
FREE = {"config", "versions", "refused"}


def leaves(value: Any, path: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
    """Return the keys of a document that hold values, each after the keys of the objects that it lies in."""
    if isinstance(value, dict) and not (len(path) == 1 and path[0] in FREE):
        return {leaf for key, inner in value.items() for leaf in leaves(inner, (*path, key))}
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return {leaf for inner in value for leaf in leaves(inner, path)}
    return {path}


def test_the_table_of_the_page_lists_what_is_written_and_no_more(tmp_path: Path, result, target):
    """A field that is written and has no row fails, and so does a row of a field that is never written."""
    gripper = load_hand("parallel_gripper", candidates=8)
    gripper = replace(gripper, mount=Mount("flange", (0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)))
    still = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), gripper.open_posture)
    path = ArmPath(("elbow",), np.zeros((13, 1)), (0, 5, 7, 12))
    grasp = replace(result.tried[0], pregrasp=still, grasp=still, squeeze=still, arm=path)
    support = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    full = replace(result, tried=(grasp,), support=support, next_view=np.eye(4))
    save_result(tmp_path / "all.json", full, target, gripper, PlanConfig(), frame="world", stamp=1.5)
    written = leaves(json.loads((tmp_path / "all.json").read_text()))
    page = (Path(__file__).parents[2] / "docs" / "format.md").read_text()
    table = page.split("<!-- format:begin -->\n")[1].split("<!-- format:end -->")[0]
    rows = [line.split("|")[1:3] for line in table.splitlines()[2:]]
    listed = [(*inside.split(), key) for inside, keys in rows for key in re.findall(r"`(\w+)`", keys)]
    assert sorted(listed) == sorted(written)
