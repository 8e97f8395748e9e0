"""Restrictions: starts that they forbid are drawn anew, candidates that they refuse are not tried, reasons counted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from graspd_core import HandModel, Scene, draw_starts, load_preset, load_scene, override, plan_grasps
from graspd_core.errors import ConfigError
from graspd_core.optimize.restrictions import (
    UNRESTRICTED,
    BoundRestriction,
    BoundRestrictions,
    Refusal,
    restrictions_in_words,
)
from graspd_core.types import Grasp, Outcome, Plane


@dataclass(frozen=True)
class Side(BoundRestriction):
    """Hands whose base lies on one side of x = `at` [m]; keeps what it was asked about."""

    at: float = 0.0
    told: str = ""

    def bind(self, scene: Scene, hand: HandModel) -> "Side":
        if not np.isfinite(self.at):
            raise ConfigError(f"side: {self.at} m; valid: a finite number")
        return self

    @property
    def impossible(self) -> str:
        return self.told

    def starts(self, positions: np.ndarray, quaternions: np.ndarray, joints: np.ndarray) -> np.ndarray:
        assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)
        return positions[:, 0] > self.at

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        return [g if g.grasp.position[0] > self.at else Refusal("on the wrong side") for g in grasps]


@dataclass(frozen=True)
class Every(BoundRestriction):
    """Refuses every n-th candidate; admits the rest with another score."""

    n: int

    def bind(self, scene: Scene, hand: HandModel) -> "Every":
        return self

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        return [Refusal("by number") if i % self.n == 0 else replace(g, score=7.0) for i, g in enumerate(grasps)]


@pytest.fixture(scope="module")
def scene():
    return load_scene("shape:box", resolution=48)


def starts(scene: Scene, hand: HandModel, bound: BoundRestrictions = UNRESTRICTED, seed: int = 3):
    return draw_starts(scene, hand, 20, seed, "cpu", torch.float64, restrictions=bound)


def test_starts_are_drawn_until_enough_are_allowed_the_same_for_a_seed(scene, hand):
    bound = BoundRestrictions((Side(0.05),))
    found = starts(scene, hand, bound)
    assert len(found.joints) == 20
    assert (found.translation[:, 0] > 0.05).all()
    assert torch.equal(found.translation, starts(scene, hand, bound).translation)
    assert not torch.equal(found.translation, starts(scene, hand, bound, seed=4).translation)
    assert (starts(scene, hand).translation[:, 0] < 0.05).any()
    assert torch.equal(starts(scene, hand, BoundRestrictions((Side(-9.0),))).joints, starts(scene, hand).joints)
    assert len(starts(scene, hand, BoundRestrictions((Side(9.0),))).joints) == 0


def test_restrictions_apply_one_after_the_other_in_the_frame_that_they_were_bound_in(scene, hand):
    grasps = plan_grasps(scene, hand, count=4, verify="none", preset="fast", measure=False).grasps
    bound = BoundRestrictions((Side(9.9), Every(2)))
    assert bound.admit(grasps) == ((), {"on the wrong side": len(grasps)})
    there = replace(bound, origin=np.array([10.0, 0, 0]))
    admitted, refused = there.admit(grasps)
    assert set(refused) <= {"by number", "on the wrong side"}
    assert refused["by number"] >= 1
    assert len(admitted) + refused.total() == len(grasps)
    assert all(any(np.allclose(g.grasp.position, a.grasp.position) for g in grasps) for a in admitted)
    assert {grasp.score for grasp in admitted} <= {7.0}


def test_what_is_refused_is_not_tried_and_is_counted(scene, hand):
    found = plan_grasps(scene, hand, count=3, preset="fast", measure=False, restrictions=[Side(0.0), Every(2)])
    assert found.tried
    assert all(g.grasp.position[0] > 0 and g.score == 7.0 for g in found.tried)
    assert found.refused["by number"] >= 1
    held = sum(grasp.usable for grasp in found.tried)
    assert found.message.startswith(f"{held} candidates held, {sum(found.refused.values())} refused: ")


@pytest.mark.parametrize("support", [None, Plane(np.array([0.0, 0.0, 1.0]), -0.05)], ids=["free", "on a table"])
@pytest.mark.parametrize("method", ["closed_form", "annealing", "graspd2022", "random_closure"])
def test_every_method_ends_where_a_restriction_leaves_nothing(scene, hand, method, support):
    scene = replace(scene, support=support)
    preset = override(load_preset("fast"), {"method": method, "rounds.most": 1})
    if method == "random_closure":
        preset = override(preset, {"random_closure.rounds": 1})
    found = plan_grasps(scene, hand, count=1, preset=preset, restrictions=[Side(9.0)])
    assert not found.tried
    assert found.outcome is Outcome.NO_CANDIDATES


def test_what_is_impossible_is_said_without_a_search(scene, hand, monkeypatch):
    monkeypatch.delattr("graspd_core.planning.rounds.find_candidates")
    found = plan_grasps(scene, hand, count=1, restrictions=[Side(0.0), Side(0.0, told="the arm ends at 0.4 m")])
    assert (found.outcome, found.message) == (Outcome.NO_CANDIDATES, "the arm ends at 0.4 m")


def test_a_malformed_restriction_is_refused(scene, hand):
    with pytest.raises(ConfigError, match="side: nan m"):
        plan_grasps(scene, hand, restrictions=[Side(float("nan"))])


def test_refusals_are_told_most_frequent_first():
    sides = BoundRestrictions((Side(),))
    assert restrictions_in_words(UNRESTRICTED, {}, 0, 0) == ""
    assert restrictions_in_words(sides, {}, 3, 3) == ""
    assert restrictions_in_words(sides, {}, 0, 0) == "no candidate was found under Side"
    told = restrictions_in_words(sides, {"outside the approach cone": 2, "out of reach": 7}, 12, 14)
    assert told == "12 candidates held, 9 refused: 7 out of reach, 2 outside the approach cone"
