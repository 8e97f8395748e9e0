"""Hands by name, from a hand description (`config/hands/*.yaml`) or from a bare URDF."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from graspd_core.errors import HandError
from graspd_core.hands.description import apply_description, read_description
from graspd_core.hands.guess import guess_palm_and_postures
from graspd_core.hands.model import HandModel
from graspd_core.hands.overlap import adjacent_links
from graspd_core.hands.surface import candidates as surface_candidates
from graspd_core.hands.urdf import read_urdf
from graspd_core.paths import config_dir

# A joint's greatest torque where neither URDF nor description gives one [N·m].
DEFAULT_EFFORT = 0.7
_CANDIDATE_SEED = 0


def hand_names() -> tuple[str, ...]:
    """Names of the hands that graspd ships with."""
    return tuple(sorted(path.stem for path in (config_dir() / "hands").glob("*.yaml")))


def load_hand(name_or_path: str | Path, *, candidates: int = 600) -> HandModel:
    """A hand by its name, by the path of its description (.yaml) or of a bare URDF (.urdf, .xml).

    A bare URDF loads with a guessed palm and guessed postures, and a warning in `HandModel.warnings`.

    Raises:
        HandError: no such hand or file, or one that cannot be used: the message names the file and the culprit.
    """
    if candidates < 1:
        raise HandError(f"candidates={candidates}: at least 1 is needed")
    path = _find(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        description = read_description(path)
        hand = apply_description(_with_effort(read_urdf(description.urdf)), description)
    else:
        hand = guess_palm_and_postures(_with_effort(_with_primitives(read_urdf(path))))
    hand = _with_primitives(hand)
    hand = replace(hand, adjacent=adjacent_links(hand))
    points, normals, links = surface_candidates(hand, candidates, _CANDIDATE_SEED)
    return replace(hand, candidate_points=points, candidate_normals=normals, candidate_link=links)


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    path = Path(text)
    if path.suffix in (".yaml", ".yml", ".urdf", ".xml"):
        if not path.is_file():
            raise HandError(f"{path}: no such file")
        return path
    if text not in hand_names():
        raise HandError(
            f"unknown hand {text!r}; known: {', '.join(hand_names())}, or the path of a .yaml or .urdf file"
        )
    return config_dir() / "hands" / f"{text}.yaml"


def _with_primitives(hand: HandModel) -> HandModel:
    if not hand.primitives:
        raise HandError(f"{hand.urdf}: no link has a <collision> element, so that nothing could touch an object")
    return hand


def _with_effort(hand: HandModel) -> HandModel:
    """Efforts that the URDF leaves open (absent or zero, a common placeholder) set to the default."""
    return replace(hand, effort=np.where(np.isfinite(hand.effort), hand.effort, DEFAULT_EFFORT))
