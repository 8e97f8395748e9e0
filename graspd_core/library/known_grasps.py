"""Find stored grasps of a known object for the present scene. Missing grasps are planned and added to the library.

A name or a mesh file identifies the object. If the library lacks the object, the error lists valid names. A stored
grasp is refused if the hand would collide with support or obstacles. If the hand comes near to support or obstacles,
or hand or object come near to an obstacle in the lift, the grasp is simulated once more. Else its stored trials count.
"""

from __future__ import annotations

import difflib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.errors import ConfigError, FormatError, MeshError
from graspd_core.hands.kinematics import forward, make_kinematics, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import collision_spheres
from graspd_core.library.grasp_library import (
    GraspLibrary,
    LibraryEntry,
    absolute,
    entry_of,
    hand_hash,
    strict_enough,
    with_mass,
)
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import source_hash
from graspd_core.optimize.loop import Poses
from graspd_core.optimize.obstacle_distance import extreme_points, gap_on_path, make_obstacle_tensors
from graspd_core.optimize.plan_config import PlanConfig, load_preset
from graspd_core.optimize.restrictions import BoundRestrictions, Restriction, restrictions_in_words
from graspd_core.perception.scene import Scene, moved_grasp, near_scene
from graspd_core.planning.plan_grasps import SEEDS, check_request, plan_grasps
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Grasp, GraspResult, Outcome, StopHook, Timing, Verdict, stacked
from graspd_core.verify.lift_trial import LiftSettings
from graspd_core.verify.run_clock import outcome_of
from graspd_core.verify.trial_registry import grasp_trials
from graspd_core.verify.verification import trial_context

_MOST_NAMED = 8


@dataclass(frozen=True)
class Physics:
    """Conditions of trials: the object's mass [kg] (None if unknown), its friction, and the name of the trials."""

    mass: float | None
    friction: float
    verify: str = "standard"

    def __str__(self) -> str:
        mass = "unknown mass" if self.mass is None else f"{self.mass:g} kg"
        return f"{mass}, friction {self.friction:g}, {self.verify} trials"

    def of(self, entries: Iterable[LibraryEntry]) -> list[LibraryEntry]:
        """Return the entries with this mass and friction, heaviest first (`with_mass`)."""
        return with_mass((entry for entry in entries if entry.friction == self.friction), self.mass)


def entry_by_name(library: GraspLibrary, hand: HandModel | None, name: str, physics: Physics) -> LibraryEntry:
    """Return the entry of the object with this name, for this hand (None for any hand).

    The object gets mass and friction of the entry. If entries differ in mass or friction, `physics` selects the entry.
    An entry with less than the mass in `physics` is refused.

    Raises:
        ConfigError: the name is unknown, has no entry for this hand or physics, or several objects have this name.
        MeshError: the object's file has changed since the entry was made.
    """
    called = [entry for entry, _ in library.entries(name=name)]
    if not called:
        names = library.names()
        listed = (difflib.get_close_matches(name, names, _MOST_NAMED) or names)[:_MOST_NAMED]
        more = f" and {len(names) - len(listed)} more" if len(names) > len(listed) else ""
        valid = f"{', '.join(listed) or 'none'}{more}"
        raise ConfigError(f"{name[:128]!r} is not in the library {library.path}; it has {valid}")
    same = _with_hand(library, hand, called, name)
    if len({entry.mesh_sha256 for entry in same}) > 1:
        sources = ", ".join(sorted({entry.source for entry in same}))
        raise ConfigError(f"{name}: the library {library.path} has several such objects: {sources}; name a mesh file")
    there = [e for e in same if e.friction == physics.friction and physics.mass in (None, e.mass)]
    if not there and len({(entry.mass, entry.friction) for entry in same}) == 1:
        there = [entry for entry in same if entry.mass >= (physics.mass or 0.0)]
    heaviest_first = sorted(there, key=lambda entry: -entry.mass)
    entry = _held_entry(library, heaviest_first, same, name, physics)
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
    """Return the entry of a mesh file, or of shape:NAME, at a scale. None if there is none and `required` is False.

    Raises:
        ConfigError: the library has no entry of this content, scale, hand and physics.
        MeshError: the file cannot be read, or has changed since the entry was made.
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
        raise ConfigError(f"{path}: scale {scale:g} is not in the library {library.path}; valid: {scales}")
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
    made = f"for {', '.join(hands)}, not for {hand.name}" if hand.name not in hands else "for another form of this hand"
    raise ConfigError(f"{what}: the library {library.path} has it {made}; `graspd library build --hand` adds this hand")


def _held_entry(
    library: GraspLibrary, entries: Sequence[LibraryEntry], others: Sequence[LibraryEntry], what: str, physics: Physics
) -> LibraryEntry:
    enough = strict_enough(entries, physics.verify)
    if enough:
        return enough[0]
    had = ", ".join(sorted({str(Physics(e.mass, e.friction, e.verify)) for e in others}))
    raise ConfigError(f"{what}: the library {library.path} does not have it with {physics}; valid: {had}")


def _changed(library: GraspLibrary, entry: LibraryEntry) -> MeshError:
    return MeshError(
        f"{entry.source}: the mesh has changed since {entry.name} was added to the library {library.path}; build it "
        f"again with `graspd library build {entry.source} --out {library.path}`, or put the old file back"
    )


# A stored grasp is simulated once more if hand or object is nearer than this to an obstacle [m].
NEAR = 0.03
# A stored grasp is refused if the hand is deeper than this in an obstacle [m]. The search allows equal depth.
_DEEP = 0.005
# Fractions of the lift at which hand and object are checked, less than 2 · `NEAR` apart. Number of object points.
_LIFT_SHARES, _LIFTED_POINTS = (0.0, 0.25, 0.5, 0.75, 1.0), 1000

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
    """Return at most `count` verified grasps of the scene's object from the library, none for an unknown object.

    Args:
        library: library from `GraspLibrary(path).checked()`.
        scene: scene with the object. The object's mesh, friction and mass (unless assumed) identify the entry.
        hand: grasping hand. Its `hand_hash` identifies the entry. Its name does not.
        count: greatest number of grasps.
        restrictions: further conditions on grasps, as for `plan_grasps`.
        verify: name of the trials that the grasps must have passed. Stricter trials count too.
        wanted: function that filters the stored grasps.
        stop: stop hook. The trials end when it returns True.

    Raises:
        FormatError: the library is damaged, missing, or of another version.
        ConfigError: a number or a restriction is invalid.
    """
    began = time.perf_counter()
    check_request(count=count, seed=0, verify=verify, deadline=None, device="cpu")
    bound = BoundRestrictions(tuple(one.bind(scene, hand) for one in restrictions))
    entries = library.of_mesh(entry_of(scene.object, hand, verify))
    good, masses, refused = list[Grasp](), list[float](), Counter[str]()
    # Entries with strict trials and heavy objects come first, so that the others are used only if needed.
    for entry in entries:
        admitted, more = bound.admit(tuple(wanted(library.grasps(entry, hand))))
        refused.update(more)
        # The object has the entry's mass in all trials, so that the result's `tried_mass` is true.
        mass = entry.mass
        about = scene if mass == scene.object.mass else replace(scene, object=scene.object.at_mass(mass))
        for grasp, reason in _held(about, hand, admitted, verify, stop or (lambda: False)):
            if reason:
                refused[reason] += 1
                continue
            good.append(grasp)
            masses.append(entry.mass)
            if len(good) == count:
                break
        if len(good) == count:
            break
    refusals = restrictions_in_words(bound, refused, len(good), 0) if refused else ""
    result = library_result(library, good, count, time.perf_counter() - began)
    tried = _least_mass(scene, masses)
    lighter = f"tried at {tried['mass']:.2g} kg" if tried["mass"] else ""
    message = "; ".join(filter(None, (result.message, lighter, refusals)))
    warnings = (*scene.object.warnings, *hand.named_warnings)
    return replace(result, message=message, refused=refused, warnings=warnings, support=scene.support, **tried)


def _least_mass(scene: Scene, masses: Sequence[float]) -> dict[str, float | None]:
    """Return the fields `mass` and `tried_mass` of a result whose grasps were simulated with these `masses` [kg]."""
    least = min(masses, default=None)
    return {"tried_mass": least, "mass": least if least is not None and least < scene.object.mass else None}


def library_result(library: GraspLibrary, grasps: Sequence[Grasp], count: int, seconds: float) -> GraspResult:
    """Return the result of a request for `count` grasps, answered with `grasps` of a library in `seconds` [s]."""
    timing = Timing(first_verified=seconds if grasps else None, total=seconds)
    message = f"{len(grasps)} grasps from the library {library.path.name}"
    return GraspResult(outcome_of(grasps, count), tuple(grasps), timing, 0, "library", message, count=count)


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
    """Return grasps from the library. If there are fewer than `count`, plan more.

    Planned grasps that are verified are added to the library. `wanted` filters both stored and planned grasps. `name`
    is the object's name in the library. Other arguments: see `plan_grasps`. Unwritable libraries cause a warning.
    """
    began, deadline, stop = time.perf_counter(), request.pop("deadline", None), request.get("stop")
    check_request(count=count, seed=seed, verify=verify, deadline=deadline, device=request.get("device", "cpu"))
    left = lambda: None if deadline is None else deadline - (time.perf_counter() - began)  # noqa: E731
    over = lambda: (stop is not None and stop()) or (left() or 1.0) <= 0  # noqa: E731
    options: dict[str, Any] = {"verify": verify, "restrictions": restrictions}
    known = known_grasps(library, scene, hand, count=count, wanted=wanted, stop=over, **options)
    found = len(known.grasps)
    if found >= count:
        return known
    config = load_preset(preset) if isinstance(preset, str) else preset
    rest = None if deadline is None else max(left() or 0.0, 1e-3)
    # The seed that found the stored grasps would find them again, so use another seed.
    options |= {"count": count - found, "seed": (seed + found) % SEEDS, "preset": config, "deadline": rest}
    planned = plan_grasps(scene, hand, **options, **request)
    warnings = planned.warnings
    try:
        add_planned(library, scene, hand, config, planned, verify, name)
    except FormatError as error:
        warnings = (*warnings, f"{error}; the grasps are not stored")
    new = wanted([grasp for grasp in planned.tried if grasp.usable])
    outcome = planned.outcome
    if outcome in (Outcome.SUCCEEDED, Outcome.NO_CANDIDATES) and found + len(new):
        outcome = Outcome.SUCCEEDED if found + len(new) >= count else Outcome.TOO_FEW
    counts = f"{found} grasps from the library {library.path.name}, and {len(new)} newly planned"
    # Use the planner's message only if it says more than the outcome.
    why = planned.message if planned.message != planned.outcome.value else ""
    return replace(
        planned,
        outcome=outcome,
        tried=(*known.tried, *new, *(grasp for grasp in planned.tried if not grasp.usable)),
        count=count,
        message="; ".join(filter(None, (counts, why))),
        warnings=warnings,
        refused=Counter(known.refused) + Counter(planned.refused),
        **_least_mass(scene, [mass for mass in (known.tried_mass, planned.tried_mass) if mass is not None]),
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
    """Add the verified grasps of a run to the library. Of their trials, keep only the hold trials.

    Return how many grasps the object has then. Raises FormatError: the library cannot be written.
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
    """Yield each grasp and why it is refused, or "". Simulate grasps near support or obstacles once more."""
    scene, far = near_scene(scene)
    near = [moved_grasp(grasp, -far) for grasp in grasps]
    gaps = clearance(scene, hand, near)
    gaps = np.where(lift_clearance(scene, hand, near) < NEAR, np.minimum(gaps, NEAR / 2), gaps)
    # Grasps that need no trial come first.
    for index in np.argsort(gaps < NEAR, kind="stable"):
        grasp, gap = grasps[index], gaps[index]
        if gap < -_DEEP:
            yield grasp, "with a link inside the support or an obstacle"
        elif gap >= NEAR:
            yield grasp, ""
        else:
            if stop():
                return
            worlds = trial_context(scene, hand, "standard" if verify == "none" else verify)
            tried = replace(grasp, trials=grasp_trials(worlds, near[index], stop))
            if tried.verdict is not Verdict.VERIFIED and stop():
                # An interrupted trial says nothing about the grasp.
                return
            yield tried, "" if tried.verdict is Verdict.VERIFIED else "that failed near the support or an obstacle"


def clearance(scene: Scene, hand: HandModel, grasps: Sequence[Grasp]) -> Float[np.ndarray, "grasps"]:
    """Return the hand's least distance to support and obstacles from retreat to squeeze [m]. Infinite without any."""
    obstacles = make_obstacle_tensors(scene, hand, "cpu", torch.float64)
    if obstacles is None or not grasps:
        return np.full(len(grasps), np.inf)
    before, there, after = (
        Poses(*map(torch.as_tensor, stacked(postures)))
        for postures in zip(*((grasp.pregrasp, grasp.grasp, grasp.squeeze) for grasp in grasps), strict=True)
    )
    # The base keeps the rotation of the grasp.
    before, after = (replace(poses, quaternion=there.quaternion) for poses in (before, after))
    kinematics = make_kinematics(hand, dtype=torch.float64)
    gaps = [gap_on_path(obstacles, kinematics, a, b, NEAR) for a, b in pairwise((before, there, after))]
    return torch.stack(gaps).amin(0).numpy()


def lift_clearance(scene: Scene, hand: HandModel, grasps: Sequence[Grasp]) -> Float[np.ndarray, "grasps"]:
    """Return the least distance of hand and object to obstacles from squeeze to lift [m]. Infinite without any."""
    least = torch.full((len(grasps),), torch.inf, dtype=torch.float64)
    if not scene.obstacles or not grasps:
        return least.numpy()
    balls = (np.concatenate(pair) for pair in zip(extreme_points(hand), collision_spheres(hand), strict=True))
    # Each has centres, radii and links.
    centers, radii, links = map(torch.as_tensor, balls)
    positions, quaternions, joints = map(torch.as_tensor, stacked([grasp.squeeze for grasp in grasps]))
    rotation = rotation_from_quaternion(quaternions)
    poses = forward(make_kinematics(hand, dtype=torch.float64), joints)
    fingers = SE3(rotation, positions).apply(place_points(placement(hand.num_links, centers, links), poses))
    target = torch.as_tensor(surface_samples(scene.object.mesh, _LIFTED_POINTS, 0)[0])
    # Without a support the hand moves back against the approach, as in the lift trial.
    back = -(rotation @ torch.as_tensor(hand.approach))
    up = back if scene.support is None else torch.as_tensor(scene.support.normal).expand_as(back)
    for sdf in (obstacle.sdf.to("cpu", torch.float64) for obstacle in scene.obstacles):
        for shift in (share * LiftSettings.lift_height * up[:, None] for share in _LIFT_SHARES):
            hands = (sample_sdf(sdf, fingers + shift)[0] - radii).amin(-1)
            least = torch.minimum(least, torch.minimum(hands, sample_sdf(sdf, target + shift)[0].amin(-1)))
    return least.numpy()
