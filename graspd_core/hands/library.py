"""Hands by name, from a hand description (`config/hands/*.yaml`) or from a bare URDF."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.errors import HandError, choices
from graspd_core.hands.default_postures import default_palm, default_postures
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel
from graspd_core.hands.readers.description import apply_description, read_description
from graspd_core.hands.readers.mjcf import read_mjcf
from graspd_core.hands.readers.urdf import EXPAND, below_link, read_urdf
from graspd_core.hands.readers.xml_io import read_xml, wrong
from graspd_core.hands.self_collision import adjacent_links
from graspd_core.hands.surface_points import with_candidates
from graspd_core.paths import config_dir

# A joint's greatest torque [N·m], a sliding joint's greatest force [N], where neither URDF nor description gives one.
DEFAULT_EFFORT, DEFAULT_FORCE = 0.7, 40.0


def hand_names() -> tuple[str, ...]:
    """Return the names of the hands that graspd ships with."""
    return tuple(sorted(path.stem for path in (config_dir() / "hands").glob("*.yaml")))


def load_hand(name_or_path: str | Path, *, candidates: int = 600, prefix: str = "") -> HandModel:
    """Load a hand by its name, or from a description (.yaml), a bare URDF or MJCF (.urdf, .xml) or a MANO file (.pkl).

    A bare URDF gets a guessed palm and guessed postures, and a warning in `HandModel.warnings`. `prefix` is put before
    the names of joints and links. Two hands on one robot need different names.

    Raises:
        HandError: no such hand or file, or it cannot be used. The message names the file and the culprit.
    """
    if candidates < 1:
        raise HandError(f"candidates={candidates}: at least 1 is needed")
    if Path(name_or_path).suffix == ".pkl":
        from graspd_core.hands.mano.mano_hand import load_mano

        return _prefixed(load_mano(name_or_path, candidates=candidates).model, prefix)
    path = _find(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        description = read_description(path)
        hand = apply_description(_with_effort(read_hand_file(description.urdf, description.root)), description)
    else:
        hand = default_postures(default_palm(_with_effort(read_hand_file(path))))
    hand = replace(hand, adjacent=adjacent_links(hand), warnings=(*hand.warnings, *doubts(hand)))
    return _prefixed(with_candidates(hand, candidates), prefix)


def _prefixed(hand: HandModel, prefix: str) -> HandModel:
    if not prefix:
        return hand
    return replace(
        hand,
        link_names=tuple(prefix + name for name in hand.link_names),
        joint_names=tuple(prefix + name for name in hand.joint_names),
        mimics=tuple(replace(mimic, name=prefix + mimic.name) for mimic in hand.mimics),
    )


def read_hand_file(path: Path, root_link: str | None = None) -> HandModel:
    """Read a URDF or an MJCF file, as the root element decides.

    `root_link` of a URDF names the link where the hand begins. Raises HandError: the file is neither, cannot be used,
    or has no shape that could touch an object.
    """
    root = read_xml(path)
    readers = {"robot": read_urdf, "mujoco": read_mjcf}
    if root.tag not in readers:
        raise wrong(path, root, f"the root element is <{root.tag}>; a URDF has <robot>, an MJCF file <mujoco>")
    if root_link is not None:
        below_link(path, root, root_link)
    hand = readers[root.tag](path, root)
    if not hand.primitives:
        raise HandError(f"{path}: no link has a collision or a visual shape, so that nothing could touch an object")
    return hand


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    path = Path(text)
    if path.suffix == ".xacro":
        raise HandError(f"{path}: is a xacro file; {EXPAND.replace('FILE', path.name)}")
    if path.suffix in (".yaml", ".yml", ".urdf", ".xml"):
        if not path.is_file():
            raise HandError(f"{path}: no such file")
        return path
    if text not in hand_names():
        files = ", or the path of a .yaml, .urdf, .xml (URDF or MJCF) or .pkl (MANO) file"
        raise HandError(f"unknown hand {text!r}; {choices(text, hand_names(), files)}")
    return config_dir() / "hands" / f"{text}.yaml"


def _with_effort(hand: HandModel) -> HandModel:
    default = np.where(hand.slides, DEFAULT_FORCE, DEFAULT_EFFORT)
    return replace(hand, effort=np.where(np.isfinite(hand.effort), hand.effort, default))


# No joint of a hand is stronger than this [N·m], and no slide [N].
_STRONGEST, _STRONGEST_SLIDE = 100.0, 10_000.0
# Axes of one linkage: cosine between them, how far apart along them, and across them [m].
_PARALLEL, _LEVEL, _SIDE_BY_SIDE = 0.999, 0.008, 0.04
# Two palms are farther apart than this [m].
_APART = 0.2


def doubts(hand: HandModel) -> tuple[str, ...]:
    """Return warnings of what a hand can hardly have: efforts of a machine, an open linkage, fingers on two palms."""
    rotations, translations = link_poses(hand, np.clip(0.0, hand.lower, hand.upper))
    linkages = _open_linkages(hand, rotations, translations)
    return (*_strong_joints(hand), *linkages, *_palms(hand, translations))


def _strong_joints(hand: HandModel) -> tuple[str, ...]:
    bounds = np.where(hand.slides, _STRONGEST_SLIDE, _STRONGEST)
    worst = int((hand.effort / bounds).argmax())
    if hand.effort[worst] <= bounds[worst]:
        return ()
    unit = "N" if hand.slides[worst] else "N·m"
    told = f"an effort of {hand.effort[worst]:.3g} {unit}, more than the {bounds[worst]:g} of any hand"
    return (f"joint {hand.joint_names[worst]!r}: {told}; say what it is in a hand description (effort)",)


def _open_linkages(
    hand: HandModel, rotations: Float[np.ndarray, "links 3 3"], translations: Float[np.ndarray, "links 3"]
) -> tuple[str, ...]:
    """Warn of free joints side by side on one link, if one of them moves only its own link: an open linkage."""
    parents = {link: int(hand.link_group[hand.link_parent[link]]) for link in np.flatnonzero(hand.link_joint >= 0)}
    coupled = {mimic.link for mimic in hand.mimics}
    free = [link for link in parents if link not in coupled and hand.joint_kind[link] == "revolute"]
    ends = {link for link in free if int(hand.link_group[link]) not in parents.values()}
    for one in ends:
        axis = rotations[one] @ hand.joint_axis[one]
        for other in free:
            if other in ends or parents[other] != parents[one]:
                continue
            apart, along = translations[other] - translations[one], rotations[other] @ hand.joint_axis[other]
            beside = abs(apart @ axis) < _LEVEL and 0.0 < np.linalg.norm(apart) < _SIDE_BY_SIDE
            if abs(axis @ along) > _PARALLEL and beside:
                names = " and ".join(repr(hand.link_joint_names[link]) for link in (other, one))
                told = "stand side by side like those of a closed linkage, and move freely"
                return (f"joints {names} {told}; couple such joints with <mimic>",)
    return ()


def _palms(hand: HandModel, translations: Float[np.ndarray, "links 3"]) -> tuple[str, ...]:
    """Warn of two links far apart, neither above the other, which fingers hang from."""
    counts = Counter(int(hand.link_parent[link]) for link in np.flatnonzero(hand.link_joint >= 0))
    branches = sorted(link for link, count in counts.items() if count > 1)

    def above(link: int) -> set[int]:
        return set() if link < 0 else {link} | above(int(hand.link_parent[link]))

    for i, one in enumerate(branches):
        for other in branches[:i]:
            related = one in above(other) or other in above(one)
            if not related and np.linalg.norm(translations[one] - translations[other]) > _APART:
                names = " and ".join(repr(hand.link_names[link]) for link in (other, one))
                return (f"fingers hang from {names}: two hands; name one as root in a hand description",)
    return ()


@lru_cache
def hand_hash(name: str) -> str:
    """Return the hash of a hand's URDF and description. Raises HandError: no such hand, or it cannot be used."""
    hand = load_hand(name, candidates=1)
    boxed = config_dir() / "hands" / f"{name}.yaml"
    files = [Path(hand.urdf), boxed if boxed.is_file() else Path(name)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
