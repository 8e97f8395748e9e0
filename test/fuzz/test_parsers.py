"""Spoilt files of every format, values of every kind, meshes and clouds that nobody would make.

Each ends in a value of finite numbers or in one clear error.
"""

import copy
import json
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fuzz_targets as fuzz
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core import PointCloud, Scene, TriangleMesh, load_scene, make_shape, scene_from_views
from graspd_core.errors import CloudError, ConfigError, FormatError, MeshError
from graspd_core.io.grasps_json import grasps_of
from graspd_core.mesh.mesh_files import check_mesh
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.plan_config import PlanConfig, plan_config, to_mapping
from graspd_core.perception.cloud.cloud_files import load_views

# GRASPD_FUZZ=50 tries fifty times as many examples, others each time; without it they are the same on every machine.
LONGER = int(os.environ.get("GRASPD_FUZZ", "1"))
NAMES = ("urdf", "mjcf", "description", "preset", "document", "mano", "dae", "cloud", "layout", "message", "bag")
NASTY = (
    *("nan", "NaN", "inf", "-inf", ".nan", "1e400", "1e308", "-1e308", "1e-320", "-1", "0", "", " ", "x", "null"),
    *("true", "99999999999999999999", "-9223372036854775808", "4294967295", "1" + 400 * "0", 5000 * "1", "٣", "\x00"),
    *("[", "{", "[[1, 2], [3]]", "\n", "<a/>", "&x;", "<!DOCTYPE a>", "*a", "&a [1]", "0x" + 5000 * "f", '"', "../x"),
)  # fmt: skip


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where inputs are written."""
    return tmp_path_factory.mktemp("inputs")


def test_every_target_is_tried() -> None:
    assert tuple(fuzz.TARGETS) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_the_first_seed_is_read(folder: Path, name: str) -> None:
    target = fuzz.TARGETS[name]
    assert fuzz.try_input(target, target.seeds()[0], folder) is None


@st.composite
def spoilt(draw: st.DrawFn, data: bytes) -> bytes:
    """An input with one to four things wrong with it: words and numbers replaced, bytes flipped, cut or repeated."""
    if draw(st.booleans()):
        data = draw(regrown(data))
    for _ in range(draw(st.integers(1, 4))):
        words = [found.span() for found in re.finditer(rb"[\w.+-]+", data)]
        action = draw(st.sampled_from(["word", "word", "word", "flip", "cut", "repeat", "drop"]))
        if action == "word" and words:
            first, last = draw(st.sampled_from(words))
            data = data[:first] + draw(st.sampled_from(NASTY)).encode() + data[last:]
            continue
        first = draw(st.integers(0, len(data)))
        last = min(len(data), first + draw(st.integers(1, 40)))
        if action == "flip" and data[first:last]:
            data = data[:first] + bytes([data[first] ^ draw(st.integers(1, 255))]) + data[first + 1 :]
        elif action == "cut":
            data = data[:first]
        elif action == "repeat":
            data = data[:last] + data[first:last] * draw(st.integers(1, 5)) + data[last:]
        elif action == "drop":
            data = data[:first] + data[last:]
    return data


@st.composite
def regrown(draw: st.DrawFn, data: bytes) -> bytes:
    """An XML file of which up to three elements were removed, moved, repeated, renamed or given another attribute."""
    try:
        root = ET.fromstring(data)
    except ET.ParseError:
        return data
    for _ in range(draw(st.integers(1, 3))):
        elements = list(root.iter())
        above = {child: parent for parent in elements for child in parent}
        element, other = draw(st.sampled_from(elements)), draw(st.sampled_from(elements))
        action = draw(st.sampled_from(["set", "drop", "rename", "remove", "move", "repeat"]))
        if action in ("set", "drop") and element.attrib:
            key = draw(st.sampled_from(sorted(element.attrib)))
            element.attrib.update({key: draw(st.sampled_from(sorted(other.attrib.values()) or [""]))})
            if action == "drop":
                del element.attrib[key]
        elif action == "rename":
            element.tag = other.tag
        elif action in ("remove", "move") and element in above:
            above[element].remove(element)
        if action in ("move", "repeat"):
            draw(st.sampled_from(list(root.iter()))).append(copy.deepcopy(element))
    return ET.tostring(root)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=8 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_a_spoilt_file_is_read_or_refused(folder, name, data):
    target = fuzz.TARGETS[name]
    seed = data.draw(st.sampled_from(target.seeds()), label="seed")
    fuzz.try_input(target, data.draw(spoilt(seed), label="input"), folder)


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
def test_a_setting_is_taken_as_it_is_or_refused_by_its_name(data: st.DataObject) -> None:
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
def test_a_changed_document_gives_the_same_grasps_or_one_clear_error(data: st.DataObject) -> None:
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


GOOD_ARCHIVES: list[dict[str, np.ndarray]] = [
    {"points": np.ones((5, 3)), "viewpoint": np.zeros(3), "forward": np.ones(3)},
    {"depth": np.ones((4, 6)), "K": np.diag([5.0, 5.0, 1.0]), "distortion": np.zeros(5), "T_world_camera": np.eye(4)},
    {"depths": np.ones((2, 4, 6)), "K": np.diag([5.0, 5.0, 1.0]), "poses": np.stack([np.eye(4)] * 2)},
]


@pytest.mark.parametrize("good", GOOD_ARCHIVES, ids=lambda good: next(iter(good)))
@settings(max_examples=15 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_an_archive_of_any_arrays_gives_points_or_an_error(folder, good, data):
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


@pytest.fixture(autouse=True, scope="module")
def forgetful() -> Iterator[None]:
    """Nothing is kept on disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GRASPD_CACHE", "off")
        yield


# Lengths as objects have them, on a coarse lattice so that corners coincide and faces lie in one plane, and wild ones.
lengths = st.one_of(st.integers(-4, 4).map(lambda n: n * 0.01), st.floats(-0.1, 0.1))
wild = st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 1e9, 50.0, 1e-300, 5e-324])


@st.composite
def meshes(draw: st.DrawFn) -> TriangleMesh:
    """Triangles at random among few corners, or a shape with corners and faces changed."""
    if draw(st.booleans()):
        count = draw(st.integers(0, 10))
        vertices = np.array(draw(st.lists(st.tuples(lengths, lengths, lengths), min_size=count, max_size=count)))
        index = st.integers(0, max(count - 1, 0))
        faces = np.array(draw(st.lists(st.tuples(index, index, index), max_size=20)), dtype=np.int64)
    else:
        shape = make_shape(draw(st.sampled_from(["box", "l_block", "plate"])))
        vertices, faces = shape.vertices.copy(), shape.faces.copy()
        for _ in range(draw(st.integers(0, 3))):
            a, b = draw(st.integers(0, len(faces) - 1)), draw(st.integers(0, len(faces) - 1))
            action = draw(st.sampled_from(["flip", "drop", "repeat", "join", "move"]))
            if action == "flip":
                faces[a] = faces[a, ::-1]
            elif action == "drop" and len(faces) > 2:
                faces = np.delete(faces, a, axis=0)
            elif action == "repeat":
                faces = np.concatenate([faces, faces[[b]]])
            elif action == "join":
                faces[a, 0] = faces[b, 1]
            else:
                vertices[faces[a, 0]] += [draw(lengths), draw(lengths), draw(lengths)]
        if draw(st.booleans()):
            vertices = np.concatenate([vertices, vertices[:3]])
    vertices, faces = vertices.reshape(-1, 3).astype(float), faces.reshape(-1, 3)
    for _ in range(draw(st.sampled_from([0, 0, 0, 1, 2]))):
        if len(vertices) and draw(st.booleans()):
            vertices[draw(st.integers(0, len(vertices) - 1)), draw(st.integers(0, 2))] = draw(wild)
        elif len(faces):
            faces[draw(st.integers(0, len(faces) - 1)), 0] = draw(st.sampled_from([-1, 10**6, 2**62]))
    return TriangleMesh(vertices, faces)


def assert_finite(scene: Scene) -> None:
    """Mass, centre, distances and normals are numbers, and normals have length one."""
    target = scene.object
    assert np.isfinite([target.volume, target.mass, target.radius, *target.center_of_mass, *target.inertia.flat]).all()
    assert target.volume > 0
    assert scene.sdf.field.isfinite().all()
    low, high = target.mesh.vertices.min(0), target.mesh.vertices.max(0)
    points = np.random.default_rng(0).uniform(low - 0.05, high + 0.05, (64, 3))
    distance, normal = sample_sdf(scene.sdf, scene.sdf.origin.new_tensor(points))
    assert distance.isfinite().all()
    assert normal.norm(dim=-1).numpy() == pytest.approx(1.0, abs=1e-3)


@settings(max_examples=80 * LONGER, derandomize=LONGER == 1)
@given(mesh=meshes())
def test_a_mesh_is_cleaned_or_refused_by_name(mesh: TriangleMesh) -> None:
    made, refusal = fuzz.outcome(lambda: check_mesh(mesh, "thing.obj"), MeshError)
    if refusal is not None:
        assert refusal.startswith("thing.obj: ")
        return
    clean, warnings = made
    assert np.isfinite(clean.vertices).all()
    assert 0 <= clean.faces.min() <= clean.faces.max() < len(clean.vertices)
    assert all(text.startswith("thing.obj: ") for text in warnings)
    again, _ = check_mesh(clean, "thing.obj")
    assert len(again.faces) == len(clean.faces)


@settings(max_examples=10 * LONGER, derandomize=LONGER == 1)
@given(mesh=meshes())
def test_a_mesh_makes_a_scene_of_finite_numbers_or_is_refused(mesh: TriangleMesh) -> None:
    scene, refusal = fuzz.outcome(lambda: load_scene(mesh, resolution=12), MeshError)
    if refusal is None:
        assert_finite(scene)


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    """Few points, a plane, a line, one point many times, a bump on a plane; some of them spoilt."""
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    count = draw(st.sampled_from([0, 1, 3, 10, 300]))
    kind = draw(st.sampled_from(["noise", "plane", "line", "point", "bump"]))
    points = rng.uniform(-0.05, 0.05, (count, 3))
    points[:, 2] += 0.5
    if kind in ("plane", "bump"):
        points[:, 2] = 0.5 - 0.03 * (kind == "bump") * (np.linalg.norm(points[:, :2], axis=1) < 0.02)
    elif kind == "line":
        points[:, :2] = points[:, [2]] * 0.1
    elif kind == "point":
        points[:] = [0, 0, 0.5]
    if count and draw(st.booleans()):
        points[rng.random(count) < draw(st.sampled_from([0.1, 1.0])), draw(st.integers(0, 2))] = draw(wild)
    return PointCloud(points, np.zeros(3), draw(st.sampled_from([None, np.array([0.0, 0.0, 1.0])])))


@settings(max_examples=8 * LONGER, derandomize=LONGER == 1)
@given(views=st.lists(clouds(), min_size=0, max_size=2), alone=st.booleans())
def test_views_make_a_scene_of_finite_numbers_or_are_refused(views, alone):
    scene, refusal = fuzz.outcome(
        lambda: scene_from_views(views, alone=alone, source="views", resolution=12), CloudError, MeshError
    )
    if refusal is None:
        assert_finite(scene)
