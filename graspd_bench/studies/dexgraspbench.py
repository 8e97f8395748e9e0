"""Study `dexgraspbench`: our grasps in DexGraspBench's own evaluation, compared with our hold trial.

    graspd bench dexgraspbench FOLDER --python ENVIRONMENT/bin/python

FOLDER is the user's checkout of DexGraspBench with its git submodule. ENVIRONMENT is a Python environment with
DexGraspBench's requirements. The checkout runs in a child process and is never imported. It reads our grasps, our
objects and a changed Allegro (`--armature`) from a temporary folder. `inert_pickle` reads results without running code.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.study import ObjectCase, Record, Request, Sections, all_shapes, find_objects
from graspd_core.errors import ConfigError, FormatError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.io.grasps_json import grasps_of, load_document
from graspd_core.mesh.topology import moved_mesh
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import Scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Grasp, Verdict
from graspd_core.verify.world import Protocol
from graspd_dataset.export_grasps import refuse_hand, write_dexgraspbench
from graspd_dataset.foreign_grasps import STAGES, npy_dictionary, numbers_of, plain_entry
from graspd_dataset.run_records import markdown_table, object_name

NAME = "dexgraspbench"
# DexGraspBench's object mass [kg], and its limits of displacement [m] and rotation [deg].
MASS, _TRAVEL, _TURN = 0.1, 0.05, 15.0
# Files of a checkout: the program, the MJCF of its Allegro, and all files that a result depends on.
_MAIN, _ALLEGRO = "src/main.py", "assets/hand/allegro/right_hand.xml"
_HASHED = ("src/**/*.py", "config/**/*.yaml", _ALLEGRO)
# Time limits of DexGraspBench [s]: for its start, and for each grasp.
_START, _GRASP = 120.0, 60.0
AS_IS, ARMATURE = "as it is", f"armature {Protocol().armature:g}"
DIFFERENCES = f"""\
Known differences between DexGraspBench and our hold trial:

- Joints of DexGraspBench's Allegro have no armature, ours {Protocol().armature:g} kg·m². Its links weigh 800 kg/m³.
  With steps of 4 ms, such light links cause half of the difference: 76 % hold, but 85 % at 2 ms (80 grasps).
- DexGraspBench averages the contact stiffness and softness of hand and object. We use those of the hand.
- In DexGraspBench a weld holds the hand's base. A weld is not rigid.
- In DexGraspBench no joint has an effort limit.
- In DexGraspBench targets move in ten jumps per stage, with 40 ms after each. Our targets move with every step.
- DexGraspBench refuses a pregrasp with an overlap above 1 cm. We refuse links that overlap by 2 mm, and deep grasps.
- In DexGraspBench the hand closes anew for each of the six pulls. Our hand closes once.
- DexGraspBench checks its limits ({_TRAVEL * 100:g} cm, {_TURN:g}°) every 0.2 s of a pull, not during closing.

In both, the object weighs {MASS:g} kg and has friction 0.6. The origin of DexGraspBench's object is the centre of mass,
whose displacement our trial measures."""


@dataclass(frozen=True)
class BenchCase(ObjectCase):
    """Evaluation of the grasps of one object.

    Attributes:
        checkout: folder of DexGraspBench.
        python: Python program that runs DexGraspBench.
        armature: whether to try the grasps a second time, with our joint armature in DexGraspBench's Allegro.
        grasps: file of our grasps. If empty, they are planned.
        content: hash of the checkout's code and of the file of grasps.
    """

    checkout: str
    python: str
    armature: bool
    grasps: str
    content: str

    @property
    def label(self) -> str:
        return f"{object_name(self.object)} {self.preset} {object_name(self.hand)} seed {self.seed} {self.armature:d}"

    def inputs(self) -> Record:
        """Return all inputs except the code. Files count by their content, not by their path."""
        return {name: value for name, value in super().inputs().items() if name not in ("checkout", "python", "grasps")}


def bench_cases(request: Request) -> tuple[BenchCase, ...]:
    """Return a case for each object and seed.

    Raises GraspdError: there is no checkout, DexGraspBench does not start, or the request has an unknown name.
    """
    if not request.checkout:
        raise ConfigError(f"{NAME}: give the folder of a checkout: graspd bench {NAME} FOLDER --python PATH")
    checkout, hand = Path(request.checkout).absolute(), request.hand or "allegro_right"
    for name in (_MAIN, _ALLEGRO):
        if not (checkout / name).is_file():
            raise ConfigError(f"{request.checkout}: not a checkout of DexGraspBench: {name} is missing")
    refuse_hand(load_hand(hand, candidates=1).name)
    python = shutil.which(request.python) if request.python else None
    if python is None:
        fault = f"{request.python!r} is not a program" if request.python else "not given"
        raise ConfigError(f"python: {fault}; give --python PATH of an environment with DexGraspBench's requirements")
    python = os.path.abspath(python)
    objects = request.objects or all_shapes()[: 1 if request.quick else None]
    if request.grasps:
        document = load_document(request.grasps)
        objects = request.objects or (str(document["object"]["source"]),)
        refuse_hand(document["hand"]["name"])
        if len(objects) > 1:
            raise ConfigError(f"grasps: {request.grasps} has grasps of one object; give one object, not {len(objects)}")
    _run([python, str(checkout / _MAIN), "--help"], Path(), _START)
    files = sorted(path for glob in _HASHED for path in checkout.glob(glob) if path.is_file())
    files += [Path(request.grasps)] if request.grasps else []
    content = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    count = request.count or (2 if request.quick else 8)
    where = {"checkout": str(checkout), "python": python, "armature": request.armature}
    return tuple(
        BenchCase(source, request.preset(), hand, seed, count, grasps=request.grasps, content=content, **where)
        for seed in request.seeds or (0,)
        for source in find_objects(objects)
    )


def run_bench(case: BenchCase) -> Record:
    """Plan or read grasps, and run DexGraspBench on all of them. Return our verdicts and DexGraspBench's results."""
    config = case.config
    hand = load_hand(case.hand, candidates=config.problem.fine_candidates)
    if case.grasps:
        document = load_document(case.grasps)
        scene = load_scene(case.object, mass=MASS, scale=float(document["object"].get("scale", 1.0)))
        grasps = grasps_of(document, case.grasps)
    else:
        scene = load_scene(case.object, mass=MASS, resolution=config.resolution)
        grasps = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=config, measure=False).tried
    ours = [{"verified": grasp.verdict is Verdict.VERIFIED, "reason": grasp.reason} for grasp in grasps]
    with tempfile.TemporaryDirectory(prefix="graspd-bench-") as folder:
        written = Path(folder) / "written"
        paths = write_grasps(scene, hand, grasps, written)
        theirs: dict[str, list[Record]] = {}
        for variant in (AS_IS, ARMATURE)[: 1 + case.armature] if grasps else ():
            xml = Path(case.checkout, _ALLEGRO)
            if variant == ARMATURE:
                xml = write_armature(xml, Path(folder) / "right_hand.xml", Protocol().armature)
            theirs[variant] = evaluate(case, written, xml, paths)
    return {"ours": ours, "theirs": theirs, "held": sum(own["verified"] for own in ours)}


def write_grasps(scene: Scene, hand: HandModel, grasps: Sequence[Grasp], out: Path) -> list[Path]:
    """Write grasps and object for DexGraspBench, with the centre of mass as origin. Return paths relative to `out`."""
    center, rows = scene.object.center_of_mass, []
    for grasp in grasps:
        row: dict[str, Any] = {"hand_name": hand.name, "object_sha256": scene.object.sha256, "mass": scene.object.mass}
        for stage in STAGES:
            posture = getattr(grasp, stage)
            row[f"{stage}_position"] = posture.position - center
            row[f"{stage}_quaternion_wxyz"] = posture.quaternion_wxyz
            row[f"{stage}_joint_positions"] = posture.joint_positions
        rows.append(row)
    if rows:
        # DexGraspBench reads relative paths from its own folder, so the path of the objects is absolute.
        write_dexgraspbench(rows, moved_mesh(scene.object.mesh, -center), out, objects=str(out.absolute() / "objects"))
    return [Path(hand.name, scene.object.sha256, f"{number}.npy") for number in range(len(rows))]


def write_armature(xml: Path, to: Path, armature: float) -> Path:
    """Write to `to` a copy of a hand's MJCF with `armature` [kg·m²] at all joints and the same meshes. Return `to`."""
    tree = ElementTree.parse(xml)
    for compiler in tree.iter("compiler"):
        compiler.set("meshdir", str((xml.parent / compiler.get("meshdir", ".")).resolve()))
    for body in tree.iter("worldbody"):
        for joint in body.iter("joint"):
            joint.set("armature", f"{armature:g}")
    tree.write(to)
    return to


def evaluate(case: BenchCase, written: Path, xml: Path, paths: Sequence[Path]) -> list[Record]:
    """Run DexGraspBench on the files `paths` in `written`. Return `held`, `travel` [m], `turn` [deg] of each grasp.

    `xml` is the hand's MJCF. Raises ConfigError: DexGraspBench ended with an error, or gave no result for a grasp.
    """
    results = Path(tempfile.mkdtemp(dir=written.parent))
    options = {"task": "eval", "hand": "allegro", "setting": "fc", "exp_name": "graspd", "n_worker": "1"}
    options |= {"task.max_num": "-1", "task.analytic_fc_metrics": "null", "task.obj_mass": f"{MASS:g}"}
    places = {"save_root": results, "grasp_dir": written, "eval_dir": results / "evaluation", "hand.xml_path": xml}
    options |= {name: "'" + str(path).replace("'", "\\'") + "'" for name, path in places.items()}
    command = [case.python, str(Path(case.checkout, _MAIN)), *(f"{name}={value}" for name, value in options.items())]
    output = _run(command, results, _START + _GRASP * len(paths))
    found = []
    for path in paths:
        file = results / "evaluation" / path
        if not file.is_file():
            raise ConfigError(f"DexGraspBench gave no result for grasp {path}: {output}")
        try:
            values = npy_dictionary(file, file.read_bytes())
            held, travel, turn = (
                float(numbers_of(plain_entry(values, key, file), (), f"{file}: {key}"))
                for key in ("succ_flag", "delta_pos", "delta_angle")
            )
        except FormatError as error:
            raise ConfigError(f"DexGraspBench gave a result that cannot be read: {error}") from None
        found.append({"held": bool(held), "travel": travel, "turn": turn})
    return found


def _run(command: Sequence[str], folder: Path, patience: float) -> str:
    """Run a command for up to `patience` [s]. Return the last line of its output. Raises ConfigError: it failed."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env={**kept, "PYTHONDONTWRITEBYTECODE": "1"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=patience,
        )
    except OSError as error:
        raise ConfigError(f"python: {command[0]}: {error.strerror or error}") from None
    except subprocess.TimeoutExpired:
        raise ConfigError(f"DexGraspBench did not end within {patience:.0f} s") from None
    lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    last = lines[-1][:300] if lines else "it wrote nothing"
    if done.returncode:
        raise ConfigError(f"DexGraspBench ended with an error: {last} (exit status {done.returncode}, {command[0]})")
    return last


def why_failed(there: Record) -> str:
    """Return in a few words why a grasp did not hold in DexGraspBench. `there` is DexGraspBench's result."""
    # DexGraspBench reports a refused pregrasp by values of 100 or more.
    if there["travel"] >= 100 and there["turn"] >= 100:
        return "refused: the pregrasp overlaps the object, or the hand itself, by more than 1 cm"
    if not np.isfinite([there["travel"], there["turn"]]).all():
        return "the simulation diverged"
    if there["travel"] >= _TRAVEL:
        return f"the object moved more than {_TRAVEL * 100:g} cm"
    return f"the object turned more than {_TURN:g}°"


def bench_summary(record: Record) -> str:
    """Return a text: how many of our verified grasps hold in DexGraspBench."""
    pairs = [pair for pair in _pairs([record], AS_IS) if pair[0]]
    return f"{sum(there['held'] for _, there in pairs)} of {len(pairs)} verified grasps hold in DexGraspBench"


def _pairs(records: Sequence[Record], variant: str) -> list[tuple[bool, Record]]:
    """Return for every grasp our verdict (True: verified), and DexGraspBench's result with a variant of the hand."""
    return [
        (own["verified"], there)
        for record in records
        if variant in record["theirs"]
        for own, there in zip(record["ours"], record["theirs"][variant], strict=True)
    ]


def bench_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table of grasps held, by object and Allegro variant. Add failure reasons and known differences."""
    headings = ["object", "its Allegro", "tried", "verified", "held by both", "by ours only", "by theirs only"]
    headings += ["by neither", "of the verified"]
    groups = [(object_name(record["object"]), [record]) for record in records]
    groups += [("**all**", list(records))] if len(records) > 1 else []
    variants = [name for name in (AS_IS, ARMATURE) if any(name in record["theirs"] for record in records)]
    body, reasons = [], []
    for name, some in groups:
        for variant in variants:
            cells = Counter((verified, there["held"]) for verified, there in _pairs(some, variant))
            both, alone = cells[True, True], cells[True, False]
            share = f"{both / (both + alone):.0%}" if both + alone else "–"
            numbers = [cells.total(), both + alone, both, alone, cells[False, True], cells[False, False]]
            body.append([name, variant, *map(str, numbers), share])
    for variant in variants:
        lost = [there for verified, there in _pairs(records, variant) if verified and not there["held"]]
        counts = "; ".join(f"{count}: {why}" for why, count in Counter(map(why_failed, lost)).most_common())
        reasons.append(f"Failed only there, {variant}: {counts or 'none'}.")
    return {NAME: [markdown_table(headings, body), "\n".join(reasons), DIFFERENCES]}
