"""What a hand looks like: visual shapes where the URDF has them, whole and bounded; else its collision solids."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.hands.model import Primitive
from graspd_core.hands.readers.visual_solids import _simpler, visual_solids
from graspd_core.mesh.mesh_files import save_mesh
from graspd_core.mesh.shapes import make_shape
from graspd_core.types import TriangleMesh

FINGER = """<joint name="j{0}" type="revolute"><parent link="palm"/><child link="f{0}"/><origin xyz="0 {1} 0"/>
  <axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <link name="f{0}">{2}<collision><geometry><box size="0.02 0.02 0.08"/></geometry></collision></link>"""
MESH = '<visual><origin xyz="0 0 0.03"/><geometry><mesh filename="shown.ply" scale="{}"/></geometry></visual>'


def hand_of(folder: Path, mesh: TriangleMesh, scale: str, prefix: str = ""):
    """Two fingers on a palm; the first shows a mesh, the second nothing of its own."""
    save_mesh(mesh, folder / "shown.ply")
    palm = '<link name="palm"><collision><geometry><box size="0.08 0.1 0.02"/></geometry></collision></link>'
    fingers = FINGER.format(1, 0.03, MESH.format(scale)), FINGER.format(2, -0.03, "")
    (folder / "hand.urdf").write_text(f'<robot name="two">{palm}{"".join(fingers)}</robot>')
    return load_hand(folder / "hand.urdf", candidates=50, prefix=prefix)


def fine_ring() -> TriangleMesh:
    import trimesh

    ring = trimesh.creation.torus(0.04, 0.01, major_sections=100, minor_sections=60)
    return TriangleMesh(np.array(ring.vertices), np.array(ring.faces, dtype=np.int64))


@pytest.mark.parametrize("prefix", ["", "left_"])
def test_a_mesh_is_drawn_whole_and_bounded_and_other_links_as_they_collide(tmp_path: Path, prefix: str):
    ring = fine_ring()
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
    soup = Primitive(0, "hull", np.eye(3), np.zeros(3), (), corners, np.arange(3 * 9000).reshape(-1, 3))
    drawn = _simpler(soup, 0.1)
    assert len(drawn.faces) <= 900 * 1.5
    assert np.ptp(drawn.vertices) > 0.8 * np.ptp(corners)
