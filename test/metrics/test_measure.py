"""Metrics of boxes and hands that can be worked out on paper: contact, penetration, overlap, wrench hull, copies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from expected import some
from hypothesis import given, settings
from hypothesis import strategies as st
from made_meshes import box_of, taken
from scipy.spatial import ConvexHull

from graspd_bench.studies.human_hand import CONTACT_DISTANCES, measure_skin
from graspd_core import HandModel, load_hand, make_shape
from graspd_core.hands.link_distance import depth_inside
from graspd_core.mesh.surface_queries import DistanceQuery, make_distance_query
from graspd_core.optimize.kernel.builds import kernel
from graspd_core.perception.scene import ObjectModel, build_scene
from graspd_core.se3 import quaternion_from_rotation, random_rotations
from graspd_core.types import Grasp, GraspMetrics, Posture, TriangleMesh
from graspd_core.verify import prepared_grasp
from graspd_core.verify.compiled_overlap import CompiledQuery
from graspd_core.verify.metrics import distinct, measure
from graspd_core.verify.prepared_grasp import (
    compiled_hull,
    cone_wrenches,
    contact_area,
    contact_links,
    intersection_volume,
    make_metrics_context,
    penetration,
    placed_hand,
    qhull,
    self_penetration,
    surface_normals,
    touching,
    wrench_hull,
)

BLOCK = """<robot name="block">
  <link name="base"/>
  <joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" effort="10" velocity="1"/></joint>
  <link name="block"><collision><geometry><box size="0.04 0.03 0.02"/></geometry></collision></link>
</robot>"""
FINGER = """
  <joint name="{name}_slide" type="prismatic"><parent link="palm"/><child link="{name}"/>
    <origin xyz="0 {y} 0.04"/><axis xyz="0 {sign} 0"/><limit lower="0" upper="0.06" effort="20" velocity="1"/></joint>
  <link name="{name}"><collision><geometry><box size="0.03 0.01 0.06"/></geometry></collision></link>"""
GRIPPER = f"""<robot name="gripper">
  <link name="palm">
    <collision><origin xyz="0 0 -0.01"/><geometry><box size="0.04 0.16 0.02"/></geometry></collision>
  </link>
  {FINGER.format(name="left", y=0.05, sign=-1)}{FINGER.format(name="right", y=-0.05, sign=1)}
</robot>"""


def load(text: str, folder: Path) -> HandModel:
    path = folder / "hand.urdf"
    path.write_text(text)
    return load_hand(path, candidates=8)


@pytest.fixture(scope="session")
def block(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    """One box of 40 x 30 x 20 mm, centred on the base frame at joint value 0."""
    return load(BLOCK, tmp_path_factory.mktemp("block"))


@pytest.fixture(scope="session")
def gripper(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    """Two fingers 10 mm thick that slide along y; their inner faces are 45 mm − q from the middle."""
    return load(GRIPPER, tmp_path_factory.mktemp("gripper"))


BOX = make_shape("box")  # 60 x 60 x 90 mm, centred


def as_object(mesh: TriangleMesh) -> ObjectModel:
    """A mesh as an object of 100 g and friction 0.6."""
    return build_scene(mesh, mass=0.1, resolution=8).object


def at(position: tuple[float, float, float], joints: tuple[float, ...], wxyz=(1.0, 0.0, 0.0, 0.0)) -> Posture:
    """A posture from a position [m] and joint values."""
    return Posture(np.array(position, dtype=float), np.array(wxyz, dtype=float), np.array(joints, dtype=float))


# The block's surface is 2·(40·30 + 30·20 + 20·40) = 5200 mm², seen by some 4000 samples: an area of A mm² is counted
# to three standard deviations of 3·sqrt(A·1.3) mm² or better.
MM2, MM3 = 1e-6, 1e-9


def area_noise(area: float) -> float:
    return 3 * np.sqrt(area / MM2 * 1.3) * MM2


@pytest.mark.parametrize("depth", [0.005, 0.012])
def test_a_block_sunk_into_a_flat_face(depth, block):
    context = make_metrics_context(as_object(BOX), block)
    placed = placed_hand(context, at((0.05 - depth, 0, 0), (0.0,)))
    # The whole end of 30 x 20 mm lies `depth` below the face; Embree counts in float32.
    assert penetration(context, placed) == pytest.approx(depth, abs=1e-7)
    # Exact on the end; cells at its edges count by the thinner of two directions.
    assert intersection_volume(context, placed) == pytest.approx(depth * 0.03 * 0.02, rel=0.02)
    assert contact_links(placed) == 1
    # Only the four sides come near the face, in a band as wide as twice the distance about a perimeter of 100 mm.
    assert contact_area(placed) == pytest.approx(0.1 * 0.004, abs=area_noise(0.0004))
    assert contact_area(placed, 0.004) == pytest.approx(0.1 * 0.008, abs=area_noise(0.0008))
    if depth == 0.005:
        # Within 10 mm: the end, 5 mm of the sides within and 10 mm without.
        assert contact_area(placed, 0.01) == pytest.approx(0.0006 + 0.1 * 0.015, abs=area_noise(0.0021))


@pytest.mark.parametrize("hand_points", [40, 4000])
def test_an_edge_that_goes_deeper_than_every_sample_of_a_face_is_found(hand_points, block, monkeypatch):
    """The block is turned by 45° about y, so that the edge between its end and a side, 30 mm long, sinks in."""
    monkeypatch.setattr(prepared_grasp, "_SAMPLES", hand_points)
    prepared_grasp.hand_surface.cache_clear()
    reach = (0.02 + 0.01) / np.sqrt(2)
    context = make_metrics_context(as_object(BOX), block)
    placed = placed_hand(
        context, at((0.03 + reach - 0.004, 0, 0), (0.0,), (np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0))
    )
    prepared_grasp.hand_surface.cache_clear()
    assert penetration(context, placed) == pytest.approx(0.004, abs=1e-6)


@pytest.mark.parametrize("gap", [0.001, 0.003])
def test_a_block_before_a_face_touches_only_within_two_millimetres(gap, block):
    context = make_metrics_context(as_object(BOX), block)
    placed = placed_hand(context, at((0.05 + gap, 0, 0), (0.0,)))
    assert penetration(context, placed) == 0.0
    assert intersection_volume(context, placed) == 0.0
    assert contact_links(placed) == touching(placed).any() == (gap < 0.002)
    # The end of 600 mm², and 1 mm of the sides.
    expected = 0.0006 + 0.1 * 0.001 if gap < 0.002 else 0.0
    assert contact_area(placed) == pytest.approx(expected, abs=area_noise(0.0007) if expected else 0.0)


@settings(max_examples=10)
@given(depth=st.floats(1e-5, 0.002), across=st.floats(-0.001, 0.001))
def test_a_flat_overlap_counts_however_thin_it_is(depth, across, block):
    context = make_metrics_context(as_object(BOX), block)
    placed = placed_hand(context, at((0.05 - depth, across, across), (0.0,)))
    # But for a rim of cells that the sides cut.
    assert intersection_volume(context, placed) == pytest.approx(depth * 0.03 * 0.02, rel=0.1)


def test_the_overlap_with_a_thin_rod_is_counted_deep_inside_the_hand(block):
    # Three millimetres square, right through the block's 20 mm: most of it is far from the hand's surface.
    context = make_metrics_context(as_object(box_of((0.0015, 0.0015, 0.045))), block)
    placed = placed_hand(context, at((0.0005, 0.0005, 0), (0.0,)))
    # All its cells are cut by its sides.
    assert intersection_volume(context, placed) == pytest.approx(3 * 3 * 20 * MM3, rel=0.15)


def test_a_slanted_overlap_is_within_the_cells_error(block):
    context = make_metrics_context(as_object(BOX), block)
    # About z by 45°: a corner of the block goes in. Depth t of a right-angled edge over 20 mm: t² · 20 mm.
    turn = np.deg2rad(45.0)
    corner = np.array([-0.02 * np.cos(turn) - 0.015 * np.sin(turn), 0, 0])
    depth = 0.008
    placed = placed_hand(
        context, at((0.03 - depth - corner[0], 0, 0), (0.0,), (np.cos(turn / 2), 0, 0, np.sin(turn / 2)))
    )
    # Faces slanted to the cells: errors that mostly cancel.
    assert intersection_volume(context, placed) == pytest.approx(depth**2 * 0.02, rel=0.05)
    assert penetration(context, placed) == pytest.approx(depth, abs=0.0005)


def test_fingers_that_pass_through_each_other(gripper):
    context = make_metrics_context(as_object(BOX), gripper)
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
def test_what_solids_of_every_kind_share_with_an_object_is_that_of_small_voxels(where, tmp_path):
    trimesh.creation.icosphere(subdivisions=1, radius=0.015).export(tmp_path / "lump.stl")
    (tmp_path / "hand.urdf").write_text(SOLIDS)
    hand = load_hand(tmp_path / "hand.urdf", candidates=8)
    assert sorted(primitive.kind for primitive in hand.primitives) == ["box", "capsule", "cylinder", "hull", "sphere"]
    context = make_metrics_context(as_object(BOX), hand)
    placed = placed_hand(context, at(where, (0.4,), (0.9, 0.1, -0.2, 0.3)))
    # The hand reaches from −7 mm to 72 mm along z, and 33 mm to either side.
    across, along = np.arange(-66, 66) + 0.5, np.arange(-16, 146) + 0.5
    voxels = np.stack(np.meshgrid(across, across, along, indexing="ij"), -1).reshape(-1, 3) * 0.0005
    points = voxels @ placed.rotations[0].T + placed.translations[0]
    points = points[(np.abs(points) < BOX.vertices.max(0)).all(1)]
    shared = np.zeros(len(points), dtype=bool)
    for link in range(hand.num_links):
        local = (points - placed.translations[link]) @ placed.rotations[link]
        shared |= depth_inside(hand, link, local) > 0
    assert shared.sum() > 8000
    assert intersection_volume(context, placed) == pytest.approx(shared.sum() * MM3 / 8, rel=0.02)


@pytest.mark.parametrize("holes", [0, 60])
def test_the_kernel_measures_as_python_does(holes, tmp_path, monkeypatch):
    # The bowl is one solid of 4,864 faces. Beside a hole, the winding number passes through one half.
    trimesh.creation.icosphere(subdivisions=1, radius=0.015).export(tmp_path / "lump.stl")
    (tmp_path / "hand.urdf").write_text(SOLIDS)
    hand, bowl = load_hand(tmp_path / "hand.urdf", candidates=8), make_shape("bowl")
    target = as_object(bowl)
    mesh = TriangleMesh(bowl.vertices, bowl.faces[holes:])
    target = replace(target, mesh=mesh)
    compiled = make_metrics_context(target, hand)
    with monkeypatch.context() as without:
        without.setenv("GRASPD_KERNEL", "off")
        reference = make_metrics_context(target, hand)
    assert isinstance(reference.query, DistanceQuery)
    if kernel().library is None:
        pytest.skip(kernel().reason)
    assert isinstance(compiled.query, CompiledQuery)
    rng, volumes = np.random.default_rng(5), []
    for _ in range(12):
        turn = rng.normal(size=4)
        where = bowl.vertices[rng.integers(len(bowl.vertices))] + rng.normal(0, 0.02, 3)
        posture = at(where, (rng.uniform(-1, 1),), turn / np.linalg.norm(turn))
        found, expected = placed_hand(compiled, posture), placed_hand(reference, posture)
        near = np.abs(expected.distance) < 0.0149
        assert (np.abs(found.distance[~near]) > 0.0149).all()
        assert np.abs(found.distance[near]) == pytest.approx(np.abs(expected.distance[near]), abs=1e-12)
        assert (np.sign(found.distance) != np.sign(expected.distance)).sum() <= (3 if holes else 0)
        assert self_penetration(compiled, found) == pytest.approx(self_penetration(reference, found), abs=1e-9)
        assert penetration(compiled, expected) == pytest.approx(penetration(reference, expected), abs=1e-9)
        volumes.append([intersection_volume(context, found) for context in (compiled, reference)])
    volume, expected = np.transpose(volumes)
    assert (volume > 1e-7).sum() >= 3
    assert volume == pytest.approx(expected, rel=0.01 if holes else 1e-9, abs=1e-15)


@pytest.mark.parametrize("depth", [0.0, 0.001, 0.006])
def test_a_box_that_sinks_into_a_box(depth: float) -> None:
    """A cube of 40 mm whose face lies `depth` below that of one of 60 mm."""
    found = measure_skin(make_distance_query(box_of(0.03)), box_of(0.02, (0.0, 0.0, 0.05 - depth)))
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
    query = make_distance_query(taken(ball))
    found = measure_skin(query, taken(ball.apply_translation([0.05, 0.0, 0.0])))
    expected = np.pi * (4 * 0.03 + 0.05) * (2 * 0.03 - 0.05) ** 2 / 12
    # Facets lie up to 0.04 mm inside the ball, of a lens 10 mm deep; the rest is the voxels' edge.
    assert found.intersection_volume == pytest.approx(expected, rel=0.03)
    assert found.penetration == pytest.approx(0.01, abs=1e-4)
    found = measure_skin(make_distance_query(box_of(0.03)), box_of(0.02, (0.5, 0.5, 0.5)))
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
        figures.append(measure_skin(make_distance_query(taken(target)), taken(skin)))
    assert figures[0].contact_area == pytest.approx(figures[1].contact_area, rel=0.06)
    assert figures[0].intersection_volume == pytest.approx(figures[1].intersection_volume, rel=0.02)


def test_a_gripper_about_a_box_closes_and_one_finger_does_not(gripper):
    context = make_metrics_context(as_object(BOX), gripper)
    # Inner faces 45 mm − q from the middle: at 14.5 mm half a millimetre from the box's 30 mm.
    both = measure(context, at((0, 0, -0.05), (0.0145, 0.0145)))
    assert both["contact_links"] == 2
    # Each inner face of 30 x 60 mm lies beside the box, and 1.5 mm of the four sides about it come within 2 mm too.
    # 1100 of 4000 samples are on them: three standard deviations are 8 %.
    assert both["contact_area"] == pytest.approx(2 * (0.03 * 0.06 + 0.18 * 0.0015), rel=0.08)
    assert some(both["epsilon"]) > 0
    assert both["penetration"] == both["intersection_volume"] == both["self_penetration"] == 0.0
    one = measure(context, at((0, 0, -0.05), (0.0145, 0.0)))
    assert one["contact_links"] == 1
    assert one["epsilon"] == 0.0


def test_nothing_touched_is_all_zero(gripper):
    metrics = measure(make_metrics_context(as_object(BOX), gripper), at((0, 0, 1.0), (0.0, 0.0)))
    assert all(value in (0.0, None) for value in metrics.values())


@settings(max_examples=8)
@given(seed=st.integers(0, 2**31))
def test_moving_object_and_hand_together_changes_nothing(seed, gripper):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
    # Not flush with anything, so that no sample or voxel sits on a border.
    posture = at((0.0012, 0.0007, -0.0511), (0.0163, 0.0151))
    moved = Posture(
        rotation @ posture.position + shift,
        quaternion_from_rotation(torch.as_tensor(rotation)).numpy(),
        posture.joint_positions,
    )
    here = measure(make_metrics_context(as_object(BOX), gripper), posture)
    there = measure(
        make_metrics_context(as_object(TriangleMesh(BOX.vertices @ rotation.T + shift, BOX.faces)), gripper), moved
    )
    assert there["contact_links"] == here["contact_links"]
    # Sums over samples and voxels: a few of thousands may change sides by float32 distances.
    assert there["contact_area"] == pytest.approx(here["contact_area"], rel=0.005)
    assert there["intersection_volume"] == pytest.approx(here["intersection_volume"], rel=0.005)
    assert there["penetration"] == pytest.approx(here["penetration"], abs=1e-7)
    # The edges of the cones start at other angles, which moves ε by up to 1 − cos(π/8).
    assert there["epsilon"] == pytest.approx(here["epsilon"], rel=0.09)


def test_normals_point_out_on_either_side_of_the_surface(gripper):
    context = make_metrics_context(as_object(BOX), gripper)
    points = np.array([[0.031, 0, 0], [0.029, 0, 0], [0, -0.031, 0.01], [0, 0, 0.046], [0.03, 0.01, 0.01]])
    expected = np.array([[1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 0, 0]])
    # Differences of float32 distances (1e-8 m) over 0.4 mm.
    assert surface_normals(context.query, points) == pytest.approx(expected, abs=1e-4)


def test_wider_contacts_about_a_box(gripper):
    context = make_metrics_context(as_object(BOX), gripper)
    assert len(context.surface.points) >= 2000
    # Inner faces half a millimetre off. Within 5 mm of the box's planes: the inner faces, 4.5 mm of the sides about
    # them, nothing of the palm, whose face is 5 mm below the box's.
    metrics = measure(context, at((0, 0, -0.0501), (0.0145, 0.0145)))
    assert metrics["contact_area_5mm"] == pytest.approx(2 * (0.03 * 0.06 + 0.18 * 0.0045), rel=0.08)
    # Within 10 mm: 9.5 mm of the sides, and the palm's strip below the box, 60 mm and 8.6 mm about its edges wide.
    strip = 0.04 * (0.06 + 2 * 0.0086)
    assert metrics["contact_area_10mm"] == pytest.approx(2 * (0.03 * 0.06 + 0.18 * 0.0095) + strip, rel=0.08)


def test_area_over_volume_of_a_block_sunk_into_a_face(block):
    metrics = measure(make_metrics_context(as_object(BOX), block), at((0.045, 0, 0), (0.0,)))
    # 5 mm deep over 30 x 20 mm; a band of 4 mm about a perimeter of 100 mm is within 2 mm of the face.
    assert metrics["contact_per_volume"] == pytest.approx(0.1 * 0.004 / (0.005 * 0.03 * 0.02), rel=0.2)


def test_more_contacts_only_widen_the_wrench_hull(gripper):
    context, posture = make_metrics_context(as_object(BOX), gripper), at((0, 0, -0.05), (0.0145, 0.0145))
    few, many = (measure(context, posture, max_contacts=count) for count in (8, 32))
    # Farthest points are nested: the first eight are among the first 32. Joggled by 1e-10.
    assert some(many["epsilon"]) >= some(few["epsilon"]) - 1e-8
    assert some(many["volume"]) > some(few["volume"])
    assert GraspMetrics({**many, "epsilon": few["epsilon"], "volume": few["volume"]}) == few


@pytest.fixture(scope="module")
def hand():
    return load_hand("parallel_gripper", candidates=60)


def grasp(hand, position=(0.0, 0.0, 0.0), turn: float = 0.0) -> Grasp:
    """A hand turned about z through the middle of its palm, which stays at `position`."""
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    quaternion = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    posture = Posture(np.array(position) - rotation @ hand.palm_center, quaternion, hand.open_posture)
    return Grasp(posture, posture, posture, (), 0.0)


def test_sixteen_copies_are_one_grasp(hand):
    first = grasp(hand)
    assert distinct([first, *(grasp(hand, (0.001 * i, 0.0, 0.0)) for i in range(16))], hand) == (first,)
    assert distinct([], hand) == ()


@pytest.mark.parametrize(
    ("other", "kept"),
    [({"position": (0.019, 0, 0)}, 1), ({"position": (0.021, 0, 0)}, 2), ({"turn": 0.34}, 1), ({"turn": 0.36}, 2)],
)
def test_far_enough_or_turned_enough_is_another(hand, other: dict, kept: int):
    assert len(distinct([grasp(hand), grasp(hand, **other)], hand)) == kept


@given(angle=st.floats(0.4, 2 * np.pi - 0.4))
def test_a_ball_held_from_another_side_is_held_otherwise(hand, angle: float):
    around = (0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.0)
    assert len(distinct([grasp(hand, (0.05, 0.0, 0.0)), grasp(hand, around, angle)], hand)) == 2


FRICTION = 0.6

# Every edge of a cone is a unit force: its normal part, and its tangential part.
NORMAL, TANGENT = 1 / np.sqrt(1 + FRICTION**2), FRICTION / np.sqrt(1 + FRICTION**2)


def disc() -> np.ndarray:
    angles = 2 * np.pi * np.arange(3) / 3
    return np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])


def plates() -> tuple[np.ndarray, np.ndarray]:
    """Four corners on either side of a cube of side 2, across y."""
    corners = np.array([[x, y, z] for y in (-1.0, 1.0) for x in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return corners, np.array([0.0, 1.0, 0.0]) * corners


def support(wrenches: np.ndarray, direction: np.ndarray) -> float:
    return float((wrenches @ direction).max())


def hull(arms: np.ndarray, normals: np.ndarray, friction: float, length: float) -> tuple[float, float]:
    found = wrench_hull(arms, normals, friction, length)
    assert (found.weakest_push is None) == (found.epsilon == 0.0)
    return found.epsilon, found.volume


@pytest.mark.parametrize("joggle", [0.0, 1e-14, 1e-12])
def test_a_hull_that_rounding_spoils_is_refused_or_right(joggle):
    # Equal and coplanar points, which the caller joggles by far more.
    rng = np.random.default_rng(3)
    library = kernel().library
    if library is None:
        pytest.skip(kernel().reason)
    for _ in range(60):
        points = np.round(rng.normal(size=(int(rng.integers(7, 150)), 6))) + joggle * rng.normal()
        found = np.empty(9)
        assert library.graspd_wrench_hull(len(points), points.ctypes.data, found.ctypes.data) == 0
        assert found[8] > 1e-9 or found[7] == pytest.approx(ConvexHull(points).volume, rel=1e-6)


@given(seed=st.integers(0, 2**31), contacts=st.integers(3, 32))
@settings(max_examples=20)
def test_the_compiled_hull_is_qhull_s(seed, contacts):
    rng = np.random.default_rng(seed)
    arms, normals = rng.normal(size=(2, contacts, 3)) * [[[0.03]], [[1.0]]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wrenches = cone_wrenches(arms, normals, FRICTION, 0.05)
    compiled = compiled_hull(wrenches)
    if kernel().library is None:
        assert compiled is None
        return
    reference = qhull(wrenches)
    assert compiled is not None
    assert max(0.0, compiled[0]) == pytest.approx(max(0.0, reference[0]), abs=1e-6)
    assert compiled[2] == pytest.approx(reference[2], rel=1e-4, abs=1e-12)
    if reference[0] > 1e-3:
        # Another facet may be as near: the origin's distance along its normal is what counts.
        assert support(wrenches, compiled[1]) == pytest.approx(reference[0], abs=1e-6)


def test_one_contact_and_two_antipodal_ones_close_nothing():
    arms = np.array([[0.03, 0, 0], [-0.03, 0, 0]])
    assert np.abs(cone_wrenches(arms, arms / 0.03, FRICTION, 0.03)[:, 3]).max() == pytest.approx(0.0, abs=1e-15)
    assert hull(arms, arms / 0.03, FRICTION, 0.03) == (0.0, 0.0)
    one = np.array([[0.03, 0, 0]])
    assert hull(one, one / 0.03, FRICTION, 0.03) == (0.0, 0.0)
    assert hull(one[:0], one[:0], FRICTION, 0.03) == (0.0, 0.0)


def test_three_contacts_on_a_disc():
    wrenches = cone_wrenches(disc(), disc(), FRICTION, 1.0)
    axes = np.eye(6)
    # Along the disc's axis, and about it, there is friction at arm 1 only. About an axis in its plane too, at the arm
    # of the contact farthest from that axis: 1, or sin 60° where a contact lies on it.
    assert support(wrenches, axes[2]) == support(wrenches, axes[5]) == pytest.approx(TANGENT)
    assert support(wrenches, axes[4]) == pytest.approx(TANGENT)
    assert support(wrenches, axes[3]) == pytest.approx(TANGENT * np.sin(np.pi / 3))
    # Away from a contact (−x) there is its normal force; towards it (+x) the other two give half of theirs and their
    # friction's sin 60°.
    assert support(wrenches, -axes[0]) == pytest.approx(NORMAL)
    assert support(wrenches, axes[0]) == pytest.approx(0.5 * NORMAL + TANGENT * np.sin(np.pi / 3))
    # Against (force z; torque x, y) contact i has only its vertical edges, TANGENT · ±v_i with v_i = (1, y_i, −x_i).
    # The v have Gram matrix 2 on and 1/2 off its diagonal, so the octahedron of the ±v_i has faces at √(9/17): ε is no
    # more than that.
    epsilon, volume = hull(disc(), disc(), FRICTION, 1.0)
    assert 0 < epsilon <= TANGENT * np.sqrt(9 / 17)
    assert volume > 0


def test_six_contacts_on_the_axes_of_a_sphere():
    # Worst is a turn about a diagonal, (1, 1, 1)/√3: each contact gives friction times the part of it across its own
    # normal, √(2/3), which lies along an edge of the cone. All six are equal there, and any push mixed in adds.
    arms = np.vstack([np.eye(3), -np.eye(3)])
    assert hull(arms, arms, FRICTION, 1.0)[0] == pytest.approx(TANGENT * np.sqrt(2 / 3), rel=1e-6)


def test_contacts_on_one_side_only_hold_nothing():
    arms, normals = plates()
    # Every edge has the same part along the common normal, so that the hull is flat too.
    assert hull(arms[:4], normals[:4], FRICTION, 1.0) == (0.0, 0.0)
    tilted = normals[:4] + 0.1 * arms[:4] * [1, 0, 1]
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    epsilon, volume = hull(arms[:4], tilted, FRICTION, 1.0)
    assert epsilon == 0.0
    assert volume > 0


@given(seed=st.integers(0, 2**31))
def test_no_direction_is_supported_less_than_epsilon_and_one_no_more(seed):
    rng = np.random.default_rng(seed)
    arms = rng.normal(size=(6, 3))
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    epsilon, _ = hull(arms, arms, FRICTION, 1.0)
    wrenches = cone_wrenches(arms, arms, FRICTION, 1.0)
    directions = rng.normal(size=(4000, 6))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    supports = (directions @ wrenches.T).max(1)
    # Where the origin is outside the hull, some support is negative and ε is zero.
    assert max(0.0, supports.min()) >= epsilon - 1e-9
    # Merged facets, not joggled ones: the nearest one's normal is supported by just ε.
    facets = ConvexHull(wrenches).equations
    nearest = facets[facets[:, -1].argmax(), :-1]
    assert max(0.0, support(wrenches, nearest)) == pytest.approx(epsilon, abs=1e-6)


@given(seed=st.integers(0, 2**31))
def test_turning_everything_changes_nothing_but_the_edges_places(seed):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    arms, normals = plates()
    epsilon, volume = hull(arms, normals, FRICTION, 1.0)
    turned = hull(arms @ rotation.T, normals @ rotation.T, FRICTION, 1.0)
    # The eight edges stand for a circle and start elsewhere: cos(π/8) = 0.92 of its radius at worst.
    assert turned[0] == pytest.approx(epsilon, rel=0.09)
    assert turned[1] == pytest.approx(volume, rel=0.2)


def test_the_torque_scale_divides_the_volume_by_its_cube():
    arms, normals = plates()
    _, volume = hull(arms, normals, FRICTION, 1.0)
    assert hull(arms, normals, FRICTION, 2.0)[1] == pytest.approx(volume / 8, rel=1e-6)
    assert hull(2 * arms, normals, FRICTION, 2.0)[1] == pytest.approx(volume, rel=1e-6)
