"""Names of presets: which is an ablation of which, and how each method is told from the others."""

from __future__ import annotations

from pathlib import Path

# Presets of the first page: those that people plan with, the published method, its repaired form and a baseline.
FEW = ("fast", "balanced", "accurate", "graspd2022", "graspd2022_repaired", "random_closure")
# The first that fits a name tells its parent; a parent has none.
_ABLATIONS = (("closed_form_", "balanced"), ("graspd2022_no_", "graspd2022_repaired"))


def parent_of(name: str) -> str | None:
    """The preset that `name` is an ablation of; None for one of its own."""
    return next((parent for prefix, parent in _ABLATIONS if name.startswith(prefix)), None)


def hand_row(hand: str) -> str:
    """The name of the cells by which hands are compared."""
    return f"hand:{Path(hand).stem}"


def is_hand(name: str) -> bool:
    """Whether a name is of cells by which hands are compared, `hand:leap_right` say."""
    return name.startswith("hand:")


def is_preset(name: str) -> bool:
    """Whether a name is of a preset: neither a sweep value nor a hand."""
    return not is_sweep_value(name) and not is_hand(name)


def is_sweep_value(name: str) -> bool:
    """Whether a name is of a sweep value, `steps=90` say, and not of a preset."""
    return "=" in name


def short_name(name: str) -> str:
    """A label for the chart: an ablation goes by what it lacks."""
    parent = parent_of(name)
    if parent is None:
        return name
    method = "closed_form_" if name.startswith("closed_form_") else "graspd2022_"
    return name.removeprefix(method).replace("_", " ")
