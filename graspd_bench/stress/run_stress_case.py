"""Runs of stress cases. A run records how the case ended, the time and memory it took, and the message to the user.

Every verified grasp must hold in a second trial. That trial reads the grasps from a saved grasps.json, reloads the
object and builds a new MuJoCo model.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from graspd_core.errors import GraspdError
from graspd_core.mesh.topology import far_centre
from graspd_core.perception.scene import ObjectModel, Scene, moved_grasp, moved_object, object_parts
from graspd_core.types import Grasp, GraspResult, TriangleMesh, Verdict
from graspd_dataset.run_records import peak_mb

Family = Literal["mesh", "cloud", "physics", "numbers", "hand"]

# The ending of a case with a verified grasp. `StressEnding` lists the other endings.
GRASP = "grasp"
# Planning may end later than its deadline by this time [s].
GRACE = 0.5


@dataclass(frozen=True, eq=False)
class Case:
    """One input with a deliberate fault.

    Attributes:
        name: unique name, words joined by dashes.
        family: kind of the faulty input.
        about: the fault, in one line.
        scene: makes the input in a given folder and loads it as a user would. It may raise a GraspdError.
        expect: valid endings: "grasp", names of `Outcome` ("TOO_FEW"), or classes of errors ("MeshError").
        whole: whether the input has a graspable object. Summaries give the fraction of such cases with a grasp.
        deadline: time limit of planning [s].
        loading: time limit of loading [s].
        memory: limit of the process's peak memory, including libraries [MB].
        options: further arguments of `plan_grasps`.
        message: text that the message to the user must contain.
        truth: returns the true mesh in the scene frame. None: grasps are not tried on a true object.
    """

    name: str
    family: Family
    about: str
    scene: Callable[[Path], Scene]
    expect: tuple[str, ...] = (GRASP,)
    whole: bool = True
    deadline: float = 20.0
    loading: float = 15.0
    memory: float = 2000.0
    options: dict[str, Any] = field(default_factory=dict)
    message: str = ""
    truth: Callable[[], TriangleMesh] | None = None


@dataclass(frozen=True)
class StressEnding:
    """Result of running a case.

    Attributes:
        case: name of the case.
        ending: "grasp", the name of an `Outcome`, the class of a GraspdError, "crash" or "hang".
        message: the message to the user.
        loading, planning: duration [s].
        memory: peak memory of the process [MB].
        tried: number of returned grasps.
        verified: number of verified grasps.
        again: number of verified grasps that hold in the second trial.
        finite: whether all postures are finite, and also all values of grasps that did not fail.
        true: number of verified grasps that hold on the true object. None if the case has no `truth`.
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
    """Return how an ending breaks the expectations and limits of its case, one line per fault. Empty without faults."""
    unexpected = f"ended in {ending.ending}, not in {' or '.join(case.expect)}: {ending.message}"
    lost, late = ending.verified - ending.again, ending.planning > case.deadline + GRACE
    wrong = {
        unexpected: ending.ending not in case.expect,
        f"planned {ending.planning:.1f} s at a deadline of {case.deadline} s": late,
        f"loaded for {ending.loading:.1f} s, longer than {case.loading} s": ending.loading > case.loading,
        f"used {ending.memory:.0f} MB, more than {case.memory:.0f} MB": ending.memory > case.memory,
        f"{lost} of {ending.verified} verified grasps fail a second trial": lost > 0,
        "a number of the result is not finite": not ending.finite,
        "the user gets no message": ending.ending != GRASP and not ending.message,
        f"the message lacks {case.message!r}": case.message not in ending.message,
    }
    return tuple(fault for fault, found in wrong.items() if found)


def run_case(case: Case, preset: str = "balanced") -> StressEnding:
    """Run a case in this process. Return its ending."""
    from graspd_core.hands.library import load_hand
    from graspd_core.planning.plan_grasps import plan_grasps

    hand = load_hand("allegro_right")
    with tempfile.TemporaryDirectory() as folder:
        began = loaded = time.perf_counter()
        try:
            scene = case.scene(Path(folder))
            loaded = time.perf_counter()
            options = {"count": 2, "deadline": case.deadline, "preset": preset} | case.options
            result = plan_grasps(scene, hand, **options)
        except GraspdError as error:
            message = str(error).replace(f"{folder}/", "")
            loading = (loaded if loaded > began else time.perf_counter()) - began
            return StressEnding(case.name, type(error).__name__, message, loading, memory=peak_mb())
        planned = time.perf_counter()
        verified = [grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED]
        return StressEnding(
            case.name,
            GRASP if verified else result.outcome.name,
            "; ".join((result.message, *result.warnings)).replace(f"{folder}/", ""),
            loaded - began,
            planned - loaded,
            peak_mb(),
            len(result.tried),
            len(verified),
            _hold_again(case, result, scene, hand, Path(folder), preset) if verified else 0,
            _finite(result),
            None if case.truth is None else _hold_truly(result, scene, hand, case.truth()),
        )


def _hold_again(case: Case, result: GraspResult, scene: Scene, hand: Any, folder: Path, preset: str) -> int:
    """Save the result, read it back, and reload the object. Return how many verified grasps pass a second trial."""
    from graspd_core.io.grasps_json import grasps_of, load_document, save_result
    from graspd_core.optimize.plan_config import load_preset
    from graspd_core.runtime import disk_cache as cache

    path = folder / "grasps.json"
    save_result(path, result, scene.object, hand, load_preset(preset))
    kept = grasps_of(load_document(path))
    cache.forget()
    return _held(kept, replace(case.scene(folder).object, mass=result.tried_mass), hand)


def _hold_truly(result: GraspResult, scene: Scene, hand: Any, truth: TriangleMesh) -> int:
    from graspd_core.perception.scene import build_scene

    true = build_scene(truth, source="truth", mass=result.tried_mass, friction=scene.object.friction)
    return _held(result.tried, true.object, hand)


def _held(grasps: Sequence[Grasp], target: ObjectModel, hand: Any) -> int:
    """Return how many verified grasps pass the hold trial on an object, in a new MuJoCo model."""
    from graspd_core.verify.hold_trial import hold_trial, out_of_place
    from graspd_core.verify.world import PROTOCOLS, at_friction, build_world

    protocol, far = at_friction(PROTOCOLS["standard"], target.friction), far_centre(target.mesh.vertices)
    target = moved_object(target, -far)
    world = build_world(hand, target, object_parts(target), protocol)
    protocol = out_of_place(protocol)
    verified = [moved_grasp(grasp, -far) for grasp in grasps if grasp.verdict is Verdict.VERIFIED]
    return sum(hold_trial(world, grasp, protocol).passed for grasp in verified)


def _finite(result: GraspResult) -> bool:
    """Return True if all postures are finite, and also all numbers in grasps that did not fail."""
    good = [asdict(grasp) for grasp in result.tried if grasp.verdict is not Verdict.FAILED]
    postures = [asdict(posture) for g in result.tried for posture in (g.pregrasp, g.grasp, g.squeeze)]
    try:
        json.dumps([good, postures], allow_nan=False, default=lambda numbers: numbers.tolist())
    except ValueError:
        return False
    return True
