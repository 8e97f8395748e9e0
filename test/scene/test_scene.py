"""Scenes from every kind of source, and the cache behind them."""

import io
import os
import re
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from shape_volumes import shape_volume

from graspd_core import TriangleMesh, load_scene
from graspd_core.errors import ConfigError, MeshError
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import SPHERE_RADIUS
from graspd_core.perception.scene import build_scene, heavy_mass, moved_grasp, object_parts
from graspd_core.runtime import disk_cache as cache
from graspd_core.types import Grasp, Plane, Posture


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    # A run of an earlier file may still cut an object. It would write its parts here.
    for thread in threading.enumerate():
        if thread.name.startswith("graspd-"):
            thread.join(60)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("GRASPD_CACHE", raising=False)
    cache.forget()
    yield tmp_path / "cache" / "graspd"
    cache.forget()


def test_a_sphere_scene_holds_the_closed_forms():
    scene = load_scene("shape:sphere", mass=0.2, friction=0.8, resolution=24)
    thing = scene.object
    assert thing.source == "shape:sphere"
    assert (thing.mass, thing.friction, thing.scale) == (0.2, 0.8, 1.0)
    assert thing.volume == pytest.approx(shape_volume("sphere"), rel=0.01)
    assert thing.center_of_mass == pytest.approx(np.zeros(3), abs=1e-6)
    assert thing.radius == pytest.approx(SPHERE_RADIUS, rel=1e-6)
    # Solid ball: I = 2/5 m r².
    assert thing.inertia == pytest.approx(np.eye(3) * 0.4 * 0.2 * SPHERE_RADIUS**2, rel=0.02, abs=1e-9)
    assert thing.warnings == ()
    assert min(scene.timing) > 0


# The ten YCB scans that docs/metrics.md names: volume [cm³] and mass [kg].
YCB = (
    (2173, 0.411), (319, 0.349), (612, 0.603), (172, 0.066), (33, 0.147), (138, 0.118), (581, 0.895), (259, 0.665),
    (203, 0.138), (185, 0.028),
)  # fmt: skip


def test_a_mass_that_nobody_gave_is_the_heavy_end_and_is_told():
    thing = load_scene("shape:box", resolution=16).object
    assert thing.mass_assumed
    assert thing.mass == heavy_mass(shape_volume("box"))
    assert f"{thing.mass:.2g} kg is assumed" in thing.warnings[-1]
    np.testing.assert_allclose(thing.inertia, load_scene("shape:box", mass=thing.mass, resolution=16).object.inertia)
    # A ball of water as large as a bottle, and a steel bolt, are no heavier.
    assert heavy_mass(1.5e-3) > 1.5
    assert heavy_mass(2e-5) > 7850 * 2e-5
    assert all(mass < heavy_mass(volume * 1e-6) for volume, mass in YCB)


def test_a_mass_that_was_given_is_exact_and_nothing_is_told():
    thing = load_scene("shape:box", mass=0.123, resolution=16).object
    assert (thing.mass, thing.mass_assumed, thing.warnings) == (0.123, False, ())
    assert thing.at_mass(0.246).inertia == pytest.approx(2 * thing.inertia)


@pytest.mark.parametrize(
    "setting", [{"mass": 0.0}, {"mass": float("nan")}, {"friction": -1.0}, {"friction": 60.0}, {"resolution": 2}]
)
def test_numbers_out_of_range_are_named(setting):
    with pytest.raises(MeshError, match=next(iter(setting))):
        load_scene("shape:box", **setting)


def test_a_sheet_is_warned_about():
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
    scene = build_scene(TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), source="sheet", resolution=16)
    assert any("not closed" in w for w in scene.object.warnings)
    assert any("the object counts as a sheet" in w for w in scene.object.warnings)
    assert (np.linalg.eigvalsh(scene.object.inertia) > 0).all()


def fields_of(own_cache):
    return sorted(own_cache.glob("sdf-*.npz"))


def test_the_second_scene_comes_from_the_disk(own_cache):
    first = load_scene("shape:torus", resolution=16)
    (file,) = fields_of(own_cache)
    place = file.stat().st_ino
    cache.forget()
    second = load_scene("shape:torus", resolution=16)
    assert torch.equal(first.sdf.field, second.sdf.field)
    assert torch.equal(first.sdf.origin, second.sdf.origin)
    assert file.stat().st_ino == place
    assert not list(own_cache.glob("*.part"))


def alien(_: bytes) -> bytes:
    """An archive of something else."""
    stream = io.BytesIO()
    np.savez(stream, other=np.zeros(3))
    return stream.getvalue()


DAMAGE = [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:900] + b"\xff" * 99 + b[999:], alien]


@pytest.mark.parametrize("damage", DAMAGE, ids=["half", "empty", "scratched", "alien"])
def test_a_damaged_file_is_built_again(own_cache, damage):
    first = load_scene("shape:torus", resolution=16)
    (file,) = fields_of(own_cache)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    cache.forget()
    again = load_scene("shape:torus", resolution=16)
    assert torch.equal(first.sdf.field, again.sdf.field)
    assert len(file.read_bytes()) == len(whole)


def test_the_disk_does_not_fill_up(own_cache, monkeypatch):
    monkeypatch.setattr(cache, "MOST_BYTES", 3000)
    monkeypatch.setattr(cache, "LOOK_EVERY", 1)
    for number in range(6):
        cache.remember(f"thing-{number}", lambda: {"numbers": np.zeros(100)}, lambda _: True)
        os.utime(own_cache / f"thing-{number}-v{cache.VERSION}.npz", (number, number))
    cache.remember("last", lambda: {"numbers": np.zeros(100)}, lambda _: True)
    left = {file.name.split("-v")[0] for file in own_cache.glob("*.npz")}
    assert left == {"thing-5", "last"}


def test_the_disk_can_be_left_alone_and_an_unwritable_one_is_done_without(own_cache, monkeypatch, tmp_path):
    monkeypatch.setenv("GRASPD_CACHE", "off")
    load_scene("shape:torus", resolution=16)
    assert not own_cache.exists()
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert sample_sdf(load_scene("shape:torus", resolution=16).sdf, torch.zeros(1, 3))[0] > 0


def test_parts_are_made_by_the_grid_of_the_scene(monkeypatch):
    thing = load_scene("shape:l_block").object
    monkeypatch.setattr("graspd_core.mesh.sdf.closest_points", lambda *_: pytest.fail("built another grid"))
    assert len(object_parts(thing)) == 2


def test_parts_are_remembered():
    thing = load_scene("shape:l_block", resolution=16).object
    parts = object_parts(thing)
    cache.forget()
    again = object_parts(thing)
    assert len(parts) == len(again) >= 2
    for one, other in zip(parts, again, strict=True):
        assert np.array_equal(one.vertices, other.vertices)
        assert np.array_equal(one.faces, other.faces)


def test_a_reconstructed_object_has_coarser_parts_than_the_same_mesh():
    mesh = load_scene("shape:bowl", resolution=32).object.mesh
    seen = build_scene(mesh, resolution=32, confidence=np.ones(len(mesh.vertices))).object
    known = build_scene(mesh, resolution=32).object
    assert seen.sha256 == known.sha256
    assert seen.reconstructed > known.reconstructed
    assert len(object_parts(seen)) <= 32 < len(object_parts(known)) <= 64


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        (((0.0, 1.0, 1.0), 0.0), "plane normal: [0.0, 1.0, 1.0]; valid: three numbers x, y, z of length 1"),
        (((0.0, 0.0, np.nan), 0.0), "plane normal: [0.0, 0.0, nan]"),
        (((0.0, 0.0, 1.0), np.inf), "plane offset: inf m; valid: a finite number"),
        (((0.0, 0.0, 1.0), 0.0, -0.01), "plane margin: -0.01 m; valid: a finite number, 0 or more"),
    ],
)
def test_a_plane_that_is_none_is_refused(numbers, told: str):
    """Trials would tilt the table by another angle than the search, and gravity would be stronger."""
    normal, *others = numbers
    with pytest.raises(ConfigError, match=re.escape(told)):
        Plane(np.array(normal), *others)


def test_a_damaged_bit_in_any_byte_of_a_file_is_noticed(own_cache):
    numbers = np.arange(3.0)

    def cached() -> np.ndarray:
        cache.forget()
        return cache.remember("bits", lambda: {"numbers": numbers}, lambda arrays: set(arrays) == {"numbers"})[
            "numbers"
        ]

    cached()
    (file,) = own_cache.iterdir()
    content = file.read_bytes()
    for at in range(len(content)):
        changed = bytearray(content)
        changed[at] ^= 1 << at % 8
        file.write_bytes(changed)
        assert np.array_equal(cached(), numbers), at


def test_a_file_of_another_user_is_read_and_an_interrupted_one_is_removed(own_cache, monkeypatch):
    def build() -> dict[str, np.ndarray]:
        return {"numbers": np.zeros(built.append(1) or 3)}

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    built: list[int] = []
    cache.remember("theirs", build, lambda _: True)
    cache.forget()
    monkeypatch.setattr(os, "utime", refuse)
    cache.remember("theirs", build, lambda _: True)
    assert len(built) == 1
    monkeypatch.setattr(np, "savez", interrupt)
    with pytest.raises(KeyboardInterrupt):
        cache.remember("interrupted", build, lambda _: True)
    assert len(list(own_cache.iterdir())) == 1


def test_files_of_killed_processes_are_removed_too(own_cache, monkeypatch):
    monkeypatch.setattr(cache, "MOST_BYTES", 3000)
    monkeypatch.setattr(cache, "LOOK_EVERY", 1)
    own_cache.mkdir(parents=True)
    left = own_cache / "tmpabc.part"
    left.write_bytes(bytes(5000))
    os.utime(left, (1, 1))
    cache.remember("new", lambda: {"numbers": np.zeros(100)}, lambda _: True)
    assert not left.exists()
    assert len(list(own_cache.iterdir())) == 1


def test_a_user_without_a_home_directory_has_no_files(own_cache, monkeypatch):
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", homeless)
    assert cache.remember("homeless", lambda: {"numbers": np.zeros(3)}, lambda _: True)["numbers"].shape == (3,)


def test_all_postures_of_a_grasp_move():
    one = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(2))
    moved = moved_grasp(Grasp(one, one, one, arrival=one), np.ones(3))
    for posture in (moved.pregrasp, moved.grasp, moved.squeeze, moved.arrival):
        assert posture is not None
        assert posture.position.tolist() == [1.0, 1.0, 1.0]
