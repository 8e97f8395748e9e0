"""Every setting of a preset reaches `plan_grasps`: changed alone, it changes a very short run."""

import dataclasses
import math
import re
from functools import cache, partial
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from expected import some

from graspd_bench.baselines.annealing import AnnealingConfig
from graspd_bench.baselines.random_closure import RandomClosureConfig
from graspd_bench.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core import GraspdError, HandModel, load_hand, make_shape, scene_from_views
from graspd_core.config import GraspStagesConfig, ProblemConfig, RoundsConfig
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config, InitialPosesConfig, LevelSetConfig
from graspd_core.optimize.plan_config import METHODS, Method, PlanConfig, method_names, method_row, override
from graspd_core.perception.scene import Scene, build_scene
from graspd_core.planning.plan_grasps import plan_grasps, planning_scene
from graspd_core.types import Plane, Progress, Stage

# As short as a run can be that still does everything once.
SETTINGS: dict[str, Any] = {
    "closed_form": ClosedFormConfig(
        starts_per_grasp=9.0,
        fingertip_starts=0.0,
        explore_steps=2,
        refine_steps=2,
        polish_steps=2,
        fine_steps=1,
        keep_per_grasp=5.0,
    ),
    "graspd2022": Graspd2022Config(
        initial=InitialPosesConfig(starts_per_grasp=3.0), level_set=LevelSetConfig(coarse_steps=2), steps=4
    ),
    "annealing": AnnealingConfig(chains_per_grasp=9.0, keep_per_grasp=5.0, steps=4, close_steps=4, directions=8),
    "random_closure": RandomClosureConfig(rounds=2, touching=1, close_steps=4),
}
SHORT = PlanConfig(
    resolution=12,
    settings=SETTINGS["closed_form"],
    problem=ProblemConfig(candidates=40, fine_candidates=60, features=8, directions=8),
    grasp_stages=GraspStagesConfig(touch_reach=0.02, open_steps=2),
    rounds=RoundsConfig(most=1),
)


@dataclasses.dataclass(frozen=True)
class Case:
    """How a setting is changed, and what must be so that it matters.

    Attributes:
        value: what it is changed to; None: something near it.
        base: other settings, by their dotted names.
        scene, hand: names of what is planned on.
        count: grasps asked for.
        verify: with trials or without.
        brief: the run is cancelled at its first report.
    """

    value: Any = None
    base: tuple[tuple[str, Any], ...] = ()
    scene: str = "box"
    hand: str = "barrett_like"
    count: int = 2
    verify: str = "none"
    brief: bool = False


# The least that a round keeps is eight, so that more take two.
TWO_ROUNDS = (
    ("rounds.most", 2),
    ("rounds.first_budget", 1.0),
    ("closed_form.searches", 1),
    ("closed_form.starts_per_grasp", 1.0),
    ("closed_form.keep_per_grasp", 0.1),
)
FEW_KEPT = (("annealing.chains_per_grasp", 2.0), ("annealing.keep_per_grasp", 0.1))
FEW_STARTS = (("closed_form.starts_per_grasp", 2.0), ("closed_form.keep_per_grasp", 1.0))
FAR_JUMPS = (("closed_form.translation_rate", 0.1), ("closed_form.joint_rate", 1.0), ("closed_form.explore_steps", 6))
HOLDING = tuple(
    {
        "robust.rank": True,
        "robust.trials": 3,
        "robust.hold_time": 0.1,
        "closed_form.explore_steps": 30,
        "closed_form.refine_steps": 30,
        "closed_form.polish_steps": 60,
        "problem.candidates": 60,
        "problem.features": 24,
        "grasp_stages.touch_reach": 0.002,
        "grasp_stages.open_steps": 40,
        "resolution": 24,
    }.items()
)
held = partial(Case, base=HOLDING, hand="parallel_gripper", count=1, verify="standard")
table = Case(scene="table")
CASES = {
    "closed_form.fingertip_starts": Case(1.0),
    "closed_form.searches": Case(1, FAR_JUMPS, count=10),
    "closed_form.keep_per_grasp": Case(1.0, (("closed_form.keep_per_grasp", 0.1),), count=10),
    "closed_form.drops": Case(6, (("closed_form.keep_per_grasp", 0.1), ("closed_form.explore_steps", 6)), count=10),
    "problem.confidence_floor": table,
    "closed_form.weights.obstacle": table,
    "closed_form.polish_weights.obstacle": Case(base=(("closed_form.polish_steps", 12),), scene="table", count=8),
    "closed_form.weights.penetration": Case(base=FAR_JUMPS),
    "closed_form.weights.self_collision": Case(base=FAR_JUMPS),
    "closed_form.polish_weights.self_collision": Case(
        base=(*FAR_JUMPS, *FEW_STARTS, ("closed_form.polish_steps", 12)), hand="allegro_right", count=12
    ),
    "graspd2022.simulation.stopping_force": Case(base=(("graspd2022.simulation.scaling", "object"),)),
    "graspd2022.contact.friction_stiffness": Case(1e-3),
    "graspd2022.contact.leak": Case(1.0),
    "graspd2022.level_set.clearance": Case(
        0.0,
        (
            ("graspd2022.level_set.schedule", "code"),
            ("graspd2022.level_set.coarse_steps", 4),
            ("graspd2022.pose_rate", 0.1),
        ),
    ),
    "graspd2022.pose_steps.within_limits": Case(base=(("graspd2022.pose_rate", 1.0),)),
    "graspd2022.constraints.limit_bound": Case(base=(("graspd2022.pose_rate", 1.0),)),
    "graspd2022.weights.inter": Case(base=(("graspd2022.pose_rate", 1.0),)),
    "annealing.keep_per_grasp": Case(1.0, FEW_KEPT, count=10),
    "annealing.contacts_per_link": Case(1, (("problem.fine_candidates", 200),)),
    "annealing.directions": Case(1, FEW_KEPT, count=10),
    "random_closure.rounds": Case(base=(("random_closure.touching", 99), ("grasp_stages.touch_reach", 0.001))),
    "random_closure.touching": Case(99, (("grasp_stages.touch_reach", 0.001),)),
    "grasp_stages.slide_stiffness": Case(hand="parallel_gripper"),
    "grasp_stages.effort_share": Case(1e-4),
    "grasp_stages.link_force": Case(0.1),
    "rounds.most": Case(1, TWO_ROUNDS, count=20),
    "rounds.growth": Case(6.0, TWO_ROUNDS, count=20),
    "rounds.first_budget": Case(1.0, verify="standard", brief=True),
    "robust.rank": held(),
    "robust.friction": held(),
    "robust.trials": held(),
    "certainty.probability": Case(0.0, HOLDING, "one view", "parallel_gripper", 1, "standard"),
    "robust.hold_time": Case(0.4, HOLDING, hand="parallel_gripper", count=1, verify="full"),
}


def leaves(cls: type, prefix: str = "") -> list[str]:
    """Dotted names of all settings."""
    hints, names = get_type_hints(cls), []
    for field in dataclasses.fields(cls):
        name = f"{prefix}{field.name}"
        kind = hints[field.name]
        names += leaves(kind, f"{name}.") if isinstance(kind, type) and dataclasses.is_dataclass(kind) else [name]
    return names


def all_leaves() -> list[str]:
    """Dotted names of all settings of all methods, as a preset file has them."""
    methods = [leaf for name in method_names() for leaf in leaves(method_row(name).config, f"{name}.")]
    return [name for name in leaves(PlanConfig) if name != "settings"] + methods


def in_config(name: str) -> str:
    """The dotted name in a `PlanConfig`, where the method's own section is `settings`."""
    first, _, rest = name.partition(".")
    return f"settings.{rest}" if first in method_names() else name


def setting(config: Any, name: str) -> Any:
    for part in in_config(name).rstrip(".").split("."):
        config = getattr(config, part)
    return config


def changed(config: Any, name: str, value: Any) -> Any:
    if name == "method":
        return dataclasses.replace(config, method=value, settings=SETTINGS[value])
    first, _, rest = in_config(name).partition(".")
    return dataclasses.replace(config, **{first: changed(getattr(config, first), rest, value) if rest else value})


def another(name: str, value: Any) -> Any:
    """A value near the given one, of its kind."""
    *path, last = name.split(".")
    if name == "method":
        return "annealing"
    config = PlanConfig(method=path[0]) if path and path[0] in method_names() else SHORT
    hint = get_type_hints(type(setting(config, ".".join(path)) if path else config))[last]
    if get_origin(hint) is Literal:
        return next(choice for choice in get_args(hint) if choice != value)
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else value * 0.5 if value else 0.5


@cache
def scene(name: str) -> Scene:
    box = make_shape("box")
    if name == "box":
        return build_scene(box, mass=0.1, resolution=12)
    if name == "one view":
        return scene_from_views(views_of(tabletop("box"), CAMERA, ring_poses(1, elevation=0.8)), mass=0.1)
    # No hand is clear of a table in the middle of the box.
    guessed = np.random.default_rng(0).random(len(box.vertices))
    return build_scene(box, mass=0.1, resolution=12, confidence=guessed, support=Plane(np.array([0.0, 0.0, 1.0]), 0.0))


@cache
def hand(name: str) -> HandModel:
    return load_hand(name, candidates=60)


@cache
def trace(config: PlanConfig, case: Case) -> str:
    """All that a run gives and tells, but for times."""
    told: list[tuple] = []
    polls = 0

    def hear(progress: Progress) -> None:
        # Between a stage's first step and its last, reports come by the clock.
        if progress.step in (1, progress.of):
            told.append((progress.stage, progress.step, progress.of, progress.best, progress.verified))

    def stop() -> bool:
        nonlocal polls
        polls += bool(told) and told[-1][0] is Stage.VERIFY
        return case.brief and bool(told)

    things = scene(case.scene), hand(case.hand)
    result = plan_grasps(*things, count=case.count, seed=1, preset=config, verify=case.verify, progress=hear, stop=stop)
    grasps = [
        (
            (g.score, g.probability, g.contacts, (g.metrics or {}).get("least_friction")),
            [v.tolist() for p in (g.pregrasp, g.grasp, g.squeeze) for v in vars(p).values()],
        )
        for g in result.grasps
    ]
    return repr((result.outcome, result.method, told, polls, grasps))


def test_what_scene_and_hand_were_loaded_with_does_not_matter():
    box, other = make_shape("box"), load_hand("barrett_like", candidates=80)
    same = build_scene(box, mass=scene("box").object.mass, resolution=24)
    finer = plan_grasps(same, other, count=2, seed=1, preset=SHORT, verify="none")
    as_asked = plan_grasps(scene("box"), hand("barrett_like"), count=2, seed=1, preset=SHORT, verify="none")
    assert len(finer.grasps) == 2
    for one, two in zip(finer.grasps, as_asked.grasps, strict=True):
        assert (one.score, one.contacts, one.metrics) == (two.score, two.contacts, two.metrics)


def test_confidence_goes_along_to_another_grid():
    box = make_shape("box")
    confidence = (box.vertices[:, 0] > 0).astype(float)
    coarse, _ = planning_scene(build_scene(box, resolution=32, confidence=confidence), 16)
    direct = build_scene(box, resolution=16, confidence=confidence)
    assert coarse.confidence is not None
    # Nodes in the middle, which lie as near to one side as to the other, may go either way.
    assert (coarse.confidence - some(direct.confidence)).abs().mean() < 0.1
    assert coarse.confidence[-1].min() > 0.99
    assert coarse.confidence[0].max() < 0.01


@pytest.mark.parametrize("nodes", [7, 257])
def test_a_setting_out_of_range_is_named(nodes: int):
    with pytest.raises(GraspdError, match=f"resolution: {nodes} nodes; valid: 8 to 256"):
        plan_grasps(scene("box"), hand("barrett_like"), preset=changed(SHORT, "resolution", nodes))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("problem.candidates", 0), ("problem.directions", 0), ("problem.friction", 0.0), ("rounds.most", 0)),
        *(("problem.fine_candidates", 20_000), ("grasp_stages.stiffness", 0.0), ("grasp_stages.open_steps", 2**32)),
        *(("grasp_stages.grip_force", 1e300), ("closed_form.delta_end", math.nan), ("closed_form.searches", 0)),
        *(("graspd2022.simulation.stopping_force", 0.0), ("annealing.directions", 0)),
    ],
)
def test_a_number_out_of_range_is_named(name: str, value: float):
    method = name.split(".")[0]
    config = changed(SHORT, "method", method) if method in method_names() else SHORT
    with pytest.raises(GraspdError, match=f"^{name}: {re.escape(repr(value))}; valid: "):
        changed(config, name, value)
    with pytest.raises(GraspdError, match=rf"^settings\.{name}: "):
        override(config, {name: value})


def test_the_settings_of_a_plugin_may_have_any_value(monkeypatch: pytest.MonkeyPatch):
    @dataclasses.dataclass(frozen=True)
    class OwnConfig:
        steps: int = 0
        speed: float = -1.0

    monkeypatch.setitem(METHODS, "own", Method("own", OwnConfig, "own", "#123456", "*", 1))
    assert PlanConfig(method="own", settings=OwnConfig(speed=-2.0)).settings.speed == -2.0


def test_only_settings_have_cases():
    assert set(CASES) <= set(all_leaves())


@pytest.mark.parametrize("name", all_leaves())
def test_a_setting_reaches_the_run(name: str):
    case, method = CASES.get(name, Case()), name.split(".")[0]
    config = changed(SHORT, "method", method) if method in method_names() else SHORT
    for key, value in case.base:
        config = changed(config, key, value)
    value = another(name, setting(config, name)) if case.value is None else case.value
    before = trace(config, dataclasses.replace(case, value=None))
    after = trace(changed(config, name, value), dataclasses.replace(case, value=None))
    assert before != after, f"{name}: {setting(config, name)!r} -> {value!r}"
