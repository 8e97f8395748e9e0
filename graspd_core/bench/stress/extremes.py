"""Extremes of physics, of numbers, and of what a hand can do, on sound objects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from graspd_core.bench.stress.run_stress_case import GRASP, Case
from graspd_core.methods.plan_config import PlanConfig
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import Scene

_MAYBE = (GRASP, "TOO_FEW", "NO_CANDIDATES")
_NONE = _MAYBE[1:]


def extreme_cases() -> tuple[Case, ...]:
    """All of them."""
    return (*physics_cases(), *number_cases(), *hand_cases())


def physics_cases() -> Iterator[Case]:
    """Friction and mass over their decades, and objects that look alike from many sides."""
    for mu in (0.1, 0.2, 0.3, 0.6, 1.0, 1.5):
        about, expect = f"a box at a friction of {mu:g}", (GRASP,) if mu >= 0.3 else _MAYBE
        yield Case(f"friction-{mu:g}", "physics", about, _shape("box", friction=mu), expect)
    for mass in (0.005, 0.02, 0.1, 0.5, 1.0, 2.0):
        about, expect = f"a cylinder of {1000 * mass:g} g", (GRASP,) if mass <= 1.0 else _MAYBE
        yield Case(f"mass-{1000 * mass:g}-g", "physics", about, _shape("cylinder", mass=mass), expect)
    for name in ("sphere", "cylinder", "torus"):
        yield Case(f"symmetric-{name}", "physics", f"a {name}: many minima of equal depth", _shape(name))


def number_cases() -> tuple[Case, ...]:
    """Values that are not numbers where the optimiser looks, grids too coarse or too fine, and no time."""
    family, box = "numbers", _shape("box")
    coarse, fine = ({"preset": PlanConfig(resolution=nodes)} for nodes in (8, 128))
    return (
        Case("nan-in-distance", family, "one node of the distance is NaN", _poisoned(0, float("nan"))),
        Case("inf-in-distance", family, "one node of the distance is infinite", _poisoned(0, float("inf"))),
        Case("nan-in-gradient", family, "one node of the gradient is NaN", _poisoned(1, float("nan"))),
        Case("zero-gradient", family, "the gradient is zero all over one slab", _flattened),
        Case("coarse-grid", family, "a grid of 8 nodes a side", box, _MAYBE, options=coarse),
        Case("fine-grid", family, "a grid of 128 nodes a side", box, options=fine),
        Case("no-time", family, "a deadline of 0.2 s", box, (GRASP, "DEADLINE"), whole=False, deadline=0.2),
        Case("one-grasp-of-many", family, "256 starts for one box", box, options={"count": 64}, deadline=60.0),
    )


def hand_cases() -> tuple[Case, ...]:
    """Objects beyond the hand."""
    wide, small, heavy = _shape("sphere", scale=10.0), _shape("sphere", scale=0.1), _shape("box", mass=30.0)
    return (
        Case("too-wide", "hand", "a ball of 70 cm across", wide, _NONE, whole=False),
        Case("too-small", "hand", "a bead of 7 mm across", small, _MAYBE, whole=False),
        Case("too-heavy", "hand", "a box of 30 kg", heavy, _NONE, whole=False),
    )


def _shape(name: str, **settings: Any) -> Callable[[Path], Scene]:
    return lambda folder: load_scene(f"shape:{name}", **settings)


def _poisoned(channel: int, value: float) -> Callable[[Path], Scene]:
    """A node on the surface, where fingers are sure to look."""

    def scene(folder: Path) -> Scene:
        clean = load_scene("shape:cylinder")
        field = clean.sdf.field.clone()
        flat = int(field[0].abs().argmin())
        field[channel].view(-1)[flat] = value
        return replace(clean, sdf=replace(clean.sdf, field=field))

    return scene


def _flattened(folder: Path) -> Scene:
    clean = load_scene("shape:cylinder")
    field = clean.sdf.field.clone()
    field[1:, :, :, field.shape[3] // 2] = torch.zeros(())
    return replace(clean, sdf=replace(clean.sdf, field=field))
