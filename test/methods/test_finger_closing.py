"""Closing until contact, on a hand so small that every touch can be worked out by hand, and on a real one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_bench.baselines.random_closure import advance, draw_approaches
from graspd_core.config import ProblemConfig
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.finger_closing import Closing, finger_of, link_gaps, make_closing, moved_links
from graspd_core.optimize.loop import Hooks, Poses, minimise
from graspd_core.optimize.problem import Problem, build_problem
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import Scene, build_scene
from graspd_core.types import TriangleMesh

DOUBLE = torch.float64

# Two slabs that slide towards each other over a palm: 60 mm apart when open, and their inner faces 4 mm nearer.
SLAB = """<link name="{}"><collision><origin xyz="0 0 0.02"/><geometry><box size="0.008 0.02 0.04"/></geometry>
  </collision></link>"""
SLIDE = """<joint name="slide_{0}" type="prismatic"><parent link="palm"/><child link="{0}"/><origin xyz="{1}0.03 0 0"/>
  <axis xyz="{2}1 0 0"/><limit lower="0" upper="0.03" effort="10" velocity="1"/></joint>"""
PALM = """<link name="palm"><collision><origin xyz="0 0 -0.01"/><geometry><box size="0.1 0.02 0.02"/></geometry>
  </collision></link>"""
PARTS = (PALM, SLAB.format("left"), SLAB.format("right"), SLIDE.format("left", "-", ""), SLIDE.format("right", "", "-"))
GRIPPER = f'<robot name="pincher">{"".join(PARTS)}</robot>'
DESCRIPTION = """urdf: pincher.urdf
palm: {link: palm, center: [0.0, 0.0, 0.0], normal: [0.0, 0.0, 1.0]}
approach: [0.0, 0.0, 1.0]
open: {slide_left: 0.0, slide_right: 0.0}
closed: {slide_left: 0.025, slide_right: 0.025}
"""


@pytest.fixture(scope="module")
def pincher(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    folder = tmp_path_factory.mktemp("pincher")
    (folder / "pincher.urdf").write_text(GRIPPER)
    (folder / "pincher.yaml").write_text(DESCRIPTION)
    return load_hand(folder / "pincher.yaml", candidates=300)


def cube_scene(half: float, shift: float = 0.0) -> Scene:
    box = make_shape("box")
    unit = 2 * (box.vertices - box.vertices.min(0)) / np.ptp(box.vertices, axis=0) - 1
    return build_scene(TriangleMesh(unit * half + np.array([shift, 0.0, 0.02]), box.faces), resolution=48)


def small_problem(scene: Scene, hand: HandModel) -> Problem:
    return build_problem(
        scene, hand, ProblemConfig(candidates=60, features=24, directions=12, friction=0.5), seed=0, dtype=DOUBLE
    )


def closed(scene: Scene, hand: HandModel, starts: Poses) -> tuple[Problem, Closing, Poses]:
    problem = small_problem(scene, hand)
    closing = make_closing(problem, hand, 30)
    return problem, closing, minimise(closing, problem, starts, Hooks()).poses


def at_home(hand: HandModel) -> Poses:
    identity = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=DOUBLE)
    return Poses(torch.zeros(1, 3, dtype=DOUBLE), identity, torch.as_tensor(hand.open_posture)[None])


def test_fingers_stop_where_they_touch_and_each_for_itself(pincher):
    # A cube of 20 mm, 4 mm off the middle: the inner faces are at ±26 mm, so they travel 20 and 12 mm.
    _, _, poses = closed(cube_scene(0.01, shift=0.004), pincher, at_home(pincher))
    # A step is 25/30 mm and halved four times before it is given up.
    assert poses.joints[0].tolist() == pytest.approx([0.020, 0.012], abs=6e-5)


def test_fingers_go_past_their_closed_value_and_stop_at_the_limit_or_at_each_other(pincher):
    # Far from any object the slabs meet: their faces are 52 mm apart, and the limit of 30 mm each is not reached.
    far = replace(at_home(pincher), translation=torch.tensor([[0.0, 0.0, 1.0]], dtype=DOUBLE))
    _, _, poses = closed(cube_scene(0.01), pincher, far)
    assert (poses.joints <= torch.as_tensor(pincher.upper)).all()
    # Proxy spheres bulge by up to a fifth of the slabs' half thickness and one millimetre of overlap is allowed.
    assert poses.joints.sum().item() == pytest.approx(0.052, abs=3e-3)


def test_a_hand_that_is_sunk_in_already_sinks_no_deeper(pincher):
    deep = replace(at_home(pincher), joints=torch.tensor([[0.018, 0.0]], dtype=DOUBLE))
    problem, closing, poses = closed(cube_scene(0.01), pincher, deep)
    before, after = (link_gaps(problem, p, closing.sphere_links)[:, 0].amin() for p in (deep, poses))
    assert before < -1e-3
    assert after >= before - 1e-9


@pytest.fixture(scope="module")
def allegro() -> HandModel:
    return load_hand("allegro_right", candidates=120)


def test_no_link_of_a_real_hand_sinks_in_and_every_joint_stops_for_a_reason(allegro):
    problem = small_problem(load_scene("shape:cylinder"), allegro)
    closing = make_closing(problem, allegro, 30)
    starts = advance(problem, closing, allegro, draw_approaches(problem, allegro, 6, 0))
    state = closing.init(problem, starts)
    for index in range(closing.steps):
        state = closing.step(problem, state, index)
    joints = state.poses.joints
    gaps = link_gaps(problem, state.poses, closing.sphere_links)
    assert gaps[:, 0].min() >= 0
    assert (joints >= problem.hand.lower).all()
    assert (joints <= problem.hand.upper).all()
    # A joint that a contact stopped moves a link that touches: half a millimetre is many times the last, halved step.
    arrived = state.stopped & (closing.rate != 0.0) & (joints != closing.target)
    touching = (gaps[:, 0] < 5e-4) | (gaps[:, 1] < -5e-4)
    assert arrived.any()
    assert closing.some(touching, closing.moves)[arrived].all()


def test_fingers_are_the_chains_of_joints(allegro, pincher):
    assert np.unique(finger_of(allegro)).tolist() == [0, 1, 2, 3]
    assert len(set(finger_of(allegro)[:4])) == 1
    assert np.unique(finger_of(pincher)).tolist() == [0, 1]
    # The first joint of a finger moves all of its links, the last one only the last.
    moves = moved_links(allegro)
    assert moves[0].sum() == 5
    assert moves[3].sum() == 2


def test_it_stops_when_told(allegro):
    problem = small_problem(load_scene("shape:box"), allegro)
    far = replace(at_home(allegro), translation=torch.ones(1, 3, dtype=DOUBLE))
    polls = iter([False, False, True])
    solution = minimise(make_closing(problem, allegro, 30), problem, far, Hooks(stop=lambda: next(polls)))
    assert (solution.steps, solution.interrupted) == (2, "cancelled")
