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

from graspd_core.config import PlanConfig, from_mapping
from graspd_core.errors import CloudError, ConfigError, FormatError
from graspd_core.formats.read_grasps import grasps_of
from graspd_core.pointcloud.cloud_files import load_views
from graspd_core.pointcloud.pointcloud2 import CloudLayout, points_from_layout

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


DEFAULTS = json.loads(json.dumps(dataclasses.asdict(PlanConfig())))


@settings(max_examples=60 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_a_setting_is_taken_as_it_is_or_refused_by_its_name(fuzz: ModuleType, data: st.DataObject) -> None:
    place = data.draw(st.sampled_from(places(DEFAULTS)), label="place")
    value = data.draw(values, label="value")
    changed = replaced(DEFAULTS, place, value)
    config, refusal = fuzz.outcome(lambda: from_mapping(PlanConfig, changed), ConfigError)
    if refusal is not None:
        assert refusal.startswith(".".join(["config", *map(str, place)])[:12])
    # A mapping may leave out what has a default.
    elif not isinstance(value, dict):
        assert json.loads(json.dumps(dataclasses.asdict(config), allow_nan=False)) == changed


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


@settings(max_examples=60 * LONGER, derandomize=LONGER == 1)
@given(
    sizes=st.tuples(st.one_of(small, st.just(2**32 - 1)), st.one_of(small, st.just(2**32 - 1)), steps, steps),
    big=st.booleans(),
    fields=st.dictionaries(st.sampled_from("xyzi"), st.tuples(steps, st.integers(0, 10)), max_size=4),
    data=st.binary(max_size=300),
)
def test_a_cloud_of_any_layout_gives_finite_points_or_an_error(
    fuzz: ModuleType, sizes: tuple[int, int, int, int], big: bool, fields: dict[str, tuple[int, int]], data: bytes
) -> None:
    layout = CloudLayout(*sizes, big, fields, memoryview(data))
    points, refusal = fuzz.outcome(lambda: points_from_layout(layout), CloudError)
    if refusal is None:
        assert 0 < len(points) <= sizes[0] * sizes[1]
        assert np.isfinite(points).all()


@settings(max_examples=30 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_an_archive_of_any_arrays_gives_points_or_an_error(fuzz: ModuleType, folder: Path, data: st.DataObject) -> None:
    known = ["points", "viewpoint", "forward", "depth", "depths", "K", "poses", "T_world_camera", "distortion", "other"]
    kinds = st.sampled_from(["f4", "f8", "u2", "u8", "i1", "i8", "?", "c8", "S3", "U2", "M8[s]"])
    shapes = st.one_of(
        st.sampled_from([(3,), (3, 3), (4, 4), (2, 3), (1, 2, 3)]), st.lists(st.integers(0, 4)).map(tuple)
    )
    names = data.draw(st.lists(st.sampled_from(known), unique=True, max_size=5), label="names")
    arrays = {name: np.ones(data.draw(shapes, label=name)[:4], data.draw(kinds)) for name in names}
    np.savez(folder / "any.npz", allow_pickle=False, **arrays)
    views, _ = fuzz.outcome(lambda: load_views(folder / "any.npz"), CloudError)
    assert all(view.points.shape[1] == 3 for view in views or ())
