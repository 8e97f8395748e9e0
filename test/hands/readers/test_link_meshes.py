"""Meshes that hands name: found where ROS keeps them, read as hulls, refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.library import read_hand_file
from graspd_core.hands.model import HandModel

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
def test_a_package_is_found_where_ros_says(
    workspace: Path, variable: str, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "package://far/m/wedge.obj"
    with pytest.raises(
        HandError, match=r"link 'a': mesh 'package://far/m/wedge.obj' was not found in any package path"
    ):
        _read(workspace, name)
    monkeypatch.setenv(variable, f"/nowhere:{workspace / folder}")
    assert len(_read(workspace, name).primitives) == 1


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
        ("x" * 5000, "", "was not found beside the file"),
        ("meshes/wedge one.obj", "0 1 1", "a factor cannot be zero"),
        ("meshes/wedge one.obj", "1000 1000 1000", "is 30 m across: if it is in millimetres, scale it by 0.001"),
        ("meshes/wedge one.obj", "1 1", "expected 3 finite number"),
        ("broken.obj", "", "link 'a': mesh 'broken.obj' cannot be read"),
        ("../package.xml", "", "cannot be read as a collision mesh: .*unknown mesh ending"),
    ],
)
def test_a_mesh_that_cannot_be_used_is_named(workspace: Path, name: str, scale: str, message: str) -> None:
    (workspace / "src" / "hand_description" / "urdf" / "broken.obj").write_text("v 1 2\nf 1 2 9\n")
    with pytest.raises(HandError, match=message):
        _read(workspace, name, scale)


def test_a_flat_mesh_becomes_a_thin_plate(workspace: Path) -> None:
    flat = workspace / "src" / "hand_description" / "meshes" / "flat.obj"
    flat.write_text("v 0 0 0\nv 0.02 0 0\nv 0 0.02 0\nf 1 2 3\n")
    assert np.ptp(_read(workspace, "meshes/flat.obj").primitives[0].vertices, axis=0).min() == pytest.approx(0.001)
