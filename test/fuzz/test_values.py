"""Values of every kind where settings, postures and grasps are expected: taken as they are, or refused by their key."""

from __future__ import annotations

import copy
import dataclasses
import json
import os
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.errors import CloudError, ConfigError, FormatError
from graspd_core.io.grasps_json import grasps_of
from graspd_core.optimize.plan_config import PlanConfig, plan_config, to_mapping
from graspd_core.perception.cloud.cloud_files import load_views
from graspd_core.perception.cloud.point_cloud import CloudLayout, points_from_layout

# GRASPD_FUZZ=50 tries fifty times as many examples, others each time; without it they are the same on every machine.
LONGER = int(os.environ.get("GRASPD_FUZZ", "1"))

numbers = st.one_of(
    st.integers(-3, 3), st.integers(), st.floats(), st.sampled_from([2**63, 10**400, 1e308, -1e308, 5e-324])
)
leaves = st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=8), st.sampled_from(["closed_form", "verified"]))
values = st.recursive(
    leaves,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=3)),
    max_leaves=6,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to everything in nested dictionaries and lists, itself included."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, entry in inside for place in places(entry, (*path, key)))]


def replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """A copy with something else at the end of a way."""
    if not path:
        return new
    value = copy.copy(value)
    value[path[0]] = replaced(value[path[0]], path[1:], new)
    return value


DEFAULTS = json.loads(json.dumps(to_mapping(PlanConfig())))


@settings(max_examples=60 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_a_setting_is_taken_as_it_is_or_refused_by_its_name(fuzz: ModuleType, data: st.DataObject) -> None:
    place = data.draw(st.sampled_from(places(DEFAULTS)), label="place")
    value = data.draw(values, label="value")
    changed = replaced(DEFAULTS, place, value)
    config, refusal = fuzz.outcome(lambda: plan_config(changed), ConfigError)
    if refusal is not None:
        named = "config" + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in place)
        # What is wrong is the value itself, or something in it.
        assert refusal.startswith((f"{named}: ", f"{named}.", f"{named}["))
    # A mapping may leave out what has a default.
    elif not isinstance(value, dict):
        assert json.loads(json.dumps(to_mapping(config), allow_nan=False)) == changed


@settings(max_examples=60 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_a_changed_document_gives_the_same_grasps_or_one_clear_error(fuzz: ModuleType, data: st.DataObject) -> None:
    document = json.loads(fuzz.TARGETS["document"].seeds()[0])
    place = data.draw(st.sampled_from(places(document)[1:]), label="place")
    changed = replaced(document, place, data.draw(values, label="value"))
    grasps, refusal = fuzz.outcome(lambda: grasps_of(changed), FormatError)
    if place[0] not in ("hand", "grasps", "version"):
        assert refusal is None
        assert [g.score for g in grasps] == [g["score"] for g in document["grasps"]]
    for grasp in grasps or ():
        for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze):
            assert np.isfinite([*posture.position, *posture.quaternion_wxyz, *posture.joint_positions]).all()
            assert np.linalg.norm(posture.quaternion_wxyz) == pytest.approx(1, abs=0.011)


small = st.integers(0, 5)
steps = st.one_of(st.integers(0, 40), st.sampled_from([2**31, 2**32 - 1]))


GOOD_LAYOUT = CloudLayout(3, 2, 16, 48, False, {"x": (0, 7), "y": (4, 7), "z": (8, 7)}, memoryview(bytes(96)))
CHANGES: dict[str, st.SearchStrategy[Any]] = {
    "width": st.one_of(small, st.just(2**32 - 1)),
    "height": st.one_of(small, st.just(2**32 - 1)),
    "point_step": steps,
    "row_step": steps,
    "is_bigendian": st.booleans(),
    "fields": st.dictionaries(st.sampled_from("xyzi"), st.tuples(steps, st.integers(0, 10)), max_size=4),
    "data": st.binary(max_size=300).map(memoryview),
}


@settings(max_examples=60 * LONGER, derandomize=LONGER == 1)
@given(data=st.binary(min_size=96, max_size=96), change=st.fixed_dictionaries({}, optional=CHANGES))
def test_a_cloud_of_any_layout_gives_finite_points_or_an_error(
    fuzz: ModuleType, data: bytes, change: dict[str, Any]
) -> None:
    layout = dataclasses.replace(GOOD_LAYOUT, **{"data": memoryview(data), **change})
    points, refusal = fuzz.outcome(lambda: points_from_layout(layout), CloudError)
    if refusal is None:
        assert 0 < len(points) <= layout.width * layout.height
        assert np.isfinite(points).all()


def test_the_layout_that_is_changed_is_a_good_one() -> None:
    assert points_from_layout(GOOD_LAYOUT).shape == (6, 3)


GOOD_ARCHIVES: list[dict[str, np.ndarray]] = [
    {"points": np.ones((5, 3)), "viewpoint": np.zeros(3), "forward": np.ones(3)},
    {"depth": np.ones((4, 6)), "K": np.diag([5.0, 5.0, 1.0]), "distortion": np.zeros(5), "T_world_camera": np.eye(4)},
    {"depths": np.ones((2, 4, 6)), "K": np.diag([5.0, 5.0, 1.0]), "poses": np.stack([np.eye(4)] * 2)},
]


@pytest.mark.parametrize("good", GOOD_ARCHIVES, ids=lambda good: next(iter(good)))
@settings(max_examples=15 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_an_archive_of_any_arrays_gives_points_or_an_error(
    fuzz: ModuleType, folder: Path, good: dict[str, np.ndarray], data: st.DataObject
) -> None:
    np.savez(folder / "any.npz", allow_pickle=False, **good)
    first = load_views(folder / "any.npz")
    kinds = st.sampled_from(["f4", "f8", "u2", "u8", "i1", "i8", "?", "c8", "S3", "U2", "M8[s]"])
    shapes = st.one_of(
        st.sampled_from([(3,), (3, 3), (4, 4), (2, 3), (1, 2, 3)]), st.lists(st.integers(0, 4)).map(tuple)
    )
    arrays = dict(good)
    for name in data.draw(st.lists(st.sampled_from([*good, "other"]), unique=True, max_size=2), label="names"):
        arrays[name] = np.ones(data.draw(shapes, label=name)[:4], data.draw(kinds))
    np.savez(folder / "any.npz", allow_pickle=False, **arrays)
    views, _ = fuzz.outcome(lambda: load_views(folder / "any.npz"), CloudError)
    if all(arrays[name] is array for name, array in good.items()):
        assert [len(view.points) for view in views] == [len(view.points) for view in first]
    for view in views or ():
        assert np.isfinite(view.viewpoint).all()
        assert view.forward is None or np.linalg.norm(view.forward) == pytest.approx(1.0)
