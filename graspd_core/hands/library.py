"""Load hands by name, from a hand description (`config/hands/*.yaml`), or from a URDF, MJCF or MANO file."""

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
from graspd_core.hands.readers.mjcf import included_files, read_mjcf
from graspd_core.hands.readers.urdf import EXPAND, below_link, read_urdf
from graspd_core.hands.readers.xml_io import read_xml, wrong
from graspd_core.hands.self_collision import adjacent_links
from graspd_core.hands.surface_points import with_candidates
from graspd_core.paths import config_dir

# Greatest torque of a revolute joint [N·m] and greatest force of a prismatic joint [N], if no file gives it.
DEFAULT_EFFORT, DEFAULT_FORCE = 0.7, 40.0


def hand_names() -> tuple[str, ...]:
    """Return the names of the hands that are part of graspd."""
    return tuple(sorted(path.stem for path in (config_dir() / "hands").glob("*.yaml")))


def load_hand(name_or_path: str | Path, *, candidates: int = 600, prefix: str = "") -> HandModel:
    """Load a hand by name, or from a description (.yaml), a URDF or MJCF file (.urdf, .xml) or a MANO file (.pkl).

    Without a description, palm and postures are guessed, with a warning in `HandModel.warnings`. `candidates` is the
    number of contact candidates. `prefix` is put before all names, because two hands on one robot need different names.

    Raises:
        HandError: the hand or file does not exist or cannot be used. The message names the file and the fault.
    """
    if Path(name_or_path).suffix == ".pkl":
        from graspd_core.hands.mano.mano_hand import load_mano

        return _prefixed(load_mano(name_or_path, candidates=candidates).model, prefix)
    path = _find(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        description = read_description(path)
        hand = apply_description(read_hand_file(description.urdf, description.root), description)
    else:
        hand = default_postures(default_palm(read_hand_file(path)))
    hand = _with_effort(hand)
    hand = replace(hand, adjacent=adjacent_links(hand), warnings=(*hand.warnings, *hand_warnings(hand)))
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
    """Read a URDF or an MJCF file. The file's root element tells its format.

    `root_link` names the link of a URDF at which the hand begins. Raises HandError: the file is neither URDF nor MJCF,
    cannot be used, or has no shape that could touch an object.
    """
    root = read_xml(path)
    readers = {"robot": read_urdf, "mujoco": read_mjcf}
    if root.tag not in readers:
        raise wrong(path, root, f"the root element is <{root.tag}>; a URDF has <robot>, an MJCF file <mujoco>")
    if root_link is not None:
        below_link(path, root, root_link)
    hand = readers[root.tag](path, root)
    if not hand.primitives:
        raise HandError(f"{path}: no link has a collision or a visual shape; valid: one shape or more")
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
    """Return the hand with the default effort for each joint that has none. A warning names these joints."""
    effort, told = hand.effort, list[str]()
    for default, unit, kind in ((DEFAULT_EFFORT, "N·m", ~hand.slides), (DEFAULT_FORCE, "N", hand.slides)):
        lost = kind & ~np.isfinite(hand.effort)
        if names := ", ".join(np.array(hand.joint_names)[lost]):
            warning = f"no effort is given for {names}: {default:g} {unit} is assumed"
            told.append(f"{warning}; set `effort` in a hand description")
        effort = np.where(lost, default, effort)
    return replace(hand, effort=effort, warnings=(*hand.warnings, *told))


# Greatest plausible effort of a revolute joint [N·m] and of a prismatic joint [N].
_STRONGEST, _STRONGEST_SLIDE = 100.0, 10_000.0
# Two joints of one linkage: least cosine between their axes, greatest distance along an axis, and total [m].
_PARALLEL, _LEVEL, _SIDE_BY_SIDE = 0.999, 0.008, 0.04
# Two branching links are two palms if they are farther apart than this [m].
_APART = 0.2


def hand_warnings(hand: HandModel) -> tuple[str, ...]:
    """Return warnings about implausible properties: excessive efforts, uncoupled joints of a linkage, two palms."""
    rotations, translations = link_poses(hand, np.clip(0.0, hand.lower, hand.upper))
    linkages = _open_linkages(hand, rotations, translations)
    return (*_strong_joints(hand), *linkages, *_palms(hand, translations))


def _strong_joints(hand: HandModel) -> tuple[str, ...]:
    bounds = np.where(hand.slides, _STRONGEST_SLIDE, _STRONGEST)
    worst = int((hand.effort / bounds).argmax())
    if hand.effort[worst] <= bounds[worst]:
        return ()
    unit = "N" if hand.slides[worst] else "N·m"
    fault = f"implausible effort of {hand.effort[worst]:.3g} {unit}; valid: up to {bounds[worst]:g}"
    return (f"joint {hand.joint_names[worst]!r}: {fault}; set `effort` in a hand description",)


def _open_linkages(
    hand: HandModel, rotations: Float[np.ndarray, "links 3 3"], translations: Float[np.ndarray, "links 3"]
) -> tuple[str, ...]:
    """Return a warning if two uncoupled joints lie side by side on a link, and only one carries further joints."""
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
                fault = "look like parts of a closed linkage, but move independently"
                return (f"joints {names} {fault}; couple these joints with <mimic>",)
    return ()


def _palms(hand: HandModel, translations: Float[np.ndarray, "links 3"]) -> tuple[str, ...]:
    """Return a warning if there are two palms: distant links on different branches, each with several fingers."""
    counts = Counter(int(hand.link_parent[link]) for link in np.flatnonzero(hand.link_joint >= 0))
    branches = sorted(link for link, count in counts.items() if count > 1)

    def above(link: int) -> set[int]:
        return set() if link < 0 else {link} | above(int(hand.link_parent[link]))

    for i, one in enumerate(branches):
        for other in branches[:i]:
            related = one in above(other) or other in above(one)
            if not related and np.linalg.norm(translations[one] - translations[other]) > _APART:
                names = " and ".join(repr(hand.link_names[link]) for link in (other, one))
                return (f"fingers hang from {names}, as in two hands; name one link as root in a hand description",)
    return ()


@lru_cache
def hand_hash(name: str) -> str:
    """Return the hash of a hand's files, description and meshes. Raises HandError: the hand is missing or unusable."""
    hand = load_hand(name, candidates=1)
    boxed = config_dir() / "hands" / f"{name}.yaml"
    files = [Path(hand.urdf), boxed if boxed.is_file() else Path(name)]
    files += included_files(files[0]) if files[0].suffix != ".pkl" else ()
    hulls = (shape.vertices.tobytes() for shape in hand.primitives)
    return hashlib.sha256(b"".join([*(file.read_bytes() for file in files), *hulls])).hexdigest()
