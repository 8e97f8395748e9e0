"""Meshes that hands name: found where ROS keeps them, read as hulls, refused by name, and drawn whole but bounded."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from made_meshes import taken

from graspd_core import HandModel, TriangleMesh, make_shape, save_mesh
from graspd_core.errors import HandError
from graspd_core.hands.library import hand_hash, hand_names, load_hand, read_hand_file
from graspd_core.hands.readers.urdf import visual_solids

WEDGE = "v 0 0 0\nv 0.02 0 0\nv 0 0.02 0\nv 0 0 0.03\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
URDF = (
    '<robot name="m"><link name="a"><collision><geometry><mesh filename="{name}"{scale}/></geometry></collision></link>'
    '<link name="b"/><joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>'
)


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """Two packages beside each other, one in a folder of another name, and an installed one."""
    for folder, package in (("hand_description", "hand_description"), ("checkout-1.2", "meshes_pkg")):
        (tmp_path / "src" / folder / "urdf").mkdir(parents=True)
        (tmp_path / "src" / folder / "meshes").mkdir()
        (tmp_path / "src" / folder / "package.xml").write_text(f"<package><name> {package} </name></package>")
        (tmp_path / "src" / folder / "meshes" / "wedge one.obj").write_text(WEDGE)
    (tmp_path / "opt" / "share" / "far" / "m").mkdir(parents=True)
    (tmp_path / "opt" / "share" / "far" / "m" / "wedge.obj").write_text(WEDGE)
    return tmp_path


def _read(workspace: Path, name: str, scale: str = "") -> HandModel:
    path = workspace / "src" / "hand_description" / "urdf" / "hand.urdf"
    path.write_text(URDF.format(name=name, scale=f' scale="{scale}"' if scale else ""))
    return read_hand_file(path)


@pytest.mark.parametrize(
    "name",
    [
        "../meshes/wedge one.obj",
        "meshes/wedge one.obj",
        "package://hand_description/meshes/wedge one.obj",
        "package://meshes_pkg/meshes/wedge%20one.obj",
        "model://hand_description/meshes/wedge one.obj",
        "package://renamed_since/meshes/wedge one.obj",
        "..\\meshes\\wedge one.obj",
        "file://{src}/hand_description/meshes/wedge%20one.obj",
        "{src}/hand_description/meshes/wedge one.obj",
    ],
)
def test_a_mesh_is_found(workspace: Path, name: str) -> None:
    hand = _read(workspace, name.format(src=workspace / "src"))
    np.testing.assert_allclose(np.ptp(hand.primitives[0].vertices, axis=0), [0.02, 0.02, 0.03])


@pytest.mark.parametrize(("variable", "folder"), [("AMENT_PREFIX_PATH", "opt"), ("ROS_PACKAGE_PATH", "opt/share/far")])
def test_a_package_is_found_where_ros_says(workspace, variable, folder, monkeypatch):
    name = "package://far/m/wedge.obj"
    with pytest.raises(
        HandError, match=r"link 'a': mesh 'package://far/m/wedge.obj' was not found in any package path"
    ):
        _read(workspace, name)
    monkeypatch.setenv(variable, f"/nowhere:{workspace / folder}")
    assert len(_read(workspace, name).primitives) == 1


def test_a_mesh_taken_from_beside_the_file_is_warned_of(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its package is nowhere, but the path in it exists beside the URDF: perhaps another hand's mesh."""
    found = _read(workspace, "package://lost/meshes/wedge one.obj")
    assert "package 'lost' was not found; meshes are searched beside the file and above it" in found.warnings
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(workspace / "opt/share/far"))
    assert _read(workspace, "package://far/m/wedge.obj").warnings == _read(workspace, "meshes/wedge one.obj").warnings


@pytest.mark.parametrize("scale", ["-1 1 1", "1 -2 1", "-1 -1 -1", "0.5"])
def test_a_mirrored_hull_is_wound_outwards(workspace: Path, scale: str) -> None:
    hull = _read(workspace, "meshes/wedge one.obj", scale).primitives[0]
    a, b, c = (hull.vertices[hull.faces[:, i]] for i in range(3))
    outward = np.einsum("fi,fi->f", np.cross(b - a, c - a), a - hull.vertices.mean(0))
    assert (outward > 0).all()
    factors = np.resize([float(word) for word in scale.split()], 3)
    np.testing.assert_allclose(hull.vertices.sum(0), factors * [0.02, 0.02, 0.03], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "scale", "message"),
    [
        ("", "", r"hand.urdf:1: link 'a': mesh '' was not found"),
        ("https://example.org/x.stl", "", "is not fetched from the network"),
        ("x" * 5000, "", "was not found in the file"),
        ("meshes/wedge one.obj", "0 1 1", "a factor cannot be zero"),
        ("meshes/wedge one.obj", "1000 1000 1000", "is 30 m across: if it is in millimetres, scale it by 0.001"),
        ("meshes/wedge one.obj", "0.001", r"is 0.03 mm across; valid: 0.3 mm or more; if its file is in metres"),
        ("meshes/wedge one.obj", "1 1", "expected 3 finite number"),
        ("broken.obj", "", "link 'a': mesh 'broken.obj' cannot be read"),
        ("../package.xml", "", "cannot be read as a collision mesh: .*unknown mesh ending"),
    ],
)
def test_a_mesh_that_cannot_be_used_is_named(workspace: Path, name: str, scale: str, message: str) -> None:
    (workspace / "src" / "hand_description" / "urdf" / "broken.obj").write_text("v 1 2\nf 1 2 9\n")
    with pytest.raises(HandError, match=message):
        _read(workspace, name, scale)


def test_a_replaced_mesh_is_read_anew_and_changes_the_hash_of_its_hand(workspace: Path) -> None:
    mesh, urdf = (workspace / "src" / "hand_description" / name for name in ("meshes/wedge one.obj", "urdf/hand.urdf"))
    before, hashed = _read(workspace, "meshes/wedge one.obj").primitives[0], hand_hash(str(urdf))
    stamp = mesh.stat().st_mtime_ns
    mesh.write_text(WEDGE.replace("0.03", "0.05"))
    os.utime(mesh, ns=(stamp, stamp))
    hand_hash.cache_clear()
    after = _read(workspace, "meshes/wedge one.obj").primitives[0]
    assert np.ptp(after.vertices, axis=0).max() > np.ptp(before.vertices, axis=0).max()
    assert hand_hash(str(urdf)) != hashed


def test_a_flat_mesh_becomes_a_thin_plate(workspace: Path) -> None:
    flat = workspace / "src" / "hand_description" / "meshes" / "flat.obj"
    flat.write_text("v 0 0 0\nv 0.02 0 0\nv 0 0.02 0\nf 1 2 3\n")
    assert np.ptp(_read(workspace, "meshes/flat.obj").primitives[0].vertices, axis=0).min() == pytest.approx(0.001)


FINGER = """<joint name="j{0}" type="revolute"><parent link="palm"/><child link="f{0}"/><origin xyz="0 {1} 0"/>
  <axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <link name="f{0}">{2}<collision><geometry><box size="0.02 0.02 0.08"/></geometry></collision></link>"""
SHOWN = '<visual><origin xyz="0 0 0.03"/><geometry><mesh filename="shown.ply" scale="{}"/></geometry></visual>'


def hand_of(folder: Path, mesh: TriangleMesh, scale: str, prefix: str = ""):
    """Two fingers on a palm; the first shows a mesh, the second nothing of its own."""
    save_mesh(folder / "shown.ply", mesh)
    palm = '<link name="palm"><collision><geometry><box size="0.08 0.1 0.02"/></geometry></collision></link>'
    fingers = FINGER.format(1, 0.03, SHOWN.format(scale)), FINGER.format(2, -0.03, "")
    (folder / "hand.urdf").write_text(f'<robot name="two">{palm}{"".join(fingers)}</robot>')
    return load_hand(folder / "hand.urdf", candidates=50, prefix=prefix)


@pytest.mark.parametrize("prefix", ["", "left_"])
def test_a_mesh_is_drawn_whole_and_bounded_and_other_links_as_they_collide(tmp_path: Path, prefix: str):
    ring = taken(trimesh.creation.torus(0.04, 0.01, major_sections=100, minor_sections=60))
    assert len(ring.faces) > 8000
    hand = hand_of(tmp_path, ring, "0.5 0.5 -0.5", prefix)
    drawn = visual_solids(hand, prefix)
    (shown,) = (shape for shape in drawn if hand.link_names[shape.link] == f"{prefix}f1")
    assert 3000 < len(shown.faces) <= 4000
    np.testing.assert_allclose(shown.translation, [0, 0, 0.03])
    np.testing.assert_allclose(np.ptp(shown.vertices, axis=0), 0.5 * np.ptp(ring.vertices, axis=0), rtol=0.02)
    # Mirrored, its faces still look outwards; the ring's hole stays open.
    a, b, c = shown.vertices[shown.faces].transpose(1, 0, 2)
    volume = float((np.cross(a, b) * c).sum()) / 6
    assert 0 < volume < 0.5 * float(np.prod(np.ptp(shown.vertices, axis=0)))
    others = [shape for shape in drawn if shape is not shown]
    assert others == [shape for shape in hand.primitives if shape.link != shown.link]


@pytest.mark.parametrize("name", hand_names())
def test_the_shipped_hands_are_drawn_link_by_link(name: str):
    hand = load_hand(name, candidates=50)
    drawn = visual_solids(hand)
    assert {shape.link for shape in drawn} >= {shape.link for shape in hand.primitives}
    assert sum(len(shape.faces) for shape in drawn) <= 4000 + 60 * len(drawn)


def test_a_visual_mesh_that_is_gone_is_named(tmp_path: Path):
    hand = hand_of(tmp_path, make_shape("mug"), "1 1 1")
    (tmp_path / "shown.ply").unlink()
    with pytest.raises(HandError, match=r"hand.urdf:\d+: link 'f1': mesh 'shown.ply' was not found"):
        visual_solids(hand)


def test_a_surface_that_cannot_be_simplified_is_drawn_as_its_hull(tmp_path: Path):
    """Triangles that share no corner: none can be taken away without a gap."""
    corners = np.random.default_rng(0).normal(size=(3 * 9000, 3)) * 0.02
    hand = hand_of(tmp_path, TriangleMesh(corners, np.arange(3 * 9000).reshape(-1, 3)), "1 1 1")
    (drawn,) = (shape for shape in visual_solids(hand) if hand.link_names[shape.link] == "f1")
    assert len(drawn.faces) <= 4000
    assert np.ptp(drawn.vertices) > 0.8 * np.ptp(corners)
