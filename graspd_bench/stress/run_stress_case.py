"""Stress cases and how they end: the outcome, how long it took, how much memory, what the user saw.

A grasp counts as verified only if it holds in a second trial too. That one starts from the file that a user would keep,
with the object loaded anew and a world built anew.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from graspd_core.errors import GraspdError
from graspd_core.mesh.topology import far_centre
from graspd_core.perception.scene import ObjectModel, Scene, moved_grasp, moved_object, object_parts
from graspd_core.types import Grasp, GraspResult, TriangleMesh, Verdict
from graspd_dataset.run_records import peak_mb

Family = Literal["mesh", "cloud", "physics", "numbers", "hand"]

# An ending that is a verified grasp. The others are names of `Outcome` or of a `GraspdError`.
GRASP = "grasp"
# What a deadline may be overrun by [s].
GRACE = 0.5


@dataclass(frozen=True, eq=False)
class Case:
    """One input that breaks methods.

    Attributes:
        name: unique, words joined by dashes.
        family: what of it is broken.
        about: what is wrong, one line.
        scene: makes the input in a folder of its own and loads it as a user would. It may raise a GraspdError.
        expect: the endings that are right: "grasp", names of `Outcome` ("TOO_FEW") or of an error ("MeshError").
        whole: a meaningful solid, or an object that can be seen. Counted in the share that ends in a verified grasp.
        hand: by name or path.
        deadline: seconds that planning is given.
        loading: seconds that loading may take.
        memory: most that the process may use at its peak, the libraries' own included [MB].
        options: further arguments of `plan_grasps`.
        told: words that the user must read.
        truth: the true object, in the scene's frame, where the scene is only what cameras saw of it.
    """

    name: str
    family: Family
    about: str
    scene: Callable[[Path], Scene]
    expect: tuple[str, ...] = (GRASP,)
    whole: bool = True
    hand: str = "allegro_right"
    deadline: float = 20.0
    loading: float = 15.0
    memory: float = 2000.0
    options: dict[str, Any] = field(default_factory=dict)
    told: str = ""
    truth: Callable[[], TriangleMesh] | None = None


@dataclass(frozen=True)
class StressEnding:
    """The end of a case.

    Attributes:
        case: its name.
        ending: "grasp", the name of an `Outcome` or of a GraspdError, or "crash" or "hang" where it was none of these.
        message: what the user saw.
        loading, planning: seconds.
        memory: peak of the process [MB].
        tried: grasps that were tried.
        verified: how many of them held.
        again: how many of those held in the second trial.
        finite: no number of the result is NaN or infinite.
        true: how many verified grasps hold on the true object. None where the case knows no truth.
    """

    case: str
    ending: str
    message: str
    loading: float = 0.0
    planning: float = 0.0
    memory: float = 0.0
    tried: int = 0
    verified: int = 0
    again: int = 0
    finite: bool = True
    true: int | None = None


def faults(case: Case, ending: StressEnding) -> tuple[str, ...]:
    """Return what is wrong with an ending, one line each, none where all is well."""
    wrong = []
    if ending.ending not in case.expect:
        wrong.append(f"ended in {ending.ending}, not in {' or '.join(case.expect)}: {ending.message}")
    if ending.planning > case.deadline + GRACE:
        wrong.append(f"planned {ending.planning:.1f} s at a deadline of {case.deadline} s")
    if ending.loading > case.loading:
        wrong.append(f"loaded for {ending.loading:.1f} s, longer than {case.loading} s")
    if ending.memory > case.memory:
        wrong.append(f"used {ending.memory:.0f} MB, more than {case.memory:.0f} MB")
    if ending.again < ending.verified:
        wrong.append(f"{ending.verified - ending.again} of {ending.verified} verified grasps fail a second trial")
    if not ending.finite:
        wrong.append("a number of the result is not finite")
    if ending.ending != GRASP and not ending.message:
        wrong.append("the user is told nothing")
    if case.told not in ending.message:
        wrong.append(f"the user does not read {case.told!r}")
    return tuple(wrong)


def run_case(case: Case, preset: str = "balanced") -> StressEnding:
    """Run a case in this process."""
    from graspd_core.hands.library import load_hand
    from graspd_core.planning.plan_grasps import plan_grasps

    hand = load_hand(case.hand)
    with tempfile.TemporaryDirectory() as folder:
        began = loaded = time.perf_counter()
        try:
            scene = case.scene(Path(folder))
            loaded = time.perf_counter()
            options = {"count": 2, "deadline": case.deadline, "preset": preset} | case.options
            result = plan_grasps(scene, hand, **options)
        except GraspdError as error:
            told = str(error).replace(f"{folder}/", "")
            loading = (loaded if loaded > began else time.perf_counter()) - began
            return StressEnding(case.name, type(error).__name__, told, loading, memory=peak_mb())
        planned = time.perf_counter()
        verified = [grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED]
        return StressEnding(
            case.name,
            GRASP if verified else result.outcome.name,
            _told(result, folder),
            loaded - began,
            planned - loaded,
            peak_mb(),
            len(result.tried),
            len(verified),
            _hold_again(case, result, scene, hand, Path(folder), preset) if verified else 0,
            _finite(result),
            None if case.truth is None else _hold_truly(verified, scene, hand, case.truth()),
        )


def _told(result: GraspResult, folder: str) -> str:
    told = (result.outcome.value, result.message, *result.warnings)
    return "; ".join(filter(None, told)).replace(f"{folder}/", "")


def _hold_again(case: Case, result: GraspResult, scene: Scene, hand: Any, folder: Path, preset: str) -> int:
    """Return how many verified grasps hold again, read from a file, on the object loaded and cut into parts anew."""
    from graspd_core.io.grasps_json import grasps_of, load_document, save_result
    from graspd_core.optimize.plan_config import load_preset
    from graspd_core.runtime import disk_cache as cache

    path = folder / "grasps.json"
    save_result(path, result, scene.object, hand, load_preset(preset))
    kept = grasps_of(load_document(path))
    cache.forget()
    verified = [grasp for grasp in kept if grasp.verdict is Verdict.VERIFIED]
    return _held(verified, case.scene(folder).object, hand)


def _hold_truly(verified: Sequence[Grasp], scene: Scene, hand: Any, truth: TriangleMesh) -> int:
    from graspd_core.perception.scene import build_scene

    true = build_scene(truth, source="truth", mass=scene.object.mass, friction=scene.object.friction)
    return _held(verified, true.object, hand)


def _held(grasps: Sequence[Grasp], target: ObjectModel, hand: Any) -> int:
    """Return how many grasps pass the hold trial on an object, in a world of its own."""
    from graspd_core.verify.hold_trial import hold_trial, out_of_place
    from graspd_core.verify.world import PROTOCOLS, at_friction, build_world

    protocol, far = at_friction(PROTOCOLS["standard"], target.friction), far_centre(target.mesh.vertices)
    target = moved_object(target, -far)
    world = build_world(hand, target, object_parts(target), protocol)
    protocol = out_of_place(protocol)
    return sum(hold_trial(world, moved_grasp(grasp, -far), protocol).passed for grasp in grasps)


def _finite(result: GraspResult) -> bool:
    """Return whether every number of every grasp that did not fail is finite. A trial that diverged may say so."""
    good = [asdict(grasp) for grasp in result.tried if grasp.verdict is not Verdict.FAILED]
    postures = [asdict(posture) for g in result.tried for posture in (g.pregrasp, g.grasp, g.squeeze)]
    try:
        json.dumps([good, postures], allow_nan=False, default=lambda numbers: numbers.tolist())
    except ValueError:
        return False
    return True
