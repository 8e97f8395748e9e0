"""Contact, penetration and overlap of boxes and of a hand that is one surface, against volumes worked out on paper."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd_bench.studies.human_hand import CONTACT_DISTANCES, measure_skin
from graspd_core.hands.library import load_hand
from graspd_core.hands.link_distance import depth_inside
from graspd_core.mesh.surface_queries import make_distance_query
from graspd_core.types import TriangleMesh
from graspd_core.verify.prepared_grasp import (
    contact_area,
    contact_links,
    intersection_volume,
    make_metrics_context,
    penetration,
    placed_hand,
    self_penetration,
    touching,
)

# The block's surface is 2·(40·30 + 30·20 + 20·40) = 5200 mm², seen by some 4000 samples: an area of A mm² is counted
# to three standard deviations of 3·sqrt(A·1.3) mm² or better.
MM2, MM3 = 1e-6, 1e-9


def area_noise(area: float) -> float:
    return 3 * np.sqrt(area / MM2 * 1.3) * MM2


@pytest.mark.parametrize("depth", [0.005, 0.012])
def test_a_block_sunk_into_a_flat_face(depth, block, box, as_object, at):
    context = make_metrics_context(as_object(box), block)
    placed = placed_hand(context, at((0.05 - depth, 0, 0), (0.0,)))
    # The whole end of 30 x 20 mm lies `depth` below the face; Embree counts in float32.
    assert penetration(placed) == pytest.approx(depth, abs=1e-7)
    # Whole voxels fit this pose, so the count is exact.
    assert intersection_volume(context, placed) == pytest.approx(depth * 0.03 * 0.02, rel=1e-9)
    assert contact_links(placed) == 1
    # Only the four sides come near the face, in a band as wide as twice the distance about a perimeter of 100 mm.
    assert contact_area(placed) == pytest.approx(0.1 * 0.004, abs=area_noise(0.0004))
    assert contact_area(placed, 0.004) == pytest.approx(0.1 * 0.008, abs=area_noise(0.0008))
    if depth == 0.005:
        # Within 10 mm: the end, 5 mm of the sides within and 10 mm without.
        assert contact_area(placed, 0.01) == pytest.approx(0.0006 + 0.1 * 0.015, abs=area_noise(0.0021))


@pytest.mark.parametrize("gap", [0.001, 0.003])
def test_a_block_before_a_face_touches_only_within_two_millimetres(gap, block, box, as_object, at):
    context = make_metrics_context(as_object(box), block)
    placed = placed_hand(context, at((0.05 + gap, 0, 0), (0.0,)))
    assert penetration(placed) == 0.0
    assert intersection_volume(context, placed) == 0.0
    assert contact_links(placed) == touching(placed).any() == (gap < 0.002)
    # The end of 600 mm², and 1 mm of the sides.
    expected = 0.0006 + 0.1 * 0.001 if gap < 0.002 else 0.0
    assert contact_area(placed) == pytest.approx(expected, abs=area_noise(0.0007) if expected else 0.0)


def test_the_overlap_with_a_thin_rod_is_counted_deep_inside_the_hand(block, box, as_object, at):
    # Three millimetres square, right through the block's 20 mm: most of it is far from the hand's surface.
    rod = TriangleMesh(box.vertices * np.array([0.0015, 0.0015, 0.045]) / np.array([0.03, 0.03, 0.045]), box.faces)
    context = make_metrics_context(as_object(rod), block)
    placed = placed_hand(context, at((0.0005, 0.0005, 0), (0.0,)))
    assert intersection_volume(context, placed) == pytest.approx(3 * 3 * 20 * MM3, rel=1e-9)


def test_the_overlap_of_a_block_wholly_inside_is_its_volume(block, box, as_object, at):
    context = make_metrics_context(as_object(box), block)
    # Turned by 1 rad about the x axis: 15 and 10 mm reach at most 18 mm, so that it stays within the box's 30 mm.
    placed = placed_hand(context, at((0.0, 0, 0), (0.0,), (np.cos(0.5), np.sin(0.5), 0, 0)))
    assert intersection_volume(context, placed) == pytest.approx(40 * 30 * 20 * MM3, rel=1e-9)
    assert touching(placed).all()


def test_a_slanted_overlap_is_within_the_voxels_error(block, box, as_object, at):
    context = make_metrics_context(as_object(box), block)
    # About z by 45°: a corner of the block goes in. Depth t of a right-angled edge over 20 mm: t² · 20 mm.
    turn = np.deg2rad(45.0)
    corner = np.array([-0.02 * np.cos(turn) - 0.015 * np.sin(turn), 0, 0])
    depth = 0.008
    placed = placed_hand(
        context, at((0.03 - depth - corner[0], 0, 0), (0.0,), (np.cos(turn / 2), 0, 0, np.sin(turn / 2)))
    )
    # A slanted face of 1 mm voxels: about half a voxel over a face of 16 x 20 mm, with signs that mostly cancel.
    assert intersection_volume(context, placed) == pytest.approx(depth**2 * 0.02, rel=0.05)
    assert penetration(placed) == pytest.approx(depth, abs=0.0005)


def test_fingers_that_pass_through_each_other(gripper, box, as_object, at):
    context = make_metrics_context(as_object(box), gripper)
    far = (0.0, 0.0, 1.0)
    # Inner faces are 45 mm − q from the middle: at 46 mm each is 2 mm inside the other finger.
    assert self_penetration(context, placed_hand(context, at(far, (0.046, 0.046)))) == pytest.approx(0.002, abs=1e-9)
    assert self_penetration(context, placed_hand(context, at(far, (0.044, 0.044)))) == 0.0


SOLIDS = """<robot name="solids"><link name="base">
  <collision><origin xyz="0 0 0.02" rpy="0.3 0 0.2"/><geometry><box size="0.03 0.02 0.05"/></geometry></collision>
  <collision><origin xyz="0.01 0 0.01"/><geometry><sphere radius="0.012"/></geometry></collision>
  <collision><origin xyz="0 0.01 0.03" rpy="1 0 0"/><geometry><cylinder radius="0.01" length="0.04"/></geometry>
  </collision>
  <collision><origin xyz="-0.01 0 0.04"/><geometry><mesh filename="lump.stl"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="0 0 0.05"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="tip"><collision><geometry><capsule radius="0.008" length="0.03"/></geometry></collision></link>
</robot>"""


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (0.02, 0.01, -0.05), (0.025, 0.025, 0.0)])
def test_what_solids_of_every_kind_share_with_an_object_is_that_of_all_voxels(where, box, as_object, at, tmp_path):
    trimesh.creation.icosphere(subdivisions=1, radius=0.015).export(tmp_path / "lump.stl")
    (tmp_path / "hand.urdf").write_text(SOLIDS)
    hand = load_hand(tmp_path / "hand.urdf", candidates=8)
    assert sorted(primitive.kind for primitive in hand.primitives) == ["box", "capsule", "cylinder", "hull", "sphere"]
    context = make_metrics_context(as_object(box), hand)
    placed = placed_hand(context, at(where, (0.4,), (0.9, 0.1, -0.2, 0.3)))
    # The hand reaches from −20 mm to 100 mm along z, and 50 mm to either side.
    across, along = np.arange(-50, 50) + 0.5, np.arange(-20, 100) + 0.5
    voxels = np.stack(np.meshgrid(across, across, along, indexing="ij"), -1).reshape(-1, 3) * 0.001
    points = voxels @ placed.rotations[0].T + placed.translations[0]
    points = points[(np.abs(points) < box.vertices.max(0)).all(1)]
    shared = np.zeros(len(points), dtype=bool)
    for link in range(hand.num_links):
        local = (points - placed.translations[link]) @ placed.rotations[link]
        shared |= depth_inside(hand, link, local) > 0
    assert shared.sum() > 1000
    assert intersection_volume(context, placed) == pytest.approx(shared.sum() * MM3, rel=1e-12)


def mesh_of(made: trimesh.Trimesh, shift: np.ndarray) -> TriangleMesh:
    return TriangleMesh(np.asarray(made.vertices) + shift, np.asarray(made.faces, dtype=np.int64))


def cube_of(size: float, shift: np.ndarray) -> TriangleMesh:
    return mesh_of(trimesh.creation.box(extents=np.full(3, size)), shift)


@pytest.mark.parametrize("depth", [0.0, 0.001, 0.006])
def test_a_box_that_sinks_into_a_box(depth: float) -> None:
    """A cube of 40 mm whose face lies `depth` below that of one of 60 mm."""
    shift = np.array([0.0, 0.0, 0.05 - depth])
    found = measure_skin(make_distance_query(cube_of(0.06, np.zeros(3))), cube_of(0.04, shift))
    assert found.intersection_volume == pytest.approx(0.04**2 * depth, abs=1e-9)
    assert found.penetration == pytest.approx(depth, abs=1e-6)
    # Near the object's face: the skin's own face, and of its sides the strips within reach on either side of it.
    for within, area in zip(CONTACT_DISTANCES, found.contact_area, strict=True):
        expected = 0.04**2 * (depth <= within) + 4 * 0.04 * (within + min(depth, within))
        # A strip of 2 mm has 1300 of the samples: 6 % are two standard deviations of their number.
        assert area == pytest.approx(expected, rel=0.06)


def test_spheres_share_a_lens_and_bodies_far_apart_nothing() -> None:
    """Two balls of 30 mm whose centres are 50 mm apart share π (4r + d)(2r − d)² / 12 (MathWorld)."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    query = make_distance_query(mesh_of(ball, np.zeros(3)))
    found = measure_skin(query, mesh_of(ball, np.array([0.05, 0.0, 0.0])))
    expected = np.pi * (4 * 0.03 + 0.05) * (2 * 0.03 - 0.05) ** 2 / 12
    # Facets lie up to 0.04 mm inside the ball, of a lens 10 mm deep; the rest is the voxels' edge.
    assert found.intersection_volume == pytest.approx(expected, rel=0.03)
    assert found.penetration == pytest.approx(0.01, abs=1e-4)
    found = measure_skin(make_distance_query(cube_of(0.06, np.zeros(3))), cube_of(0.04, np.full(3, 0.5)))
    assert found.contact_area == (0.0, 0.0, 0.0)
    assert (found.intersection_volume, found.penetration) == (0.0, 0.0)


def test_figures_do_not_depend_on_the_frame() -> None:
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.7, 0.4]))
    turn[:3, 3] = [0.3, -0.2, 0.1]
    figures = []
    for transform in (np.eye(4), turn):
        target = trimesh.creation.box(extents=[0.05, 0.06, 0.07]).apply_transform(transform)
        skin = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
        skin.apply_translation([0.035, 0.0, 0.0]).apply_transform(transform)
        query = make_distance_query(mesh_of(target, np.zeros(3)))
        figures.append(measure_skin(query, mesh_of(skin, np.zeros(3))))
    assert figures[0].contact_area == pytest.approx(figures[1].contact_area, rel=0.06)
    assert figures[0].intersection_volume == pytest.approx(figures[1].intersection_volume, rel=0.02)
