"""Extremes of physics, of numbers, and of what a hand can do, on sound objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from graspd_core.bench.stress.run_stress_case import GRASP, Case
from graspd_core.methods.plan_config import PlanConfig
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import Scene

_FEW = ("TOO_FEW", "NO_CANDIDATES")


def extreme_cases() -> tuple[Case, ...]:
    """All of them."""
    return (*physics_cases(), *number_cases(), *hand_cases())


def physics_cases() -> tuple[Case, ...]:
    """Friction and mass over their decades, and objects that look alike from many sides."""
    frictions = [
        _case(
            f"friction-{mu:g}",
            "physics",
            f"a box at a friction of {mu:g}",
            "shape:box",
            (GRASP,) if mu >= 0.3 else (GRASP, *_FEW),
            friction=mu,
        )
        for mu in (0.1, 0.2, 0.3, 0.6, 1.0, 1.5)
    ]
    masses = [
        _case(
            f"mass-{1000 * mass:g}-g",
            "physics",
            f"a cylinder of {1000 * mass:g} g",
            "shape:cylinder",
            (GRASP,) if mass <= 1.0 else (GRASP, *_FEW),
            mass=mass,
        )
        for mass in (0.005, 0.02, 0.1, 0.5, 1.0, 2.0)
    ]
    symmetric = [
        _case(f"symmetric-{name}", "physics", f"a {name}: many minima of equal depth", f"shape:{name}")
        for name in ("sphere", "cylinder", "torus")
    ]
    return (*frictions, *masses, *symmetric)


def number_cases() -> tuple[Case, ...]:
    """Values that are not numbers where the optimiser looks, grids too coarse or too fine, and no time."""
    return (
        _case("nan-in-distance", "numbers", "one node of the distance is NaN", _poisoned(0, float("nan"))),
        _case("inf-in-distance", "numbers", "one node of the distance is infinite", _poisoned(0, float("inf"))),
        _case("nan-in-gradient", "numbers", "one node of the gradient is NaN", _poisoned(1, float("nan"))),
        _case("zero-gradient", "numbers", "the gradient is zero all over one slab", _flattened),
        replace(
            _case("coarse-grid", "numbers", "a grid of 8 nodes a side", "shape:box", (GRASP, *_FEW)),
            options={"preset": PlanConfig(resolution=8)},
        ),
        replace(
            _case("fine-grid", "numbers", "a grid of 128 nodes a side", "shape:box"),
            options={"preset": PlanConfig(resolution=128)},
        ),
        replace(
            _case("no-time", "numbers", "a deadline of 0.2 s", "shape:box", (GRASP, "DEADLINE"), whole=False),
            deadline=0.2,
        ),
        replace(
            _case("one-grasp-of-many", "numbers", "256 starts for one box", "shape:box"),
            options={"count": 64},
            deadline=60.0,
        ),
    )


def hand_cases() -> tuple[Case, ...]:
    """Objects beyond the hand."""
    return (
        _case("too-wide", "hand", "a ball of 70 cm across", "shape:sphere", _FEW, whole=False, scale=10.0),
        _case("too-small", "hand", "a bead of 7 mm across", "shape:sphere", (GRASP, *_FEW), whole=False, scale=0.1),
        _case("too-heavy", "hand", "a box of 30 kg", "shape:box", _FEW, whole=False, mass=30.0),
    )


def _case(
    name: str,
    family,
    about: str,
    source: str | Callable[[], Scene],
    expect: tuple[str, ...] = (GRASP,),
    *,
    whole: bool = True,
    **settings,
) -> Case:
    def scene(folder: Path) -> Scene:
        return source() if callable(source) else load_scene(source, **settings)

    return Case(name, family, about, scene, expect, whole)


def _poisoned(channel: int, value: float) -> Callable[[], Scene]:
    """A node on the surface, where fingers are sure to look."""

    def scene() -> Scene:
        clean = load_scene("shape:cylinder")
        field = clean.sdf.field.clone()
        flat = int(field[0].abs().argmin())
        field[channel].view(-1)[flat] = value
        return replace(clean, sdf=replace(clean.sdf, field=field))

    return scene


def _flattened() -> Scene:
    clean = load_scene("shape:cylinder")
    field = clean.sdf.field.clone()
    field[1:, :, :, field.shape[3] // 2] = torch.zeros(())
    return replace(clean, sdf=replace(clean.sdf, field=field))
