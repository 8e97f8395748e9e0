"""Grasps of a known object in the present scene. Missing ones are planned and added to the library.

A name or a mesh file says which object is meant. An error says what the library has instead. Stored grasps are as good
as when they were tried if nothing stands near. Otherwise a hand that would collide is refused, one that comes near is
tried again, and all others stay.
"""

from __future__ import annotations

import difflib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.errors import ConfigError, FormatError, MeshError
from graspd_core.hands.kinematics import make_kinematics
from graspd_core.hands.model import HandModel
from graspd_core.library.grasp_library import (
    GraspLibrary,
    LibraryEntry,
    absolute,
    entry_of,
    hand_hash,
    source_hash,
    strict_enough,
)
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.loop import Poses
from graspd_core.optimize.obstacle_distance import gap_on_the_way, make_obstacle_tensors
from graspd_core.optimize.plan_config import PlanConfig, load_preset
from graspd_core.optimize.restrictions import BoundRestrictions, Restriction, restrictions_in_words
from graspd_core.perception.scene import Scene, moved_grasp, near_scene
from graspd_core.planning.plan_grasps import check_request, plan_grasps
from graspd_core.types import Grasp, GraspResult, Outcome, Posture, StopHook, Timing, Verdict
from graspd_core.verify.run_clock import result_of
from graspd_core.verify.trial_registry import grasp_trials
from graspd_core.verify.verification import trial_context

_MOST_NAMED = 8


@dataclass(frozen=True)
class Physics:
    """What grasps must hold under: mass [kg] and friction of the object, and the trials. A mass of None accepts any."""

    mass: float | None
    friction: float
    verify: str = "standard"

    def __str__(self) -> str:
        mass = "any mass" if self.mass is None else f"{self.mass:g} kg"
        return f"{mass}, friction {self.friction:g}, {self.verify} trials"

    def of(self, entries: Iterable[LibraryEntry]) -> list[LibraryEntry]:
        """Return the entries of this mass and friction, heaviest first."""
        same = [e for e in entries if e.friction == self.friction and self.mass in (None, e.mass)]
        return sorted(same, key=lambda entry: -entry.mass)


def entry_by_name(library: GraspLibrary, hand: HandModel | None, name: str, physics: Physics) -> LibraryEntry:
    """Return the entry of an object of that name, for a hand, None for any hand.

    Of several masses and frictions it takes the wanted one, a single one always.

    Raises:
        ConfigError: the name is unknown, or not with this hand or physics, or several objects have it.
        MeshError: the object's file has changed since.
    """
    called = [entry for entry, _ in library.entries(name=name)]
    if not called:
        names = library.names()
        shown = (difflib.get_close_matches(name, names, _MOST_NAMED) or names)[:_MOST_NAMED]
        more = f" and {len(names) - len(shown)} more" if len(names) > len(shown) else ""
        told = f"{', '.join(shown) or 'none'}{more}"
        raise ConfigError(f"{name[:128]!r} is not in the library {library.path}; it has {told}")
    same = _with_hand(library, hand, called, name)
    if len({entry.mesh_sha256 for entry in same}) > 1:
        sources = ", ".join(sorted({entry.source for entry in same}))
        raise ConfigError(f"{name}: the library {library.path} has several: {sources}; name the mesh file")
    there = physics.of(same)
    if not there and len({(entry.mass, entry.friction) for entry in same}) == 1:
        there = same
    entry = _held_entry(library, there, same, name, physics)
    if entry.source and Path(entry.source).is_file() and source_hash(entry.source) != entry.file_sha256:
        raise _changed(library, entry)
    return entry


def entry_by_file(
    library: GraspLibrary,
    hand: HandModel | None,
    source: str | Path,
    scale: float,
    physics: Physics,
    *,
    required: bool = True,
) -> LibraryEntry | None:
    """Return the entry of a mesh file, or shape:NAME, at a scale. None if it is missing and not required.

    Raises:
        ConfigError: the content is unknown, or not at this scale, with this hand or this physics.
        MeshError: it cannot be read, or has changed since the library was made.
    """
    path = absolute(str(source))
    content = [entry for entry, _ in library.entries(file_sha256=source_hash(path))]
    if not required:
        content = [entry for entry in content if hand is None or entry.hand_content == hand_hash(hand)]
        same = [entry for entry in physics.of(content) if entry.scale == scale]
        return next(iter(strict_enough(same, physics.verify)), None)
    if not content:
        before = [entry for entry, _ in library.entries(source=path)]
        if before:
            raise _changed(library, before[0])
        raise ConfigError(f"{path}: its mesh is not in the library {library.path}; `graspd library build` adds it")
    sized = [entry for entry in content if entry.scale == scale]
    if not sized:
        scales = ", ".join(sorted({f"{entry.scale:g}" for entry in content}))
        raise ConfigError(f"{path}: not at scale {scale:g} in the library {library.path}; it has it at {scales}")
    same = _with_hand(library, hand, sized, path)
    return _held_entry(library, physics.of(same), same, path, physics)


def _with_hand(
    library: GraspLibrary, hand: HandModel | None, entries: Sequence[LibraryEntry], what: str
) -> list[LibraryEntry]:
    if hand is None:
        return list(entries)
    same = [entry for entry in entries if entry.hand_content == hand_hash(hand)]
    if same:
        return same
    hands = sorted({entry.hand for entry in entries})
    told = f"for {', '.join(hands)}, not for {hand.name}" if hand.name not in hands else "for another make of this hand"
    raise ConfigError(f"{what}: in the library {library.path} {told}; `graspd library build --hand` adds it")


def _held_entry(
    library: GraspLibrary, entries: Sequence[LibraryEntry], others: Sequence[LibraryEntry], what: str, physics: Physics
) -> LibraryEntry:
    enough = strict_enough(entries, physics.verify)
    if enough:
        return enough[0]
    had = ", ".join(sorted({str(Physics(e.mass, e.friction, e.verify)) for e in others}))
    raise ConfigError(f"{what}: not with {physics} in the library {library.path}; it has {had}")


def _changed(library: GraspLibrary, entry: LibraryEntry) -> MeshError:
    return MeshError(
        f"{entry.source}: the mesh has changed since {entry.name} came into the library {library.path}; build it again "
        f"with `graspd library build {entry.source} --out {library.path}`, or put the old file back"
    )


# Where hand or object is nearer to something than this [m], a grasp is tried again.
NEAR = 0.03
# Deeper in something than this is no grasp [m]: the search itself allows as much.
_DEEP = 0.005

Wanted = Callable[[Sequence[Grasp]], Sequence[Grasp]]


def known_grasps(
    library: GraspLibrary,
    scene: Scene,
    hand: HandModel,
    *,
    count: int = 16,
    restrictions: Sequence[Restriction] = (),
    verify: str = "standard",
    wanted: Wanted = list,
    stop: StopHook | None = None,
) -> GraspResult:
    """Return at most `count` verified grasps that the library has of the scene's object, none for an unknown one.

    Args:
        library: from `GraspLibrary(path).checked()`.
        scene: known by its mesh, friction and mass, if that was given. Support and obstacles count.
        hand: known by its content.
        count: grasps wanted.
        restrictions: as of `plan_grasps`.
        verify: trials that they must have passed. Stricter ones are good too.
        wanted: chooses the stored grasps that may be given.
        stop: polled, true ends the trials.

    Raises:
        FormatError: the library is torn, of another version or not there.
        ConfigError: a number or a restriction is not valid.
    """
    began = time.perf_counter()
    check_request(count=count, seed=0, verify=verify, deadline=None, device="cpu")
    bound = BoundRestrictions(tuple(one.bind(scene, hand) for one in restrictions))
    entries = library.of_mesh(entry_of(scene.object, hand, verify), any_mass=scene.object.mass_assumed)
    stored = [grasp for entry in entries for grasp in library.grasps(entry, hand)]
    admitted, refused = bound.admit(tuple(wanted(stored)))
    good: list[Grasp] = []
    for grasp, reason in _held(scene, hand, admitted, verify, stop or (lambda: False)):
        if reason:
            refused[reason] += 1
            continue
        good.append(grasp)
        if len(good) == count:
            break
    told = restrictions_in_words(bound, refused, len(good), len(admitted)) if refused else ""
    result = library_result(library, good, count, time.perf_counter() - began)
    message = "; ".join(filter(None, (result.message, told)))
    return replace(result, message=message, refused=refused, warnings=(*scene.object.warnings, *hand.named_warnings))


def library_result(library: GraspLibrary, grasps: Sequence[Grasp], count: int, seconds: float) -> GraspResult:
    """Return grasps of a library as a result of `count` wanted, which took `seconds`."""
    timing = Timing(first_verified=seconds if grasps else None, total=seconds)
    told = f"{len(grasps)} grasps of the library {library.path.name}"
    return result_of(grasps, count, method="library", timing=timing, message=told)


def known_or_planned(
    library: GraspLibrary,
    scene: Scene,
    hand: HandModel,
    *,
    count: int = 16,
    seed: int = 0,
    preset: str | PlanConfig = "balanced",
    verify: str = "standard",
    restrictions: Sequence[Restriction] = (),
    wanted: Wanted = list,
    name: str = "",
    **request: Any,
) -> GraspResult:
    """Return grasps of the library, and plan the rest of `count`.

    The verified ones are added to the library. `wanted` chooses which grasps count, stored and planned ones. `name` is
    the object's name in the library. All else is as of `plan_grasps`. A library that cannot be written is a warning in
    the result.
    """
    began, deadline, stop = time.perf_counter(), request.pop("deadline", None), request.get("stop")
    left = lambda: None if deadline is None else deadline - (time.perf_counter() - began)  # noqa: E731
    over = lambda: (stop is not None and stop()) or (left() or 1.0) <= 0  # noqa: E731
    asked: dict[str, Any] = {"verify": verify, "restrictions": restrictions}
    known = known_grasps(library, scene, hand, count=count, wanted=wanted, stop=over, **asked)
    found = len(known.grasps)
    if found >= count:
        return known
    config = load_preset(preset) if isinstance(preset, str) else preset
    rest = None if deadline is None else max(left() or 0.0, 1e-3)
    # Another seed than that of the stored grasps, which would be found again.
    asked |= {"count": count - found, "seed": seed + found, "preset": config, "deadline": rest}
    planned = plan_grasps(scene, hand, **asked, **request)
    warnings = planned.warnings
    try:
        add_planned(library, scene, hand, config, planned, verify, name)
    except FormatError as error:
        warnings = (*warnings, f"{error}; what was planned is not kept")
    new = wanted([grasp for grasp in planned.tried if grasp.usable])
    outcome = planned.outcome
    if outcome in (Outcome.SUCCEEDED, Outcome.NO_CANDIDATES) and found + len(new):
        outcome = Outcome.SUCCEEDED if found + len(new) >= count else Outcome.TOO_FEW
    told = f"{found} grasps of the library {library.path.name}, {len(new)} planned"
    # A reason, not what the outcome of the plan alone says.
    why = planned.message if planned.message != planned.outcome.value else ""
    return replace(
        planned,
        outcome=outcome,
        tried=(*known.tried, *new, *(grasp for grasp in planned.tried if not grasp.usable)),
        count=count,
        message="; ".join(filter(None, (told, why))),
        warnings=warnings,
        refused=Counter(known.refused) + Counter(planned.refused),
    )


def add_planned(
    library: GraspLibrary,
    scene: Scene,
    hand: HandModel,
    config: PlanConfig,
    planned: GraspResult,
    verify: str,
    name: str = "",
) -> int:
    """Add the verified grasps of a run to the library, with the trial of the object alone.

    Returns their number. Raises FormatError: the library cannot be written.
    """
    if verify == "none":
        return 0
    alone = [
        replace(grasp, trials=tuple(trial for trial in grasp.trials if trial.name == "hold"))
        for grasp in planned.tried
        if grasp.verdict is Verdict.VERIFIED
    ]
    target = scene.object if planned.mass is None else scene.object.at_mass(planned.mass)
    return library.add(entry_of(target, hand, verify, name), target, hand, config, alone) if alone else 0


def _held(
    scene: Scene, hand: HandModel, grasps: Sequence[Grasp], verify: str, stop: StopHook
) -> Iterable[tuple[Grasp, str]]:
    """Yield each grasp, tried again if something stands near, and why it is refused, empty if it is not."""
    scene, far = near_scene(scene)
    near = [moved_grasp(grasp, -far) for grasp in grasps]
    gaps = clearance(scene, hand, near)
    vertices = torch.as_tensor(scene.object.mesh.vertices)
    if any(float(sample_sdf(o.sdf, vertices.to(o.sdf.field))[0].min()) < NEAR for o in scene.obstacles):
        gaps = np.minimum(gaps, NEAR / 2)
    # Those that need no trial come first.
    for index in np.argsort(gaps < NEAR, kind="stable"):
        grasp, gap = grasps[index], gaps[index]
        if gap < -_DEEP:
            yield grasp, "with a link in what stands about the object"
        elif gap >= NEAR:
            yield grasp, ""
        else:
            if stop():
                return
            worlds = trial_context(scene, hand, "standard" if verify == "none" else verify)
            tried = replace(grasp, trials=grasp_trials(worlds, near[index], stop))
            yield tried, "" if tried.verdict is Verdict.VERIFIED else "that did not hold beside what stands near"


def clearance(scene: Scene, hand: HandModel, grasps: Sequence[Grasp]) -> Float[np.ndarray, "grasps"]:
    """Return the least distance [m] of each hand to support and obstacles, retreat to squeeze, infinite without."""
    obstacles = make_obstacle_tensors(scene, hand, "cpu", torch.float64)
    if obstacles is None or not grasps:
        return np.full(len(grasps), np.inf)

    turns = _rows([grasp.grasp.quaternion_wxyz for grasp in grasps])

    def ends(stage: str) -> Poses:
        postures: list[Posture] = [getattr(grasp, stage) for grasp in grasps]
        return Poses(_rows([p.position for p in postures]), turns, _rows([p.joint_positions for p in postures]))

    kinematics = make_kinematics(hand, dtype=torch.float64)
    ways = [("pregrasp", "grasp"), ("grasp", "squeeze")]
    gaps = [gap_on_the_way(obstacles, kinematics, ends(a), ends(b), NEAR) for a, b in ways]
    return torch.stack(gaps).amin(0).numpy()


def _rows(values: Sequence[np.ndarray]) -> torch.Tensor:
    return torch.as_tensor(np.stack(values)).double()
