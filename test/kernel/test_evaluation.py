"""The compiled step against torch: values and gradients on every hand, and what must not matter."""

from dataclasses import asdict, replace

import pytest
import torch
from expected import some

from graspd_core import draw_starts, hand_names, load_hand
from graspd_core.config import ProblemConfig
from graspd_core.optimize.closed_form.closed_form import ClosedForm, weighted
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, LossWeights
from graspd_core.optimize.kernel import builds
from graspd_core.optimize.kernel_problem import KernelProblem
from graspd_core.optimize.loop import moved_along, pack, unpack
from graspd_core.optimize.losses import hard_contact
from graspd_core.optimize.problem import Terms, build_problem, evaluate, least_distance

DELTA = 0.006
# Exploring, refining among sharp points, polishing.
LOOKS = ({}, {"sharp": True}, {"sharp": True, "fine": True})
# Each term with a weight that makes its gradient count.
WEIGHTS = LossWeights(3.0, 1.0, 1.0, 1.0, 0.02, 1.0)


def evaluate_compiled(
    problem: KernelProblem, x, radius, delta: float, weights: LossWeights, *, fine=False, sharp=False, soft=True
) -> tuple[torch.Tensor, torch.Tensor, Terms]:
    """Weighted loss of every row, its gradient, and the terms; the rows are `AdamState.x`."""
    x, radius = x.contiguous(), radius.contiguous()
    loss, gradient, terms = torch.empty(len(x)), torch.empty_like(x), torch.empty(len(x), len(Terms._fields))
    given = builds.Weights(**asdict(weights)), len(x), x, radius, delta, fine, sharp, soft
    problem.call("graspd_evaluate", *given, loss, gradient, terms)
    return loss, gradient, Terms(*terms.T)


def by_torch(problem, x, radius, **look) -> Terms:
    poses = moved_along(unpack(x), -problem.hand.pivot)
    return evaluate(problem, poses, radius, DELTA, **look)


def gradient_of(problem, x, radius, weights: LossWeights, **look) -> torch.Tensor:
    x = x.clone().requires_grad_(True)
    terms = by_torch(problem, x, radius, **look)
    return torch.autograd.grad(weighted(terms, weights).sum(), x)[0]


@pytest.mark.parametrize("look", LOOKS, ids=["coarse", "sharp", "fine"])
@pytest.mark.parametrize("scene", ["box", "mug", "guessed", "crowded"])
@pytest.mark.parametrize("hand", hand_names())
def test_it_agrees_with_torch(problem_of, rows_of, hand, scene, look):
    problem = problem_of(hand, scene)
    x = rows_of(hand, scene, problem)
    # A radius at which no candidate lies exactly on the padded surface: there a gradient may be either side's.
    radius = torch.linspace(0.0, 0.011, len(x))
    loss, gradient, terms = evaluate_compiled(some(problem.compiled), x, radius, DELTA, WEIGHTS, **look)
    expected = by_torch(problem, x, radius, **look)
    for name, value in expected._asdict().items():
        mine = getattr(terms, name)
        if value is None:
            assert (mine == 0).all(), name
        else:
            assert mine.tolist() == pytest.approx(value.tolist(), rel=2e-4, abs=2e-5), name
    slope = gradient_of(problem, x, radius, WEIGHTS, **look)
    error = (gradient - slope).norm(dim=-1) / slope.norm(dim=-1)
    # float32 sums in another order; where two candidates of a group tie, a row may follow the other one.
    assert error.median() < 1e-4, error
    assert error.sort().values[-2] < 1e-2, error
    assert torch.isfinite(loss).all()


@pytest.mark.parametrize("patch_size", [0, 4])
def test_a_link_without_coarse_candidates_is_in_no_group(hands, scenes, rows_of, patch_size):
    settings = ProblemConfig(candidates=8, patch_size=patch_size)
    problem = build_problem(scenes["box"], hands("allegro_right"), settings, seed=0)
    x, radius = rows_of("allegro_right", "box", problem), torch.full((12,), 0.003)
    distance = evaluate_compiled(some(problem.compiled), x, radius, DELTA, WEIGHTS, fine=True)[2].distance
    assert distance.tolist() == pytest.approx(by_torch(problem, x, radius, fine=True).distance.tolist(), rel=1e-4)


@pytest.mark.parametrize("scene", ["box", "crowded"])
def test_the_gradient_is_that_of_the_value(problem_of, rows_of, scene):
    """Central differences of the kernel itself, along random directions; kinks are left out by the median."""
    problem = problem_of("barrett_like", scene)
    compiled, x = some(problem.compiled), rows_of("barrett_like", scene, problem)
    radius = torch.full((len(x),), 0.004)

    def value(rows: torch.Tensor) -> torch.Tensor:
        return evaluate_compiled(compiled, rows, radius, 0.02, WEIGHTS)[0]

    gradient = evaluate_compiled(compiled, x, radius, 0.02, WEIGHTS)[1]
    errors = []
    for seed in range(6):
        along = torch.randn(x.shape, generator=torch.Generator().manual_seed(seed)) * 1e-3
        along[:, :3] *= 0.1
        slope = (value(x + along) - value(x - along)) / 2
        errors.append((slope - (gradient * along).sum(-1)).abs() / (gradient * along).norm(dim=-1))
    assert torch.stack(errors).median() < 0.02


def test_contact_without_a_width_has_no_slope_of_its_own(problem_of, rows_of):
    problem = problem_of("allegro_right", "box")
    x, radius = rows_of("allegro_right", "box", problem), torch.full((12,), 0.0031)
    only = LossWeights(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    _, gradient, terms = evaluate_compiled(some(problem.compiled), x, radius, DELTA, only, soft=False)
    expected = by_torch(problem, x, radius, activate=hard_contact).wrench_resistance
    assert terms.wrench_resistance.tolist() == pytest.approx(expected.tolist(), rel=1e-4)
    slope = gradient_of(problem, x, radius, only, activate=hard_contact)
    assert ((gradient - slope).norm(dim=-1) < 1e-3 * slope.norm(dim=-1).clamp_min(1.0)).all()


def test_every_build_gives_the_same_up_to_rounding(problem_of, rows_of, monkeypatch):
    problem = problem_of("leap_right", "mug")
    x, radius = rows_of("leap_right", "mug", problem), torch.full((12,), 0.003)
    found = {}
    for name in builds.BUILDS:
        if not builds.BUILDS[name] - builds._instructions():
            monkeypatch.setenv("GRASPD_KERNEL", name)
            assert builds.kernel().name == name
            found[name] = evaluate_compiled(some(problem.compiled), x, radius, DELTA, WEIGHTS, **LOOKS[2])[0].tolist()
    assert len(found) > 1 or "v3" not in found
    for loss in found.values():
        assert loss == pytest.approx(found["baseline"], rel=1e-4)


def test_least_distance(problem_of, rows_of):
    problem = problem_of("allegro_right", "mug")
    x = rows_of("allegro_right", "mug", problem)
    poses = moved_along(unpack(x), -problem.hand.pivot)
    expected = least_distance(problem, poses)
    found = torch.empty(len(x))
    some(problem.compiled).call("graspd_least_distance", len(x), x, found)
    assert found.tolist() == pytest.approx(expected.tolist(), abs=1e-6)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
@pytest.mark.parametrize("where", ["pose", "field", "radius", "weight"])
def test_what_is_not_a_number_stays_with_its_row(problem_of, rows_of, bad, where):
    problem = problem_of("allegro_right", "crowded")
    x, radius, weights = rows_of("allegro_right", "crowded", problem), torch.full((12,), 0.003), WEIGHTS
    clean = evaluate_compiled(some(problem.compiled), x, radius, DELTA, weights, **LOOKS[2])
    if where == "pose":
        x = x.clone()
        x[5, 0] = bad
    elif where == "radius":
        radius[5] = bad
    elif where == "weight":
        weights = replace(WEIGHTS, penetration=bad)
    else:
        grid = problem.object.sdf
        broken = grid.field.clone()
        broken[0, 10, 10, 10] = bad
        problem = replace(problem, object=replace(problem.object, sdf=replace(grid, field=broken)))
    loss, gradient, _ = evaluate_compiled(some(problem.compiled), x, radius, DELTA, weights, **LOOKS[2])
    if where in ("pose", "radius"):
        others = torch.arange(12) != 5
        assert torch.equal(loss[others], clean[0][others])
        assert torch.equal(gradient[others], clean[1][others])
    # As in torch: a row that is not finite stands still, and says so by its loss.
    solver = ClosedForm(replace(ClosedFormConfig(), polish_weights=weights), 12)
    expected = solver.value_and_gradient(problem, x, radius, DELTA, **LOOKS[2])[0]
    finite = loss.isfinite() & gradient.isfinite().all(-1)
    assert torch.equal(finite, expected.isfinite())


def test_torch_evaluates_what_the_kernel_does_not(problem_of, monkeypatch):
    problem = problem_of("allegro_right", "box")
    assert problem.compiled is not None
    grid = problem.object.sdf
    double = replace(problem.object, sdf=grid.to("cpu", torch.float64))
    assert replace(problem, object=double).compiled is None
    monkeypatch.setenv("GRASPD_KERNEL", "off")
    assert problem.compiled is None


@pytest.mark.parametrize("links", [1, 99])
def test_hands_of_one_moving_link_and_of_a_hundred_links(tmp_path, scenes, links):
    """A chain of boxes, as long as one may be; every seventh joint slides."""
    box = '<collision><origin xyz="0 0 0.004"/><geometry><box size="0.006 0.006 0.008"/></geometry></collision>'
    parts = [f'<link name="l{i}">{box}</link>' for i in range(links + 1)]
    joint = (
        '<joint name="j{0}" type="{1}"><parent link="l{2}"/><child link="l{0}"/><origin xyz="0 0 0.008"/>'
        '<axis xyz="0 1 0"/><limit lower="-0.3" upper="0.4" effort="1" velocity="1"/></joint>'
    )
    parts += [joint.format(i, "prismatic" if i % 7 == 3 else "revolute", i - 1) for i in range(1, links + 1)]
    path = tmp_path / "chain.urdf"
    path.write_text(f'<robot name="chain">{"".join(parts)}</robot>')
    hand = load_hand(str(path), candidates=300)
    assert len(hand.joint_names) == links
    problem = build_problem(scenes["box"], hand, ProblemConfig(candidates=150, features=16, directions=12), seed=0)
    starts = draw_starts(scenes["box"], hand, 6, 0, "cpu", torch.float32)
    x, radius = pack(moved_along(starts, problem.hand.pivot)), torch.linspace(0.001, 0.006, 6)
    for look in LOOKS:
        _, gradient, terms = evaluate_compiled(some(problem.compiled), x, radius, DELTA, WEIGHTS, **look)
        expected = by_torch(problem, x, radius, **look)
        assert terms.penetration.tolist() == pytest.approx(expected.penetration.tolist(), rel=1e-3, abs=1e-4)
        slope = gradient_of(problem, x, radius, WEIGHTS, **look)
        assert ((gradient - slope).norm(dim=-1) / slope.norm(dim=-1)).median() < 1e-3
