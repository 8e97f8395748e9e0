"""`graspd bench cell`: bins emptied in simulated cells, and the true outcome of each attempt.

The picker knows only joint readings and depth images. The tables report the simulator's ground truth (the referee).
Before a bin is emptied, the study finds the objects that can be held. An object can be held if graspd finds a verified
grasp of its true mesh at its true mass in free space. Seeds up to `DEVELOPED_ON` were used to develop the picker.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from graspd_bench.study import Case, Record, Request, Sections, Study
from graspd_cell.grasp_source import InProcessGrasps, ReportingSource
from graspd_cell.picker import Attempt, Ending, Picker
from graspd_cell.referee import Report
from graspd_cell.simulated_robot import SETTLING, SimulatedRobot
from graspd_cell.things import Thing, ThingSource, family_sources, find_sources
from graspd_cell.world import pile_cell
from graspd_core.arms.arm import load_arm
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.hands.library import hand_hash, load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.shapes import source_hash
from graspd_core.perception.scene import build_scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Verdict
from graspd_dataset.run_records import markdown_table, peak_mb

PAIRS = ("ur5e_like+allegro_right", "panda_like+leap_right", "ur5e_like+parallel_gripper")
SIZES, MOST_THINGS = (1, 5, 10), 24
# No setting was chosen with seeds from `_FIRST_SEED` on.
DEVELOPED_ON, _FIRST_SEED = 245, 246
SEEDS = tuple(range(_FIRST_SEED, _FIRST_SEED + 4))
# Greatest number of attempts at a bin: `_TRIES_A_THING` for each object, plus `_MORE_TRIES`.
_TRIES_A_THING, _MORE_TRIES = 2, 3
# Upper bounds of the probability bands in the calibration table.
_BANDS = (0.5, 0.7, 0.85, 0.95, 1.01)


@dataclass(frozen=True)
class CellCase(Case):
    """One bin and one robot. The bin gets `size` objects of `things` or, if `things` is empty, random objects."""

    pair: str
    size: int
    seed: int
    preset: str
    things: tuple[tuple[str, float | None], ...] = ()

    @property
    def label(self) -> str:
        return f"{self.pair} {self.size} {self.seed} {self.preset} {'folder' if self.things else 'families'}"

    def inputs(self) -> Record:
        """Return all inputs except the code. Files of objects, arm and hand are given by hashes of their content."""
        arm, hand = self.pair.split("+")
        files = [source_hash(source) for source, mass in self.things if mass is not None]
        files += [hand_hash(hand)] if Path(hand).is_file() else []
        files += map(source_hash, (arm, load_arm(arm).chain.urdf)) if Path(arm).is_file() else ()
        return {**super().inputs(), **({"files": files} if files else {})}

    def sources(self) -> tuple[ThingSource, ...]:
        """Return the objects in the order in which they are dropped."""
        given = [ThingSource(*thing) for thing in self.things]
        rng, order = np.random.default_rng((self.seed, self.size)), list[ThingSource]()
        number = self.seed
        while len(order) < self.size:
            stock = given or list(family_sources((number,)))
            order += [stock[k] for k in rng.permutation(len(stock))]
            number += 1000
        return tuple(order[: self.size])


def cell_cases(request: Request) -> tuple[CellCase, ...]:
    """Return a case for each arm-hand pair, object count and seed. Raises ConfigError: a case or object is invalid."""
    pairs, sizes = list[str](), list[int]()
    for case in request.cases:
        if case.isdigit() and 1 <= int(case) <= MOST_THINGS:
            sizes.append(int(case))
        elif case.count("+") == 1:
            pairs.append(case)
        else:
            raise ConfigError(f"cases: {case!r}; valid: 1 to {MOST_THINGS} things, or a pair such as {PAIRS[0]}")
    things = tuple((source.source, source.mass) for source in find_sources(request.objects))
    sizes = sizes or ([1] if request.quick else list(SIZES))
    pairs = pairs or list(PAIRS[2:] if request.quick else PAIRS)
    seeds = request.seeds or (SEEDS[:1] if request.quick else SEEDS)
    return tuple(
        CellCase(pair, size, seed, request.preset(), things) for pair in pairs for size in sizes for seed in seeds
    )


def run_cell(case: CellCase) -> Record:
    """Empty one bin and return its record."""
    arm_name, hand_name = case.pair.split("+")
    arm, hand = load_arm(arm_name), load_hand(hand_name)
    world = pile_cell(arm, hand, case.sources(), case.seed)
    fits = {thing.name: can_be_held(hand, thing, case.preset) for thing in world.things}
    robot = SimulatedRobot(world, seed=case.seed)
    robot.wait(SETTLING)
    began = robot.referee()
    watch = AttemptWatch(robot)
    cpu: list[float] = []
    source = InProcessGrasps(arm, hand, world.layout, preset=case.preset, seed=case.seed)
    timed = ReportingSource(source, lambda view, offer: cpu.append(offer.cpu_seconds))
    picker = Picker(robot, timed, arm, hand, world.layout)
    most, error = _TRIES_A_THING * case.size + _MORE_TRIES, ""
    try:
        for attempt in picker.empty_the_bin(most):
            watch.note(attempt, cpu[-1])
            watch.about_to_look()
    except GraspdError as failure:
        error = str(failure)
    ended = robot.referee()
    return {
        "dropped": dict(began.places),
        "ended": dict(ended.places),
        "masses": {thing.name: round(thing.model.mass, 4) for thing in world.things},
        "fits": fits,
        "attempts": watch.records,
        "looks": len(cpu),
        "graspd_cpu": sum(cpu),
        "why_ended": error or picker.why_ended,
        "gave_up": bool(error),
        "simulated_s": round(robot.time, 2),
        "peak_mb": peak_mb(),
    }


def can_be_held(hand: HandModel, thing: Thing, preset: str) -> bool:
    """Return True if graspd finds a verified grasp of the object's true mesh at its true mass in free space."""
    scene = build_scene(thing.model.mesh, source=thing.name, mass=thing.model.mass)
    result = plan_grasps(scene, hand, count=1, seed=0, preset=preset, measure=False)
    return any(grasp.verdict is Verdict.VERIFIED for grasp in result.grasps)


class AttemptWatch:
    """Comparison of the picker's report of each attempt with the referee's ground truth.

    `records` has one JSON-ready record per attempt.
    """

    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot, self.records = robot, list[Record]()
        self.about_to_look()

    def about_to_look(self) -> None:
        """Store the true object poses before an attempt and reset the referee's peak forces."""
        self._before: Report = self._robot.referee()
        self._poses = self._robot.thing_poses()
        self._robot.clear_forces()

    def note(self, attempt: Attempt, cpu: float) -> Record:
        """Add and return the record of an attempt that has just ended. `cpu` is graspd's CPU time [s]."""
        now = self._robot.referee()
        moved = {name: place for name, place in now.places.items() if place != self._before.places[name]}
        target = self._target(attempt.place)
        out = [name for name, place in moved.items() if place == "place bin"]
        told = {key: value for key, value in asdict(attempt).items() if key != "place"}
        record = {
            **{key: round(value, 3) if isinstance(value, float) else value for key, value in told.items()},
            "ending": str(attempt.ending),
            "place": np.round(attempt.place, 4).tolist(),
            "target": target,
            "moved": moved,
            "out": out,
            "astray": [name for name, place in moved.items() if place in ("table", "lost")],
            "hard": now.hard(target, *out),
            "graspd_cpu": round(cpu, 3),
        }
        self.records.append(record)
        return record

    def _target(self, place: np.ndarray) -> str:
        """Return which object outside the place bin is nearest to `place`, base frame [m]. Return "" if none is left.

        An object that leans over the pick bin's wall is graspable, although its centre of mass is outside the bin.
        """
        world = self._robot.world
        surfaces = [
            (np.linalg.norm((thing.seen.vertices @ pose[:3, :3].T + pose[:3, 3]) - place, axis=1).min(), thing.name)
            for thing, pose in zip(world.things, self._poses, strict=True)
            if self._before.places[thing.name] != world.layout.place.name
        ]
        return min(surfaces)[1] if surfaces else ""


def executed(attempt: Record) -> bool:
    """Return True if the arm had a path to the object. Unreachable grasps say nothing about grasp quality."""
    return attempt["ending"] != str(Ending.NO_WAY)


def first_attempts(attempts: Sequence[Record]) -> list[Record]:
    """Return the first attempt at each object, as identified by the referee. Skip attempts without an object."""
    firsts: dict[str, Record] = {}
    for attempt in attempts:
        if attempt["target"]:
            firsts.setdefault(attempt["target"], attempt)
    return list(firsts.values())


_HEADINGS = [
    "arm and hand", "things", "in the bin", "can be held", "of those out", "all out", "astray", "attempts",
    "first attempts that succeeded", "hit something hard", "verified and executed", "of those in the other bin",
]  # fmt: skip


def cell_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return three tables (results, calibration of the probability, outcomes) and a line with median times."""
    groups: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        groups.setdefault((_stock(record), str(record["size"])), []).append(record)
    body = [_row(*key, own) for key, own in groups.items()]
    for stock in dict.fromkeys(map(_stock, records)):
        body.append(_row(stock, "all", [record for record in records if _stock(record) == stock]))
    parts = [markdown_table(_HEADINGS, body), _curve(records), _endings(records), _times(records)]
    return {"cell": [part for part in parts if part]}


def _stock(record: Record) -> str:
    """Return the label of a table row: the arm-hand pair, and `given things` if the user named the objects."""
    return f"{record['pair']}, given things" if record.get("things") else str(record["pair"])


def _row(pair: str, size: str, own: Sequence[Record]) -> list[str]:
    attempts = [attempt for record in own for attempt in record["attempts"]]
    there = [(r, name) for r in own for name, place in r["dropped"].items() if place == "pick bin"]
    fit = [(record, name) for record, name in there if record["fits"][name]]
    out = [record["ended"][name] == "place bin" for record, name in there]
    fit_out = [record["ended"][name] == "place bin" for record, name in fit]
    first = [attempt for record in own for attempt in first_attempts(record["attempts"])]
    sure = [attempt for attempt in attempts if attempt["verified"] and executed(attempt)]
    return [
        pair,
        size,
        str(len(there)),
        str(len(fit)),
        _share(fit_out),
        _share(out),
        str(sum(record["ended"][name] in ("table", "lost") for record, name in there)),
        str(len(attempts)),
        _share([bool(attempt["out"]) for attempt in first]),
        _share([bool(attempt["hard"]) for attempt in attempts]),
        str(len(sure)),
        _share([bool(attempt["out"]) for attempt in sure]),
    ]


def _share(flags: Sequence[bool]) -> str:
    return f"{sum(flags)} ({100 * sum(flags) / len(flags):.0f} %)" if flags else "–"


def _curve(records: Sequence[Record]) -> str:
    tried = [a for r in records for a in r["attempts"] if a["probability"] is not None and executed(a)]
    body, low = [], 0.0
    for high in _BANDS:
        own = [a for a in tried if low <= a["probability"] < high]
        if own:
            mean = sum(a["probability"] for a in own) / len(own)
            body.append(
                [f"{low:g} to {min(high, 1.0):g}", str(len(own)), f"{mean:.2f}", _share([bool(a["out"]) for a in own])]
            )
        low = high
    return markdown_table(["probability", "executed", "mean", "in the other bin"], body) if body else ""


def _endings(records: Sequence[Record]) -> str:
    attempts = [attempt for record in records for attempt in record["attempts"]]
    endings = Counter((attempt["ending"], bool(attempt["out"])) for attempt in attempts)
    body = [[ending, "yes" if out else "no", str(count)] for (ending, out), count in endings.most_common()]
    return markdown_table(["the picker says", "a thing is in the other bin", "attempts"], body)


def _times(records: Sequence[Record]) -> str:
    attempts = [attempt for record in records for attempt in record["attempts"] if attempt["closing_seconds"] > 0]
    if not attempts:
        return ""
    cpu, wall, closing, whole = (
        np.median([attempt[name] for attempt in attempts])
        for name in ("graspd_cpu", "graspd_seconds", "closing_seconds", "seconds")
    )
    told = f"from image to grasp {wall:.1f} s ({cpu:.1f} CPU s); from there to the closed hand {closing:.1f} s"
    return f"Medians: {told}; a whole attempt {whole:.1f} s of the robot's clock."


def cell_summary(record: Record) -> str:
    """Return a one-line summary: objects in the place bin and attempts."""
    there = [name for name, place in record["dropped"].items() if place == "pick bin"]
    out = sum(record["ended"][name] == "place bin" for name in there)
    return f"{out} of {len(there)} out in {len(record['attempts'])} attempts"


STUDY = Study(
    "bins emptied in simulated cells by three arms and hands, from depth images to the other bin",
    cell_cases, run_cell, cell_sections,
    ("../graspd_cell/*.py", "rendering/*.py"), ("presets", "objects", "cases", "seeds", "quick"),
    lambda case: 8.0 + 4.0 * case.size**2, summary=cell_summary, usual=False,
    # OMPL takes one seed per process. With earlier cases in the process, the motion planner draws other numbers.
    alone=True,
)  # fmt: skip
