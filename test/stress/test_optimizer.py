"""The optimiser where numbers go wrong: poisoned fields, precisions, batches, threads, starts inside things."""

import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from graspd_core import PlanConfig, Scene, draw_starts, load_scene
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.candidates import PlannerInput, assemble
from graspd_core.optimize.closed_form.closed_form import ClosedForm
from graspd_core.optimize.loop import Hooks, Poses, minimise, pack, unpack
from graspd_core.optimize.problem import Problem, hand_forward
from graspd_core.se3 import rotation_from_quaternion

PLAN = PlanConfig()
# The preset's method in a tenth of its steps.
SHORT = replace(PLAN.settings, explore_steps=6, refine_steps=6, polish_steps=6)
BATCH = 16


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("shape:box")


@pytest.fixture(scope="module")
def sound(scene, hand) -> Problem:
    return PlannerInput(scene, hand, 4, 0, PLAN, Hooks()).problem


@pytest.fixture(scope="module")
def starts(scene, hand) -> Poses:
    return draw_starts(scene, hand, BATCH, 0, "cpu", torch.float32)


@pytest.fixture(scope="module")
def clean(sound, starts) -> Tensor:
    return pack(minimise(ClosedForm(SHORT, BATCH), sound, starts, Hooks()).poses)


@pytest.mark.parametrize("channel", [0, 1], ids=["distance", "gradient"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_starts_that_meet_a_poisoned_node_are_dropped_and_the_others_unharmed(sound, starts, clean, channel, value):
    field = sound.object.sdf.field.clone()
    # A node of the surface, where fingers are sure to look.
    field[channel].view(-1)[int(field[0].abs().argmin())] = value
    poisoned = replace(sound, object=replace(sound.object, sdf=replace(sound.object.sdf, field=field)))
    solution = minimise(ClosedForm(SHORT, BATCH), poisoned, starts, Hooks())
    found = torch.isfinite(solution.loss)
    assert found.any()
    same = (pack(solution.poses) == clean).all(-1)
    assert same.any()
    # Whoever never looked at the node goes the same way to the last bit; whoever did is dropped or went elsewhere.
    assert (found | ~same).all()


def test_a_start_goes_the_same_way_alone_and_among_many(sound, starts, clean):
    many = unpack(pack(starts).repeat(256 // BATCH, 1))
    among = minimise(ClosedForm(SHORT, 256), sound, many, Hooks())
    alone = minimise(ClosedForm(SHORT, 1), sound, starts[torch.tensor([3])], Hooks())
    assert torch.equal(pack(among.poses)[:BATCH], clean)
    assert torch.equal(pack(alone.poses)[0], clean[3])


def test_starts_in_the_middle_of_the_object_escape(hand, sound, starts):
    rotation = rotation_from_quaternion(starts.quaternion)
    palm = starts.translation + rotation @ torch.as_tensor(hand.palm_center, dtype=torch.float32)
    inside = replace(starts, translation=starts.translation + sound.object.center - palm)
    at = (rotation @ torch.as_tensor(hand.palm_center, dtype=torch.float32)) + inside.translation
    assert (sample_sdf(sound.object.sdf, at)[0] < -0.02).all()
    solution = minimise(ClosedForm(PLAN.settings, BATCH), sound, inside, Hooks())
    poses = solution.poses
    placed = hand_forward(sound, sound.hand.fine, poses)
    depth = -sample_sdf(sound.object.sdf, placed.points)[0].amin(-1)
    # As deep as starts outside end: a millimetre or two.
    assert (depth < 0.003).all()
    assert len(assemble(sound, hand, poses, PLAN)) > BATCH // 2


@pytest.mark.parametrize(
    ("friction", "delta"), [(0.02, 0.01), (0.2, 0.01), (2.0, 0.01), (20.0, 0.01), (0.4, 1e-6), (0.4, 1e-3), (0.4, 1.0)]
)
def test_decades_of_friction_and_contact_width_give_finite_losses(sound, starts, friction: float, delta: float):
    """Where a loss or a slope is no number, the solver says infinity and zero, so that such a start stands still."""
    for polish in (False, True):
        solver, radius = ClosedForm(SHORT, BATCH), torch.zeros(BATCH)
        look = {"fine": polish, "sharp": polish}
        slippery = replace(sound, friction=friction)
        loss, gradient = solver.value_and_gradient(slippery, pack(starts), radius, delta, **look)
        assert torch.isfinite(loss).all()
        assert (gradient.norm(dim=-1) > 0).all()


def test_a_surface_that_is_zero_all_over_gives_no_nan(sound, starts):
    """Distance zero and normal zero at every node: nothing to hold, and nothing to divide by."""
    flat = replace(sound.object.sdf, field=torch.zeros_like(sound.object.sdf.field))
    nothing = replace(sound, object=replace(sound.object, sdf=flat))
    solver, radius = ClosedForm(SHORT, BATCH), torch.zeros(BATCH)
    loss, gradient = solver.value_and_gradient(nothing, pack(starts), radius, 0.01, fine=True, sharp=True)
    assert torch.isfinite(loss).all()
    assert torch.isfinite(gradient).all()


_CAPPED = """
import resource, torch
torch.set_num_threads(1)
from graspd_core.hands.library import load_hand
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.perception.load_scene import load_scene
hand, scene = load_hand("allegro_right"), load_scene("shape:box")
plan_grasps(scene, hand, count=1, preset="fast")
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 64 * 2**20, -1))
try:
    print(plan_grasps(scene, hand, count=1024, preset="accurate", verify="none").outcome.name)
except Exception as error:
    print(type(error).__name__, str(error)[:200])
"""


@pytest.mark.slow
def test_too_little_memory_is_a_named_failure_and_no_crash():
    done = subprocess.run([sys.executable, "-c", _CAPPED], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("ResourceError"), done.stdout
    assert "memory" in done.stdout
